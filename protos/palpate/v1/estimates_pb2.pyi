from palpate.v1 import common_pb2 as _common_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class QualityFlag(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    QUALITY_FLAG_UNSPECIFIED: _ClassVar[QualityFlag]
    QUALITY_FLAG_STALE: _ClassVar[QualityFlag]
    QUALITY_FLAG_SATURATED: _ClassVar[QualityFlag]
    QUALITY_FLAG_UNTARED: _ClassVar[QualityFlag]
    QUALITY_FLAG_OUT_OF_RANGE: _ClassVar[QualityFlag]
    QUALITY_FLAG_EXTRAPOLATING: _ClassVar[QualityFlag]
    QUALITY_FLAG_RANGE_UNKNOWN: _ClassVar[QualityFlag]
    QUALITY_FLAG_UNCALIBRATED: _ClassVar[QualityFlag]
QUALITY_FLAG_UNSPECIFIED: QualityFlag
QUALITY_FLAG_STALE: QualityFlag
QUALITY_FLAG_SATURATED: QualityFlag
QUALITY_FLAG_UNTARED: QualityFlag
QUALITY_FLAG_OUT_OF_RANGE: QualityFlag
QUALITY_FLAG_EXTRAPOLATING: QualityFlag
QUALITY_FLAG_RANGE_UNKNOWN: QualityFlag
QUALITY_FLAG_UNCALIBRATED: QualityFlag

class ErrorBounds(_message.Message):
    __slots__ = ("level", "force_magnitude", "force", "contact_location", "displacement", "other_sensors")
    LEVEL_FIELD_NUMBER: _ClassVar[int]
    FORCE_MAGNITUDE_FIELD_NUMBER: _ClassVar[int]
    FORCE_FIELD_NUMBER: _ClassVar[int]
    CONTACT_LOCATION_FIELD_NUMBER: _ClassVar[int]
    DISPLACEMENT_FIELD_NUMBER: _ClassVar[int]
    OTHER_SENSORS_FIELD_NUMBER: _ClassVar[int]
    level: float
    force_magnitude: float
    force: float
    contact_location: float
    displacement: float
    other_sensors: bool
    def __init__(self, level: _Optional[float] = ..., force_magnitude: _Optional[float] = ..., force: _Optional[float] = ..., contact_location: _Optional[float] = ..., displacement: _Optional[float] = ..., other_sensors: _Optional[bool] = ...) -> None: ...

class FeatureEstimate(_message.Message):
    __slots__ = ("source", "sensor_serial", "bundle_sha256", "tare_id", "in_contact", "force", "force_sd", "contact_location", "contact_location_sd", "quality", "bundle_name", "bundle_version", "centre_of_pressure", "centre_of_pressure_sd", "contact_normal", "contact_normal_sd", "bounds")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_SERIAL_FIELD_NUMBER: _ClassVar[int]
    BUNDLE_SHA256_FIELD_NUMBER: _ClassVar[int]
    TARE_ID_FIELD_NUMBER: _ClassVar[int]
    IN_CONTACT_FIELD_NUMBER: _ClassVar[int]
    FORCE_FIELD_NUMBER: _ClassVar[int]
    FORCE_SD_FIELD_NUMBER: _ClassVar[int]
    CONTACT_LOCATION_FIELD_NUMBER: _ClassVar[int]
    CONTACT_LOCATION_SD_FIELD_NUMBER: _ClassVar[int]
    QUALITY_FIELD_NUMBER: _ClassVar[int]
    BUNDLE_NAME_FIELD_NUMBER: _ClassVar[int]
    BUNDLE_VERSION_FIELD_NUMBER: _ClassVar[int]
    CENTRE_OF_PRESSURE_FIELD_NUMBER: _ClassVar[int]
    CENTRE_OF_PRESSURE_SD_FIELD_NUMBER: _ClassVar[int]
    CONTACT_NORMAL_FIELD_NUMBER: _ClassVar[int]
    CONTACT_NORMAL_SD_FIELD_NUMBER: _ClassVar[int]
    BOUNDS_FIELD_NUMBER: _ClassVar[int]
    source: _common_pb2.Stamp
    sensor_serial: str
    bundle_sha256: bytes
    tare_id: int
    in_contact: bool
    force: _common_pb2.Vector3
    force_sd: _common_pb2.Vector3
    contact_location: _common_pb2.Vector3
    contact_location_sd: _common_pb2.Vector3
    quality: _containers.RepeatedScalarFieldContainer[QualityFlag]
    bundle_name: str
    bundle_version: int
    centre_of_pressure: _common_pb2.Vector3
    centre_of_pressure_sd: _common_pb2.Vector3
    contact_normal: _common_pb2.Vector3
    contact_normal_sd: float
    bounds: ErrorBounds
    def __init__(self, source: _Optional[_Union[_common_pb2.Stamp, _Mapping]] = ..., sensor_serial: _Optional[str] = ..., bundle_sha256: _Optional[bytes] = ..., tare_id: _Optional[int] = ..., in_contact: _Optional[bool] = ..., force: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., force_sd: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., contact_location: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., contact_location_sd: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., quality: _Optional[_Iterable[_Union[QualityFlag, str]]] = ..., bundle_name: _Optional[str] = ..., bundle_version: _Optional[int] = ..., centre_of_pressure: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., centre_of_pressure_sd: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., contact_normal: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., contact_normal_sd: _Optional[float] = ..., bounds: _Optional[_Union[ErrorBounds, _Mapping]] = ...) -> None: ...

class FieldEstimate(_message.Message):
    __slots__ = ("source", "sensor_serial", "bundle_sha256", "tare_id", "mesh_sha256", "displacement", "displacement_sd", "contact_force", "quality", "bundle_name", "bundle_version", "coefficients", "basis_sha256", "bounds")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_SERIAL_FIELD_NUMBER: _ClassVar[int]
    BUNDLE_SHA256_FIELD_NUMBER: _ClassVar[int]
    TARE_ID_FIELD_NUMBER: _ClassVar[int]
    MESH_SHA256_FIELD_NUMBER: _ClassVar[int]
    DISPLACEMENT_FIELD_NUMBER: _ClassVar[int]
    DISPLACEMENT_SD_FIELD_NUMBER: _ClassVar[int]
    CONTACT_FORCE_FIELD_NUMBER: _ClassVar[int]
    QUALITY_FIELD_NUMBER: _ClassVar[int]
    BUNDLE_NAME_FIELD_NUMBER: _ClassVar[int]
    BUNDLE_VERSION_FIELD_NUMBER: _ClassVar[int]
    COEFFICIENTS_FIELD_NUMBER: _ClassVar[int]
    BASIS_SHA256_FIELD_NUMBER: _ClassVar[int]
    BOUNDS_FIELD_NUMBER: _ClassVar[int]
    source: _common_pb2.Stamp
    sensor_serial: str
    bundle_sha256: bytes
    tare_id: int
    mesh_sha256: bytes
    displacement: _containers.RepeatedScalarFieldContainer[float]
    displacement_sd: _containers.RepeatedScalarFieldContainer[float]
    contact_force: _containers.RepeatedScalarFieldContainer[float]
    quality: _containers.RepeatedScalarFieldContainer[QualityFlag]
    bundle_name: str
    bundle_version: int
    coefficients: _containers.RepeatedScalarFieldContainer[float]
    basis_sha256: bytes
    bounds: ErrorBounds
    def __init__(self, source: _Optional[_Union[_common_pb2.Stamp, _Mapping]] = ..., sensor_serial: _Optional[str] = ..., bundle_sha256: _Optional[bytes] = ..., tare_id: _Optional[int] = ..., mesh_sha256: _Optional[bytes] = ..., displacement: _Optional[_Iterable[float]] = ..., displacement_sd: _Optional[_Iterable[float]] = ..., contact_force: _Optional[_Iterable[float]] = ..., quality: _Optional[_Iterable[_Union[QualityFlag, str]]] = ..., bundle_name: _Optional[str] = ..., bundle_version: _Optional[int] = ..., coefficients: _Optional[_Iterable[float]] = ..., basis_sha256: _Optional[bytes] = ..., bounds: _Optional[_Union[ErrorBounds, _Mapping]] = ...) -> None: ...

class SynthesisEstimate(_message.Message):
    __slots__ = ("source", "sensor_serial", "bundle_sha256", "mesh_sha256", "tared_counts", "tared_counts_sd", "quality", "bundle_name", "bundle_version")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_SERIAL_FIELD_NUMBER: _ClassVar[int]
    BUNDLE_SHA256_FIELD_NUMBER: _ClassVar[int]
    MESH_SHA256_FIELD_NUMBER: _ClassVar[int]
    TARED_COUNTS_FIELD_NUMBER: _ClassVar[int]
    TARED_COUNTS_SD_FIELD_NUMBER: _ClassVar[int]
    QUALITY_FIELD_NUMBER: _ClassVar[int]
    BUNDLE_NAME_FIELD_NUMBER: _ClassVar[int]
    BUNDLE_VERSION_FIELD_NUMBER: _ClassVar[int]
    source: _common_pb2.Stamp
    sensor_serial: str
    bundle_sha256: bytes
    mesh_sha256: bytes
    tared_counts: _containers.RepeatedScalarFieldContainer[float]
    tared_counts_sd: _containers.RepeatedScalarFieldContainer[float]
    quality: _containers.RepeatedScalarFieldContainer[QualityFlag]
    bundle_name: str
    bundle_version: int
    def __init__(self, source: _Optional[_Union[_common_pb2.Stamp, _Mapping]] = ..., sensor_serial: _Optional[str] = ..., bundle_sha256: _Optional[bytes] = ..., mesh_sha256: _Optional[bytes] = ..., tared_counts: _Optional[_Iterable[float]] = ..., tared_counts_sd: _Optional[_Iterable[float]] = ..., quality: _Optional[_Iterable[_Union[QualityFlag, str]]] = ..., bundle_name: _Optional[str] = ..., bundle_version: _Optional[int] = ...) -> None: ...

class StageTimings(_message.Message):
    __slots__ = ("age_at_arrival_s", "waiting_s", "decode_s", "tare_s", "infer_s", "encode_s")
    AGE_AT_ARRIVAL_S_FIELD_NUMBER: _ClassVar[int]
    WAITING_S_FIELD_NUMBER: _ClassVar[int]
    DECODE_S_FIELD_NUMBER: _ClassVar[int]
    TARE_S_FIELD_NUMBER: _ClassVar[int]
    INFER_S_FIELD_NUMBER: _ClassVar[int]
    ENCODE_S_FIELD_NUMBER: _ClassVar[int]
    age_at_arrival_s: float
    waiting_s: float
    decode_s: float
    tare_s: float
    infer_s: float
    encode_s: float
    def __init__(self, age_at_arrival_s: _Optional[float] = ..., waiting_s: _Optional[float] = ..., decode_s: _Optional[float] = ..., tare_s: _Optional[float] = ..., infer_s: _Optional[float] = ..., encode_s: _Optional[float] = ...) -> None: ...
