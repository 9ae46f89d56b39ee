"""Data sets on disk: HDF5 schema ``palpate.features`` version 1, written whole or not at all."""

from __future__ import annotations

import logging
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from palpate.errors import DatasetError
from palpate.extras import require
from palpate.files.atomic import written_whole
from palpate_training.datasets.features import SENSOR_FRAME, SHAPES, FeatureDataset, Provenance

if TYPE_CHECKING:
    import h5py

logger = logging.getLogger(__name__)

SCHEMA = "palpate.features"
SCHEMA_VERSION = 1

UNITS: dict[str, str] = {
    "electrodes": "counts",
    "baseline": "counts",
    "force": "N",
    "group": "1",
    "block": "1",
    "sensor": "1",
    "contact_location": "m",
    "in_contact": "1",
    "time_ns": "ns",
}

OPTIONAL = ("contact_location", "in_contact", "time_ns")
"""Datasets a file may lack."""

_CHUNK_ROWS = 4096
"""One chunk of electrodes is 150 KiB: small enough to stream, large enough to compress."""


def palpate_version() -> str:
    """Version of the installed palpate, for provenance."""
    try:
        return version("palpate")
    except PackageNotFoundError:
        return "unknown"


def write_dataset(path: Path, data: FeatureDataset) -> str:
    """Write a data set; the file appears complete or not at all.

    Args:
        path: File to write (``.h5``).
        data: What to write.

    Returns:
        The content's SHA-256, hex.

    Raises:
        DatasetError: The disk refused.
    """
    h5 = require("h5py", extra="training")
    digest = data.content_sha256()
    with written_whole(path) as partial, h5.File(partial, "w") as file:
        _write_attributes(file, data, digest)
        for name, array in data.arrays().items():
            dataset = file.create_dataset(
                name,
                data=array,
                chunks=(min(_CHUNK_ROWS, len(data)), *array.shape[1:]),
                compression="gzip",
                compression_opts=4,
                shuffle=True,
            )
            dataset.attrs["unit"] = UNITS[name]
    logger.info("wrote %s: %d rows, content %s", path, len(data), digest[:12])
    return digest


def _write_attributes(file: h5py.File, data: FeatureDataset, digest: str) -> None:
    file.attrs["schema"] = SCHEMA
    file.attrs["schema_version"] = SCHEMA_VERSION
    file.attrs["frame"] = SENSOR_FRAME
    file.attrs["sensor_names"] = list(data.sensor_names)
    file.attrs["content_sha256"] = digest
    for key, value in asdict(data.provenance).items():
        file.attrs[f"provenance.{key}"] = value


def open_dataset(path: Path) -> FeatureDataset:
    """Read a data set and check everything about it.

    Args:
        path: File written by ``write_dataset``, or by anyone to the same schema.

    Returns:
        The data set, in memory.

    Raises:
        DatasetError: The file is missing, damaged, of another schema or version, or its content
            breaks the schema; the message names the dataset inside the file.
    """
    h5 = require("h5py", extra="training")
    if not path.is_file():
        raise DatasetError(f"{path}: no such file", remedy="make it: palpate data ingest-record")
    try:
        with h5.File(path, "r") as file:
            _check_header(path, file)
            arrays = {name: _read(path, file, name) for name in SHAPES if _has(path, file, name)}
            attributes = dict(file.attrs)
    except OSError as error:
        raise DatasetError(
            f"{path}: not a readable HDF5 file (truncated or damaged): {error}",
            remedy="make it again, or copy it again and compare its size",
        ) from error
    provenance = Provenance(
        **{key: _text(attributes.get(f"provenance.{key}", "")) for key in _PROVENANCE_KEYS}
    )
    data = FeatureDataset(
        **arrays,
        sensor_names=tuple(_text(name) for name in attributes["sensor_names"]),
        provenance=provenance,
        name=str(path),
    )
    expected = _text(attributes.get("content_sha256", ""))
    if expected and expected != data.content_sha256():
        raise DatasetError(
            f"{path}: the content does not match its content_sha256",
            remedy="the rows were changed after writing; make the file again",
        )
    return data


_PROVENANCE_KEYS = tuple(Provenance.__dataclass_fields__)


def _check_header(path: Path, file: h5py.File) -> None:
    schema = _text(file.attrs.get("schema", ""))
    if schema != SCHEMA:
        raise DatasetError(
            f"{path}: schema is {schema or 'not stated'!r}, expected {SCHEMA!r}",
            remedy="use a file made by `palpate data ingest-...`",
        )
    found = int(file.attrs.get("schema_version", 0))
    if found != SCHEMA_VERSION:
        remedy = "update palpate" if found > SCHEMA_VERSION else "make the file again"
        raise DatasetError(
            f"{path}: schema version {found}, this palpate reads {SCHEMA_VERSION}", remedy=remedy
        )
    if _text(file.attrs.get("frame", "")) != SENSOR_FRAME:
        raise DatasetError(
            f"{path}: attribute frame is {_text(file.attrs.get('frame', ''))!r}",
            remedy=f"rotate force and location first; the schema knows only: {SENSOR_FRAME}",
        )
    if "sensor_names" not in file.attrs:
        raise DatasetError(
            f"{path}: attribute sensor_names is missing", remedy="name every sensor, in order"
        )


def _has(path: Path, file: h5py.File, name: str) -> bool:
    if name in file:
        return True
    if name in OPTIONAL:
        return False
    raise DatasetError(
        f"{path}: dataset {name!r} is missing",
        remedy=f"write {name} [{UNITS[name]}], one row for each row of electrodes",
    )


def _read(path: Path, file: h5py.File, name: str) -> np.ndarray[Any, Any]:
    dataset = file[name]
    unit = _text(dataset.attrs.get("unit", ""))
    if unit != UNITS[name]:
        raise DatasetError(
            f"{path}: {name} is in {unit or 'no stated unit'!r}, expected {UNITS[name]!r}",
            remedy=f"convert {name} to {UNITS[name]} and set its attribute unit",
        )
    array: np.ndarray[Any, Any] = dataset[()]
    return array


def _text(value: object) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
