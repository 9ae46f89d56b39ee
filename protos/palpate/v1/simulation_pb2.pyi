from palpate.v1 import common_pb2 as _common_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class SimulationRequest(_message.Message):
    __slots__ = ("request_id", "indenter", "path", "parameters", "deadline_s", "want_displacement", "want_contact_force")
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    INDENTER_FIELD_NUMBER: _ClassVar[int]
    PATH_FIELD_NUMBER: _ClassVar[int]
    PARAMETERS_FIELD_NUMBER: _ClassVar[int]
    DEADLINE_S_FIELD_NUMBER: _ClassVar[int]
    WANT_DISPLACEMENT_FIELD_NUMBER: _ClassVar[int]
    WANT_CONTACT_FORCE_FIELD_NUMBER: _ClassVar[int]
    request_id: str
    indenter: str
    path: _containers.RepeatedCompositeFieldContainer[_common_pb2.Pose]
    parameters: SimulationParameters
    deadline_s: float
    want_displacement: bool
    want_contact_force: bool
    def __init__(self, request_id: _Optional[str] = ..., indenter: _Optional[str] = ..., path: _Optional[_Iterable[_Union[_common_pb2.Pose, _Mapping]]] = ..., parameters: _Optional[_Union[SimulationParameters, _Mapping]] = ..., deadline_s: _Optional[float] = ..., want_displacement: _Optional[bool] = ..., want_contact_force: _Optional[bool] = ...) -> None: ...

class SimulationParameters(_message.Message):
    __slots__ = ("skin_thickness_m", "shear_modulus_pa", "friction_coefficient", "fluid_volume_m3")
    SKIN_THICKNESS_M_FIELD_NUMBER: _ClassVar[int]
    SHEAR_MODULUS_PA_FIELD_NUMBER: _ClassVar[int]
    FRICTION_COEFFICIENT_FIELD_NUMBER: _ClassVar[int]
    FLUID_VOLUME_M3_FIELD_NUMBER: _ClassVar[int]
    skin_thickness_m: float
    shear_modulus_pa: float
    friction_coefficient: float
    fluid_volume_m3: float
    def __init__(self, skin_thickness_m: _Optional[float] = ..., shear_modulus_pa: _Optional[float] = ..., friction_coefficient: _Optional[float] = ..., fluid_volume_m3: _Optional[float] = ...) -> None: ...

class SimulationProgress(_message.Message):
    __slots__ = ("request_id", "steps_done", "steps_total", "elapsed_s")
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    STEPS_DONE_FIELD_NUMBER: _ClassVar[int]
    STEPS_TOTAL_FIELD_NUMBER: _ClassVar[int]
    ELAPSED_S_FIELD_NUMBER: _ClassVar[int]
    request_id: str
    steps_done: int
    steps_total: int
    elapsed_s: float
    def __init__(self, request_id: _Optional[str] = ..., steps_done: _Optional[int] = ..., steps_total: _Optional[int] = ..., elapsed_s: _Optional[float] = ...) -> None: ...

class SimulationStep(_message.Message):
    __slots__ = ("pose_sensor_indenter", "force", "torque", "fluid_pressure_pa", "displacement", "contact_force")
    POSE_SENSOR_INDENTER_FIELD_NUMBER: _ClassVar[int]
    FORCE_FIELD_NUMBER: _ClassVar[int]
    TORQUE_FIELD_NUMBER: _ClassVar[int]
    FLUID_PRESSURE_PA_FIELD_NUMBER: _ClassVar[int]
    DISPLACEMENT_FIELD_NUMBER: _ClassVar[int]
    CONTACT_FORCE_FIELD_NUMBER: _ClassVar[int]
    pose_sensor_indenter: _common_pb2.Pose
    force: _common_pb2.Vector3
    torque: _common_pb2.Vector3
    fluid_pressure_pa: float
    displacement: _containers.RepeatedScalarFieldContainer[float]
    contact_force: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, pose_sensor_indenter: _Optional[_Union[_common_pb2.Pose, _Mapping]] = ..., force: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., torque: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., fluid_pressure_pa: _Optional[float] = ..., displacement: _Optional[_Iterable[float]] = ..., contact_force: _Optional[_Iterable[float]] = ...) -> None: ...

class SimulationReply(_message.Message):
    __slots__ = ("request_id", "mesh_sha256", "steps", "stopped_because", "elapsed_s")
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    MESH_SHA256_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    STOPPED_BECAUSE_FIELD_NUMBER: _ClassVar[int]
    ELAPSED_S_FIELD_NUMBER: _ClassVar[int]
    request_id: str
    mesh_sha256: bytes
    steps: _containers.RepeatedCompositeFieldContainer[SimulationStep]
    stopped_because: str
    elapsed_s: float
    def __init__(self, request_id: _Optional[str] = ..., mesh_sha256: _Optional[bytes] = ..., steps: _Optional[_Iterable[_Union[SimulationStep, _Mapping]]] = ..., stopped_because: _Optional[str] = ..., elapsed_s: _Optional[float] = ...) -> None: ...
