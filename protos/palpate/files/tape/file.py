"""A tape on disk: one NumPy archive, there whole or not at all, and read strictly.

``header`` is JSON (schema, version, coordinate frame, units, names, digest of the content), the
other members are arrays. Same tape, same bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import ConfigError, DatasetError
from palpate.files.tape.content import (
    UNIT_NUMBERS,
    Tape,
    TapeTrajectory,
    TapeUnit,
    check_tape,
)

SCHEMA, VERSION, FRAME = "palpate.tape", 1, "sensor"
UNITS = {
    "rest_counts": "counts",
    "steps": "1",
    "poses": "m, 1",
    "force": "N",
    "torque": "N m",
    "fluid_pressure": "Pa",
    "counts": "counts",
    "coefficients": "1",
    "mean": "m",
    "modes": "1",
    "mode_scales": "m",
    "nodes": "m",
    "outer_faces": "1",
    "inner_faces": "1",
}
"""Arrays of a tape in the order in which they are hashed, and their units."""

_OF_THE_SKIN = ("mean", "modes", "mode_scales", "nodes", "outer_faces", "inner_faces")
_HEADER = "header"
_KEYS = {
    "schema", "version", "frame", "units", "source", "rest_pressure_pa", "mesh_sha256",
    "fingers", "trajectories", "sha256",
}  # fmt: skip
_FILE_BYTES_MAX = 64 << 20
_MEMBER_BYTES_MAX = 256 << 20
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_AGAIN = "copy it again from where it was made, or build it again"

Arrays = dict[str, npt.NDArray[Any]]


def write_tape(path: Path, tape: Tape) -> bytes:
    """Write a tape, whole or not at all; a file that is there is replaced.

    Args:
        path: ``NAME.npz``.
        tape: The tape.

    Returns:
        Digest of the content, 32 bytes.

    Raises:
        ConfigError: The name does not end in ``.npz``.
        DatasetError: The tape breaks its rules, or the disk refuses.
    """
    if path.suffix != ".npz":
        raise ConfigError(f"{path} is no name of a tape", remedy="let it end in .npz")
    check_tape(tape)
    header, arrays = _parts(tape)
    header["sha256"] = _digest(header, arrays).hex()
    text = json.dumps(header, indent=1, allow_nan=False).encode("ascii")
    members: Arrays = {_HEADER: np.frombuffer(text, np.uint8), **arrays}
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
                for name, array in members.items():
                    member = zipfile.ZipInfo(
                        f"{name}.npy"
                    )  # of a fixed date: same tape, same bytes
                    member.compress_type = zipfile.ZIP_DEFLATED
                    buffer = io.BytesIO()
                    np.lib.format.write_array(buffer, array, allow_pickle=False)
                    archive.writestr(member, buffer.getvalue())
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise DatasetError(
            f"cannot write {path}: {error.strerror or error}",
            remedy="check that its folder is there, and the disk",
        ) from error
    return bytes.fromhex(header["sha256"])


def read_tape(path: Path) -> Tape:
    """Read a tape and check every byte of it.

    Raises:
        ConfigError: There is no such file.
        DatasetError: It is no tape, damaged, or of a schema that this palpate does not know; names
            the file and what is wrong.
    """
    try:
        if path.stat().st_size > _FILE_BYTES_MAX:
            raise DatasetError(
                f"{path} exceeds {_FILE_BYTES_MAX >> 20} MiB: no tape", remedy="give a tape"
            )
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"the tape {path} cannot be read: {error.strerror or error}",
            remedy="give the path of a tape, NAME.npz",
        ) from error
    members = _members(data, path)
    header = _header(members.pop(_HEADER, None), path)
    if members.keys() != UNITS.keys():
        odd = sorted(members.keys() ^ UNITS.keys())
        raise DatasetError(f"{path}: members missing or unknown: {', '.join(odd)}", remedy=_AGAIN)
    if header["sha256"] != _digest(header, members).hex():
        raise DatasetError(f"{path}: the content is not what its digest says", remedy=_AGAIN)
    try:
        tape = _tape(header, members)
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise DatasetError(f"{path} is no tape: {error!r}", remedy=_AGAIN) from error
    check_tape(tape, where=str(path))
    return tape


def _members(data: bytes, path: Path) -> Arrays:
    """All arrays of the archive; each is checked against its CRC before it is looked at."""
    arrays: Arrays = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for member in archive.infolist():
                name = member.filename.removesuffix(".npy")
                if member.compress_type not in _METHODS or member.file_size > _MEMBER_BYTES_MAX:
                    raise ValueError(f"member {name!r} is packed in an unknown way or too large")
                if name in arrays:
                    raise ValueError(f"member {name!r} is there twice")
                buffer = io.BytesIO(archive.read(member))
                arrays[name] = np.lib.format.read_array(buffer, allow_pickle=False)
    except (
        zipfile.BadZipFile, zlib.error, struct.error, ValueError, OSError, EOFError, KeyError,
        NotImplementedError, RuntimeError, OverflowError, MemoryError,
    ) as error:  # fmt: skip  # all that a damaged archive makes zipfile and NumPy raise
        raise DatasetError(f"{path} is no tape or damaged: {error}", remedy=_AGAIN) from error
    return arrays


def _header(array: npt.NDArray[Any] | None, path: Path) -> dict[str, Any]:
    if array is None:
        raise DatasetError(f"{path} has no header: no tape", remedy="give a palpate tape")
    try:
        header = json.loads(array.tobytes())
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: the header is no JSON: {error}", remedy=_AGAIN) from error
    if not isinstance(header, dict) or header.get("schema") != SCHEMA:
        raise DatasetError(f"{path} is not of schema {SCHEMA}", remedy="give a palpate tape")
    version = header.get("version")
    if version != VERSION:
        newer = isinstance(version, int) and version > VERSION
        raise DatasetError(
            f"{path} is of schema {SCHEMA} version {version!r}, this palpate knows {VERSION}",
            remedy="upgrade palpate on this host" if newer else _AGAIN,
        )
    if header.keys() != _KEYS:
        odd = ", ".join(sorted(header.keys() ^ _KEYS))
        raise DatasetError(f"{path}: keys of the header missing or unknown: {odd}", remedy=_AGAIN)
    if header["frame"] != FRAME or header["units"] != UNITS:
        raise DatasetError(
            f"{path} is not in the {FRAME} frame and SI units", remedy="convert before writing"
        )
    return header


def _digest(header: dict[str, Any], arrays: Arrays) -> bytes:
    """SHA-256 of all that a tape says."""
    known = {key: value for key, value in header.items() if key != "sha256"}
    digest = hashlib.sha256(json.dumps(known, sort_keys=True).encode("ascii"))
    for name in UNITS:
        array = arrays[name]
        digest.update(f"{name} {array.dtype.str} {array.shape};".encode("ascii"))
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()


def _parts(tape: Tape) -> tuple[dict[str, Any], Arrays]:
    presses = tape.trajectories
    header = {
        "schema": SCHEMA,
        "version": VERSION,
        "frame": FRAME,
        "units": UNITS,
        "source": tape.source,
        "rest_pressure_pa": float(tape.rest_pressure_pa),
        "mesh_sha256": tape.mesh_sha256.hex(),
        "fingers": [
            {"name": unit.name, "parameters": unit.parameters}
            | {key: float(getattr(unit, key)) for key in UNIT_NUMBERS}
            for unit in tape.units
        ],
        "trajectories": [{"id": one.id, "indenter": one.indenter} for one in presses],
    }
    arrays: Arrays = {
        "rest_counts": np.stack([unit.rest_counts for unit in tape.units]),
        "steps": np.array([len(one.poses) for one in presses], np.int32),
        "poses": np.concatenate([one.poses for one in presses]),
        "force": np.concatenate([one.force for one in presses]),
        "torque": np.concatenate([one.torque for one in presses]),
        "fluid_pressure": np.concatenate([one.fluid_pressure_pa for one in presses]),
        "counts": np.concatenate([one.counts for one in presses], axis=1),
        "coefficients": np.concatenate([one.coefficients for one in presses]),
        **{name: getattr(tape, name) for name in _OF_THE_SKIN},
    }
    return header, arrays


def _tape(header: dict[str, Any], arrays: Arrays) -> Tape:
    steps = arrays["steps"]
    ends = np.cumsum(steps)
    by_step = ("poses", "force", "torque", "fluid_pressure", "coefficients")
    lengths = {len(arrays[name]) for name in by_step} | {arrays["counts"].shape[1]}
    if steps.dtype != np.int32 or steps.min() < 1 or lengths != {int(ends[-1])}:
        raise ValueError("its trajectories and arrays are not of the same number of steps")
    cut = [np.split(arrays[name], ends[:-1]) for name in by_step]
    counts = np.split(arrays["counts"], ends[:-1], axis=1)
    return Tape(
        units=tuple(
            TapeUnit(**finger, rest_counts=rest)
            for finger, rest in zip(header["fingers"], arrays["rest_counts"], strict=True)
        ),
        trajectories=tuple(
            TapeTrajectory(one["id"], one["indenter"], pose, force, torque, pressure, count, part)
            for one, pose, force, torque, pressure, part, count in zip(
                header["trajectories"], *cut, counts, strict=True
            )
        ),
        rest_pressure_pa=header["rest_pressure_pa"],
        mesh_sha256=bytes.fromhex(header["mesh_sha256"]),
        source=header["source"],
        **{name: arrays[name] for name in _OF_THE_SKIN},
    )
