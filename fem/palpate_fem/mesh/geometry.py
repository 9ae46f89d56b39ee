"""A fingertip as the solver sees it: the skin's mesh and the rigid core inside."""

from __future__ import annotations

from dataclasses import dataclass

from palpate.errors import ConfigError
from palpate_fem.mesh.core import Core
from palpate_fem.mesh.solid import SolidMesh

# What the builders take. Thinner skins than these lose their meaning, thicker ones fold at the
# proximal edge; finer meshes are beyond a direct solver, coarser ones miss the shape.
LIMITS = {"thickness_m": (0.5e-3, 3.0e-3), "edge_m": (0.25e-3, 1.5e-3), "layers": (1, 6)}


@dataclass(frozen=True)
class Geometry:
    """Skin and core, both in the sensor frame [m], unpressurised and not in contact."""

    mesh: SolidMesh
    core: Core


def check_limits(**arguments: float) -> None:
    """Refuse arguments of a builder that are not finite or out of `LIMITS`.

    Raises:
        ConfigError: Names the argument and its limits.
    """
    for name, value in arguments.items():
        low, high = LIMITS[name]
        if not low <= value <= high:
            raise ConfigError(
                f"{name} = {value} is not within [{low:g}, {high:g}]",
                remedy="give lengths in metres, within these limits",
            )
