from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Origin(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ORIGIN_UNSPECIFIED: _ClassVar[Origin]
    ORIGIN_LIVE: _ClassVar[Origin]
    ORIGIN_SIMULATED: _ClassVar[Origin]
    ORIGIN_REPLAYED: _ClassVar[Origin]

class SensorType(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SENSOR_TYPE_UNSPECIFIED: _ClassVar[SensorType]
    SENSOR_TYPE_BIOTAC: _ClassVar[SensorType]
    SENSOR_TYPE_BIOTAC_SP: _ClassVar[SensorType]
ORIGIN_UNSPECIFIED: Origin
ORIGIN_LIVE: Origin
ORIGIN_SIMULATED: Origin
ORIGIN_REPLAYED: Origin
SENSOR_TYPE_UNSPECIFIED: SensorType
SENSOR_TYPE_BIOTAC: SensorType
SENSOR_TYPE_BIOTAC_SP: SensorType

class Stamp(_message.Message):
    __slots__ = ("sequence", "device_tick", "monotonic_ns", "wall_ns", "clock_id", "origin", "missed_before", "session_id")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TICK_FIELD_NUMBER: _ClassVar[int]
    MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
    WALL_NS_FIELD_NUMBER: _ClassVar[int]
    CLOCK_ID_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_FIELD_NUMBER: _ClassVar[int]
    MISSED_BEFORE_FIELD_NUMBER: _ClassVar[int]
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    device_tick: int
    monotonic_ns: int
    wall_ns: int
    clock_id: int
    origin: Origin
    missed_before: int
    session_id: int
    def __init__(self, sequence: _Optional[int] = ..., device_tick: _Optional[int] = ..., monotonic_ns: _Optional[int] = ..., wall_ns: _Optional[int] = ..., clock_id: _Optional[int] = ..., origin: _Optional[_Union[Origin, str]] = ..., missed_before: _Optional[int] = ..., session_id: _Optional[int] = ...) -> None: ...

class Vector3(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("px", "py", "pz", "qw", "qx", "qy", "qz")
    PX_FIELD_NUMBER: _ClassVar[int]
    PY_FIELD_NUMBER: _ClassVar[int]
    PZ_FIELD_NUMBER: _ClassVar[int]
    QW_FIELD_NUMBER: _ClassVar[int]
    QX_FIELD_NUMBER: _ClassVar[int]
    QY_FIELD_NUMBER: _ClassVar[int]
    QZ_FIELD_NUMBER: _ClassVar[int]
    px: float
    py: float
    pz: float
    qw: float
    qx: float
    qy: float
    qz: float
    def __init__(self, px: _Optional[float] = ..., py: _Optional[float] = ..., pz: _Optional[float] = ..., qw: _Optional[float] = ..., qx: _Optional[float] = ..., qy: _Optional[float] = ..., qz: _Optional[float] = ...) -> None: ...
