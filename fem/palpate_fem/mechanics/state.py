"""Solution of the discrete problem, and the balance of forces there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate_fem.arrays import Floats, Ints
from palpate_fem.mesh.solid import SolidMesh

FORCE_FLOOR_N = 1e-6
"""Least scale of the forces [N], for a body without load; rounding errors are far below."""

TRACTION_FLOOR_PA = 100.0
"""Least scale of the tractions [Pa]; a light touch makes a thousand times more."""


@dataclass(slots=True)
class SolutionState:
    """Unknowns and history of one fingertip at one moment; the start of the next increment.

    Attributes:
        position: Nodal positions [m], (V, 3).
        pressure: Element pressures, positive in tension [Pa], (E,).
        fluid_pressure: Above ambient [Pa].
        core_pressure: Contact pressure on the core [Pa], (inner faces, points).
        indenter_pressure: Contact pressure on the indenter [Pa], (outer faces, points).
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
    def at_rest(cls, mesh: SolidMesh) -> SolutionState:
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

    def copy(self) -> SolutionState:
        """An independent copy."""
        return SolutionState(
            self.position.copy(),
            self.pressure.copy(),
            self.fluid_pressure,
            self.core_pressure.copy(),
            self.indenter_pressure.copy(),
            self.traction.copy(),
            self.anchor.copy(),
        )


def _points(faces: Ints) -> int:
    """Contact points of a face: its corners."""
    return int(faces.shape[1]) if faces.ndim == 2 else 0


@dataclass(slots=True)
class ForceBalance:
    """Forces at one state, what does not cancel, and by how much each law is violated.

    Attributes:
        internal: Nodal forces of the skin's stress, (V, 3). Internal, indenter and core forces,
            less those of the fluid, add up to zero at the free nodes.
        indenter: Minus the nodal forces of the indenter on the skin, (V, 3).
        core: Minus the nodal forces of the core on the skin, (V, 3).
        volume_gradient: Derivative of the cavity's volume by the nodal positions [m^2], (V, 3).
        volume: Of the cavity [m^3].
        unbalanced: Their sum at the free unknowns, fluid pressure included [N], (n,).
        scale: Norm of the nodal forces that have to cancel [N].
        strain_error: Largest |v - v0 - v0 p / kappa| / v0 of an element.
        gap_error_m: Largest difference between a contact point's gap and its law's [m].
        traction_error: Largest difference between a traction and its law's, over the largest one.
        smallest_jacobian: Smallest det F of all quadrature points.
    """

    internal: Floats
    indenter: Floats
    core: Floats
    volume_gradient: Floats
    volume: float
    unbalanced: Floats
    scale: float
    strain_error: float
    gap_error_m: float
    traction_error: float
    smallest_jacobian: float

    @property
    def residual(self) -> float:
        """Unbalanced force over the scale of the forces that cancel."""
        return float(np.linalg.norm(self.unbalanced)) / max(self.scale, FORCE_FLOOR_N)
