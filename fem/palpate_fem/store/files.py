"""Files that appear complete or not at all, with one writer at a time.

A writer claims a file by a lock on ``NAME.part``, writes into that, brings it to the disk and
renames it. The kernel drops a lock with its process, so a killed writer blocks nobody.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
from pathlib import Path

from palpate.errors import DatasetError, ErrorCode
from palpate.files.atomic import sync_folder
from palpate.files.simulation_store import SUFFIX
from palpate.process import Closing

PART = ".part"


class StoreTakenError(DatasetError):
    """Another writer uses the store, or runs or has finished this trajectory."""

    code = ErrorCode.UNAVAILABLE


class StoreDiskError(DatasetError):
    """The disk is full or refuses; what a store holds is kept."""

    code = ErrorCode.DISK


class StoreMismatchError(DatasetError):
    """The result belongs to another fingertip than the store."""


def disk_error(path: Path, error: OSError) -> StoreDiskError:
    """The error for a file that cannot be written."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    remedy = "free some space" if full else "check the folder's rights and that its disk is there"
    in_store = any(folder.suffix == SUFFIX for folder in (path, *path.parents))
    kept = ": what was finished before is kept" if in_store else ""
    return StoreDiskError(
        f"cannot write {path}: {error.strerror or error}",
        remedy=f"{remedy} and run the same command again{kept}",
    )


class FileClaim(Closing):
    """The exclusive right to write one file, until the block or the process ends.

    Args:
        target: The file; its folder is created.
        wait: Wait for another claim to end instead of raising.

    Attributes:
        part: File to write into, if :meth:`commit` does not suit.

    Raises:
        StoreTakenError: Another process or thread has claimed it.
        StoreDiskError: No file can be created in the folder.
    """

    def __init__(self, target: Path, *, wait: bool = False) -> None:
        self.target = target
        self.part = target.with_name(target.name + PART)
        try:
            _make_folder(target.parent)
            self._file = self._lock(wait)
        except OSError as error:
            raise disk_error(self.part, error) from error
        self._open = True

    def _lock(self, wait: bool) -> int:
        while True:
            file = os.open(self.part, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
                if _is_at(file, self.part):  # else its last owner renamed or removed it meanwhile
                    return file
            except BlockingIOError as error:
                os.close(file)
                raise StoreTakenError(
                    f"{self.target} is being written by another process",
                    remedy="leave this one to it and take the next",
                ) from error
            except BaseException:
                os.close(file)
                raise
            os.close(file)

    def commit(self, image: bytes | memoryview) -> None:
        """Make ``image`` the content of the file, on the disk, and end the claim.

        Raises:
            StoreDiskError: The disk refused; the file is as before.
        """
        self._check_open()
        try:
            os.ftruncate(self._file, 0)
            rest = memoryview(image)
            while rest:
                rest = rest[os.write(self._file, rest) :]
        except OSError as error:
            raise disk_error(self.target, error) from error
        self.finish()

    def finish(self) -> None:
        """Make ``part`` the file, on the disk, and end the claim.

        Raises:
            StoreDiskError: The disk refused; the file is as before.
        """
        self._check_open()
        try:
            os.fsync(self._file)
            os.rename(self.part, self.target)
            self._open = False
            os.close(self._file)
            sync_folder(self.target.parent)
        except OSError as error:
            raise disk_error(self.target, error) from error

    def _check_open(self) -> None:
        if not self._open:
            raise ValueError(f"the claim on {self.target} has ended")

    def close(self) -> None:
        """End the claim without writing. Does nothing after ``commit`` or ``finish``."""
        if not self._open:
            return
        self._open = False
        # A disk that refuses has been told by then; the next claim takes over what is left.
        with contextlib.suppress(OSError):
            self.part.unlink()
        os.close(self._file)


class FolderLock:
    """Lock of a folder: for one writer, or for several that all use ``shared``.

    Args:
        folder: The folder; it exists.
        shared: Whether others with ``shared`` may write at the same time.

    Raises:
        StoreTakenError: Another writer has locked it.
        StoreDiskError: No file can be created in the folder.
    """

    def __init__(self, folder: Path, *, shared: bool) -> None:
        path = folder / "lock"
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise disk_error(path, error) from error
        try:
            fcntl.flock(self._file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except OSError as error:
            owner = os.pread(self._file, 32, 0).decode("ascii", "replace").strip()
            os.close(self._file)
            if not isinstance(error, BlockingIOError):
                raise disk_error(path, error) from error
            raise StoreTakenError(
                f"{folder} is being written by " + (f"process {owner}" if owner else "others"),
                remedy="wait for its end, write to another store, or let all writers share it",
            ) from error
        self._shared = shared
        if not shared:
            self._sign(f"{os.getpid()}\n")

    def release(self) -> None:
        """Unlock the folder."""
        if not self._shared:
            self._sign("")
        os.close(self._file)

    def _sign(self, text: str) -> None:
        # Only for the message to a second writer; on a full disk it is left out.
        try:
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, text.encode("ascii"), 0)
        except OSError:
            return


def _make_folder(folder: Path) -> None:
    if folder.is_dir():
        return
    _make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    sync_folder(folder.parent)


def _is_at(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False
