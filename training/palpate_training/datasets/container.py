"""HDF5 files of arrays with units, a schema, provenance and a content hash."""

from __future__ import annotations

import csv
import hashlib
import logging
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from palpate import __version__
from palpate.errors import ConfigError, DatasetError
from palpate.files.hdf5 import (
    Hdf5Schema,
    add_array,
    h5py_module,
    hdf5_written_whole,
    opened,
    read_array,
    text,
)

if TYPE_CHECKING:
    import h5py

_log = logging.getLogger(__name__)

_CHUNK_BYTES = 1 << 18
"""256 KiB: small enough to stream, large enough to compress."""


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a data set comes from.

    Attributes:
        source: What was measured or simulated, one line for people.
        command: The command that wrote the data set.
        input_sha256: SHA-256 of the input file, hex; empty where there was none.
        licence: What may be done with the rows.
        palpate_version: Version of palpate that wrote it.
        notes: Assumptions made on the way in, e.g. how axes were matched.
    """

    source: str
    command: str
    input_sha256: str
    licence: str
    palpate_version: str
    notes: str = ""


def joined_provenance(
    parts: Sequence[Provenance], contents: Sequence[str], command: str, note: str = ""
) -> Provenance:
    """Where a data set comes from that is put together of several; it keeps their notes.

    Args:
        parts: Where each of them comes from.
        contents: Digest of the content of each.
        command: The command that joins them.
        note: What else is to be said of joining them.

    Raises:
        DatasetError: Their licences differ.
    """
    licences = dict.fromkeys(part.licence for part in parts)
    if len(licences) > 1:
        raise DatasetError(
            f"the licences differ: {'; '.join(licences)}", remedy="join data sets of one licence"
        )
    sources = Counter(part.source for part in parts)
    notes = [f"{len(parts)} joined; input_sha256 is the digest of their contents"]
    if note:
        notes[0] += f"; {note}"
    notes += dict.fromkeys(part.notes for part in parts if part.notes)
    return Provenance(
        source="; ".join(f"{n} of: {one}" if n > 1 else one for one, n in sources.items()),
        command=command,
        input_sha256=hashlib.sha256("\n".join(contents).encode()).hexdigest(),
        licence=next(iter(licences)),
        palpate_version=__version__,
        notes="; of parts: ".join(notes),
    )


@dataclass(frozen=True, slots=True)
class StoredColumn:
    """An array of a schema: its unit and its type; ``str`` means a list of texts."""

    unit: str
    dtype: type[np.generic] | type[str]


@dataclass(frozen=True, slots=True)
class StoredTables:
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
            add_array(digest, name, array)
        for name, value in sorted(self.numbers.items()):
            digest.update(f"{name}={value!r}".encode())
        return digest.hexdigest()


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def csv_rows(path: Path, refuse: type[DatasetError] | type[ConfigError]) -> list[list[str]]:
    """Rows of a CSV file as words; ``refuse`` is raised where it cannot be read."""
    try:
        # Spreadsheets begin a file with a byte order mark.
        with path.open(encoding="utf-8-sig", newline="") as file:
            return list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise refuse(f"{path} cannot be read: {error}", remedy="check the path") from error


def read_archive(
    path: Path, names: Callable[[Sequence[str]], Iterable[str]], *, remedy: str
) -> dict[str, npt.NDArray[Any]]:
    """Arrays of a NumPy archive (``.npz``).

    Args:
        path: The archive.
        names: Names that it holds -> names of the arrays to read.
        remedy: What to do where it cannot be read.

    Raises:
        DatasetError: It is missing or damaged, or lacks an array.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in names(archive.files)}
    except KeyError as error:
        raise DatasetError(f"{path}: {error.args[0]}", remedy=remedy) from error
    except (OSError, ValueError, EOFError, MemoryError, zlib.error, zipfile.BadZipFile) as error:
        raise DatasetError(
            f"{path}: not a readable NumPy archive: {error}", remedy=remedy
        ) from error


REPEATED_SHARE = 0.01
"""Of the rows of a data set that another one may hold, too."""


def refuse_repeated(
    names: Sequence[str | Path],
    parts: Sequence[tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]]],
) -> None:
    """Refuse presses that are in two data sets: they would count twice, and be tested on.

    Rows are compared, not digests: a copy may be shrunk, or have come back from a table. Equal rows
    of a data set count once.

    Args:
        names: Of the data sets.
        parts: Tared electrodes (N, 19) and force (N, 3) of each; rows without a force say nothing.

    Raises:
        DatasetError: They are.
    """
    known: list[npt.NDArray[np.uint64]] = []
    for number, (tared, force) in enumerate(parts):
        codes = _row_codes(np.hstack([tared, force])[np.any(force != 0.0, axis=1)])
        for first, others in enumerate(known):
            same = len(np.intersect1d(codes, others, assume_unique=True))
            if same > REPEATED_SHARE * min(len(codes), len(others)):
                raise DatasetError(
                    f"{names[number]} and {names[first]} hold the same presses: {same} rows",
                    remedy="give each data set once, and none beside one that it is a part of",
                )
        known.append(codes)


def _row_codes(rows: npt.NDArray[np.floating]) -> npt.NDArray[np.uint64]:
    """A number of each row (N, K), as float32, sorted and once; others have it by chance only."""
    words = np.ascontiguousarray(rows, np.float32).view(np.uint32).astype(np.uint64)
    weights = np.random.default_rng(0).integers(1, 2**63, words.shape[1], dtype=np.uint64)
    codes = np.sort(words @ weights)  # np.unique takes 50 times as long
    return np.concatenate([codes[:1], codes[1:][np.diff(codes) != 0]])


def write_tables(
    path: Path, schema: Hdf5Schema, columns: Mapping[str, StoredColumn], tables: StoredTables
) -> str:
    """Write a file, complete or not at all; returns the content's SHA-256, hex.

    Raises:
        DatasetError: The disk refused.
    """
    digest = tables.content_sha256()
    with hdf5_written_whole(path, extra="training") as file:
        write_header(file, schema, digest, tables.provenance, tables.numbers)
        for name, column in columns.items():
            write_array(file, name, column, tables.arrays[name])
    _log.info("wrote %s: content %s", path, digest[:12])
    return digest


def write_header(
    file: h5py.File,
    schema: Hdf5Schema,
    content_sha256: str,
    provenance: Provenance,
    numbers: Mapping[str, float | str | int],
) -> None:
    """Write schema, content hash, numbers and provenance as attributes of the file."""
    file.attrs.update(
        {
            **schema.facts,
            "content_sha256": content_sha256,
            **numbers,
        }
    )
    write_provenance(file, provenance)


def write_provenance(file: h5py.File, provenance: Provenance) -> None:
    """Write where the content comes from, as attributes of the file."""
    file.attrs.update({f"provenance.{key}": text for key, text in asdict(provenance).items()})


def write_array(
    file: h5py.File | h5py.Group, name: str, column: StoredColumn, array: npt.NDArray[Any]
) -> None:
    """Write an array with its unit, in chunks and compressed."""
    if column.dtype is str:
        h5 = h5py_module("training")
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


def read_tables(
    path: Path,
    schema: Hdf5Schema,
    columns: Mapping[str, StoredColumn],
    numbers: tuple[str, ...] = (),
    *,
    optional: Mapping[str, StoredColumn] | None = None,
    optional_numbers: tuple[str, ...] = (),
) -> StoredTables:
    """Read a file and check its schema, units, types and content hash.

    A file that has one of the ``optional`` columns has all of them, and ``optional_numbers``.

    Raises:
        DatasetError: It is missing, damaged, of another schema or version, lacks an array, has one
            in another unit or type, or its content was changed; names file and array.
    """
    with opened(path, extra="training") as file:
        schema.check(path, file)
        if any(name in file for name in optional or ()):
            columns, numbers = {**columns, **(optional or {})}, numbers + optional_numbers
        arrays = {
            name: read_array(path, file, name, column.unit, column.dtype)
            for name, column in columns.items()
        }
        attributes = dict(file.attrs)
    for name in (*numbers, "content_sha256"):
        if name not in attributes:
            raise DatasetError(f"{path}: attribute {name} is missing", remedy="make the file again")
    tables = StoredTables(
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
    """Where a file comes from, by its attributes; empty where it has none."""
    return Provenance(
        **{
            key: text(attributes.get(f"provenance.{key}", ""))
            for key in Provenance.__dataclass_fields__
        }
    )


def _plain(value: object) -> float | str:
    return float(value) if isinstance(value, (float, np.floating)) else text(value)
