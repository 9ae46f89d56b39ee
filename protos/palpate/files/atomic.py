"""Writing files and folders atomically: one appears complete or not at all."""

from __future__ import annotations

import contextlib
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
        os.replace(partial, path)
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
