from palpate.v1 import common_pb2 as _common_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class SimulationPhase(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SIMULATION_PHASE_UNSPECIFIED: _ClassVar[SimulationPhase]
    SIMULATION_PHASE_WAITING: _ClassVar[SimulationPhase]
    SIMULATION_PHASE_PRESSURISING: _ClassVar[SimulationPhase]
    SIMULATION_PHASE_INDENTING: _ClassVar[SimulationPhase]

class SimulationOutcome(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SIMULATION_OUTCOME_UNSPECIFIED: _ClassVar[SimulationOutcome]
    SIMULATION_OUTCOME_COMPLETE: _ClassVar[SimulationOutcome]
    SIMULATION_OUTCOME_FORCE_LIMIT: _ClassVar[SimulationOutcome]
    SIMULATION_OUTCOME_DIVERGED: _ClassVar[SimulationOutcome]
    SIMULATION_OUTCOME_DEADLINE: _ClassVar[SimulationOutcome]
    SIMULATION_OUTCOME_CANCELLED: _ClassVar[SimulationOutcome]
SIMULATION_PHASE_UNSPECIFIED: SimulationPhase
SIMULATION_PHASE_WAITING: SimulationPhase
SIMULATION_PHASE_PRESSURISING: SimulationPhase
SIMULATION_PHASE_INDENTING: SimulationPhase
SIMULATION_OUTCOME_UNSPECIFIED: SimulationOutcome
SIMULATION_OUTCOME_COMPLETE: SimulationOutcome
SIMULATION_OUTCOME_FORCE_LIMIT: SimulationOutcome
SIMULATION_OUTCOME_DIVERGED: SimulationOutcome
SIMULATION_OUTCOME_DEADLINE: SimulationOutcome
SIMULATION_OUTCOME_CANCELLED: SimulationOutcome

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
    __slots__ = ("request_id", "steps_done", "steps_total", "elapsed_s", "phase", "waiting_before")
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    STEPS_DONE_FIELD_NUMBER: _ClassVar[int]
    STEPS_TOTAL_FIELD_NUMBER: _ClassVar[int]
    ELAPSED_S_FIELD_NUMBER: _ClassVar[int]
    PHASE_FIELD_NUMBER: _ClassVar[int]
    WAITING_BEFORE_FIELD_NUMBER: _ClassVar[int]
    request_id: str
    steps_done: int
    steps_total: int
    elapsed_s: float
    phase: SimulationPhase
    waiting_before: int
    def __init__(self, request_id: _Optional[str] = ..., steps_done: _Optional[int] = ..., steps_total: _Optional[int] = ..., elapsed_s: _Optional[float] = ..., phase: _Optional[_Union[SimulationPhase, str]] = ..., waiting_before: _Optional[int] = ...) -> None: ...

class SimulationConvergence(_message.Message):
    __slots__ = ("increments", "iterations", "factorisations", "residual", "volume_error", "penetration_m", "seconds")
    INCREMENTS_FIELD_NUMBER: _ClassVar[int]
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    FACTORISATIONS_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_FIELD_NUMBER: _ClassVar[int]
    VOLUME_ERROR_FIELD_NUMBER: _ClassVar[int]
    PENETRATION_M_FIELD_NUMBER: _ClassVar[int]
    SECONDS_FIELD_NUMBER: _ClassVar[int]
    increments: int
    iterations: int
    factorisations: int
    residual: float
    volume_error: float
    penetration_m: float
    seconds: float
    def __init__(self, increments: _Optional[int] = ..., iterations: _Optional[int] = ..., factorisations: _Optional[int] = ..., residual: _Optional[float] = ..., volume_error: _Optional[float] = ..., penetration_m: _Optional[float] = ..., seconds: _Optional[float] = ...) -> None: ...

class SimulationStep(_message.Message):
    __slots__ = ("pose_sensor_indenter", "force", "torque", "fluid_pressure_pa", "displacement", "contact_force", "wrench", "contact_area_m2", "centre_of_pressure", "convergence")
    POSE_SENSOR_INDENTER_FIELD_NUMBER: _ClassVar[int]
    FORCE_FIELD_NUMBER: _ClassVar[int]
    TORQUE_FIELD_NUMBER: _ClassVar[int]
    FLUID_PRESSURE_PA_FIELD_NUMBER: _ClassVar[int]
    DISPLACEMENT_FIELD_NUMBER: _ClassVar[int]
    CONTACT_FORCE_FIELD_NUMBER: _ClassVar[int]
    WRENCH_FIELD_NUMBER: _ClassVar[int]
    CONTACT_AREA_M2_FIELD_NUMBER: _ClassVar[int]
    CENTRE_OF_PRESSURE_FIELD_NUMBER: _ClassVar[int]
    CONVERGENCE_FIELD_NUMBER: _ClassVar[int]
    pose_sensor_indenter: _common_pb2.Pose
    force: _common_pb2.Vector3
    torque: _common_pb2.Vector3
    fluid_pressure_pa: float
    displacement: _containers.RepeatedScalarFieldContainer[float]
    contact_force: _containers.RepeatedScalarFieldContainer[float]
    wrench: _containers.RepeatedScalarFieldContainer[float]
    contact_area_m2: float
    centre_of_pressure: _containers.RepeatedScalarFieldContainer[float]
    convergence: SimulationConvergence
    def __init__(self, pose_sensor_indenter: _Optional[_Union[_common_pb2.Pose, _Mapping]] = ..., force: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., torque: _Optional[_Union[_common_pb2.Vector3, _Mapping]] = ..., fluid_pressure_pa: _Optional[float] = ..., displacement: _Optional[_Iterable[float]] = ..., contact_force: _Optional[_Iterable[float]] = ..., wrench: _Optional[_Iterable[float]] = ..., contact_area_m2: _Optional[float] = ..., centre_of_pressure: _Optional[_Iterable[float]] = ..., convergence: _Optional[_Union[SimulationConvergence, _Mapping]] = ...) -> None: ...

class SimulationReply(_message.Message):
    __slots__ = ("request_id", "mesh_sha256", "steps", "stopped_because", "elapsed_s", "more", "first_step", "progress", "outcome", "travel_m")
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    MESH_SHA256_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    STOPPED_BECAUSE_FIELD_NUMBER: _ClassVar[int]
    ELAPSED_S_FIELD_NUMBER: _ClassVar[int]
    MORE_FIELD_NUMBER: _ClassVar[int]
    FIRST_STEP_FIELD_NUMBER: _ClassVar[int]
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    OUTCOME_FIELD_NUMBER: _ClassVar[int]
    TRAVEL_M_FIELD_NUMBER: _ClassVar[int]
    request_id: str
    mesh_sha256: bytes
    steps: _containers.RepeatedCompositeFieldContainer[SimulationStep]
    stopped_because: str
    elapsed_s: float
    more: bool
    first_step: int
    progress: SimulationProgress
    outcome: SimulationOutcome
    travel_m: float
    def __init__(self, request_id: _Optional[str] = ..., mesh_sha256: _Optional[bytes] = ..., steps: _Optional[_Iterable[_Union[SimulationStep, _Mapping]]] = ..., stopped_because: _Optional[str] = ..., elapsed_s: _Optional[float] = ..., more: _Optional[bool] = ..., first_step: _Optional[int] = ..., progress: _Optional[_Union[SimulationProgress, _Mapping]] = ..., outcome: _Optional[_Union[SimulationOutcome, str]] = ..., travel_m: _Optional[float] = ...) -> None: ...

class SimulationCancelRequest(_message.Message):
    __slots__ = ("request_id",)
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    request_id: str
    def __init__(self, request_id: _Optional[str] = ...) -> None: ...

class SimulationCancelReply(_message.Message):
    __slots__ = ("found",)
    FOUND_FIELD_NUMBER: _ClassVar[int]
    found: bool
    def __init__(self, found: _Optional[bool] = ...) -> None: ...
