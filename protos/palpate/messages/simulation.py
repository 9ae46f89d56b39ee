"""Simulation: request, progress, steps, reply, cancelling. Comments: ``simulation.proto``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from palpate.messages.frames import DoubleArray, FloatArray, Pose


@dataclass(frozen=True, slots=True)
class SimulationParameters:
    """Finite-element parameters; None = the server's calibrated value."""

    skin_thickness_m: float | None = None
    shear_modulus_pa: float | None = None
    friction_coefficient: float | None = None
    fluid_volume_m3: float | None = None


@dataclass(frozen=True, slots=True)
class SimulationRequest:
    """Indent the finite-element fingertip along a path.

    Attributes:
        request_id: Chosen by the caller; no two that run at once may share it.
        indenter: Standard name, e.g. ``"sphere_3-5mm"``.
        path: Poses of the indenter, in order; the first does not touch the skin.
        deadline_s: How long it may take, time in the queue included [s]; 0 = the server's limit.
        want_displacement: Whether steps carry the nodal displacement.
        want_contact_force: Whether steps carry the nodal forces of the indenter.
    """

    request_id: str
    indenter: str
    path: Sequence[Pose]
    parameters: SimulationParameters = SimulationParameters()
    deadline_s: float = 0.0
    want_displacement: bool = False
    want_contact_force: bool = False


class SimulationPhase(IntEnum):
    """What a simulation is at."""

    UNSPECIFIED = 0
    WAITING = 1
    PRESSURISING = 2
    INDENTING = 3


class SimulationOutcome(IntEnum):
    """How a simulation ended; UNSPECIFIED = it has not."""

    UNSPECIFIED = 0
    COMPLETE = 1
    FORCE_LIMIT = 2
    DIVERGED = 3
    DEADLINE = 4
    CANCELLED = 5


@dataclass(frozen=True, slots=True)
class SimulationProgress:
    """How far a running simulation is.

    Attributes:
        steps_done: Converged steps.
        steps_total: Steps of the path, one less than its poses.
        elapsed_s: Since the request was accepted [s].
        waiting_before: Requests that will be served before this one.
    """

    request_id: str
    steps_done: int
    steps_total: int
    elapsed_s: float
    phase: SimulationPhase = SimulationPhase.UNSPECIFIED
    waiting_before: int = 0


@dataclass(frozen=True, slots=True)
class SimulationConvergence:
    """How a step was solved; residual and volume error are relative, penetration in [m]."""

    increments: int
    iterations: int
    factorisations: int
    residual: float
    volume_error: float
    penetration_m: float
    seconds: float


@dataclass(frozen=True, slots=True)
class SimulationStep:
    """One converged step, sensor frame.

    Attributes:
        force: Net force on the BioTac, friction included [N], float64, shape ``(3,)``.
        torque: Its moment about the origin [N m], float64, shape ``(3,)``.
        fluid_pressure_pa: Above ambient [Pa].
        displacement: Nodal displacement from the pressurised, untouched state [m], shape
            ``(V, 3)``; None = not asked for.
        contact_force: Nodal force of the indenter on the skin [N], shape ``(V, 3)``, or None.
        contact_area_m2: Area of skin under the indenter [m^2].
        centre_of_pressure: Of the indenter's normal forces [m], float64, shape ``(3,)``; None
            without contact.
        convergence: How it was solved; None = the service does not say.
    """

    pose_sensor_indenter: Pose
    force: DoubleArray
    torque: DoubleArray
    fluid_pressure_pa: float
    displacement: FloatArray | None = None
    contact_force: FloatArray | None = None
    contact_area_m2: float = 0.0
    centre_of_pressure: DoubleArray | None = None
    convergence: SimulationConvergence | None = None


@dataclass(frozen=True, slots=True)
class SimulationReply:
    """Part of an answer, or all of it (``palpate.client.simulations`` joins the parts).

    Attributes:
        mesh_sha256: Digest of the mesh of the fields, 32 bytes; empty only without steps.
        steps: Converged steps, in order of the path.
        stopped_because: Why it ended before the end of the path, if it did.
        elapsed_s: Since the request was accepted [s].
        more: Another part follows, or an error.
        first_step: Number of the first of ``steps``; step k ends at pose k + 1 of the path.
        outcome: In the last part: how it ended.
        travel_m: In the last part: travel of the indenter, turns included, up to the last converged
            increment, which may lie between two poses [m].
    """

    request_id: str
    mesh_sha256: bytes
    steps: Sequence[SimulationStep]
    stopped_because: str = ""
    elapsed_s: float = 0.0
    more: bool = False
    first_step: int = 0
    progress: SimulationProgress | None = None
    outcome: SimulationOutcome = SimulationOutcome.UNSPECIFIED
    travel_m: float = 0.0

    @property
    def forces(self) -> DoubleArray:
        """Net forces on the BioTac [N], shape ``(len(steps), 3)``."""
        return np.array([step.force for step in self.steps], np.float64).reshape(-1, 3)


@dataclass(frozen=True, slots=True)
class SimulationCancelRequest:
    """Stop a simulation that waits or runs."""

    request_id: str


@dataclass(frozen=True, slots=True)
class SimulationCancelReply:
    """Whether there was such a simulation."""

    found: bool
