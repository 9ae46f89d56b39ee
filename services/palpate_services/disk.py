"""Free space, and the error that says there is too little."""

from __future__ import annotations

import os
from pathlib import Path

from palpate.errors import ErrorCode, RecordingError


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
