"""A store of simulations as the viewer draws it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.files.hdf5 import text
from palpate.files.simulation_store import SimulationFiles

_FIELDS = ("displacement", "indenter_force", "core_force")

Floats = npt.NDArray[np.floating[Any]]
Ints = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class DrawnFingertip:
    """The pressurised, untouched fingertip.

    Attributes:
        nodes: Positions [m], shape (V, 3), sensor frame.
        outer: Triangles of the outer surface, shape (T, 3), outward.
        inner: Triangles of the inner surface, shape (T, 3), away from the skin's solid.
        core_vertices: The core's surface [m], shape (C, 3).
        core_faces: Its triangles.
        facts: What to say of it, by name with unit.
    """

    nodes: Floats
    outer: Ints
    inner: Ints
    core_vertices: Floats
    core_faces: Ints
    facts: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class DrawnTrajectory:
    """One trajectory as far as it is drawn: how it began and its steps, K in all.

    Sensor frame, SI. At the beginning, row 0, the finger is pressurised and nothing touches it.

    Attributes:
        id: E.g. ``sphere_medium/03/normal``.
        indenter: Its name.
        outcome: How it ended.
        reason: Why it did not complete.
        pose: Position and quaternion w x y z, shape (K, 7).
        force: Net force on the BioTac [N], shape (K, 3).
        fluid_pressure_pa: Shape (K,).
        contact_area_m2: Shape (K,).
        centre_of_pressure: Shape (K, 3); NaN without contact.
        displacement: Shape (K, V, 3) [m].
        indenter_force: Nodal forces on the skin, shape (K, V, 3) [N].
        core_force: Likewise of the core.
        iterations: Newton iterations, shape (K,).
        shape: The indenter in its own frame: vertices [m], triangles; None = not kept.
    """

    id: str
    indenter: str
    outcome: str
    reason: str
    pose: Floats
    force: Floats
    fluid_pressure_pa: Floats
    contact_area_m2: Floats
    centre_of_pressure: Floats
    displacement: Floats
    indenter_force: Floats
    core_force: Floats
    iterations: Ints
    shape: tuple[Floats, Ints] | None


class DrawnSimulations(SimulationFiles):
    """A store of simulations, read for drawing."""

    def fingertip(self) -> DrawnFingertip:
        """The fingertip.

        Raises:
            DatasetError: Damaged, or a file of measured trajectories, which has none.
        """
        with self.head() as file:
            tip = file["fingertip"]
            facts = {name: f"{float(value):g}" for name, value in tip["parameters"].attrs.items()}
            for name in ("fluid_pressure_pa", "total_thickness_m"):
                facts[name] = f"{tip.attrs[name]:g}"
            facts["mesh"] = f"{text(tip.attrs['mesh_name'])}, {len(tip['nodes']):,} nodes"
            return DrawnFingertip(
                nodes=tip["pressurised_nodes"][()],
                outer=_triangles(tip["outer_faces"][()]),
                # Kept with normals into the solid, which is right for a volume and not for a light.
                inner=_triangles(tip["inner_faces"][()])[:, ::-1],
                core_vertices=tip["core_vertices"][()],
                core_faces=tip["core_faces"][()],
                facts=facts,
            )

    def trajectory(self, trajectory: str) -> DrawnTrajectory:
        """One trajectory.

        Raises:
            DatasetError: Not there, damaged, or measured, so without fields.
        """
        with self.head() as file:
            rest_pa = float(file["fingertip"].attrs["fluid_pressure_pa"])
        with self.group(trajectory) as group:
            shape = None
            if "indenter_vertices" in group:
                shape = group["indenter_vertices"][()], group["indenter_faces"][()]
            # What is added in front of the steps: the first pose, and nothing happening.
            before = {
                "pose": group["path"][0],
                "fluid_pressure_pa": rest_pa,
                "centre_of_pressure": np.nan,
                **dict.fromkeys(("force", "contact_area_m2", *_FIELDS), 0.0),
            }
            return DrawnTrajectory(
                id=trajectory,
                indenter=text(group.attrs["indenter"]),
                outcome=text(group.attrs["outcome"]),
                reason=text(group.attrs["reason"]),
                **{name: _begun(group[name][()], first) for name, first in before.items()},
                iterations=_begun(group["convergence"]["iterations"], 0),
                shape=shape,
            )


def _begun(steps: Floats, first: Any) -> Any:
    return np.concatenate(
        [np.broadcast_to(first, (1, *steps.shape[1:])).astype(steps.dtype), steps]
    )


def _triangles(faces: Ints) -> Ints:
    """Triangles of triangles or quadrilaterals."""
    if faces.shape[1:] != (4,):
        return faces
    return np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
