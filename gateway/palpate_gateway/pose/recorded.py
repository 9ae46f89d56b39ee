"""Robot poses in a palpate record: what a robot's program told while the recorder ran.

Poses of the indenter that were published then are in the record, too, and the driver ``record``
plays them. This is for those that shall be made anew, e.g. with a better ``base_sensor``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from palpate.bus.topics import ROBOT_POSE
from palpate.errors import ConfigError, RecordingError, WireError
from palpate.files.record import RecordItem, read_record
from palpate.messages import RobotPoseFrame
from palpate_gateway.pose.rows import Row
from palpate_gateway.pose.track import PoseTrack, Verdict


class RecordedPoses:
    """Poses of one robot of a record; used once.

    Args:
        path: ``NAME.mcap``.
        robot: Name of the robot; empty = the only one.

    Raises:
        RecordingError: Not a record, or without poses of this robot.
        ConfigError: It has poses of several robots, and none was chosen.
    """

    def __init__(self, path: Path, robot: str) -> None:
        self._path = path
        self._track = PoseTrack()
        self._restarts = 0
        self._robot = robot or self._only_robot()
        self.start_wall_ns: int | None = None
        """Wall clock at the first pose [ns]; set when that has been read."""

    @property
    def counters(self) -> Mapping[str, int]:
        """Losses and what was left out; ``restarts`` of the robot's program."""
        return {**self._track.counters, "restarts": self._restarts}

    def close(self) -> None:
        """Nothing is held."""

    def rows(self) -> Iterator[Row]:
        """Poses in order of time.

        Raises:
            RecordingError: The record is damaged, or has no pose of this robot.
        """
        began_ns: int | None = None  # of this run of the program, by its own clock
        since_s = last_s = 0.0
        first_log_ns = 0
        for item in self._items():
            frame = self._decoded(item)
            verdict = self._track.take(frame)
            if verdict is Verdict.RESTARTED:
                # Only the recorder's clock spans both runs; its poses are late by the bus's delay.
                self._restarts += 1
                since_s = max((item.log_time_ns - first_log_ns) * 1e-9, last_s)
                began_ns = None
                self._track.restart()
                verdict = self._track.take(frame)
            if verdict is not Verdict.NEW:
                continue
            if self.start_wall_ns is None:
                self.start_wall_ns = frame.wall_ns or item.log_time_ns
                first_log_ns = item.log_time_ns
            if began_ns is None:
                began_ns = frame.time_ns
            last_s = since_s + (frame.time_ns - began_ns) * 1e-9
            yield Row(frame.sequence, last_s, frame.pose_base_flange, self._track.missed_before)
        if self.start_wall_ns is None:
            raise self._no_poses()

    def _items(self) -> Iterator[RecordItem]:
        for item in read_record(self._path):
            if item.address.topic == ROBOT_POSE.name and item.address.sensor == self._robot:
                yield item

    def _decoded(self, item: RecordItem) -> RobotPoseFrame:
        try:
            return ROBOT_POSE.codec.decode(item.payload)
        except WireError as error:
            raise RecordingError(
                f"{self._path}: a pose of robot {self._robot!r} is damaged: {error.problem}",
                remedy="replay another record; this one broke the contract when written",
            ) from error

    def _only_robot(self) -> str:
        robots: set[str] = set()
        try:
            for item in read_record(self._path):
                if item.address.topic == ROBOT_POSE.name:
                    robots.add(item.address.sensor)
        except RecordingError:
            # A damaged record still delivers what comes before the damage, and then says so.
            if not robots:
                raise
        if len(robots) > 1:
            raise ConfigError(
                f"{self._path} holds {len(robots)} robots: {', '.join(sorted(robots))}",
                remedy="choose one with the option robot",
            )
        if not robots:
            raise self._no_poses()
        return robots.pop()

    def _no_poses(self) -> RecordingError:
        return RecordingError(
            f"{self._path} holds no poses of a robot",
            remedy="record while the robot's program publishes them; poses of the indenter are "
            "played by the driver record",
        )
