"""Simulation request, progress and reply."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from palpate.protos.messages.frames import FloatArray


@dataclass(frozen=True, slots=True)
class Pose:
    """Position [m] and unit quaternion w x y z, sensor frame."""

    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class SimulationParameters:
    """Finite-element parameters; None = the server's calibrated value."""

    skin_thickness_m: float | None = None
    shear_modulus_pa: float | None = None
    friction_coefficient: float | None = None
    fluid_volume_m3: float | None = None


@dataclass(frozen=True, slots=True)
class SimulationRequest:
    """Indent the finite-element fingertip along a path; see ``simulation.proto``."""

    request_id: str
    indenter: str
    path: Sequence[Pose]
    parameters: SimulationParameters = SimulationParameters()
    deadline_s: float = 0.0
    want_displacement: bool = False
    want_contact_force: bool = False


@dataclass(frozen=True, slots=True)
class SimulationProgress:
    """How far a running simulation is."""

    request_id: str
    steps_done: int
    steps_total: int
    elapsed_s: float


@dataclass(frozen=True, slots=True)
class SimulationStep:
    """One converged step: wrench on the BioTac [N, N m], fluid pressure [Pa], fields ``(V, 3)``."""

    pose_sensor_indenter: Pose
    force: FloatArray
    torque: FloatArray
    fluid_pressure_pa: float
    displacement: FloatArray | None = None
    contact_force: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class SimulationReply:
    """Converged steps in order of the path, and why it stopped early, if it did."""

    request_id: str
    mesh_sha256: bytes
    steps: Sequence[SimulationStep]
    stopped_because: str = ""
    elapsed_s: float = 0.0
