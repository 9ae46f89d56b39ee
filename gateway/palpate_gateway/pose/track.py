"""The order of a robot's poses: what was lost, what came late or twice, when it began anew."""

from __future__ import annotations

from collections import deque
from enum import Enum

from palpate.messages import RobotPoseFrame

_BEGAN_ANEW = 10
"""So many poses in a row that cannot follow the last good one, but each other, are a new run."""

_MISSED_MAX = 0xFFFF_FFFF
"""What a stamp can say."""

_RUNS_REMEMBERED = 16


class Verdict(Enum):
    """What the place of a pose in its run says of it."""

    NEW = "new"
    DROPPED = "dropped"
    RESTARTED = "restarted"


class PoseTrack:
    """Judges each pose by run, sequence and time.

    ``counters``: ``lost_poses``; and of poses that are dropped ``late_poses`` (an earlier one than
    the last), ``repeated_poses`` (of the same time), ``wrong_times`` (a clock that went back) and
    ``poses_of_old_runs`` (of a program that another one has replaced).
    """

    def __init__(self) -> None:
        self._old_runs: deque[int] = deque(maxlen=_RUNS_REMEMBERED)
        self.begin()

    def begin(self) -> None:
        """Any pose may come next, but none of a run that has been replaced."""
        self.counters = dict.fromkeys(
            ("lost_poses", "late_poses", "repeated_poses", "wrong_times", "poses_of_old_runs"), 0
        )
        self.restart()

    def restart(self) -> None:
        """The same, and the counters go on."""
        self.missed_before = 0
        """Poses lost directly before the last new one."""
        self._missed = 0
        self._last: RobotPoseFrame | None = None
        self._suspect: RobotPoseFrame | None = None
        self._suspects = 0

    def take(self, frame: RobotPoseFrame) -> Verdict:
        """Judge the next pose; after RESTARTED comes ``begin`` or ``restart``."""
        if frame.run_id in self._old_runs:
            return self._drop("poses_of_old_runs")
        last = self._last
        if last is None:
            return self._accept(frame, 0)
        if frame.run_id != last.run_id:
            self._retire(last)
            return Verdict.RESTARTED
        ahead = frame.sequence - last.sequence
        if ahead > 0 and frame.time_ns > last.time_ns:
            return self._accept(frame, ahead - 1)
        if frame.time_ns == last.time_ns:
            if ahead > 0:  # the robot had nothing new to tell, and the sequence goes on
                self._lose(ahead - 1)
                self._last = frame
            return self._drop("repeated_poses")
        if ahead <= 0 and frame.run_id:
            return self._drop("late_poses")
        if ahead <= 0 and frame.time_ns > last.time_ns:
            return Verdict.RESTARTED  # it counts from 1 again, and its clock went on
        return self._doubt(frame, "wrong_times" if ahead > 0 else "late_poses")

    def _accept(self, frame: RobotPoseFrame, missed: int) -> Verdict:
        self._lose(missed)
        self.missed_before, self._missed = min(self._missed, _MISSED_MAX), 0
        self._last, self._suspect, self._suspects = frame, None, 0
        return Verdict.NEW

    def _lose(self, poses: int) -> None:
        self.counters["lost_poses"] += poses
        self._missed += poses

    def _drop(self, counter: str) -> Verdict:
        self.counters[counter] += 1
        return Verdict.DROPPED

    def _doubt(self, frame: RobotPoseFrame, counter: str) -> Verdict:
        """One that came late, if it is alone or few; else the program began anew."""
        suspect, self._suspect = self._suspect, frame
        follows = (
            suspect is not None
            and frame.sequence > suspect.sequence
            and frame.time_ns > suspect.time_ns
        )
        self._suspects = self._suspects + 1 if follows else 1
        if self._suspects >= _BEGAN_ANEW:
            return Verdict.RESTARTED
        return self._drop(counter)

    def _retire(self, frame: RobotPoseFrame) -> None:
        if frame.run_id:
            self._old_runs.append(frame.run_id)
