"""What a user's robot tells. Comments: ``robot.proto``."""

from __future__ import annotations

from dataclasses import dataclass

from palpate.messages.simulation import Pose


@dataclass(frozen=True, slots=True)
class RobotPoseFrame:
    """Where the flange of a robot is, in the robot's base frame, by the robot's own clock.

    Attributes:
        robot: Name of the robot, as in the key.
        sequence: Contiguous in one run of the robot's program, from 1; a hole = a pose was lost.
        time_ns: When it was there, by a monotonic clock of the program's own [ns].
        pose_base_flange: Position [m] and unit quaternion w x y z of the flange in the base.
        run_id: Another one at each start of the program; 0 = not told.
        wall_ns: Wall clock at the same instant [ns since the Unix epoch]; 0 = not told.
    """

    robot: str
    sequence: int
    time_ns: int
    pose_base_flange: Pose
    run_id: int = 0
    wall_ns: int = 0
