"""Messages of services and requests to them: tare, zero, status, model metadata, typed error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

from palpate.errors import ErrorCode
from palpate.messages.estimates import TrainingRange
from palpate.messages.frames import NO_TARE, FloatArray, Stamp
from palpate.messages.models import ServedModel


class SensorState(IntEnum):
    """State of a sensor; it delivers frames from ``LIVE`` to ``ZERO_LOST``."""

    UNKNOWN = 0
    STARTING = 1
    LIVE = 2
    WARMING = 3
    ZERO_LOST = 4
    LOST = 5
    ENDED = 6


class FaultKind(IntEnum):
    """What is wrong with a channel."""

    UNKNOWN = 0
    SATURATED = 1
    DEAD = 2
    STUCK = 3
    ODD = 4


@dataclass(frozen=True, slots=True)
class ChannelFault:
    """Channels of a sensor that have the same fault, by name, e.g. ``E7`` or ``PAC``."""

    kind: FaultKind
    channels: Sequence[str]


@dataclass(frozen=True, slots=True)
class SensorStatus:
    """State of one sensor of a gateway.

    Attributes:
        name: Its name in keys.
        since_monotonic_ns: Host monotonic clock when it came into this state [ns].
        faults: Channels that must not be used; empty = none.
        message: One line for people; empty = none.
    """

    name: str
    state: SensorState
    since_monotonic_ns: int = 0
    faults: Sequence[ChannelFault] = ()
    message: str = ""


@dataclass(frozen=True, slots=True)
class WrenchZeroRequest:
    """Take the present load of a force/torque sensor as zero.

    ``readings`` are averaged before it and after it; 0 = the gateway's own number. ``request_id``
    is as in ``TareRequest``.
    """

    readings: int = 0
    request_id: str = ""


@dataclass(frozen=True, slots=True)
class WrenchZero:
    """The zero that a force/torque sensor took. All values as published, on the BioTac.

    Attributes:
        sensor_serial: Serial number of the force/torque sensor.
        device: One line for people: model and address.
        monotonic_ns: Host monotonic clock when it was taken [ns].
        wall_ns: Host wall clock when it was taken [ns since the Unix epoch].
        force_before: Mean force before it [N], shape ``(3,)``; ``force_after`` likewise.
        torque_before: Mean torque before it [N m], shape ``(3,)``; ``torque_after`` likewise.
        readings_averaged: How many readings each mean is of.
    """

    sensor_serial: str
    device: str
    monotonic_ns: int
    wall_ns: int
    force_before: FloatArray
    torque_before: FloatArray
    force_after: FloatArray
    torque_after: FloatArray
    readings_averaged: int


@dataclass(frozen=True, slots=True)
class Tare:
    """The untouched state of one sensor.

    Attributes:
        tare_id: Unique per gateway run and sensor, never ``NO_TARE``.
        stamp: Stamp of the last frame averaged.
        electrodes: Mean raw counts (the baseline), float32, shape ``(19,)`` (SP: 24).
        electrodes_sd: Standard deviation of the averaged frames [counts], the same shape.
        pdc: Mean raw PDC [counts]; ``pac``, ``tac`` and ``tdc`` likewise, of the valid samples; 0 =
            there were none.
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
    """Tare now (``tare_id = NO_TARE``), or look up the tare of this id.

    Attributes:
        frames: How many are averaged; 0 = the gateway's own number.
        request_id: Names the token that the caller holds while it waits; empty = it holds none.
        anyway: Whether to tare although the finger is still, but farther from where it last rested
            untouched than it drifts.
    """

    tare_id: int = NO_TARE
    frames: int = 0
    request_id: str = ""
    anyway: bool = False


@dataclass(frozen=True, slots=True)
class ServiceRequest:
    """Ask a service for its status or its model's metadata."""


class ServiceState(IntEnum):
    """State of a process."""

    STARTING = 1
    READY = 2
    DEGRADED = 3
    FINISHED = 4
    STOPPING = 5


@dataclass(frozen=True, slots=True)
class ErrorReply:
    """A ``PalpateError`` as a message: its code, problem, remedy and ``retry_after_s``."""

    code: ErrorCode
    message: str
    remedy: str
    retry_after_s: float = 0.0


@dataclass(frozen=True, slots=True)
class SupervisedProcess:
    """A process as its supervisor sees it.

    Attributes:
        service: What it serves, e.g. ``gateway``.
        instance: Name of this process among several of its kind.
        state: One word: ``running``, ``starting``, ``backoff``, ``exited``, ...
        pid: Its process id; 0 = it does not run.
        restarts: How often it was started again.
        uptime_s: Since its last start [s].
    """

    service: str
    instance: str
    state: str
    pid: int = 0
    restarts: int = 0
    uptime_s: float = 0.0


GAUGE_MAX = 1e18
"""Largest magnitude of a gauge; a larger one, or NaN, measures nothing and is left out."""

UPTIME_MAX_S = 1e10
"""Longest uptime [s]: 300 years, as in int64 nanoseconds."""


@dataclass(frozen=True, slots=True)
class Status:
    """State and counters of a process: sent each second, on a change of state, and when asked.

    Attributes:
        service: ``gateway``, ``features``, ``recorder``, ...
        instance: Name of this process among several of its kind.
        monotonic_ns: Host monotonic clock [ns].
        wall_ns: Host wall clock [ns since the Unix epoch].
        uptime_s: Since the process was ready to count [s].
        version: Version of palpate.
        counters: Events since the start.
        gauges: Present values, at most ``GAUGE_MAX``; the name ends in the unit.
        sensors: Sensors it serves.
        message: One line for people.
        sensor_states: Of a gateway: each of its sensors.
        processes: Of a supervisor: each process that should run.
        models: Of an estimating service: bundles that it serves, each as ``name:version``.
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
    sensor_states: Sequence[SensorStatus] = ()
    processes: Sequence[SupervisedProcess] = ()
    models: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class TensorInfo:
    """Name, type, shape (-1 = any batch size) and unit of one input or output of a model."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    unit: str


@dataclass(frozen=True, slots=True)
class ModelMetadata:
    """Description of a served bundle.

    Attributes:
        name: Name of the bundle.
        task: ``"features"``, ``"field"`` or ``"synthesis"``.
        bundle_sha256: Digest of its manifest, 32 bytes.
        contract_version: Version of the bundle contract it was written for.
        training_data_sha256: Digest of the data set it was trained on, hex.
        metrics: Held-out results; the name ends in the unit.
        trained_on: One line for people.
        served: Which bundle serves which sensor; the other attributes describe the first.
        training_range: What it was trained on; None = it does not say.
        mesh_sha256: Content hash of the mesh of its fields, 32 bytes; empty = no fields.
        basis_sha256: Content hash of the basis of its coefficients, 32 bytes; empty = none.
        modes: Modes of that basis.
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
    served: Sequence[ServedModel] = ()
    training_range: TrainingRange | None = None
    mesh_sha256: bytes = b""
    basis_sha256: bytes = b""
    modes: int = 0
