from palpate.v1 import common_pb2 as _common_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ElectrodeFrame(_message.Message):
    __slots__ = ("stamp", "sensor_serial", "sensor_type", "electrodes", "pdc", "pac", "tac", "tdc", "validity", "slot_period_ns", "tare_id")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    SENSOR_SERIAL_FIELD_NUMBER: _ClassVar[int]
    SENSOR_TYPE_FIELD_NUMBER: _ClassVar[int]
    ELECTRODES_FIELD_NUMBER: _ClassVar[int]
    PDC_FIELD_NUMBER: _ClassVar[int]
    PAC_FIELD_NUMBER: _ClassVar[int]
    TAC_FIELD_NUMBER: _ClassVar[int]
    TDC_FIELD_NUMBER: _ClassVar[int]
    VALIDITY_FIELD_NUMBER: _ClassVar[int]
    SLOT_PERIOD_NS_FIELD_NUMBER: _ClassVar[int]
    TARE_ID_FIELD_NUMBER: _ClassVar[int]
    stamp: _common_pb2.Stamp
    sensor_serial: str
    sensor_type: _common_pb2.SensorType
    electrodes: bytes
    pdc: int
    pac: bytes
    tac: int
    tdc: int
    validity: int
    slot_period_ns: int
    tare_id: int
    def __init__(self, stamp: _Optional[_Union[_common_pb2.Stamp, _Mapping]] = ..., sensor_serial: _Optional[str] = ..., sensor_type: _Optional[_Union[_common_pb2.SensorType, str]] = ..., electrodes: _Optional[bytes] = ..., pdc: _Optional[int] = ..., pac: _Optional[bytes] = ..., tac: _Optional[int] = ..., tdc: _Optional[int] = ..., validity: _Optional[int] = ..., slot_period_ns: _Optional[int] = ..., tare_id: _Optional[int] = ...) -> None: ...

class WrenchFrame(_message.Message):
    __slots__ = ("stamp", "sensor_serial", "force", "torque", "overload")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    SENSOR_SERIAL_FIELD_NUMBER: _ClassVar[int]
    FORCE_FIELD_NUMBER: _ClassVar[int]
    TORQUE_FIELD_NUMBER: _ClassVar[int]
    OVERLOAD_FIELD_NUMBER: _ClassVar[int]
    stamp: _common_pb2.Stamp
    sensor_serial: str
    force: _common_pb2.Vector3
    torque: _common_pb2.Vector3
    overload: bool
    def __init__(self, stamp: _Optional[_Union[_common_pb2.Stamp, _Mapping]] = ..., sensor_serial: _Optional[str] = ..., force: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., torque: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., overload: _Optional[bool] = ...) -> None: ...

class IndenterPoseFrame(_message.Message):
    __slots__ = ("stamp", "indenter", "pose_sensor_indenter", "in_contact", "contact_unknown")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    INDENTER_FIELD_NUMBER: _ClassVar[int]
    POSE_SENSOR_INDENTER_FIELD_NUMBER: _ClassVar[int]
    IN_CONTACT_FIELD_NUMBER: _ClassVar[int]
    CONTACT_UNKNOWN_FIELD_NUMBER: _ClassVar[int]
    stamp: _common_pb2.Stamp
    indenter: str
    pose_sensor_indenter: _common_pb2.Pose
    in_contact: bool
    contact_unknown: bool
    def __init__(self, stamp: _Optional[_Union[_common_pb2.Stamp, _Mapping]] = ..., indenter: _Optional[str] = ..., pose_sensor_indenter: _Optional[_Union[_common_pb2.Pose, _Mapping]] = ..., in_contact: _Optional[bool] = ..., contact_unknown: _Optional[bool] = ...) -> None: ...

class FieldFrame(_message.Message):
    __slots__ = ("stamp", "sensor_serial", "mesh_sha256", "displacement")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    SENSOR_SERIAL_FIELD_NUMBER: _ClassVar[int]
    MESH_SHA256_FIELD_NUMBER: _ClassVar[int]
    DISPLACEMENT_FIELD_NUMBER: _ClassVar[int]
    stamp: _common_pb2.Stamp
    sensor_serial: str
    mesh_sha256: bytes
    displacement: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, stamp: _Optional[_Union[_common_pb2.Stamp, _Mapping]] = ..., sensor_serial: _Optional[str] = ..., mesh_sha256: _Optional[bytes] = ..., displacement: _Optional[_Iterable[float]] = ...) -> None: ...
