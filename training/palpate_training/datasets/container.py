"""HDF5 files of arrays with units, a schema and a content hash, written whole or not at all.

What ``palpate_training.datasets.features_file`` is to rows of features, this is to the data sets
of the experiment, which have several tables of different lengths.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.extras import require
from palpate.files.atomic import written_whole
from palpate_training.datasets.features import SENSOR_FRAME, Provenance

if TYPE_CHECKING:
    import h5py

logger = logging.getLogger(__name__)

_CHUNK_BYTES = 1 << 18
"""256 KiB: small enough to stream, large enough to compress."""


@dataclass(frozen=True, slots=True)
class Column:
    """An array of a schema: its unit and its type; ``str`` means a list of texts."""

    unit: str
    dtype: type[np.generic] | type[str]


@dataclass(frozen=True, slots=True)
class Tables:
    """What a file holds.

    Attributes:
        arrays: By name, ``/`` separates groups; texts as arrays of objects.
        numbers: Single numbers or words that belong to the content.
        provenance: Where it comes from.
    """

    arrays: Mapping[str, npt.NDArray[Any]]
    numbers: Mapping[str, float | str]
    provenance: Provenance

    def content_sha256(self) -> str:
        """SHA-256 of names, shapes and values, hex; does not depend on the layout of the file."""
        digest = hashlib.sha256()
        for name, array in sorted(self.arrays.items()):
            if array.dtype == object:
                digest.update(f"{name}:text:{array.shape}".encode())
                for text in array:
                    encoded = str(text).encode()
                    digest.update(f"{len(encoded)}:".encode() + encoded)
                continue
            little = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False)
            digest.update(f"{name}:{little.dtype.str}:{little.shape}".encode())
            digest.update(little.tobytes())
        for name, value in sorted(self.numbers.items()):
            digest.update(f"{name}={value!r}".encode())
        return digest.hexdigest()


def write_tables(
    path: Path, schema: str, version: int, columns: Mapping[str, Column], tables: Tables
) -> str:
    """Write a file; it appears complete or not at all.

    Args:
        path: File to write (``.h5``).
        schema: Name of the schema.
        version: Its version.
        columns: What each array is.
        tables: What to write.

    Returns:
        The content's SHA-256, hex.

    Raises:
        DatasetError: The disk refused.
    """
    digest = tables.content_sha256()
    with hdf5_written_whole(path) as file:
        write_header(file, schema, version, digest, tables.provenance, tables.numbers)
        for name, column in columns.items():
            write_array(file, name, column, tables.arrays[name])
    logger.info("wrote %s: content %s", path, digest[:12])
    return digest


@contextlib.contextmanager
def hdf5_written_whole(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file to write to, which gets its name when the block ends without an error.

    Raises:
        DatasetError: The disk refused.
    """
    h5 = require("h5py", extra="training")
    with written_whole(path) as partial, h5.File(partial, "w") as file:
        yield file


def write_header(
    file: h5py.File,
    schema: str,
    version: int,
    content_sha256: str,
    provenance: Provenance,
    numbers: Mapping[str, float | str | int],
) -> None:
    """Write what a file says of itself, as its attributes."""
    file.attrs.update(
        {
            "schema": schema,
            "schema_version": version,
            "frame": SENSOR_FRAME,
            "content_sha256": content_sha256,
            **numbers,
            **{f"provenance.{k}": v for k, v in asdict(provenance).items()},
        }
    )


def write_array(
    file: h5py.File | h5py.Group, name: str, column: Column, array: npt.NDArray[Any]
) -> None:
    """Write an array with its unit, in chunks and compressed."""
    if column.dtype is str:
        h5 = require("h5py", extra="training")
        # Texts lie on HDF5's heap, which no filter reaches.
        dataset = file.create_dataset(name, data=array, dtype=h5.string_dtype())
    else:
        row_bytes = max(1, array.nbytes // max(1, len(array)))
        rows = max(1, min(len(array), _CHUNK_BYTES // row_bytes))
        dataset = file.create_dataset(
            name,
            data=array,
            chunks=(rows, *array.shape[1:]),
            compression="gzip",
            compression_opts=4,
            shuffle=True,
        )
    dataset.attrs["unit"] = column.unit


def schema_of(path: Path) -> str:
    """Schema that a file says it has; empty where it says nothing.

    Raises:
        DatasetError: It is missing or not a readable HDF5 file.
    """
    with opened(path) as file:
        return text(file.attrs.get("schema", ""))


@contextlib.contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file to read from; what HDF5 says of a damaged one becomes ``DatasetError``."""
    h5 = require("h5py", extra="training")
    if not path.is_file():
        raise DatasetError(f"{path}: no such file", remedy="check the path, or make the file")
    try:
        with h5.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError) as error:
        raise DatasetError(
            f"{path}: not a readable HDF5 file (truncated or damaged): {error}",
            remedy="make it again, or copy it again and compare its size",
        ) from error


def read_tables(
    path: Path,
    schema: str,
    version: int,
    columns: Mapping[str, Column],
    numbers: tuple[str, ...] = (),
) -> Tables:
    """Read a file and check its schema, units, types and content hash.

    Raises:
        DatasetError: It is missing, damaged, of another schema or version, lacks an array, has one
            in another unit or type, or its content was changed; names file and array.
    """
    with opened(path) as file:
        check_header(path, file, schema, version)
        arrays = {name: read_array(path, file, name, column) for name, column in columns.items()}
        attributes = dict(file.attrs)
    for name in (*numbers, "content_sha256"):
        if name not in attributes:
            raise DatasetError(f"{path}: attribute {name} is missing", remedy="make the file again")
    tables = Tables(
        arrays,
        {name: _plain(attributes[name]) for name in numbers},
        read_provenance(attributes),
    )
    if text(attributes["content_sha256"]) != tables.content_sha256():
        raise DatasetError(
            f"{path}: the content does not match its content_sha256",
            remedy="the rows were changed after writing; make the file again",
        )
    return tables


def read_provenance(attributes: Mapping[str, Any]) -> Provenance:
    """Where a file comes from, by its attributes; empty where it does not say."""
    return Provenance(
        **{
            key: text(attributes.get(f"provenance.{key}", ""))
            for key in Provenance.__dataclass_fields__
        }
    )


def check_header(path: Path, file: h5py.File, schema: str, version: int) -> None:
    """Check schema, version and frame.

    Raises:
        DatasetError: One is another.
    """
    found = text(file.attrs.get("schema", ""))
    if found != schema:
        raise DatasetError(
            f"{path}: schema is {found or 'not stated'!r}, expected {schema!r}",
            remedy="`palpate data inspect` says what the file is",
        )
    number = int(file.attrs.get("schema_version", 0))
    if number != version:
        raise DatasetError(
            f"{path}: schema version {number}, this palpate reads {version}",
            remedy="update palpate" if number > version else "make the file again",
        )
    frame = text(file.attrs.get("frame", ""))
    if frame != SENSOR_FRAME:
        raise DatasetError(
            f"{path}: attribute frame is {frame!r}",
            remedy=f"rotate everything first; the schema knows only: {SENSOR_FRAME}",
        )


def read_array(
    path: Path, file: h5py.File | h5py.Group, name: str, column: Column
) -> npt.NDArray[Any]:
    """Read an array and check unit and type.

    Raises:
        DatasetError: It is missing, or has another unit or type; names file and array.
    """
    if name not in file:
        raise DatasetError(
            f"{path}: dataset {name!r} is missing", remedy=f"write {name} [{column.unit}]"
        )
    dataset = file[name]
    unit = text(dataset.attrs.get("unit", ""))
    if unit != column.unit:
        raise DatasetError(
            f"{path}: {name} is in {unit or 'no stated unit'!r}, expected {column.unit!r}",
            remedy=f"convert {name} to {column.unit} and set its attribute unit",
        )
    array: npt.NDArray[Any] = dataset[()]
    if column.dtype is str:
        return np.array([text(value) for value in array], dtype=object)
    if array.dtype != column.dtype:
        raise DatasetError(
            f"{path}: {name} is {array.dtype}, expected {np.dtype(column.dtype)}",
            remedy=f"convert {name} before writing",
        )
    return array


def _plain(value: object) -> float | str:
    return float(value) if isinstance(value, (float, np.floating)) else text(value)


def text(value: object) -> str:
    """An attribute or element of HDF5 as text."""
    return value.decode() if isinstance(value, bytes) else str(value)
