"""Codec of what a user's robot tells."""

from __future__ import annotations

from palpate.codec.base import Codec, codec_of
from palpate.codec.checks import reject
from palpate.codec.simulation import pose_from_wire, pose_to_wire
from palpate.errors import ConfigError, WireError
from palpate.messages import RobotPoseFrame
from palpate.names import check_name
from palpate.v1 import robot_pb2

_TIMES = 1 << 63


def _check(robot: str, sequence: int, time_ns: int, wall_ns: int) -> None:
    try:
        check_name(robot, "robot")
    except ConfigError as error:
        raise WireError(error.problem, remedy=error.remedy, reason="robot") from error
    if sequence < 1:
        reject("sequence", f"sequence is {sequence}, sequences start at 1")
    # Beyond int64 no clock of ours can be; and consumers store times as int64.
    if not (0 <= time_ns < _TIMES and 0 <= wall_ns < _TIMES):
        reject("time", f"times {time_ns}, {wall_ns} ns are negative or exceed int64")


def _from_wire(msg: robot_pb2.RobotPoseFrame) -> RobotPoseFrame:
    robot, sequence, time_ns, wall_ns = msg.robot, msg.sequence, msg.time_ns, msg.wall_ns
    _check(robot, sequence, time_ns, wall_ns)
    pose = pose_from_wire(msg.pose_base_flange, "pose_base_flange")
    return RobotPoseFrame(robot, sequence, time_ns, pose, msg.run_id, wall_ns)


def _encode(frame: RobotPoseFrame) -> bytes:
    _check(frame.robot, frame.sequence, frame.time_ns, frame.wall_ns)
    try:
        msg = robot_pb2.RobotPoseFrame(
            robot=frame.robot,
            run_id=frame.run_id,
            sequence=frame.sequence,
            time_ns=frame.time_ns,
            wall_ns=frame.wall_ns,
            pose_base_flange=pose_to_wire(frame.pose_base_flange, "pose_base_flange"),
        )
    except (TypeError, ValueError) as error:
        if isinstance(error, WireError):
            raise
        raise WireError(
            f"{frame}: {error}",
            remedy="give whole numbers of nanoseconds, and three and four numbers of a pose",
            reason="parse",
        ) from error
    return msg.SerializeToString()


ROBOT_POSE_FRAME: Codec[RobotPoseFrame] = codec_of(robot_pb2.RobotPoseFrame, _encode, _from_wire)
