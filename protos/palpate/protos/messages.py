"""Messages as Python values: what the wire of ``palpate.v1`` means, with shapes and units.

SI units, sensor frame (docs/conventions.md) unless a name says otherwise. Values are frozen; arrays
are not copied on construction and must not be written to afterwards. The codec checks them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from palpate.protos.errors import ErrorCode

FloatArray = npt.NDArray[np.float32]
CountArray = npt.NDArray[np.uint16]

COUNTS_MAX = 4095
"""Full scale of the 12-bit ADC [counts]."""

PAC_SAMPLES = 22
"""PAC readings in one 44-slot frame (hardware manual: E1, PAC, E2, PAC, ...)."""

NO_TARE = 0
"""``tare_id`` of a frame that was taken before any tare."""


class Origin(IntEnum):
    """Where a reading comes from."""

    LIVE = 1
    SIMULATED = 2
    REPLAYED = 3


class SensorType(IntEnum):
    """The kind of tactile sensor."""

    BIOTAC = 1
    BIOTAC_SP = 2

    @property
    def electrode_count(self) -> int:
        """Number of sensing electrodes."""
        return 19 if self is SensorType.BIOTAC else 24

    @property
    def validity_bits(self) -> int:
        """Number of channels with a validity bit: electrodes, PDC, TAC, TDC, PAC samples."""
        return self.electrode_count + 3 + PAC_SAMPLES


@dataclass(frozen=True, slots=True)
class Stamp:
    """When and where one reading was taken.

    Attributes:
        sequence: Contiguous per sensor and gateway run, from 1; a hole = lost on the bus.
        device_tick: The device's own unwrapped counter.
        monotonic_ns: Host monotonic clock at the first slot of the frame [ns].
        wall_ns: Host wall clock at the same instant [ns since the Unix epoch].
        clock_id: Names the monotonic clock; one value per host and boot.
        origin: Live, simulated or replayed.
        missed_before: Frames the device is known to have lost directly before this one.
    """

    sequence: int
    device_tick: int
    monotonic_ns: int
    wall_ns: int
    clock_id: int
    origin: Origin
    missed_before: int = 0


@dataclass(frozen=True, slots=True)
class ElectrodeFrame:
    """One sampling round of a BioTac: raw 12-bit counts, nothing subtracted.

    Attributes:
        stamp: When.
        sensor_serial: Serial number of the sensor.
        sensor_type: Fixes the number of electrodes.
        electrodes: Raw counts E1..E19, uint16, shape ``(19,)`` (SP: 24).
        pdc: Raw static pressure [counts].
        pac: Raw dynamic pressure in order of sampling [counts], uint16, shape ``(22,)``.
        tac: Raw dynamic temperature [counts].
        tdc: Raw static temperature [counts].
        validity: Bit set = channel good. Electrodes from bit 0, then PDC, TAC, TDC, then PAC.
        slot_period_ns: Time between two slots [ns].
        tare_id: The tare in force; ``NO_TARE`` = none.
    """

    stamp: Stamp
    sensor_serial: str
    sensor_type: SensorType
    electrodes: CountArray
    pdc: int
    pac: CountArray
    tac: int
    tdc: int
    validity: int
    slot_period_ns: int
    tare_id: int = NO_TARE

    @property
    def electrodes_valid(self) -> bool:
        """Whether every electrode of this frame is good."""
        mask = (1 << self.sensor_type.electrode_count) - 1
        return self.validity & mask == mask


@dataclass(frozen=True, slots=True)
class WrenchFrame:
    """One reading of a force/torque sensor.

    Attributes:
        stamp: When.
        sensor_serial: Serial number of the force/torque sensor.
        force: Force on the BioTac [N], sensor frame, float32, shape ``(3,)``.
        torque: Torque on the BioTac about the sensor frame's origin [N m], shape ``(3,)``.
        overload: The device says its range is exceeded.
    """

    stamp: Stamp
    sensor_serial: str
    force: FloatArray
    torque: FloatArray
    overload: bool = False


@dataclass(frozen=True, slots=True)
class IndenterPoseFrame:
    """Where the indenter is.

    Attributes:
        stamp: When.
        indenter: Standard name, e.g. ``"sphere_3-5mm"``.
        position: Tip of the indenter [m], sensor frame, float64, shape ``(3,)``.
        orientation: Unit quaternion w x y z of the indenter in the sensor frame, shape ``(4,)``.
        in_contact: Whether it touches the skin, where the source knows.
    """

    stamp: Stamp
    indenter: str
    position: npt.NDArray[np.float64]
    orientation: npt.NDArray[np.float64]
    in_contact: bool = False


@dataclass(frozen=True, slots=True)
class FeatureEstimate:
    """Electrodes -> features; a pure function of frame, tare and bundle.

    Attributes:
        source: Stamp of the frame it was made from.
        sensor_serial: Serial number of that frame's sensor.
        bundle_sha256: Digest of the bundle's manifest, 32 bytes.
        tare_id: Tare that was subtracted.
        in_contact: False below the bundle's contact threshold.
        force: Net force on the BioTac [N], shape ``(3,)``.
        force_sd: One standard deviation per axis [N], shape ``(3,)``.
        contact_location: Position of the indenter's tip [m], shape ``(3,)``; None without contact
            or where the bundle does not estimate it.
        contact_location_sd: One standard deviation per axis [m], shape ``(3,)``; None likewise.
    """

    source: Stamp
    sensor_serial: str
    bundle_sha256: bytes
    tare_id: int
    in_contact: bool
    force: FloatArray
    force_sd: FloatArray
    contact_location: FloatArray | None = None
    contact_location_sd: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class FieldEstimate:
    """Electrodes -> fields.

    Attributes:
        source: Stamp of the frame it was made from.
        sensor_serial: Serial number of that frame's sensor.
        bundle_sha256: Digest of the bundle's manifest, 32 bytes.
        tare_id: Tare that was subtracted.
        mesh_sha256: Content hash of the mesh, 32 bytes.
        displacement: Nodal displacement from the pressurised state [m], shape ``(V, 3)``.
        displacement_sd: One standard deviation of its magnitude [m], shape ``(V,)``, or None.
        contact_force: Nodal contact force on the skin [N], shape ``(V, 3)``, or None.
    """

    source: Stamp
    sensor_serial: str
    bundle_sha256: bytes
    tare_id: int
    mesh_sha256: bytes
    displacement: FloatArray
    displacement_sd: FloatArray | None = None
    contact_force: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class SynthesisEstimate:
    """Fields -> electrodes.

    Attributes:
        source: Stamp of the field's source.
        sensor_serial: Serial number of the sensor that is imitated.
        bundle_sha256: Digest of the bundle's manifest, 32 bytes.
        mesh_sha256: Content hash of the mesh, 32 bytes.
        tared_counts: E1..E19 minus baseline [counts], shape ``(19,)``.
        tared_counts_sd: One standard deviation [counts], shape ``(19,)``, or None.
    """

    source: Stamp
    sensor_serial: str
    bundle_sha256: bytes
    mesh_sha256: bytes
    tared_counts: FloatArray
    tared_counts_sd: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Tare:
    """The untouched state of one sensor.

    Attributes:
        tare_id: Unique per gateway run and sensor, never ``NO_TARE``.
        stamp: Stamp of the last frame averaged.
        sensor_serial: Serial number of the sensor.
        electrodes: Mean raw counts (the baseline), float32, shape ``(19,)``.
        electrodes_sd: Standard deviation of the averaged frames [counts], shape ``(19,)``.
        pdc: Mean raw PDC [counts].
        pac: Mean raw PAC [counts].
        tac: Mean raw TAC [counts].
        tdc: Mean raw TDC [counts].
        frames_averaged: How many frames went in.
    """

    tare_id: int
    stamp: Stamp
    sensor_serial: str
    electrodes: FloatArray
    electrodes_sd: FloatArray
    pdc: float
    pac: float
    tac: float
    tdc: float
    frames_averaged: int


@dataclass(frozen=True, slots=True)
class TareRequest:
    """Tare now (``tare_id = NO_TARE``), or tell me the tare of this id."""

    tare_id: int = NO_TARE
    frames: int = 0


@dataclass(frozen=True, slots=True)
class ServiceRequest:
    """Ask a service for its status or its model's metadata."""


class ServiceState(IntEnum):
    """What a process says of itself."""

    STARTING = 1
    READY = 2
    DEGRADED = 3
    FINISHED = 4
    STOPPING = 5


@dataclass(frozen=True, slots=True)
class ErrorReply:
    """A typed error as a message.

    Attributes:
        code: What kind.
        message: What was wrong, naming the thing.
        remedy: What to do.
        retry_after_s: Ask again after this time [s]; 0 = do not.
    """

    code: ErrorCode
    message: str
    remedy: str
    retry_after_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Status:
    """What a process says of itself, once a second and when asked.

    Attributes:
        service: ``gateway``, ``features``, ``recorder``, ...
        instance: Name of this process among several of its kind.
        state: See ``ServiceState``.
        monotonic_ns: Host monotonic clock [ns].
        wall_ns: Host wall clock [ns since the Unix epoch].
        uptime_s: Since the process was ready to count [s].
        version: Version of palpate.
        counters: Events since the start.
        gauges: Present values; the name ends in the unit.
        sensors: Sensors it serves.
        message: One line for people.
        last_error: The last thing that went wrong, if any.
    """

    service: str
    instance: str
    state: ServiceState
    monotonic_ns: int
    wall_ns: int
    uptime_s: float
    version: str
    counters: Mapping[str, int] = field(default_factory=dict)
    gauges: Mapping[str, float] = field(default_factory=dict)
    sensors: Sequence[str] = ()
    message: str = ""
    last_error: ErrorReply | None = None


@dataclass(frozen=True, slots=True)
class TensorInfo:
    """Name, type, shape (-1 = any batch size) and unit of one input or output of a model."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    unit: str


@dataclass(frozen=True, slots=True)
class ModelMetadata:
    """What a served bundle says of itself.

    Attributes:
        name: Name of the bundle.
        version: Its version.
        task: ``"features"``, ``"field"`` or ``"synthesis"``.
        bundle_sha256: Digest of its manifest, 32 bytes.
        contract_version: Version of the bundle contract it was written for.
        inputs: Inputs of the model.
        outputs: Outputs of the model.
        training_data_sha256: Digest of the data set it was trained on, hex.
        metrics: Held-out results; the name ends in the unit.
        trained_on: One line for people.
    """

    name: str
    version: int
    task: str
    bundle_sha256: bytes
    contract_version: int
    inputs: Sequence[TensorInfo]
    outputs: Sequence[TensorInfo]
    training_data_sha256: str
    metrics: Mapping[str, float]
    trained_on: str


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
