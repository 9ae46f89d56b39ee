from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ModelAction(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    MODEL_ACTION_UNSPECIFIED: _ClassVar[ModelAction]
    MODEL_ACTION_LIST: _ClassVar[ModelAction]
    MODEL_ACTION_LOAD: _ClassVar[ModelAction]
    MODEL_ACTION_UNLOAD: _ClassVar[ModelAction]
    MODEL_ACTION_ROLL_BACK: _ClassVar[ModelAction]
MODEL_ACTION_UNSPECIFIED: ModelAction
MODEL_ACTION_LIST: ModelAction
MODEL_ACTION_LOAD: ModelAction
MODEL_ACTION_UNLOAD: ModelAction
MODEL_ACTION_ROLL_BACK: ModelAction

class ModelCommand(_message.Message):
    __slots__ = ("action", "station", "service", "instance", "bundle", "sensor", "nonce", "wall_ns")
    ACTION_FIELD_NUMBER: _ClassVar[int]
    STATION_FIELD_NUMBER: _ClassVar[int]
    SERVICE_FIELD_NUMBER: _ClassVar[int]
    INSTANCE_FIELD_NUMBER: _ClassVar[int]
    BUNDLE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    NONCE_FIELD_NUMBER: _ClassVar[int]
    WALL_NS_FIELD_NUMBER: _ClassVar[int]
    action: ModelAction
    station: str
    service: str
    instance: str
    bundle: str
    sensor: str
    nonce: bytes
    wall_ns: int
    def __init__(self, action: _Optional[_Union[ModelAction, str]] = ..., station: _Optional[str] = ..., service: _Optional[str] = ..., instance: _Optional[str] = ..., bundle: _Optional[str] = ..., sensor: _Optional[str] = ..., nonce: _Optional[bytes] = ..., wall_ns: _Optional[int] = ...) -> None: ...

class ModelRequest(_message.Message):
    __slots__ = ("command", "mac")
    COMMAND_FIELD_NUMBER: _ClassVar[int]
    MAC_FIELD_NUMBER: _ClassVar[int]
    command: bytes
    mac: bytes
    def __init__(self, command: _Optional[bytes] = ..., mac: _Optional[bytes] = ...) -> None: ...

class ServedModel(_message.Message):
    __slots__ = ("sensor", "name", "version", "bundle_sha256", "since_wall_ns", "previous")
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    BUNDLE_SHA256_FIELD_NUMBER: _ClassVar[int]
    SINCE_WALL_NS_FIELD_NUMBER: _ClassVar[int]
    PREVIOUS_FIELD_NUMBER: _ClassVar[int]
    sensor: str
    name: str
    version: int
    bundle_sha256: bytes
    since_wall_ns: int
    previous: str
    def __init__(self, sensor: _Optional[str] = ..., name: _Optional[str] = ..., version: _Optional[int] = ..., bundle_sha256: _Optional[bytes] = ..., since_wall_ns: _Optional[int] = ..., previous: _Optional[str] = ...) -> None: ...

class ModelInventory(_message.Message):
    __slots__ = ("instance", "served", "available", "change_s")
    INSTANCE_FIELD_NUMBER: _ClassVar[int]
    SERVED_FIELD_NUMBER: _ClassVar[int]
    AVAILABLE_FIELD_NUMBER: _ClassVar[int]
    CHANGE_S_FIELD_NUMBER: _ClassVar[int]
    instance: str
    served: _containers.RepeatedCompositeFieldContainer[ServedModel]
    available: _containers.RepeatedScalarFieldContainer[str]
    change_s: float
    def __init__(self, instance: _Optional[str] = ..., served: _Optional[_Iterable[_Union[ServedModel, _Mapping]]] = ..., available: _Optional[_Iterable[str]] = ..., change_s: _Optional[float] = ...) -> None: ...
