"""Data sets on disk: HDF5 schema ``palpate.features`` version 1, written whole or not at all."""

from __future__ import annotations

import logging
from pathlib import Path

from palpate.errors import DatasetError
from palpate.files.hdf5 import Hdf5Schema, hdf5_written_whole, opened, read_array, text
from palpate_training.datasets.container import read_provenance, write_provenance
from palpate_training.datasets.features import SHAPES, FeatureDataset

logger = logging.getLogger(__name__)

FEATURES_SCHEMA = Hdf5Schema("palpate.features", 1, "use a file made by `palpate data ingest-...`")

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
    digest = data.content_sha256()
    with hdf5_written_whole(path, extra="training") as file:
        names = {"sensor_names": list(data.sensor_names)}
        file.attrs.update({**FEATURES_SCHEMA.facts, **names, "content_sha256": digest})
        write_provenance(file, data.provenance)
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
    with opened(path, extra="training", missing="make it: palpate data ingest-record") as file:
        FEATURES_SCHEMA.check(path, file)
        if "sensor_names" not in file.attrs:
            raise DatasetError(
                f"{path}: attribute sensor_names is missing", remedy="name every sensor, in order"
            )
        arrays = {
            name: read_array(path, file, name, UNITS[name])
            for name in SHAPES
            if name in file or name not in OPTIONAL
        }
        attributes = dict(file.attrs)
    data = FeatureDataset(
        **arrays,
        sensor_names=tuple(text(name) for name in attributes["sensor_names"]),
        provenance=read_provenance(attributes),
        name=str(path),
    )
    expected = text(attributes.get("content_sha256", ""))
    if expected and expected != data.content_sha256():
        raise DatasetError(
            f"{path}: the content does not match its content_sha256",
            remedy="the rows were changed after writing; make the file again",
        )
    return data
