"""HDF5 files of palpate: one header, typed errors, arrays with units.

Every file says at its root what it is: ``schema``, ``schema_version`` and ``frame``. h5py is
optional, and imported when a file is opened.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from palpate.config import looking_at
from palpate.errors import DatasetError
from palpate.files.atomic import written_whole
from palpate.process import require

if TYPE_CHECKING:
    import h5py

SENSOR_FRAME = "sensor frame: x distal, y lateral, z dorsal; force is the force on the BioTac"
"""Frame of every file, and the text of its attribute ``frame``."""

_VALUES_BYTES = 64 << 10  # no block of what HDF5 notes about values is as large
_FREE_BYTES = 64 << 20
_RATIO_MAX = 100  # of what an array may expand to; those of palpate expand to ten times at most

COPY_AGAIN = "make it again, or copy it again and compare its size"


@dataclass(frozen=True, slots=True)
class Hdf5Schema:
    """Header of a kind of file.

    Attributes:
        name: Value of the attribute ``schema``, e.g. ``palpate.features``.
        version: Value of the attribute ``schema_version``.
        remedy: What to do with a file of another schema.
    """

    name: str
    version: int
    remedy: str

    @property
    def facts(self) -> dict[str, str | int]:
        """Attributes to write at the root of a file, in this order."""
        return {"schema": self.name, "schema_version": self.version, "frame": SENSOR_FRAME}

    def check(self, where: object, file: h5py.File) -> None:
        """Check the header of an open file.

        Raises:
            DatasetError: Another schema, version or frame.
        """
        found = text(file.attrs.get("schema", ""))
        if found != self.name:
            raise DatasetError(
                f"{where}: schema is {found or 'not stated'!r}, expected {self.name!r}",
                remedy=self.remedy,
            )
        try:
            number = int(file.attrs.get("schema_version", 0))
        except (TypeError, ValueError, OverflowError) as error:
            raise DatasetError(
                f"{where}: attribute schema_version is no whole number", remedy=self.remedy
            ) from error
        if number != self.version:
            raise DatasetError(
                f"{where}: schema version {number}, this palpate reads {self.version}",
                remedy="update palpate" if number > self.version else "make the file again",
            )
        frame = text(file.attrs.get("frame", ""))
        if frame != SENSOR_FRAME:
            raise DatasetError(
                f"{where}: attribute frame is {frame!r}",
                remedy=f"rotate everything first; the schema knows only: {SENSOR_FRAME}",
            )


def h5py_module(extra: str) -> ModuleType:
    """The package h5py.

    Raises:
        MissingExtraError: It is not installed; ``extra`` of palpate installs it.
    """
    return require("h5py", extra=extra)


def name_a_file(folder: Path) -> str:
    """What to do where a folder was given and not a file: name one, e.g. of those that it holds."""
    found = sorted(
        str(one.relative_to(folder)) for at in ("*.h5", "*/*.h5") for one in folder.glob(at)
    )
    shown = [*found[:4], "..."] if len(found) > 4 else found
    return f"name a file in it: {', '.join(shown)}" if shown else "name a file"


@contextlib.contextmanager
def opened(
    path: Path, *, extra: str, missing: str = "check the path, or make the file"
) -> Iterator[h5py.File]:
    """An HDF5 file to read from; ``missing`` says what to do if there is no such file.

    Raises:
        ConfigError: It lies in a folder that is closed.
        DatasetError: It is missing, truncated or damaged.
        MissingExtraError: h5py is not installed; ``extra`` of palpate installs it.
    """
    h5 = h5py_module(extra)
    with looking_at(path):
        is_folder, is_file = path.is_dir(), path.is_file()
    if is_folder:
        raise DatasetError(f"{path} is a folder", remedy=name_a_file(path))
    if not is_file:
        raise DatasetError(f"{path}: no such file", remedy=missing)
    try:
        # Our files appear whole and never change, so no lock is needed, which some disks lack.
        with h5.File(path, "r", locking=False) as file:
            yield file
    except (OSError, RuntimeError) as error:
        raise DatasetError(
            f"{path}: not a readable HDF5 file (truncated or damaged): {error}", remedy=COPY_AGAIN
        ) from error


@contextlib.contextmanager
def new_file(path: Path, *, extra: str, libver: Any = None) -> Iterator[h5py.File]:
    """An HDF5 file to write to; ``libver`` as h5py has it.

    Raises:
        OSError: The disk refused; the file is of no use then.
        MissingExtraError: h5py is not installed; ``extra`` of palpate installs it.
    """
    h5 = h5py_module(extra)
    with _ForHdf5(path) as disk:
        file = h5.File(disk, "w", libver=libver)
        try:
            yield file
        except Exception as error:
            if disk.refused is not None:
                raise disk.refused from error
            raise
        finally:
            file.close()
        if disk.refused is not None:
            raise disk.refused


class _ForHdf5(io.FileIO):
    """A file whose writes never fail; what the disk refuses is kept in memory, if it is small.

    HDF5 writes much when it closes a file or a data set. If that is refused, it tries again when
    the process ends, and crashes it. Large blocks are values, which it does not need.

    Attributes:
        refused: What the disk said first.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self.refused: OSError | None = None
        self._kept: list[tuple[int, bytes]] = []

    def write(self, data: Any) -> int:
        """Write all of it."""
        block, at = memoryview(data).cast("B"), self.tell()
        done = 0
        while self.refused is None and done < len(block):
            try:
                done += super().write(block[done:])
            except OSError as error:
                self.refused = error
        if self.refused is not None and len(block) < _VALUES_BYTES:
            self._kept.append((at, bytes(block)))
        return len(block)

    def readinto(self, buffer: Any) -> int:
        """Read what was written, in whichever place."""
        block, at = memoryview(buffer).cast("B"), self.tell()
        found = super().readinto(block) or 0
        block[found:] = bytes(len(block) - found)
        for place, kept in self._kept:
            first, last = max(at, place), min(at + len(block), place + len(kept))
            if first < last:
                block[first - at : last - at] = kept[first - place : last - place]
        return len(block)

    def truncate(self, size: int | None = None) -> int:
        """Set the size; a disk that is full keeps its own."""
        try:
            return super().truncate(size)
        except OSError as error:
            self.refused = self.refused or error
            return size or 0


@contextlib.contextmanager
def hdf5_written_whole(path: Path, *, extra: str) -> Iterator[h5py.File]:
    """An HDF5 file to write to, which gets its name when the block ends without an error.

    It may replace a file of the same schema only: another one was named by mistake, e.g. the last
    input because the name of the output was left out.

    Raises:
        DatasetError: The disk refused, or another kind of file is there.
        MissingExtraError: h5py is not installed.
    """
    with written_whole(path) as partial, new_file(partial, extra=extra) as file:
        yield file
        _check_replaced(path, text(file.attrs.get("schema", "")), extra)


def _check_replaced(path: Path, schema: str, extra: str) -> None:
    if not path.exists():
        return
    try:
        found = schema_of(path, extra=extra)
    except DatasetError:
        found = ""
    if found != schema:
        raise DatasetError(
            f"{path} is there and is no {schema}, but {found or 'another kind of file'}",
            remedy="name the file to write, last; move this one away if it may be replaced",
        )


def schema_of(path: Path, *, extra: str) -> str:
    """Schema that a file states; empty where it states none.

    Raises:
        DatasetError: It is missing or not a readable HDF5 file.
    """
    with opened(path, extra=extra) as file:
        return text(file.attrs.get("schema", ""))


def read_array(
    where: object,
    group: h5py.Group,
    name: str,
    unit: str,
    dtype: npt.DTypeLike | None = None,
) -> npt.NDArray[Any]:
    """Read an array; check its attribute ``unit`` and, where given, its type (``str`` = texts).

    Raises:
        DatasetError: It is missing, or has another unit or type.
    """
    if name not in group or not hasattr(group[name], "dtype"):
        raise DatasetError(f"{where}: dataset {name!r} is missing", remedy=f"write {name} [{unit}]")
    dataset = group[name]
    found = text(dataset.attrs.get("unit", ""))
    if found != unit:
        raise DatasetError(
            f"{where}: {name} is in {found or 'no stated unit'!r}, expected {unit!r}",
            remedy=f"convert {name} to {unit} and set its attribute unit",
        )
    stored = group.file.id.get_filesize()
    if dataset.nbytes > _FREE_BYTES + _RATIO_MAX * stored:
        raise DatasetError(
            f"{where}: {name} says that it has {dataset.nbytes:,} bytes, its file has {stored:,}",
            remedy=COPY_AGAIN,
        )
    array: npt.NDArray[Any] = dataset[()]
    if dtype is str:
        return np.array([text(value) for value in array], dtype=object)
    if dtype is not None and array.dtype != dtype:
        raise DatasetError(
            f"{where}: {name} is {array.dtype}, expected {np.dtype(dtype)}",
            remedy=f"convert {name} before writing",
        )
    return array


def add_array(digest: hashlib._Hash, name: str, array: npt.NDArray[Any]) -> None:
    """Add name, type, shape and values of an array to a digest; little-endian on every machine."""
    little = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False)
    digest.update(f"{name}:{little.dtype.str}:{little.shape}".encode())
    digest.update(little.tobytes())


def rows_sha256(sensors: Iterable[str], arrays: Mapping[str, npt.NDArray[Any]]) -> str:
    """SHA-256 of a data set of features, hex: its sensors' names, and arrays in their order."""
    digest = hashlib.sha256("\n".join(sensors).encode())
    for name, array in arrays.items():
        add_array(digest, name, array)
    return digest.hexdigest()


def check_rows(path: Path, stated: str, found: str) -> None:
    """Refuse a data set whose rows are not those that were written; ``stated`` may be empty.

    Raises:
        DatasetError: They are not.
    """
    if stated and stated != found:
        raise DatasetError(
            f"{path}: the content does not match its content_sha256",
            remedy="the rows were changed after writing; make the file again",
        )


def text(value: object) -> str:
    """An attribute or element of HDF5 as text, whichever way it was written."""
    return value.decode() if isinstance(value, bytes) else str(value)


def set_attributes(target: Any, values: Mapping[str, Any]) -> None:
    """Write attributes, texts with a fixed length.

    HDF5 keeps texts of variable length in a heap without a checksum: there a flipped bit gives
    another text, or a reader that never returns.
    """
    h5 = h5py_module("fem")
    for name, value in values.items():
        if isinstance(value, str):
            code = value.encode("utf-8", "replace")
            value = np.array(code, h5.string_dtype("utf-8", max(1, len(code))))
        target.attrs[name] = value
