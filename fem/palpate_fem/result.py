"""What a simulation returns: an `IndentationResult` of one `IndentationStep` for each pose."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from palpate_fem.arrays import Floats


class IndentationOutcome(StrEnum):
    """How an indentation ended."""

    COMPLETE = "complete"
    FORCE_LIMIT = "force limit"  # the skin is pinched on the core
    DIVERGED = "diverged"
    DEADLINE = "deadline"
    CANCELLED = "cancelled"


@dataclass(frozen=True, slots=True)
class Convergence:
    """How a step was solved: cost and remaining errors."""

    increments: int
    iterations: int
    factorisations: int
    residual: float  # ||unbalanced nodal force|| / force scale
    volume_error: float  # |V - V target| / V
    penetration_m: float  # deepest, indenter or core [m]
    seconds: float


@dataclass(frozen=True, slots=True)
class IndentationStep:
    """One converged step; all in the sensor frame, SI.

    Attributes:
        pose: Pose of the indenter: position [m] and quaternion w x y z, shape (7,).
        displacement: Nodal displacement from the pressurised, untouched state [m], shape (V, 3).
        fluid_pressure_pa: Above ambient [Pa].
        force: Net force of the indenter on the skin, friction included [N], shape (3,).
        torque: Its moment about the origin [N m], shape (3,).
        indenter_force: Nodal forces of the indenter on the skin [N], shape (V, 3).
        core_force: Nodal forces of the core on the skin [N], shape (V, 3).
        contact_area_m2: Area of the skin that touches the indenter [m^2].
        centre_of_pressure: Of the indenter's normal forces [m], shape (3,); NaN without contact.
        stress: Mean Cauchy stress of each element: xx yy zz yz xz xy [Pa], shape (E, 6).
        convergence: Cost and remaining errors.
    """

    pose: Floats
    displacement: Floats
    fluid_pressure_pa: float
    force: Floats
    torque: Floats
    indenter_force: Floats
    core_force: Floats
    contact_area_m2: float
    centre_of_pressure: Floats
    stress: Floats
    convergence: Convergence


@dataclass(frozen=True, slots=True)
class IndentationResult:
    """The converged steps of one indentation, and how it ended.

    The first pose is the start, without contact; each further one is a step, so a complete
    indentation with K poses has K - 1 steps.

    Attributes:
        indenter: Name of the indenter.
        path: Requested poses, shape (K, 7).
        steps: Converged steps, in order of the path; K - 1 of them if the outcome is COMPLETE.
        outcome: How it ended.
        reason: One sentence if it is not complete: what happened, and at which travel.
        travel_m: Travel of the indenter, turns included (`path_lengths`), at the last *converged*
            increment, which may lie between two poses [m].
        seconds: Computing time.
    """

    indenter: str
    path: Floats
    steps: tuple[IndentationStep, ...]
    outcome: IndentationOutcome
    reason: str = ""
    travel_m: float = 0.0
    seconds: float = field(default=0.0, compare=False)

    @property
    def forces(self) -> Floats:
        """Net forces [N], shape (len(steps), 3)."""
        return np.array([step.force for step in self.steps], np.float64).reshape(-1, 3)
