"""Poses of the indenter from recorded robot poses: a CSV file, or a palpate record.

A record may also hold poses of the indenter, as they were published; the driver ``record`` replays
those. This driver computes them again from the robot's poses, e.g. with a better ``base_sensor``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path

from pydantic import Field

from palpate.bus.topics import POSE, ROBOT_POSE
from palpate.config import Name
from palpate.errors import RecordingError, WireError
from palpate.files.record import RecordItem, only_name, read_record
from palpate.messages import RobotPoseFrame
from palpate_gateway.clock.envelope import SETTLED_S, ClockEnvelope
from palpate_gateway.device import BusDevice, DeviceIdentity, FileDevice
from palpate_gateway.pose.placement import Placement, PlacementOptions, within_reach
from palpate_gateway.pose.table import PoseRow, PoseTable
from palpate_gateway.pose.track import PoseTrack, PoseVerdict
from palpate_gateway.readings import PoseReading

_SET_NS = 5e7
"""A delay, or a line of delays, that jumps by more is of a wall clock that was set [ns]."""

_DRIFT = 1e-3
"""Share of the time between two poses by which clocks can drift apart meanwhile."""


class _RunClock:
    """The clock of one run of a robot's program, without its drift from the recorded wall clock.

    Args:
        first: The first pose of the run.
        log_ns: When the recorder received it [ns since the Unix epoch].
    """

    def __init__(self, first: RobotPoseFrame, log_ns: int) -> None:
        self._time_ns, self._wall_ns = first.time_ns, first.wall_ns or log_ns
        self._tells_wall = first.wall_ns > 0
        self._envelope = ClockEnvelope()
        self._robot_ns = self._delay_ns = self._set_ns = 0
        self._line_ns = self._zero_ns = 0.0

    def elapsed_s(self, frame: RobotPoseFrame, log_ns: int) -> float:
        """Time of the next pose since the first [s]."""
        robot_ns = frame.time_ns - self._time_ns
        wall_ns = frame.wall_ns if self._tells_wall else log_ns
        if wall_ns:
            self._envelope.add(robot_ns * 1e-9, self._delay(robot_ns, wall_ns))
        line_ns = self._envelope.at(robot_ns * 1e-9)
        moved_ns, self._line_ns = line_ns - self._line_ns, line_ns
        # How late the first poses came is no drift either.
        if robot_ns * 1e-9 < SETTLED_S or abs(moved_ns) > _SET_NS:
            self._zero_ns += moved_ns
        return (robot_ns + line_ns - self._zero_ns) * 1e-9

    def _delay(self, robot_ns: int, wall_ns: int) -> int:
        """How much later than the first pose this one is by the wall clock than by its own [ns]."""
        delay_ns = wall_ns - self._wall_ns - robot_ns - self._set_ns
        jump_ns = delay_ns - self._delay_ns
        apart_ns = _SET_NS + _DRIFT * (robot_ns - self._robot_ns)
        if self._tells_wall and abs(jump_ns) > apart_ns:  # the bus delays others by more
            self._set_ns += jump_ns
            delay_ns -= jump_ns
        self._robot_ns, self._delay_ns = robot_ns, delay_ns
        return delay_ns


class RecordedPoses:
    """Poses of one robot in a record; can be read once.

    Args:
        path: ``NAME.mcap``.
        robot: Name of the robot; empty = the only one.

    Raises:
        RecordingError: Not a record, or without poses of this robot.
        ConfigError: It has poses of several robots, and the option ``robot`` is missing.
    """

    def __init__(self, path: Path, robot: str) -> None:
        self._path = path
        self._track = PoseTrack()
        self._restarts = 0
        self._rejected: Counter[str] = Counter()
        self._robot = robot or only_name(path, ROBOT_POSE.name, "robot")
        if not self._robot:
            raise self._no_poses()
        self.start_wall_ns: int | None = None
        """Wall clock at the first pose [ns]; known once that has been read."""

    @property
    def counters(self) -> Mapping[str, int]:
        """Lost, dropped and rejected poses, and ``restarts`` of the robot's program."""
        return {**self._track.counters, **self._rejected, "restarts": self._restarts}

    def close(self) -> None:
        """Do nothing: the record is closed after each reading."""

    def rows(self) -> Iterator[PoseRow]:
        """Poses in order of time.

        Raises:
            RecordingError: The record is damaged, or has no pose of this robot.
        """
        run: _RunClock | None = None  # of this run of the program
        since_s = last_s = 0.0
        first_log_ns = heard_ns = 0
        for item in self._items():
            try:
                frame = ROBOT_POSE.codec.decode(item.payload)
            except WireError as error:  # the recorder keeps what breaks the contract
                self._rejected[f"rejected_{error.reason}"] += 1
                continue
            if heard_ns and item.log_time_ns - heard_ns > 1e9 * BusDevice.gone_s:
                self._track.forget()  # as live
            verdict = self._track.take(frame)
            if verdict is PoseVerdict.RESTARTED:
                # Only the recorder's clock spans both runs; its times include the delay of the bus.
                self._restarts += 1
                since_s = max((item.log_time_ns - first_log_ns) * 1e-9, last_s)
                run = None
                self._track.restart()
                verdict = self._track.take(frame)
            if verdict is not PoseVerdict.NEW:
                continue
            heard_ns = item.log_time_ns
            if self.start_wall_ns is None:
                self.start_wall_ns = frame.wall_ns or item.log_time_ns
                first_log_ns = item.log_time_ns
            if run is None:
                run = _RunClock(frame, item.log_time_ns)
            last_s = max(last_s, since_s + run.elapsed_s(frame, item.log_time_ns))
            yield PoseRow(frame.sequence, last_s, frame.pose_base_flange, self._track.missed_before)
        if self.start_wall_ns is None:
            raise self._no_poses()

    def _items(self) -> Iterator[RecordItem]:
        for item in read_record(self._path):
            if item.address.topic == ROBOT_POSE.name and item.address.sensor == self._robot:
                yield item

    def _no_poses(self) -> RecordingError:
        return RecordingError(
            f"{self._path} holds no poses of a robot",
            remedy="record while the robot's program publishes them; the driver record replays "
            "poses of the indenter",
        )


class PoseFileOptions(PlacementOptions):
    """Options of the ``pose_file`` driver.

    Attributes:
        path: A CSV file, or a palpate record ``NAME.mcap``.
        robot: Name of the robot in a record; None = the only one.
        start_wall_ns: Wall clock at the first pose [ns since the Unix epoch]; None = from the
            file, else unknown.
    """

    path: Path
    robot: Name | None = None
    start_wall_ns: int | None = Field(default=None, ge=0, lt=1 << 63)


class PoseFile(FileDevice):
    """A file of robot poses as a finite device, which delivers as fast as it is read."""

    options_class = PoseFileOptions

    def __init__(self, options: PoseFileOptions) -> None:
        model = f"robot poses {options.path.name}, {options.indenter}"
        super().__init__("pose_file", None, model, POSE.rate_hz)
        self._options = options
        self._placement = Placement(options)
        self._source: PoseTable | RecordedPoses | None = None
        self._counts: Mapping[str, int] = {}
        self._samples = 0

    @property
    def counters(self) -> Mapping[str, int]:
        """Poses that became readings, and dropped poses by reason."""
        more = self._counts if self._source is None else self._source.counters
        return {"samples": self._samples, **more}

    def _open(self) -> DeviceIdentity:
        options = self._options
        self._samples = 0
        self._source = (
            RecordedPoses(options.path, options.robot or "")
            if options.path.suffix == ".mcap"
            else PoseTable(options.path)
        )
        try:
            rows = self._source.rows()
            # The first row has the wall clock, and a file without a valid row must fail here.
            self._deliver(self._poses(chain([next(rows)], rows)))
        except BaseException:
            self._close()
            raise
        file_wall_ns = self._source.start_wall_ns
        return DeviceIdentity(
            serial=options.robot or options.path.name,
            slot_period_s=1.0 / self.info.rate_hz,
            start_wall_ns=file_wall_ns if options.start_wall_ns is None else options.start_wall_ns,
        )

    def _close(self) -> None:
        source, self._source = self._source, None
        super()._close()
        if source is not None:
            self._counts = source.counters
            source.close()

    def _poses(self, rows: Iterable[PoseRow]) -> Iterator[PoseReading]:
        began_s: float | None = None
        for row in rows:
            if began_s is None:
                began_s = row.time_s  # time zero: the wall clock is known at the first pose
            if not within_reach(row.pose.position):  # in a record: a table tells line and column
                told = ", ".join(f"{part:g}" for part in row.pose.position)
                raise RecordingError(
                    f"{self._options.path}: pose {row.tick} is at ({told}) m, out of any robot's "
                    "reach",
                    remedy="let the robot's program publish metres, and record again",
                )
            self._samples += 1
            yield self._placement.reading(
                row.pose,
                tick=row.tick,
                time_s=row.time_s - began_s,
                missed_before=row.missed_before,
            )
