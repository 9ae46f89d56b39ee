"""The files of a recorder: rotation, full disks, and records that a killed recorder left behind."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from palpate.bus import TapSample
from palpate.bus.continuity import Holes
from palpate.bus.topics import FIELD, FIELD_TRUTH, TARE, TOPICS, Topic, sensor_key
from palpate.errors import ErrorCode, RecordingError, WireError
from palpate.files.record import Recovery, is_being_written, recover
from palpate.files.record_writer import RecordGone, RecordWriter
from palpate.health import Health
from palpate.heartbeat import beat
from palpate.messages import NO_TARE, ElectrodeFrame, ServiceState, Tare
from palpate_services.config import RecorderConfig
from palpate_services.inference.loop import RateLimit
from palpate_services.inference.repository import MeshLibrary
from palpate_services.recorder import retention
from palpate_services.viewer.live_view import LiveView, ViewMessage, ViewPlan
from palpate_services.viewer.timeline import SensorTimeline


class DiskError(RecordingError):
    """The disk is full or refuses to write; recording pauses, everything else goes on."""

    code = ErrorCode.DISK


def free_bytes(folder: Path) -> int:
    """Bytes an unprivileged process may still write under ``folder``.

    Raises:
        DiskError: The folder cannot be examined, e.g. because its disk is gone.
    """
    try:
        status = os.statvfs(folder)
    except OSError as error:
        raise DiskError(
            f"{folder}: {error.strerror}", remedy="mount the disk again, or record elsewhere"
        ) from error
    return status.f_bavail * status.f_frsize


def disk_error(folder: Path, why: str) -> DiskError:
    """The error for a disk that is full or refuses to write, with its free space."""
    try:
        left = f"{free_bytes(folder) / 1e6:,.0f} MB free"
    except DiskError:
        left = "free space unknown"
    return DiskError(
        f"recording to {folder} is paused: {why} ({left})",
        remedy="free some space, and see that the folder may be written: recording resumes by "
        "itself; or record elsewhere: recorder.out, or --out of `palpate record`",
    )


_log = logging.getLogger(__name__)

PART = ".part"
RECOVERED = ".recovered.mcap"

_HEAD_BYTES = 8
"""A smaller part lacks even the mark at the start of every MCAP file: it holds nothing [bytes]."""


FRESH_BYTES = 512
FRESH_S = 10.0
"""A part as small and young as this may belong to a recorder that has not locked it yet."""


def leftovers(folder: Path) -> list[Path]:
    """Records in ``folder`` whose writer is gone, oldest first.

    A writer holds a lock on its part; the kernel drops it with the process.
    """
    return [part for part in sorted(folder.glob(f"*.mcap{PART}")) if not _alive(part)]


def recover_all(parts: Iterable[Path], stop: threading.Event | None = None) -> list[Recovery]:
    """Recover leftovers; one that cannot be read stays as it is, one that is empty is removed.

    ``stop`` ends the work between two files. Returns what was recovered.
    """
    done: list[Recovery] = []
    for part in parts:
        if stop is not None and stop.is_set():
            break
        try:
            # A recovery that was itself killed, its source is still there; or a recorder that was
            # killed before its first write was whole.
            if _is_half(part) or part.stat().st_size < _HEAD_BYTES:
                part.unlink(missing_ok=True)
            else:
                done.append(recover(part))
        except (RecordingError, OSError) as error:
            _log.warning("%s cannot be recovered: %s", part, error)
    return done


def _is_half(part: Path) -> bool:
    """Whether it is a recovery that did not come to its end."""
    return part.name.endswith(f"{RECOVERED}{PART}")


class RecordRecovery:
    """Recovers leftovers in a thread, because a large one must not delay the new record.

    One of which the disk has no room for a copy waits: the copy would make the recorder pause.
    Counts ``recovered_records``, and those of them that were damaged: ``damaged_records``.
    """

    def __init__(self, folder: Path, health: Health, min_free_bytes: int) -> None:
        self._folder = folder
        self._health = health
        self._min_free_bytes = min_free_bytes
        self._waiting: list[Path] = []
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Look for leftovers and start to recover them, unless a recovery still runs."""
        if self._thread is not None and self._thread.is_alive():
            return
        # Looked up before the thread starts: the new record that the caller opens after this call
        # must not be taken for a leftover.
        parts = leftovers(self._folder)
        self._waiting = []
        if parts:
            self._thread = threading.Thread(
                target=self._run, args=(parts,), name="recovery", daemon=True
            )
            self._thread.start()

    def resume(self) -> None:
        """Start again, if there is room now for one that waits."""
        if any(part.exists() and self._has_room(part) for part in self._waiting):
            self.start()

    def stop(self) -> None:
        """Stop after the present file; after two seconds it is left for the next start."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)

    def _run(self, parts: list[Path]) -> None:
        for part in sorted(parts, key=_is_half, reverse=True):  # those are removed: it gives room
            if not (_is_half(part) or self._has_room(part)):
                _log.warning("%s waits to be recovered until there is room for a copy", part)
                self._waiting.append(part)
                continue
            for found in recover_all([part], self._stop):
                _log.log(logging.WARNING if found.places else logging.INFO, "recovered %s", found)
                self._health.count("recovered_records", 1)
                if found.places:
                    self._health.count("damaged_records", 1)

    def _has_room(self, part: Path) -> bool:
        """Whether the disk has room for a copy, and for the recorder; True if it cannot be said."""
        try:
            return free_bytes(self._folder) >= part.stat().st_size + self._min_free_bytes
        except OSError:
            return True


def _alive(part: Path) -> bool:
    try:
        status = part.stat()
        if status.st_size < FRESH_BYTES and time.time() - status.st_mtime < FRESH_S:
            return True
        return is_being_written(part)
    except (OSError, RecordingError):
        return True  # gone or not ours: nothing to recover


CHECK_S = 0.15
"""Time between two checks of the disk, and from the last message before a silence to its flush [s]:
a full disk must be reported within a second, a killed recorder must lose no more than 0.3 s."""

RESUME_MARGIN_BYTES = 1024**2
"""Recording resumes only with this much more than ``min_free_bytes``: without the margin it would
start and stop in turn."""

CLOSE_S = 60.0
"""How long a slow disk may take to close a record, in the thread that beats [s]: it waits until all
is on the disk."""

VIEW_CLOSE_S = 5.0
"""How long a stopping recorder waits for its view to be completed [s]."""

RETRY_S = 1.0
"""Time between two attempts to open a record on a disk that refused one [s]."""


_FIELDS = (FIELD, FIELD_TRUTH)


FindTare = Callable[[str, int], Tare | None]
"""From a sensor and the id of one of its tares to the tare; None = not known yet."""


class RecordFiles:
    """Writes samples to the present record, and draws them into its view.

    Use from one thread, but for ``other_trouble_is_over``.

    Frames name their tare. One that was taken before the record began is looked up and recorded
    before them: without it nobody could read the frames. Each tare is recorded once.

    Args:
        config: Where and what.
        station: Its name.
        health: Of the recorder.
        find_tare: Looks up a tare, and may wait for it; None = only those are recorded that come
            while it records.

    Raises:
        ConfigError: One of ``config.bundles`` does not exist.
    """

    def __init__(
        self,
        config: RecorderConfig,
        station: str,
        health: Health,
        find_tare: FindTare | None = None,
    ) -> None:
        self._find_tare = find_tare
        self._tares: set[tuple[str, int]] = set()  # in the present record
        self._config = config
        self._station = station
        self._health = health
        self._counts: Counter[str] = Counter()
        self._path = config.out
        self.opened: list[Path] = []
        """The records that were begun, in this order; each has its name when it has ended."""
        self._writer: RecordWriter | None = None
        self._view: LiveView | None = None
        self._views: list[LiveView] = []  # the present one, and earlier ones that are not finished
        self._size = 0
        self._unflushed = 0
        self._opened_s = 0.0
        self._checked_s = 0.0
        self._tried_s = float("-inf")
        self._told = False  # of the present trouble with the disk
        self._says_ready = False
        self._recovery = RecordRecovery(config.out, health, config.min_free_bytes)
        MeshLibrary(config.bundles)  # raises for one that is missing, which a view would only log
        self._retention = retention.Retention(config, station, health)
        self._kept_s = float("-inf")
        self._holes = Holes()
        self._field_rate = RateLimit(config.field_rate_hz or None)

    def start(self) -> None:
        """Make the folder, recover what a killed run left behind, open the first record.

        Raises:
            RecordingError: The folder cannot be made. A full disk is no error but a state.
        """
        self._make_folder()
        self._recovery.start()
        self._open()

    def _make_folder(self) -> None:
        try:
            self._config.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordingError(
                f"recorder.out = {self._config.out}: {error.strerror}",
                remedy="name a folder that this user may write to: recorder.out, or --out of "
                "`palpate record`",
            ) from error

    def write(self, sample: TapSample) -> None:
        """Record one sample; without a disk to write to it is counted as ``lost_disk_full``.

        Those that never came are counted as ``lost_on_bus``.
        """
        if self._writer is None:
            self._counts["lost_disk_full"] += 1
            self._holes = Holes()  # what is missing when it goes on is counted already
            return
        topic = TOPICS.get(sample.topic)
        if topic is None or topic.codec.schema != sample.schema:
            self._counts["rejected_schema"] += 1
            return
        message = self._decode(topic, sample)
        stamp = None if message is None else topic.stamp_of(message)
        if stamp is not None and topic.contiguous:
            arrived_ns, lost_here = sample.received_monotonic_ns, sample.lost_here
            if hole := self._holes.take(
                sample.key, stamp, arrived_ns=arrived_ns, lost_here=lost_here
            ):
                self._counts["lost_on_bus"] += hole
        if isinstance(message, Tare):
            name = sample.sensor, message.tare_id
            if name in self._tares:  # one that was looked up for a frame, or is told again
                self._counts["repeated_tares"] += 1
                return
            self._tares.add(name)
        elif isinstance(message, ElectrodeFrame):
            self._write_tare_of(message, sample)
            if self._writer is None:  # the disk refused the tare
                self._counts["lost_disk_full"] += 1
                return
        stream = f"{sample.sensor}/{sample.topic}"
        field_stamp = stamp if topic in _FIELDS else None
        if field_stamp is not None and self._field_rate.reached(stream, field_stamp):
            self._counts["skipped_field_rate"] += 1
            return
        try:
            self._writer.write(
                sample.key,
                sample.schema,
                sample.payload,
                log_time_ns=sample.received_wall_ns,
                publish_time_ns=sample.received_wall_ns if stamp is None else stamp.wall_ns,
                sequence=0 if stamp is None else stamp.sequence,
            )
        except WireError as error:
            self._counts[f"rejected_{error.reason}"] += 1
            return
        except RecordingError as error:
            # Lost with it: samples that the writer still held in its buffer.
            self._unflushed += 1
            self._count_unflushed()
            self._pause(error.problem)
            return
        # The writer flushes by its own clock; that the file has grown is the sign of it.
        size = self._writer.bytes_written
        self._unflushed = self._unflushed + 1 if size == self._size else 0
        self._size = size
        if field_stamp is not None:
            self._field_rate.note(stream, field_stamp)
        self._counts[f"recorded_{sample.topic}"] += 1
        self._counts["recorded_bytes"] += len(sample.payload)
        if self._view is not None and message is not None and sample.topic in SensorTimeline.TOPICS:
            self._view.offer(ViewMessage(sample.sensor, sample.topic, sample.payload))

    def _write_tare_of(self, frame: ElectrodeFrame, sample: TapSample) -> None:
        """Record the tare that a frame names, if the present record does not hold it."""
        name = sample.sensor, frame.tare_id
        if self._find_tare is None or frame.tare_id == NO_TARE or name in self._tares:
            return
        tare = self._find_tare(*name)
        if tare is not None:
            self.write(
                replace(
                    sample,
                    topic=TARE.name,
                    key=sensor_key(sample.station, sample.sensor, TARE.name),
                    encoding=TARE.encoding,
                    payload=TARE.codec.encode(tare),
                )
            )

    def _decode(self, topic: Topic[Any], sample: TapSample) -> Any:
        """The message; None if it cannot be decoded.

        Such a payload is recorded all the same, so that its cause can be found.
        """
        try:
            return topic.codec.decode(sample.payload)
        except WireError as error:
            self._counts[f"invalid_{error.reason}"] += 1
            return None

    def tick(self, *, idle: bool = False) -> None:
        """Check disk, size and age of the record every ``CHECK_S``; call it more often.

        ``idle``: no messages arrive at present, so none will cause a flush of the last ones.
        """
        now_s = time.monotonic()
        if now_s - self._checked_s < CHECK_S:
            return
        self._checked_s = now_s
        if self._says_ready:
            self._says_ready = False
            self._say_ready()
        if self._writer is None:
            self._try_to_resume(now_s)
        else:
            self._check(self._writer, now_s, idle=idle)
        if now_s - self._kept_s >= retention.CHECK_S:
            self._keep(now_s)
        self.report()

    def _keep(self, now_s: float) -> None:
        """Remove old records, within what the present one has left of the room.

        Then recover those that waited for room.
        """
        self._kept_s = now_s
        present = 0
        if self._writer is not None:
            present = self._writer.bytes_written
            with contextlib.suppress(OSError):  # a view is there after its first update, if at all
                present += self._writer.path.with_suffix(".rrd").stat().st_size
        self._retention.apply(present)
        self._recovery.resume()

    def report(self) -> None:
        """Hand the counters to health."""
        counts, self._counts = self._counts, Counter()
        # Views of earlier records stay in the list until their threads have ended, to be counted:
        # asked before, because a thread may still count between the two.
        going_on = [v for v in self._views if v is self._view or not v.join(0.0)]
        for view in self._views:
            counts.update(view.take_counts())
        self._views = going_on
        for name, count in counts.items():
            self._health.count(name, count)
        size = 0 if self._writer is None else self._writer.bytes_written
        self._health.gauge("record_bytes", float(size))

    def close(self) -> None:
        """Close record and view; a failing disk is reported, not raised."""
        self._recovery.stop()
        problem = self._close_files()
        if problem is not None:
            self._fail(problem)
        for view in self._views:
            view.close(VIEW_CLOSE_S)
        self.report()

    def _open(self) -> None:
        self._tried_s = time.monotonic()
        try:
            self._check_room(self._config.min_free_bytes)
            path = self._new_path()
            facts = {"station": self._station, **self._retention.facts}
            if self._config.run:
                facts["run"] = self._config.run
            self._writer = RecordWriter(path, facts)
        except RecordingError as error:
            self._fail(error.problem)
            return
        self._size = self._unflushed = 0
        self._told = False
        self._tares.clear()
        self._opened_s = time.monotonic()
        if self._config.rrd:
            plan = ViewPlan(
                path.with_suffix(".rrd"),
                path.stem,
                self._config.rrd_max_bytes,
                self._config.bundles,
            )
            self._view = LiveView(plan)
            self._views.append(self._view)
        self._path = path
        self.opened.append(path)
        self._say_ready()
        self._counts["records_opened"] += 1
        _log.info("recording to %s", path)

    def other_trouble_is_over(self) -> None:
        """Have the next ``tick`` say that it records, if it does; from any thread."""
        self._says_ready = True

    def _say_ready(self) -> None:
        if self._writer is not None:
            self._health.set_state(ServiceState.READY, f"recording to {self._path}")

    def _new_path(self) -> Path:
        now = datetime.now(UTC)
        stamp = f"{now:%Y%m%dT%H%M%S}.{now.microsecond // 1000:03d}Z"
        return self._config.out / f"{self._station}-{stamp}.mcap"

    def _check_room(self, wanted: int) -> None:
        self._make_folder()  # somebody may have removed it
        free = free_bytes(self._config.out)
        self._health.gauge("disk_free_bytes", float(free))
        if free < wanted:
            raise DiskError(f"less than {wanted / 1e6:,.0f} MB are free", remedy="free some space")

    def _check(self, writer: RecordWriter, now_s: float, *, idle: bool) -> None:
        config = self._config
        try:
            writer.check_place()
            if idle:
                self._flush(writer)
            self._check_room(config.min_free_bytes)
        except RecordGone:
            self._close_files()  # tells it
            self._open()
            return
        except RecordingError as error:
            self._pause(error.problem)
            return
        full = 0 < config.rotate_bytes <= writer.bytes_written
        over = 0 < config.rotate_s <= now_s - self._opened_s
        if full or over:
            problem = self._close_files()
            if problem is not None:
                self._fail(problem)
            else:
                self._open()
            self._keep(now_s)  # the closed record is one of those that count

    def _flush(self, writer: RecordWriter) -> None:
        """Write the last messages before a silence of the streams."""
        try:
            writer.flush()
        except RecordingError:
            self._count_unflushed()
            raise
        # The size too: `write` takes a larger file for the sign of a flush of its own.
        self._size, self._unflushed = writer.bytes_written, 0

    def _try_to_resume(self, now_s: float) -> None:
        if now_s - self._tried_s < RETRY_S:
            return
        self._tried_s = now_s
        try:
            self._check_room(self._config.min_free_bytes + RESUME_MARGIN_BYTES)
        except RecordingError as error:
            self._fail(error.problem)
            return
        self._open()
        if self._writer is not None:
            self._recovery.start()  # of the record that the full disk cut off

    def _count_unflushed(self) -> None:
        """Count the samples in the writer's buffer as lost; they cannot be written any more."""
        if self._unflushed:
            self._counts["lost_disk_full"] += self._unflushed
            self._unflushed = 0

    def _pause(self, why: str) -> None:
        self._close_files()  # it may fail for the same reason, which is reported below
        self._fail(why)
        self._tried_s = time.monotonic()

    def _fail(self, why: str) -> None:
        error = disk_error(self._config.out, why)
        if not self._told:  # health may be DEGRADED for another reason, or still from the last time
            _log.error("%s", error)
            self._counts["disk_failures"] += 1
            self._told = True
        self._health.fail(error)
        self.report()

    def _close_files(self) -> str | None:
        """Close record and view; returns the problem if the record could not be closed."""
        writer, self._writer = self._writer, None
        view, self._view = self._view, None
        problem = None
        if writer is not None:
            beat(CLOSE_S)
            try:
                writer.close()
            except RecordGone as gone:
                self._unflushed = 0  # among those that are lost with it
                self._counts["lost_with_record"] += gone.lost
                self._counts["records_gone"] += 1
                _log.error("%s", gone)
                self._health.fail(gone)
                writer.abandon()
            except RecordingError as error:
                problem = error.problem
                self._count_unflushed()
                writer.abandon()  # the part stays; recovery saves its complete messages
        if view is not None:
            view.finish()
        return problem
