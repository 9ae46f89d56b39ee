"""What a killed recorder left behind: a ``.mcap.part`` becomes a readable record again."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable
from pathlib import Path

from palpate.errors import RecordingError
from palpate.files.record import is_being_written, recover
from palpate.health import Health

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
