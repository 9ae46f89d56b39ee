"""Content of a store: one fingertip, and trajectories that were simulated or measured on it."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_fem.arrays import Floats, Ints
from palpate_fem.config import FingertipParameters
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.result import IndentationOutcome

Setting = bool | int | float | str

Outline = tuple[NDArray[np.floating[Any]], Ints]
"""A closed triangle mesh of an indenter, outward, in its own frame: vertices [m], triangles."""

SAME_SHAPE_M = 1e-7
"""Pressurised shapes from the same inputs agree to this [m]: far above the solver's tolerance, far
below what matters. A larger difference means that the solver itself has changed."""

_SAME_VOLUME = 1e-3
"""Share by which volumes of fluid may differ then; 0.1 um on the whole skin are a quarter of it."""


@dataclass(frozen=True)
class StoredFingertip:
    """The fingertip that all trajectories of a store share; sensor frame, SI.

    Attributes:
        mesh: The solid, unpressurised.
        parameters: Physical parameters.
        settings: Settings of the solver, by name (``named_values`` of a dataclass).
        pressurised_nodes: Nodal positions from which displacements count [m], shape (V, 3).
        fluid_pressure_pa: Above ambient, untouched [Pa].
        fluid_volume_m3: Between skin and core [m^3].
        total_thickness_m: Dorso-ventral extent, pressurised [m].
        core_vertices: Surface of the core, for pictures [m], shape (C, 3).
        core_faces: Its triangles, shape (T, 3), outward.
    """

    mesh: SolidMesh
    parameters: FingertipParameters
    settings: Mapping[str, Setting]
    pressurised_nodes: Floats
    fluid_pressure_pa: float
    fluid_volume_m3: float
    total_thickness_m: float
    core_vertices: Floats
    core_faces: Ints

    @cached_property
    def key(self) -> str:
        """Digest, hex, of mesh, parameters and settings; `differences` looks at the core, too."""
        digest = hashlib.sha256(self.mesh.sha256)
        for name, value in sorted({**named_values(self.parameters), **self.settings}.items()):
            # A flag or count written back as a NumPy scalar must not change the digest.
            digest.update(f"{name}={_plain(value)!r};".encode())
        return digest.hexdigest()

    def differences(self, other: StoredFingertip) -> list[str]:
        """What makes trajectories of the two differ, a phrase for each; empty = nothing."""
        found = []
        if self.mesh.sha256 != other.mesh.sha256:
            found.append(f"mesh {_mesh_name(self.mesh)} is not {_mesh_name(other.mesh)}")
        mine = {**named_values(self.parameters), **self.settings}
        theirs = {**named_values(other.parameters), **other.settings}
        for name in sorted(mine.keys() | theirs.keys()):
            here, there = _plain(mine.get(name)), _plain(theirs.get(name))
            if here != there:
                found.append(f"{name} {here} is not {there}")
        if not found:
            apart = float(np.abs(self.pressurised_nodes - other.pressurised_nodes).max(initial=0.0))
            if not apart <= SAME_SHAPE_M:
                found.append(f"the same inputs give a pressurised skin {apart * 1e6:.3g} um away")
            here, there = self.fluid_volume_m3, other.fluid_volume_m3
            if not math.isclose(here, there, rel_tol=_SAME_VOLUME):
                found.append(f"a fluid volume of {here:.4g} m^3 is not {there:.4g}")
            if not self._has_core_of(other):
                found.append("the core is not the same")
        return found

    def _has_core_of(self, other: StoredFingertip) -> bool:
        mine, theirs = self.core_vertices, other.core_vertices
        same_faces = np.array_equal(self.core_faces, other.core_faces)
        return same_faces and bool(
            mine.shape == theirs.shape and np.allclose(mine, theirs, rtol=0.0, atol=SAME_SHAPE_M)
        )


@dataclass(frozen=True, slots=True)
class TrajectorySummary:
    """A trajectory without its fields: quick to read, and all that a measured one has.

    Attributes:
        id: E.g. ``sphere_medium/03/normal``.
        indenter: Its name.
        sensor: Name of the BioTac that was measured; empty = simulated.
        outcome: How it ended.
        reason: Why it did not complete.
        complete: Whether every pose of the path has its step.
        travel_m: Path length at the last converged increment [m].
        seconds: Computing time [s].
        path: Requested poses, shape (K + 1 or more, 7), sensor frame; the first does not touch, the
            steps are at those that follow. For a measured trajectory, its poses.
        pose: Poses of the steps, shape (K, 7), sensor frame.
        force: Net force on the BioTac [N], shape (K, 3).
        fluid_pressure_pa: Above ambient [Pa], shape (K,); NaN where not measured.
    """

    id: str
    indenter: str
    sensor: str
    outcome: IndentationOutcome
    reason: str
    complete: bool
    travel_m: float
    seconds: float
    path: Floats
    pose: Floats
    force: Floats
    fluid_pressure_pa: Floats


def named_values(record: Any) -> dict[str, Setting]:
    """Fields of a dataclass of parameters or settings that are not None, by name."""
    values = {field.name: getattr(record, field.name) for field in fields(record)}
    return {name: value for name, value in values.items() if value is not None}


def _plain(value: object) -> object:
    return value.item() if isinstance(value, np.generic) else value


def _mesh_name(mesh: SolidMesh) -> str:
    return f"{mesh.name or 'unnamed'} ({mesh.sha256.hex()[:12]})"
