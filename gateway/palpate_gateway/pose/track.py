"""The order of a robot's poses: finds lost, late and repeated poses, and restarts."""

from __future__ import annotations

from collections import deque
from enum import Enum

from palpate.messages import RobotPoseFrame

_BEGAN_ANEW = 10
"""Poses in a row that follow each other, but not the last good one, and so show a new run."""

_MISSED_MAX = 0xFFFF_FFFF
"""Largest number that a stamp can hold."""

_RUNS_REMEMBERED = 16


class PoseVerdict(Enum):
    """Judgement on the next pose of a run."""

    NEW = "new"
    DROPPED = "dropped"
    RESTARTED = "restarted"


class PoseTrack:
    """Judges each pose by run, sequence and time.

    ``counters``: ``lost_poses``, and for dropped poses ``late_poses`` (earlier than the last one),
    ``repeated_poses`` (same time), ``wrong_times`` (the clock went back) and ``poses_of_old_runs``
    (from a program that another one has replaced).
    """

    def __init__(self) -> None:
        self._old_runs: deque[int] = deque(maxlen=_RUNS_REMEMBERED)
        self.begin()

    def begin(self) -> None:
        """Accept any next pose, except of a run that was replaced; set the counters to 0."""
        self.counters = dict.fromkeys(
            ("lost_poses", "late_poses", "repeated_poses", "wrong_times", "poses_of_old_runs"), 0
        )
        self.restart()

    def restart(self) -> None:
        """The same without a change of the counters."""
        self.missed_before = 0
        """Poses lost directly before the last new one."""
        self._missed = 0
        self._last: RobotPoseFrame | None = None
        self._suspect: RobotPoseFrame | None = None
        self._suspects = 0

    def forget(self) -> None:
        """The program that had replaced others is gone: poses of theirs count again."""
        self._old_runs.clear()

    def take(self, frame: RobotPoseFrame) -> PoseVerdict:
        """Judge the next pose; after RESTARTED comes ``begin`` or ``restart``."""
        if frame.run_id in self._old_runs:
            return self._drop("poses_of_old_runs")
        last = self._last
        if last is None:
            return self._accept(frame, 0)
        if frame.run_id != last.run_id:
            self._retire(last)
            return PoseVerdict.RESTARTED
        ahead = frame.sequence - last.sequence
        if ahead > 0 and frame.time_ns > last.time_ns:
            return self._accept(frame, ahead - 1)
        if frame.time_ns == last.time_ns:
            if ahead > 0:  # the robot published the same state again
                self._lose(ahead - 1)
                self._last = frame
            return self._drop("repeated_poses")
        # With a run id a restart shows by a new id, so an old sequence number is only late.
        if ahead <= 0 and frame.run_id:
            return self._drop("late_poses")
        if ahead <= 0 and frame.time_ns > last.time_ns:
            return PoseVerdict.RESTARTED  # it counts from 1 again, while its clock continued
        return self._doubt(frame, "wrong_times" if ahead > 0 else "late_poses")

    def _accept(self, frame: RobotPoseFrame, missed: int) -> PoseVerdict:
        self._lose(missed)
        self.missed_before, self._missed = min(self._missed, _MISSED_MAX), 0
        self._last, self._suspect, self._suspects = frame, None, 0
        return PoseVerdict.NEW

    def _lose(self, poses: int) -> None:
        self.counters["lost_poses"] += poses
        self._missed += poses

    def _drop(self, counter: str) -> PoseVerdict:
        self.counters[counter] += 1
        return PoseVerdict.DROPPED

    def _doubt(self, frame: RobotPoseFrame, counter: str) -> PoseVerdict:
        """Judge a pose that is late if few are like it, and shows a restart if many are."""
        suspect, self._suspect = self._suspect, frame
        follows = (
            suspect is not None
            and frame.sequence > suspect.sequence
            and frame.time_ns > suspect.time_ns
        )
        self._suspects = self._suspects + 1 if follows else 1
        if self._suspects >= _BEGAN_ANEW:
            return PoseVerdict.RESTARTED
        return self._drop(counter)

    def _retire(self, frame: RobotPoseFrame) -> None:
        if frame.run_id:
            self._old_runs.append(frame.run_id)
