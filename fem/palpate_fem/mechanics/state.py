"""Unknowns and memory of one fingertip at one moment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_fem.mesh.solid import SolidMesh

Floats = NDArray[np.float64]


@dataclass(slots=True)
class State:
    """What one increment hands to the next.

    Attributes:
        position: Nodal positions [m], (V, 3).
        pressure: Element pressures, positive in tension [Pa], (E,).
        fluid_pressure: Above ambient [Pa].
        core_pressure: Contact pressure on the core [Pa], (inner faces, points).
        indenter_pressure: The same on the indenter, (outer faces, points).
        traction: Friction of each point on the indenter [Pa], (outer faces, points, 3).
        anchor: Where each point sticks to the indenter, in its frame [m], (outer faces, points, 3).
    """

    position: Floats
    pressure: Floats
    fluid_pressure: float
    core_pressure: Floats
    indenter_pressure: Floats
    traction: Floats
    anchor: Floats

    @classmethod
    def at_rest(cls, mesh: SolidMesh) -> State:
        """Unpressurised and untouched."""
        inner = (len(mesh.inner_faces), _points(mesh.inner_faces))
        outer = (len(mesh.outer_faces), _points(mesh.outer_faces))
        return cls(
            position=mesh.nodes.copy(),
            pressure=np.zeros(len(mesh.elements)),
            fluid_pressure=0.0,
            core_pressure=np.zeros(inner),
            indenter_pressure=np.zeros(outer),
            traction=np.zeros((*outer, 3)),
            anchor=np.zeros((*outer, 3)),
        )

    def copy(self) -> State:
        """An independent copy."""
        return State(
            self.position.copy(),
            self.pressure.copy(),
            self.fluid_pressure,
            self.core_pressure.copy(),
            self.indenter_pressure.copy(),
            self.traction.copy(),
            self.anchor.copy(),
        )


def _points(faces: NDArray[np.int32]) -> int:
    """Contact points of a face: its corners."""
    return int(faces.shape[1]) if faces.ndim == 2 else 0
