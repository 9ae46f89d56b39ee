from palpate.v1 import common_pb2 as _common_pb2
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class RobotPoseFrame(_message.Message):
    __slots__ = ("robot", "run_id", "sequence", "time_ns", "wall_ns", "pose_base_flange")
    ROBOT_FIELD_NUMBER: _ClassVar[int]
    RUN_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    WALL_NS_FIELD_NUMBER: _ClassVar[int]
    POSE_BASE_FLANGE_FIELD_NUMBER: _ClassVar[int]
    robot: str
    run_id: int
    sequence: int
    time_ns: int
    wall_ns: int
    pose_base_flange: _common_pb2.Pose
    def __init__(self, robot: _Optional[str] = ..., run_id: _Optional[int] = ..., sequence: _Optional[int] = ..., time_ns: _Optional[int] = ..., wall_ns: _Optional[int] = ..., pose_base_flange: _Optional[_Union[_common_pb2.Pose, _Mapping]] = ...) -> None: ...
