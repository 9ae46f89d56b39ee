from palpate.v1 import estimates_pb2 as _estimates_pb2
from palpate.v1 import frames_pb2 as _frames_pb2
from palpate.v1 import simulation_pb2 as _simulation_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class FeatureRequest(_message.Message):
    __slots__ = ("sensor", "frame")
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    sensor: str
    frame: _frames_pb2.ElectrodeFrame
    def __init__(self, sensor: _Optional[str] = ..., frame: _Optional[_Union[_frames_pb2.ElectrodeFrame, _Mapping]] = ...) -> None: ...

class ContactDescription(_message.Message):
    __slots__ = ("indenter", "location", "direction", "depth_m", "force_n")
    INDENTER_FIELD_NUMBER: _ClassVar[int]
    LOCATION_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    DEPTH_M_FIELD_NUMBER: _ClassVar[int]
    FORCE_N_FIELD_NUMBER: _ClassVar[int]
    indenter: str
    location: _containers.RepeatedScalarFieldContainer[float]
    direction: _containers.RepeatedScalarFieldContainer[float]
    depth_m: float
    force_n: float
    def __init__(self, indenter: _Optional[str] = ..., location: _Optional[_Iterable[float]] = ..., direction: _Optional[_Iterable[float]] = ..., depth_m: _Optional[float] = ..., force_n: _Optional[float] = ...) -> None: ...

class SynthesisRequest(_message.Message):
    __slots__ = ("field", "contact", "simulation", "simulator", "deadline_s", "every_step", "request_id")
    FIELD_FIELD_NUMBER: _ClassVar[int]
    CONTACT_FIELD_NUMBER: _ClassVar[int]
    SIMULATION_FIELD_NUMBER: _ClassVar[int]
    SIMULATOR_FIELD_NUMBER: _ClassVar[int]
    DEADLINE_S_FIELD_NUMBER: _ClassVar[int]
    EVERY_STEP_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    field: _frames_pb2.FieldFrame
    contact: ContactDescription
    simulation: _simulation_pb2.SimulationRequest
    simulator: str
    deadline_s: float
    every_step: bool
    request_id: str
    def __init__(self, field: _Optional[_Union[_frames_pb2.FieldFrame, _Mapping]] = ..., contact: _Optional[_Union[ContactDescription, _Mapping]] = ..., simulation: _Optional[_Union[_simulation_pb2.SimulationRequest, _Mapping]] = ..., simulator: _Optional[str] = ..., deadline_s: _Optional[float] = ..., every_step: _Optional[bool] = ..., request_id: _Optional[str] = ...) -> None: ...

class SynthesisReply(_message.Message):
    __slots__ = ("estimate", "step", "step_number", "outcome", "stopped_because", "more")
    ESTIMATE_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    STEP_NUMBER_FIELD_NUMBER: _ClassVar[int]
    OUTCOME_FIELD_NUMBER: _ClassVar[int]
    STOPPED_BECAUSE_FIELD_NUMBER: _ClassVar[int]
    MORE_FIELD_NUMBER: _ClassVar[int]
    estimate: _estimates_pb2.SynthesisEstimate
    step: _simulation_pb2.SimulationStep
    step_number: int
    outcome: _simulation_pb2.SimulationOutcome
    stopped_because: str
    more: bool
    def __init__(self, estimate: _Optional[_Union[_estimates_pb2.SynthesisEstimate, _Mapping]] = ..., step: _Optional[_Union[_simulation_pb2.SimulationStep, _Mapping]] = ..., step_number: _Optional[int] = ..., outcome: _Optional[_Union[_simulation_pb2.SimulationOutcome, str]] = ..., stopped_because: _Optional[str] = ..., more: _Optional[bool] = ...) -> None: ...

class BasisRequest(_message.Message):
    __slots__ = ("basis_sha256",)
    BASIS_SHA256_FIELD_NUMBER: _ClassVar[int]
    basis_sha256: bytes
    def __init__(self, basis_sha256: _Optional[bytes] = ...) -> None: ...

class FieldBasis(_message.Message):
    __slots__ = ("basis_sha256", "mesh_sha256", "modes_total", "first_mode", "nodes", "mean", "modes", "more")
    BASIS_SHA256_FIELD_NUMBER: _ClassVar[int]
    MESH_SHA256_FIELD_NUMBER: _ClassVar[int]
    MODES_TOTAL_FIELD_NUMBER: _ClassVar[int]
    FIRST_MODE_FIELD_NUMBER: _ClassVar[int]
    NODES_FIELD_NUMBER: _ClassVar[int]
    MEAN_FIELD_NUMBER: _ClassVar[int]
    MODES_FIELD_NUMBER: _ClassVar[int]
    MORE_FIELD_NUMBER: _ClassVar[int]
    basis_sha256: bytes
    mesh_sha256: bytes
    modes_total: int
    first_mode: int
    nodes: int
    mean: _containers.RepeatedScalarFieldContainer[float]
    modes: _containers.RepeatedScalarFieldContainer[float]
    more: bool
    def __init__(self, basis_sha256: _Optional[bytes] = ..., mesh_sha256: _Optional[bytes] = ..., modes_total: _Optional[int] = ..., first_mode: _Optional[int] = ..., nodes: _Optional[int] = ..., mean: _Optional[_Iterable[float]] = ..., modes: _Optional[_Iterable[float]] = ..., more: _Optional[bool] = ...) -> None: ...
