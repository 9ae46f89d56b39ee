"""Solution of the discrete problem, and the balance of forces there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from palpate_fem.arrays import Floats, Ints
from palpate_fem.mesh.solid import SolidMesh

FORCE_FLOOR_N = 1e-6
"""Least scale of the forces [N], for a body without load; rounding errors are far below."""

TRACTION_FLOOR_PA = 100.0
"""Least scale of the tractions [Pa]; a light touch makes a thousand times more."""


@dataclass(frozen=True, slots=True)
class MortarCorrection:
    """What mortar contact adds to contact at the nodes of one surface; see ``mortar``.

    Attributes:
        gap: Added to the gap of each contact point [m], (faces, points).
        spread: From the pressures of the contact points, (faces * points,), to the forces of the
            other body on the nodes, (3 V,), less those of contact at the nodes [m^2]. For linear
            solutions; the forces themselves are evaluated at the present positions.
        held: Direction of the pressure at quadrature points that hang far above the other body,
            (faces, points, 3); zero where it is that of the distance at the present position.
    """

    gap: Floats
    spread: sparse.csc_array
    held: Floats

    @classmethod
    def none(cls, faces: Ints, nodes: int) -> MortarCorrection:
        """Contact at the nodes."""
        size = (len(faces), _points(faces))
        spread = sparse.csc_array((3 * nodes, faces.size))
        return cls(np.zeros(size), spread, np.zeros((*size, 3)))

    def load(self, pressure: Floats) -> Floats:
        """Force of pressures (faces, points) [Pa] on the nodes [N], (V, 3)."""
        return np.asarray(self.spread @ pressure.ravel()).reshape(-1, 3)


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
        on_core: Mortar correction of the inner surface; replaced as a whole, so copies share it.
        on_indenter: Mortar correction of the outer surface.
    """

    position: Floats
    pressure: Floats
    fluid_pressure: float
    core_pressure: Floats
    indenter_pressure: Floats
    traction: Floats
    anchor: Floats
    on_core: MortarCorrection
    on_indenter: MortarCorrection

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
            on_core=MortarCorrection.none(mesh.inner_faces, len(mesh.nodes)),
            on_indenter=MortarCorrection.none(mesh.outer_faces, len(mesh.nodes)),
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
            self.on_core,
            self.on_indenter,
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
