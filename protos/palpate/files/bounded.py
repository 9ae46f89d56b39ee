"""Reading what a stranger may have written: no more than a stated number of bytes, ever.

Sizes are checked before anything is read, expanded or allocated. All functions raise ``ValueError``
with what is wrong, or the ``OSError`` of the file; the caller names the file in its typed error.
"""

from __future__ import annotations

import io
import json
import math
import os
import stat
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

_ARRAYS_MAX = 64
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""How NumPy packs; LZMA takes as much memory as its data say."""
_HEADER_BYTES_MAX = 1 << 12
_RANK_MAX = 8
_KINDS = "biuf"  # truth values and numbers: no objects, no records, no texts


def open_regular(path: Path, *, follow: bool = True) -> BinaryIO:
    """Open a regular file to read it; ``follow`` allows a link to one.

    A FIFO, a device or a socket is refused without being read: that could block, or never end.

    Raises:
        OSError: It cannot be opened.
        ValueError: It is no regular file.
    """
    if not follow and path.is_symlink():
        raise ValueError("it is a symbolic link, not a regular file")
    # O_NONBLOCK: to open a FIFO would wait for its writer. It changes nothing for a file.
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | (0 if follow else os.O_NOFOLLOW)
    number = os.open(path, flags)
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise ValueError("it is not a regular file")
    return open(number, "rb")


def read_regular(path: Path, most_bytes: int) -> bytes:
    """All bytes of a regular file that is no link.

    Raises:
        OSError: It cannot be opened.
        ValueError: It is no regular file, or has more than ``most_bytes``.
    """
    with open_regular(path, follow=False) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most_bytes:
            raise ValueError(f"it has {size:,} bytes, {most_bytes:,} are allowed")
        data = file.read(size + 1)
    if len(data) > size:
        raise ValueError("it grows while it is read")
    return data


def plain_number(text: str) -> float:
    """The number that a cell or a word says, as every other program reads it; may be nan or inf.

    Raises:
        ValueError: It is none.
    """
    # Python also reads 1_0, and the digits of all scripts.
    if "_" in text or not text.isascii():
        raise ValueError("it is not a number")
    return float(text)


def parse_json(text: bytes) -> Any:
    """The value of a JSON text: finite numbers only, each key once, nested moderately.

    Raises:
        ValueError: It is no such JSON.
    """
    try:
        return json.loads(
            text,
            parse_float=_finite,
            parse_constant=_not_finite,
            object_pairs_hook=_each_key_once,
        )
    except RecursionError as error:
        raise ValueError("its values are nested too deeply") from error


def _finite(word: str) -> float:
    number = float(word)
    return number if math.isfinite(number) else _not_finite(word)


def _not_finite(word: str) -> float:
    raise ValueError(f"{word} is not a number of JSON")


def _each_key_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) != len(pairs):
        raise ValueError("a key stands twice in one object")
    return values


def arrays_of_npz(data: bytes, most_bytes: int) -> dict[str, npt.NDArray[Any]]:
    """Arrays of a NumPy archive by name, which together have at most ``most_bytes``.

    Raises:
        ValueError: It is no such archive, holds anything but arrays of numbers, or its arrays are
            larger than allowed or than what the archive holds of them.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if len(members) > _ARRAYS_MAX:
                raise ValueError(f"it holds {len(members)} arrays, {_ARRAYS_MAX} are allowed")
            size = sum(member.file_size for member in members)
            if size > most_bytes:
                raise ValueError(
                    f"its arrays say that they have {size:,} bytes, {most_bytes:,} are allowed"
                )
            arrays = {}
            for member in members:
                if member.compress_type not in _METHODS:
                    raise ValueError(f"{member.filename!r} is packed in another way than NumPy's")
                with archive.open(member) as file:
                    # A member that expands to more than it says ends at what it says.
                    content = file.read(member.file_size)
                name = member.filename.removesuffix(".npy")
                if name in arrays:
                    raise ValueError(f"the array {name!r} stands twice in it")
                arrays[name] = _array(name, content)
            return arrays
    except (
        zipfile.BadZipFile, zlib.error, struct.error, OSError, EOFError, RuntimeError,
        OverflowError, MemoryError,
    ) as error:  # fmt: skip  # all that a damaged archive makes zipfile and NumPy raise
        raise ValueError(str(error)) from error


def _array(name: str, content: bytes) -> npt.NDArray[Any]:
    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        reader = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }.get(version)
        if reader is None:
            raise ValueError(f"its format version is {version}")
        shape, fortran, dtype = reader(file, max_header_size=_HEADER_BYTES_MAX)
    except (
        ValueError, TypeError, SyntaxError, tokenize.TokenError, RecursionError, MemoryError,
    ) as error:  # fmt: skip
        raise ValueError(f"the header of the array {name!r} cannot be read: {error}") from error
    if dtype.kind not in _KINDS or dtype.hasobject:
        raise ValueError(f"the array {name!r} is of type {dtype}, which is no number")
    if len(shape) > _RANK_MAX or any(size < 0 for size in shape):
        raise ValueError(f"the array {name!r} has the shape {shape}")
    stated = math.prod(shape) * dtype.itemsize
    found = len(content) - file.tell()
    if stated != found:
        raise ValueError(
            f"the array {name!r} says that it has {stated:,} bytes, the archive holds {found:,}"
        )
    flat = np.frombuffer(content, dtype, offset=file.tell())
    return flat.reshape(shape, order="F" if fortran else "C").copy()
