"""Writing files and folders: one appears complete or not at all, and outlasts a power failure."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from palpate.errors import DatasetError, PalpateError


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A temporary path beside a file; renamed to the file when the block ends without an error.

    The file's folder is made. A file that is there stays until then. The block may make a folder
    at the temporary path, if nothing is at its place.

    Raises:
        DatasetError: The disk is full, or the folder cannot be written.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        _sync(partial)
        os.replace(partial, path)
        sync_folder(path.parent)
    except PalpateError:  # some are OSErrors, too, of what the block read
        raise
    except OSError as error:
        raise DatasetError(
            f"cannot write {path}: {error}", remedy="check the folder's rights and free space"
        ) from error
    finally:
        with contextlib.suppress(OSError):  # its folder may be what could not be made
            if partial.is_dir():
                shutil.rmtree(partial)
            else:
                partial.unlink(missing_ok=True)


def write_synced(path: Path, content: bytes) -> None:
    """Write a new file, and bring it to the disk: what is renamed then outlasts a power failure."""
    with open(path, "xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync(path: Path) -> None:
    """Bring a file, or a folder and all in it, to the disk."""
    if path.is_dir():
        for one in path.iterdir():
            _sync(one)
        sync_folder(path)
    else:
        with open(path, "rb") as file:
            os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Bring the names in a folder to the disk; else a power failure may undo a renaming.

    A file system that cannot, as some of a network, decides itself when it does.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except PermissionError:  # names may be written there, and not listed
        return
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)
