from palpate.v1 import common_pb2 as _common_pb2
from palpate.v1 import frames_pb2 as _frames_pb2
from palpate.v1 import models_pb2 as _models_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ServiceState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SERVICE_STATE_UNSPECIFIED: _ClassVar[ServiceState]
    SERVICE_STATE_STARTING: _ClassVar[ServiceState]
    SERVICE_STATE_READY: _ClassVar[ServiceState]
    SERVICE_STATE_DEGRADED: _ClassVar[ServiceState]
    SERVICE_STATE_FINISHED: _ClassVar[ServiceState]
    SERVICE_STATE_STOPPING: _ClassVar[ServiceState]

class SensorState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SENSOR_STATE_UNSPECIFIED: _ClassVar[SensorState]
    SENSOR_STATE_STARTING: _ClassVar[SensorState]
    SENSOR_STATE_LIVE: _ClassVar[SensorState]
    SENSOR_STATE_WARMING: _ClassVar[SensorState]
    SENSOR_STATE_ZERO_LOST: _ClassVar[SensorState]
    SENSOR_STATE_LOST: _ClassVar[SensorState]
    SENSOR_STATE_ENDED: _ClassVar[SensorState]

class FaultKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    FAULT_KIND_UNSPECIFIED: _ClassVar[FaultKind]
    FAULT_KIND_SATURATED: _ClassVar[FaultKind]
    FAULT_KIND_DEAD: _ClassVar[FaultKind]
    FAULT_KIND_STUCK: _ClassVar[FaultKind]
    FAULT_KIND_ODD: _ClassVar[FaultKind]

class ErrorCode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ERROR_CODE_UNSPECIFIED: _ClassVar[ErrorCode]
    ERROR_CODE_INVALID_REQUEST: _ClassVar[ErrorCode]
    ERROR_CODE_NOT_FOUND: _ClassVar[ErrorCode]
    ERROR_CODE_UNAVAILABLE: _ClassVar[ErrorCode]
    ERROR_CODE_RESOURCE_EXHAUSTED: _ClassVar[ErrorCode]
    ERROR_CODE_DEADLINE_EXCEEDED: _ClassVar[ErrorCode]
    ERROR_CODE_WRONG_CONTRACT: _ClassVar[ErrorCode]
    ERROR_CODE_DEVICE: _ClassVar[ErrorCode]
    ERROR_CODE_DISK: _ClassVar[ErrorCode]
    ERROR_CODE_SIMULATION: _ClassVar[ErrorCode]
    ERROR_CODE_INTERNAL: _ClassVar[ErrorCode]
    ERROR_CODE_PERMISSION_DENIED: _ClassVar[ErrorCode]
SERVICE_STATE_UNSPECIFIED: ServiceState
SERVICE_STATE_STARTING: ServiceState
SERVICE_STATE_READY: ServiceState
SERVICE_STATE_DEGRADED: ServiceState
SERVICE_STATE_FINISHED: ServiceState
SERVICE_STATE_STOPPING: ServiceState
SENSOR_STATE_UNSPECIFIED: SensorState
SENSOR_STATE_STARTING: SensorState
SENSOR_STATE_LIVE: SensorState
SENSOR_STATE_WARMING: SensorState
SENSOR_STATE_ZERO_LOST: SensorState
SENSOR_STATE_LOST: SensorState
SENSOR_STATE_ENDED: SensorState
FAULT_KIND_UNSPECIFIED: FaultKind
FAULT_KIND_SATURATED: FaultKind
FAULT_KIND_DEAD: FaultKind
FAULT_KIND_STUCK: FaultKind
FAULT_KIND_ODD: FaultKind
ERROR_CODE_UNSPECIFIED: ErrorCode
ERROR_CODE_INVALID_REQUEST: ErrorCode
ERROR_CODE_NOT_FOUND: ErrorCode
ERROR_CODE_UNAVAILABLE: ErrorCode
ERROR_CODE_RESOURCE_EXHAUSTED: ErrorCode
ERROR_CODE_DEADLINE_EXCEEDED: ErrorCode
ERROR_CODE_WRONG_CONTRACT: ErrorCode
ERROR_CODE_DEVICE: ErrorCode
ERROR_CODE_DISK: ErrorCode
ERROR_CODE_SIMULATION: ErrorCode
ERROR_CODE_INTERNAL: ErrorCode
ERROR_CODE_PERMISSION_DENIED: ErrorCode

class Tare(_message.Message):
    __slots__ = ("tare_id", "stamp", "sensor_serial", "electrodes", "electrodes_sd", "pdc", "pac", "tac", "tdc", "frames_averaged")
    TARE_ID_FIELD_NUMBER: _ClassVar[int]
    STAMP_FIELD_NUMBER: _ClassVar[int]
    SENSOR_SERIAL_FIELD_NUMBER: _ClassVar[int]
    ELECTRODES_FIELD_NUMBER: _ClassVar[int]
    ELECTRODES_SD_FIELD_NUMBER: _ClassVar[int]
    PDC_FIELD_NUMBER: _ClassVar[int]
    PAC_FIELD_NUMBER: _ClassVar[int]
    TAC_FIELD_NUMBER: _ClassVar[int]
    TDC_FIELD_NUMBER: _ClassVar[int]
    FRAMES_AVERAGED_FIELD_NUMBER: _ClassVar[int]
    tare_id: int
    stamp: _common_pb2.Stamp
    sensor_serial: str
    electrodes: _containers.RepeatedScalarFieldContainer[float]
    electrodes_sd: _containers.RepeatedScalarFieldContainer[float]
    pdc: float
    pac: float
    tac: float
    tdc: float
    frames_averaged: int
    def __init__(self, tare_id: _Optional[int] = ..., stamp: _Optional[_Union[_common_pb2.Stamp, _Mapping]] = ..., sensor_serial: _Optional[str] = ..., electrodes: _Optional[_Iterable[float]] = ..., electrodes_sd: _Optional[_Iterable[float]] = ..., pdc: _Optional[float] = ..., pac: _Optional[float] = ..., tac: _Optional[float] = ..., tdc: _Optional[float] = ..., frames_averaged: _Optional[int] = ...) -> None: ...

class TareRequest(_message.Message):
    __slots__ = ("tare_id", "frames", "request_id", "anyway")
    TARE_ID_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    ANYWAY_FIELD_NUMBER: _ClassVar[int]
    tare_id: int
    frames: int
    request_id: str
    anyway: bool
    def __init__(self, tare_id: _Optional[int] = ..., frames: _Optional[int] = ..., request_id: _Optional[str] = ..., anyway: _Optional[bool] = ...) -> None: ...

class WrenchZeroRequest(_message.Message):
    __slots__ = ("readings", "request_id")
    READINGS_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    readings: int
    request_id: str
    def __init__(self, readings: _Optional[int] = ..., request_id: _Optional[str] = ...) -> None: ...

class WrenchZero(_message.Message):
    __slots__ = ("sensor_serial", "device", "monotonic_ns", "wall_ns", "force_before", "torque_before", "force_after", "torque_after", "readings_averaged")
    SENSOR_SERIAL_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
    WALL_NS_FIELD_NUMBER: _ClassVar[int]
    FORCE_BEFORE_FIELD_NUMBER: _ClassVar[int]
    TORQUE_BEFORE_FIELD_NUMBER: _ClassVar[int]
    FORCE_AFTER_FIELD_NUMBER: _ClassVar[int]
    TORQUE_AFTER_FIELD_NUMBER: _ClassVar[int]
    READINGS_AVERAGED_FIELD_NUMBER: _ClassVar[int]
    sensor_serial: str
    device: str
    monotonic_ns: int
    wall_ns: int
    force_before: _common_pb2.Vector3
    torque_before: _common_pb2.Vector3
    force_after: _common_pb2.Vector3
    torque_after: _common_pb2.Vector3
    readings_averaged: int
    def __init__(self, sensor_serial: _Optional[str] = ..., device: _Optional[str] = ..., monotonic_ns: _Optional[int] = ..., wall_ns: _Optional[int] = ..., force_before: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., torque_before: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., force_after: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., torque_after: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., readings_averaged: _Optional[int] = ...) -> None: ...

class ServiceRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ChannelFault(_message.Message):
    __slots__ = ("kind", "channels")
    KIND_FIELD_NUMBER: _ClassVar[int]
    CHANNELS_FIELD_NUMBER: _ClassVar[int]
    kind: FaultKind
    channels: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, kind: _Optional[_Union[FaultKind, str]] = ..., channels: _Optional[_Iterable[str]] = ...) -> None: ...

class SensorStatus(_message.Message):
    __slots__ = ("name", "state", "since_monotonic_ns", "faults", "message")
    NAME_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    SINCE_MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
    FAULTS_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    name: str
    state: SensorState
    since_monotonic_ns: int
    faults: _containers.RepeatedCompositeFieldContainer[ChannelFault]
    message: str
    def __init__(self, name: _Optional[str] = ..., state: _Optional[_Union[SensorState, str]] = ..., since_monotonic_ns: _Optional[int] = ..., faults: _Optional[_Iterable[_Union[ChannelFault, _Mapping]]] = ..., message: _Optional[str] = ...) -> None: ...

class SupervisedProcess(_message.Message):
    __slots__ = ("service", "instance", "state", "pid", "restarts", "uptime_s")
    SERVICE_FIELD_NUMBER: _ClassVar[int]
    INSTANCE_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    PID_FIELD_NUMBER: _ClassVar[int]
    RESTARTS_FIELD_NUMBER: _ClassVar[int]
    UPTIME_S_FIELD_NUMBER: _ClassVar[int]
    service: str
    instance: str
    state: str
    pid: int
    restarts: int
    uptime_s: float
    def __init__(self, service: _Optional[str] = ..., instance: _Optional[str] = ..., state: _Optional[str] = ..., pid: _Optional[int] = ..., restarts: _Optional[int] = ..., uptime_s: _Optional[float] = ...) -> None: ...

class Status(_message.Message):
    __slots__ = ("service", "instance", "state", "monotonic_ns", "wall_ns", "uptime_s", "version", "counters", "gauges", "sensors", "message", "last_error", "sensor_states", "processes", "models")
    class CountersEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    class GaugesEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    SERVICE_FIELD_NUMBER: _ClassVar[int]
    INSTANCE_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
    WALL_NS_FIELD_NUMBER: _ClassVar[int]
    UPTIME_S_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    COUNTERS_FIELD_NUMBER: _ClassVar[int]
    GAUGES_FIELD_NUMBER: _ClassVar[int]
    SENSORS_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    LAST_ERROR_FIELD_NUMBER: _ClassVar[int]
    SENSOR_STATES_FIELD_NUMBER: _ClassVar[int]
    PROCESSES_FIELD_NUMBER: _ClassVar[int]
    MODELS_FIELD_NUMBER: _ClassVar[int]
    service: str
    instance: str
    state: ServiceState
    monotonic_ns: int
    wall_ns: int
    uptime_s: float
    version: str
    counters: _containers.ScalarMap[str, int]
    gauges: _containers.ScalarMap[str, float]
    sensors: _containers.RepeatedScalarFieldContainer[str]
    message: str
    last_error: Error
    sensor_states: _containers.RepeatedCompositeFieldContainer[SensorStatus]
    processes: _containers.RepeatedCompositeFieldContainer[SupervisedProcess]
    models: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, service: _Optional[str] = ..., instance: _Optional[str] = ..., state: _Optional[_Union[ServiceState, str]] = ..., monotonic_ns: _Optional[int] = ..., wall_ns: _Optional[int] = ..., uptime_s: _Optional[float] = ..., version: _Optional[str] = ..., counters: _Optional[_Mapping[str, int]] = ..., gauges: _Optional[_Mapping[str, float]] = ..., sensors: _Optional[_Iterable[str]] = ..., message: _Optional[str] = ..., last_error: _Optional[_Union[Error, _Mapping]] = ..., sensor_states: _Optional[_Iterable[_Union[SensorStatus, _Mapping]]] = ..., processes: _Optional[_Iterable[_Union[SupervisedProcess, _Mapping]]] = ..., models: _Optional[_Iterable[str]] = ...) -> None: ...

class TensorInfo(_message.Message):
    __slots__ = ("name", "dtype", "shape", "unit")
    NAME_FIELD_NUMBER: _ClassVar[int]
    DTYPE_FIELD_NUMBER: _ClassVar[int]
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    name: str
    dtype: str
    shape: _containers.RepeatedScalarFieldContainer[int]
    unit: str
    def __init__(self, name: _Optional[str] = ..., dtype: _Optional[str] = ..., shape: _Optional[_Iterable[int]] = ..., unit: _Optional[str] = ...) -> None: ...

class ModelMetadata(_message.Message):
    __slots__ = ("name", "version", "task", "bundle_sha256", "contract_version", "inputs", "outputs", "training_data_sha256", "metrics", "trained_on", "served", "training_range", "mesh_sha256", "basis_sha256", "modes")
    class MetricsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    NAME_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    TASK_FIELD_NUMBER: _ClassVar[int]
    BUNDLE_SHA256_FIELD_NUMBER: _ClassVar[int]
    CONTRACT_VERSION_FIELD_NUMBER: _ClassVar[int]
    INPUTS_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    TRAINING_DATA_SHA256_FIELD_NUMBER: _ClassVar[int]
    METRICS_FIELD_NUMBER: _ClassVar[int]
    TRAINED_ON_FIELD_NUMBER: _ClassVar[int]
    SERVED_FIELD_NUMBER: _ClassVar[int]
    TRAINING_RANGE_FIELD_NUMBER: _ClassVar[int]
    MESH_SHA256_FIELD_NUMBER: _ClassVar[int]
    BASIS_SHA256_FIELD_NUMBER: _ClassVar[int]
    MODES_FIELD_NUMBER: _ClassVar[int]
    name: str
    version: int
    task: str
    bundle_sha256: bytes
    contract_version: int
    inputs: _containers.RepeatedCompositeFieldContainer[TensorInfo]
    outputs: _containers.RepeatedCompositeFieldContainer[TensorInfo]
    training_data_sha256: str
    metrics: _containers.ScalarMap[str, float]
    trained_on: str
    served: _containers.RepeatedCompositeFieldContainer[_models_pb2.ServedModel]
    training_range: TrainingRange
    mesh_sha256: bytes
    basis_sha256: bytes
    modes: int
    def __init__(self, name: _Optional[str] = ..., version: _Optional[int] = ..., task: _Optional[str] = ..., bundle_sha256: _Optional[bytes] = ..., contract_version: _Optional[int] = ..., inputs: _Optional[_Iterable[_Union[TensorInfo, _Mapping]]] = ..., outputs: _Optional[_Iterable[_Union[TensorInfo, _Mapping]]] = ..., training_data_sha256: _Optional[str] = ..., metrics: _Optional[_Mapping[str, float]] = ..., trained_on: _Optional[str] = ..., served: _Optional[_Iterable[_Union[_models_pb2.ServedModel, _Mapping]]] = ..., training_range: _Optional[_Union[TrainingRange, _Mapping]] = ..., mesh_sha256: _Optional[bytes] = ..., basis_sha256: _Optional[bytes] = ..., modes: _Optional[int] = ...) -> None: ...

class ValueRange(_message.Message):
    __slots__ = ("name", "unit", "low", "high", "length_max")
    NAME_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    LOW_FIELD_NUMBER: _ClassVar[int]
    HIGH_FIELD_NUMBER: _ClassVar[int]
    LENGTH_MAX_FIELD_NUMBER: _ClassVar[int]
    name: str
    unit: str
    low: _containers.RepeatedScalarFieldContainer[float]
    high: _containers.RepeatedScalarFieldContainer[float]
    length_max: float
    def __init__(self, name: _Optional[str] = ..., unit: _Optional[str] = ..., low: _Optional[_Iterable[float]] = ..., high: _Optional[_Iterable[float]] = ..., length_max: _Optional[float] = ...) -> None: ...

class TrainingRange(_message.Message):
    __slots__ = ("source", "data_sha256", "rows", "inputs", "outputs", "combinations")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    DATA_SHA256_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    INPUTS_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    COMBINATIONS_FIELD_NUMBER: _ClassVar[int]
    source: str
    data_sha256: str
    rows: int
    inputs: _containers.RepeatedCompositeFieldContainer[ValueRange]
    outputs: _containers.RepeatedCompositeFieldContainer[ValueRange]
    combinations: bool
    def __init__(self, source: _Optional[str] = ..., data_sha256: _Optional[str] = ..., rows: _Optional[int] = ..., inputs: _Optional[_Iterable[_Union[ValueRange, _Mapping]]] = ..., outputs: _Optional[_Iterable[_Union[ValueRange, _Mapping]]] = ..., combinations: _Optional[bool] = ...) -> None: ...

class Error(_message.Message):
    __slots__ = ("code", "message", "remedy", "retry_after_ms")
    CODE_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    REMEDY_FIELD_NUMBER: _ClassVar[int]
    RETRY_AFTER_MS_FIELD_NUMBER: _ClassVar[int]
    code: ErrorCode
    message: str
    remedy: str
    retry_after_ms: int
    def __init__(self, code: _Optional[_Union[ErrorCode, str]] = ..., message: _Optional[str] = ..., remedy: _Optional[str] = ..., retry_after_ms: _Optional[int] = ...) -> None: ...

class FieldRequest(_message.Message):
    __slots__ = ("sensor", "frame", "reduced")
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    REDUCED_FIELD_NUMBER: _ClassVar[int]
    sensor: str
    frame: _frames_pb2.ElectrodeFrame
    reduced: bool
    def __init__(self, sensor: _Optional[str] = ..., frame: _Optional[_Union[_frames_pb2.ElectrodeFrame, _Mapping]] = ..., reduced: _Optional[bool] = ...) -> None: ...
