"""Which old records a recorder removes, so that it never fills a disk by itself.

Only whole files that a recorder with retention has written: named by it, in its folder, with the
fact ``retention`` at their start. A record that is renamed or moved is kept, as is every other
file. A record that is open somewhere stays readable there until it is closed, as files do on Linux.
"""

from __future__ import annotations

import contextlib
import logging
import re
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from palpate.clock import EARLIEST_WALL_S
from palpate.errors import RecordingError
from palpate.files.record import is_being_written, metadata_of
from palpate.health import Health
from palpate_services.config import RecorderConfig

_log = logging.getLogger(__name__)

FACT = "retention"
"""Key of the fact in a record that allows its removal."""

OLDEST_FIRST = "oldest first"

CHECK_S = 60.0
"""Time between two looks at the folder [s]."""

STEADY_S = 600.0
"""How long the wall clock must have run without a jump before ages are believed [s]: that of a host
that has just started may be years off."""

_JUMP_S = 60.0
# Goes on while the host is suspended, as the wall clock does.
_STEADY = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
_STAMP = r"-\d{8}T\d{6}\.\d{3}Z"
_ENDING = r"(?:\.recovered)?\.mcap(?:\.part|\.damaged)?"


@dataclass(frozen=True, slots=True)
class OldRecord:
    """A closed record: its file, the view beside it, bytes of both, and when it ended (wall, s)."""

    path: Path
    view: Path
    size: int
    ended_s: float


class Retention:
    """Removes the oldest records of a folder. Use from one thread.

    Counters: ``removed_records``, ``removed_bytes``, ``removal_failures``. Gauge:
    ``kept_records_bytes``, the closed records that may be removed.
    """

    def __init__(self, config: RecorderConfig, station: str, health: Health) -> None:
        self._config = config
        self._station = station
        self._name = re.compile(f"(?P<stem>{re.escape(station)}{_STAMP}){_ENDING}")
        self._health = health
        self._mine: dict[tuple[str, int], bool] = {}  # by name and inode: files never change
        # Those that were closed at the first look; and when each other one was first seen closed
        # (steady, s): the wall clock by which it was written may have been put right since then.
        # Also of one whose time cannot be: it was written before the clock was set.
        self._earlier: set[tuple[str, int]] = set()
        self._closed_s: dict[tuple[str, int], float] = {}
        self._looked = False
        self._clocks = self._read_clocks()
        self._steady_since_s = self._clocks[0]

    @property
    def facts(self) -> dict[str, str]:
        """Facts to write into a new record."""
        on = self._config.keep_bytes or self._config.keep_s
        return {FACT: OLDEST_FIRST} if on else {}

    def apply(self, present_bytes: int = 0) -> None:
        """Remove what is too old or too much; ``present_bytes`` is the size of the open record."""
        if not self.facts:
            return
        try:
            paths = list(self._config.out.iterdir())
        except OSError as error:
            _log.warning("%s cannot be read: %s", self._config.out, error.strerror or error)
            return
        records = sorted(self._found(paths), key=lambda record: (record.ended_s, record.path.name))
        total = sum(record.size for record in records) + present_bytes
        oldest_s = self._oldest_allowed_s()
        for record in records:
            if record.ended_s < oldest_s:
                why = f"it is older than {self._config.keep_s / 86400:g} days"
            elif self._config.keep_bytes and total > self._config.keep_bytes:
                why = f"all records have more than {self._config.keep_bytes:,} bytes"
            else:
                continue
            if self._remove(record, why):
                total -= record.size
        self._health.gauge("kept_records_bytes", float(total - present_bytes))

    def _oldest_allowed_s(self) -> float:
        """Wall time [s] before which a record must not have ended."""
        now, before = self._read_clocks(), self._clocks
        self._clocks = now
        if abs((now[1] - before[1]) - (now[0] - before[0])) > _JUMP_S:
            self._steady_since_s = now[0]
        if not self._config.keep_s or now[0] - self._steady_since_s < STEADY_S:
            return float("-inf")
        return now[1] - self._config.keep_s

    @staticmethod
    def _read_clocks() -> tuple[float, float]:
        return time.clock_gettime(_STEADY), time.time()

    def _found(self, paths: Iterable[Path]) -> Iterator[OldRecord]:
        """Closed records among these that this station's recorder may remove."""
        seen: set[tuple[str, int]] = set()
        steady_s, wall_s = self._read_clocks()
        for path in paths:
            match = self._name.fullmatch(path.name)
            # A file can be renamed, recovered or removed by others at any time.
            with contextlib.suppress(OSError, RecordingError):
                if match is None or path.is_symlink() or not path.is_file():
                    continue
                status = path.stat()
                key = path.name, status.st_ino
                seen.add(key)
                # Before it is opened, which may fail for a moment: its age does not depend on that.
                if not self._looked:
                    self._earlier.add(key)
                if path.suffix == ".part" and is_being_written(path):
                    self._earlier.discard(key)
                    continue
                if key not in self._earlier or status.st_mtime < EARLIEST_WALL_S:
                    self._closed_s.setdefault(key, steady_s)
                if key not in self._mine:
                    self._mine[key] = metadata_of(path).get(FACT) == OLDEST_FIRST
                if not self._mine[key]:
                    continue
                view = path.with_name(f"{match['stem']}.rrd")
                size = status.st_size + (view.stat().st_size if view.is_file() else 0)
                closed_s = self._closed_s.get(key)
                ended_s = status.st_mtime if closed_s is None else wall_s - (steady_s - closed_s)
                yield OldRecord(path, view, size, ended_s)
        self._earlier &= seen
        self._mine = {key: mine for key, mine in self._mine.items() if key in seen}
        self._closed_s = {key: at_s for key, at_s in self._closed_s.items() if key in seen}
        self._looked = True

    def _remove(self, record: OldRecord, why: str) -> bool:
        try:
            record.view.unlink(missing_ok=True)
            record.path.unlink()
        except OSError as error:
            _log.warning("%s cannot be removed: %s", record.path, error.strerror or error)
            self._health.count("removal_failures", 1)
            return False
        _log.info("removed %s (%d bytes): %s", record.path, record.size, why)
        self._health.count("removed_records", 1)
        self._health.count("removed_bytes", record.size)
        return True
