"""The files of a recorder: which is open, when the next begins, what happens on a full disk."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import Counter
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from palpate.bus import TapSample
from palpate.bus.topics import TOPICS, Topic
from palpate.errors import ErrorCode, RecordingError, WireError
from palpate.files.record import RecordWriter, is_being_written, recover
from palpate.health import Health
from palpate.messages import ServiceState
from palpate_services.config import RecorderConfig
from palpate_services.inference.repository import MeshLibrary
from palpate_services.viewer.live import ViewWorker
from palpate_services.viewer.timeline import SensorScene


class DiskError(RecordingError):
    """The disk takes no more; recording pauses, everything else goes on."""

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
    """The error for a disk that is full or refuses to write, with what is left of it."""
    try:
        left = f"{free_bytes(folder)} bytes free"
    except DiskError:
        left = "free space unknown"
    return DiskError(
        f"recording to {folder} is paused: {why} ({left})",
        remedy="free some space or change recorder.out; recording resumes by itself",
    )


log = logging.getLogger(__name__)

PART = ".part"
RECOVERED = ".recovered.mcap"


NEWBORN_BYTES = 512
NEWBORN_S = 10.0
"""A part this small and young may belong to a recorder that has not locked it yet."""


def leftovers(folder: Path) -> list[Path]:
    """Records in ``folder`` whose writer is gone, oldest first.

    A writer holds a lock on its part; the kernel drops it with the process.
    """
    return [part for part in sorted(folder.glob(f"*.mcap{PART}")) if not _alive(part)]


def recover_all(parts: Iterable[Path], stop: threading.Event | None = None) -> list[Path]:
    """Recover leftovers; one that cannot be read is left as it is.

    Args:
        parts: As found by :func:`leftovers`.
        stop: Ends the work between two files.

    Returns:
        The recovered records.
    """
    done: list[Path] = []
    for part in parts:
        if stop is not None and stop.is_set():
            break
        try:
            if part.name.endswith(f"{RECOVERED}{PART}"):
                part.unlink()  # a recovery that was itself killed; its source is still there
            else:
                done.append(recover(part))
        except (RecordingError, OSError) as error:
            log.warning("%s cannot be recovered: %s", part, error)
    return done


class Recovery:
    """Recovers leftovers in a thread: a large one must not delay the new record.

    Args:
        folder: Folder of records.
        health: Counts ``recovered_records``.
    """

    def __init__(self, folder: Path, health: Health) -> None:
        self._folder = folder
        self._health = health
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Look for leftovers now, recover them by and by; nothing while it is still at it."""
        if self._thread is not None and self._thread.is_alive():
            return
        parts = leftovers(self._folder)
        if parts:
            self._thread = threading.Thread(
                target=self._run, args=(parts,), name="recovery", daemon=True
            )
            self._thread.start()

    def stop(self) -> None:
        """Finish the file at hand, for a moment; an unfinished one is begun again next time."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)

    def _run(self, parts: list[Path]) -> None:
        for path in recover_all(parts, self._stop):
            log.info("recovered %s", path)
            self._health.count("recovered_records", 1)


def _alive(part: Path) -> bool:
    try:
        status = part.stat()
        if status.st_size < NEWBORN_BYTES and time.time() - status.st_mtime < NEWBORN_S:
            return True
        return is_being_written(part)
    except (OSError, RecordingError):
        return True  # gone or not ours: nothing to recover


CHECK_S = 0.15
"""Time between two looks at the disk, and from the last message before a pause to its flush: a full
disk must be reported within a second, a killed recorder must lose no more than 0.3 s."""

RESUME_MARGIN_BYTES = 1024**2
"""More than ``min_free_bytes`` must be free before recording resumes, or it would flutter."""

VIEW_CLOSE_S = 5.0
"""How long a stopping recorder waits for its view to be drawn to the end."""

RETRY_S = 1.0
"""Time between two attempts to open a record on a disk that refused one."""


class RecordKeeper:
    """Writes samples to the record of the hour and draws them beside it. Use from one thread.

    Args:
        config: What is recorded, and where.
        station: Stands in the names of the files.
        health: Hears of every event.

    Raises:
        ConfigError: One of ``config.bundles`` does not exist.
    """

    def __init__(self, config: RecorderConfig, station: str, health: Health) -> None:
        self._config = config
        self._station = station
        self._health = health
        self._counts: Counter[str] = Counter()
        self._writer: RecordWriter | None = None
        self._view: ViewWorker | None = None
        self._views: list[ViewWorker] = []  # the present one, and those that still draw the rest
        self._path: Path | None = None
        self._size = 0
        self._unflushed = 0
        self._opened_s = 0.0
        self._checked_s = 0.0
        self._tried_s = float("-inf")
        self._recovery = Recovery(config.out, health)
        self._meshes = MeshLibrary(config.bundles)

    def start(self) -> None:
        """Make the folder, save what a killed run left behind, open the first record.

        Raises:
            RecordingError: The folder cannot be made. A full disk is no error but a state.
        """
        try:
            self._config.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordingError(
                f"recorder.out = {self._config.out}: {error.strerror}",
                remedy="set recorder.out to a folder this user may write to",
            ) from error
        self._recovery.start()
        self._open()

    def write(self, sample: TapSample) -> None:
        """Record one sample; without a disk to write to it is counted as ``lost_disk_full``."""
        if self._writer is None:
            self._counts["lost_disk_full"] += 1
            return
        topic = TOPICS.get(sample.topic)
        if topic is None or topic.codec.schema != sample.schema:
            self._counts["rejected_schema"] += 1
            return
        message, wall_ns, sequence = self._look_at(topic, sample)
        try:
            self._writer.write(
                sample.key,
                sample.schema,
                sample.payload,
                log_time_ns=sample.received_wall_ns,
                publish_time_ns=wall_ns,
                sequence=sequence,
            )
        except RecordingError as error:
            # With it go those that the writer had not handed to the disk yet.
            self._counts["lost_disk_full"] += 1 + self._unflushed
            self._pause(error.problem)
            return
        size = self._writer.bytes_written
        self._unflushed = self._unflushed + 1 if size == self._size else 0
        self._size = size
        self._counts[f"recorded_{sample.topic}"] += 1
        self._counts["recorded_bytes"] += len(sample.payload)
        if self._view is not None and message is not None and sample.topic in SensorScene.TOPICS:
            self._view.offer(sample.sensor, message)

    def _look_at(self, topic: Topic[Any], sample: TapSample) -> tuple[Any, int, int]:
        """Message, wall clock [ns] and sequence of its stamp.

        What breaks the contract is recorded as it came, for whoever has to find out why.
        """
        try:
            message = topic.codec.decode(sample.payload)
        except WireError as error:
            self._counts[f"invalid_{error.reason}"] += 1
            return None, sample.received_wall_ns, 0
        stamp = topic.stamp_of(message)
        if stamp is None:
            return message, sample.received_wall_ns, 0
        return message, stamp.wall_ns, stamp.sequence

    def tick(self, *, idle: bool = False) -> None:
        """Look at disk, size and time; call it often, it paces itself.

        Args:
            idle: Nothing comes at present, so no coming message will flush the last one.
        """
        now_s = time.monotonic()
        if now_s - self._checked_s < CHECK_S:
            return
        self._checked_s = now_s
        if self._writer is None:
            self._try_to_resume(now_s)
        else:
            if idle:
                self._flush()
            self._check_space()
            self._check_rotation(now_s)
        self.report()

    def report(self) -> None:
        """Hand the counters over to health."""
        counts, self._counts = self._counts, Counter()
        for view in self._views:
            counts.update(view.take_counts())
        self._views = [v for v in self._views if v is self._view or not v.join(0.0)]
        for name, count in counts.items():
            self._health.count(name, count)
        size = 0 if self._writer is None else self._writer.bytes_written
        self._health.gauge("record_bytes", float(size))

    def close(self) -> None:
        """Close record and view; a disk that refuses is reported, not raised."""
        self._recovery.stop()
        problem = self._close_files()
        if problem is not None:
            self._fail(problem)
        for view in self._views:
            view.join(VIEW_CLOSE_S)
        self.report()

    @property
    def path(self) -> Path | None:
        """The record that is being written; None while there is none."""
        return self._path

    def _open(self) -> None:
        self._tried_s = time.monotonic()
        try:
            self._check_room(self._config.min_free_bytes)
            path = self._new_path()
            self._writer = RecordWriter(path, {"station": self._station})
        except RecordingError as error:
            self._fail(error.problem)
            return
        self._path = path
        self._size = self._unflushed = 0
        self._opened_s = time.monotonic()
        if self._config.rrd:
            self._view = ViewWorker(
                path.with_suffix(".rrd"),
                title=path.stem,
                max_bytes=self._config.rrd_max_bytes,
                meshes=self._meshes,
            )
            self._views.append(self._view)
        self._health.set_state(ServiceState.READY, f"recording to {path}")
        self._counts["records_opened"] += 1
        log.info("recording to %s", path)

    def _new_path(self) -> Path:
        now = datetime.now(UTC)
        stamp = f"{now:%Y%m%dT%H%M%S}.{now.microsecond // 1000:03d}Z"
        return self._config.out / f"{self._station}-{stamp}.mcap"

    def _check_room(self, wanted: int) -> None:
        free = free_bytes(self._config.out)
        self._health.gauge("disk_free_bytes", float(free))
        if free < wanted:
            raise DiskError(f"less than {wanted} bytes are free", remedy="free some space")

    def _check_space(self) -> None:
        if self._writer is None:
            return
        try:
            self._check_room(self._config.min_free_bytes)
        except DiskError as error:
            self._pause(error.problem)

    def _flush(self) -> None:
        """What came last before a pause of the streams must reach the disk as well."""
        if self._writer is not None:
            try:
                self._writer.flush()
            except RecordingError as error:
                self._counts["lost_disk_full"] += self._unflushed
                self._pause(error.problem)
            self._unflushed = 0

    def _check_rotation(self, now_s: float) -> None:
        config = self._config
        if self._writer is None:
            return
        full = config.rotate_bytes is not None and self._writer.bytes_written >= config.rotate_bytes
        over = config.rotate_s is not None and now_s - self._opened_s >= config.rotate_s
        if full or over:
            problem = self._close_files()
            if problem is not None:
                self._fail(problem)
            else:
                self._open()

    def _try_to_resume(self, now_s: float) -> None:
        if now_s - self._tried_s < RETRY_S:
            return
        self._tried_s = now_s
        try:
            self._check_room(self._config.min_free_bytes + RESUME_MARGIN_BYTES)
        except DiskError as error:
            self._fail(error.problem)
            return
        self._open()
        if self._writer is not None:
            self._recovery.start()  # what the full disk cut off

    def _pause(self, why: str) -> None:
        self._close_files()  # it may fail for the same reason, which is told already
        self._fail(why)
        self._tried_s = time.monotonic()

    def _fail(self, why: str) -> None:
        error = disk_error(self._config.out, why)
        if self._health.state is not ServiceState.DEGRADED:
            log.error("%s", error)
            self._counts["disk_failures"] += 1
        self._health.fail(error)
        self.report()

    def _close_files(self) -> str | None:
        """Close record and view; why the record could not be closed, if so."""
        writer, self._writer = self._writer, None
        view, self._view = self._view, None
        self._path = None
        problem = None
        if writer is not None:
            try:
                writer.close()
            except RecordingError as error:
                problem = error.problem
                writer.abandon()  # the part stays; recovery saves what is whole in it
        if view is not None:
            view.finish()
        return problem
