"""The tape: simulated indentations of one fingertip in a file that is small enough to ship.

Trajectories are quasi-static: a step is a settled state, so a player may run through them at any
speed, stop, and come back along the same states. Displacements are kept as coefficients of a basis
whose modes are whole numbers with a scale each; ``tape_build`` says why.

A tape is one NumPy archive. Its ``header`` is JSON (schema, version, coordinate frame, units,
names, digest of the content), the other members are arrays. Same tape, same bytes. The gateway's
virtual finger plays tapes (docs/adr/0012-virtual-finger-stand-in.md).
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import ConfigError, DatasetError
from palpate.files.atomic import written_whole
from palpate.files.bounded import arrays_of_npz, open_regular
from palpate.messages import FloatArray

Array = npt.NDArray[np.float64]

ELECTRODES = 19
"""Electrodes of a BioTac."""

REST_COUNTS = 0.5
"""A step 0 whose ideal counts are farther from ``rest_counts`` is not untouched [counts]."""

REST_PRESSURE_PA = 18.25
"""The same for the pressure: half a count of PDC [Pa]."""

REST_FIELD_M = 20e-6
"""The same for the mean displacement of a node [m]: a basis of few modes decodes not quite zero."""

_UNIT_NORM = 1e-6
_TEXT_MAX = 128
_REMEDY = "build the tape again with palpate.files.tape_build"


@dataclass(frozen=True, slots=True, eq=False)
class TapeSpecimen:
    """One BioTac: what a player needs besides the ideal counts.

    Attributes:
        name: Of the sensor, e.g. ``"biotac1"``; part of its serial number.
        parameters: All its electrical parameters as a JSON object, for people.
        rest_counts: Ideal counts of the untouched sensor with its core at ``reference_c``, float32,
            shape ``(19,)``.
        noise_counts: Standard deviation of an electrode's noise [counts].
        reference_c: Temperature of the warmed-up core, at which all ideal counts hold [degrees C].
        temperature_coefficient: d ln conductivity / d T [1/K].
        heating_k: How far the core's own electronics warm it up [K].
        heating_tau_s: With this time constant [s].
        gradient_sd: Standard deviation of the spatial modes of ln conductivity.
        creep_share: Share of an electrode's change that comes late.
        creep_tau_s: With this time constant [s].
        pdc_offset: PDC at ambient pressure [counts].
        pac_offset: PAC at constant pressure [counts].
        tac_offset: TAC at constant temperature [counts].
    """

    name: str
    parameters: str
    rest_counts: FloatArray
    noise_counts: float
    reference_c: float
    temperature_coefficient: float
    heating_k: float
    heating_tau_s: float
    gradient_sd: float
    creep_share: float
    creep_tau_s: float
    pdc_offset: float
    pac_offset: float
    tac_offset: float


SPECIMEN_NUMBERS = tuple(
    name
    for name in TapeSpecimen.__dataclass_fields__
    if name not in ("name", "parameters", "rest_counts")
)
"""The fields of a specimen that are single numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class TapeTrajectory:
    """One press: K settled states, the first untouched. Sensor frame.

    Attributes:
        poses: Tip [m] and unit quaternion w x y z of the indenter, which presses along its +z,
            float64, shape ``(K, 7)``.
        force: Force on the BioTac [N], float32, shape ``(K, 3)``; step 0 is zero.
        torque: Torque on the BioTac about the sensor frame's origin [N m], float32, shape
            ``(K, 3)``; step 0 is zero.
        fluid_pressure_pa: Pressure of the fluid above ambient [Pa], float32, shape ``(K,)``.
        counts: Ideal counts of each specimen before noise and rounding, float32, shape
            ``(U, K, 19)``; step 0 is the specimen's ``rest_counts``.
        coefficients: Of the displacement in the tape's basis, float32, shape ``(K, C)``; step 0
            decodes to about zero.
    """

    id: str
    indenter: str
    poses: Array
    force: FloatArray
    torque: FloatArray
    fluid_pressure_pa: FloatArray
    counts: FloatArray
    coefficients: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Tape:
    """Simulated presses of one fingertip with one or more specimens. Sensor frame, SI.

    Attributes:
        specimens: The BioTacs; the mechanics is the same for all.
        trajectories: The presses.
        rest_pressure_pa: Fluid pressure of the pressurised, untouched finger above ambient [Pa].
        mean: Mean displacement of the basis [m], float32, shape ``(V, 3)``.
        modes: Modes in steps of ``mode_scales``, int16, shape ``(C, V, 3)``.
        mode_scales: Of each mode, float32, shape ``(C,)``: a displacement is
            ``mean + sum_c coefficients[c] * mode_scales[c] * modes[c]`` [m].
        nodes: Nodes of the pressurised, untouched skin [m], float32, shape ``(V, 3)``.
        outer_faces: Triangles of the outer surface, int32, shape ``(F, 3)``.
        inner_faces: Triangles of the inner surface, int32, shape ``(G, 3)``.
        mesh_sha256: Content hash of the mesh, 32 bytes.
        source: Where it comes from and its licence, for people.
    """

    specimens: tuple[TapeSpecimen, ...]
    trajectories: tuple[TapeTrajectory, ...]
    rest_pressure_pa: float
    mean: FloatArray
    modes: npt.NDArray[np.int16]
    mode_scales: FloatArray
    nodes: FloatArray
    outer_faces: npt.NDArray[np.int32]
    inner_faces: npt.NDArray[np.int32]
    mesh_sha256: bytes
    source: str = ""

    def scaled_modes(self) -> FloatArray:
        """Modes as numbers, float32, shape ``(C, 3 V)``: what a player keeps to decode often."""
        scaled = self.modes.astype(np.float32) * self.mode_scales[:, None, None]
        return scaled.reshape(len(self.modes), -1)

    def displacement(self, coefficients: FloatArray) -> FloatArray:
        """Nodal displacement [m] of coefficients ``(C,)``, float32, shape ``(V, 3)``."""
        moved = coefficients @ self.scaled_modes()
        return np.asarray(self.mean + moved.reshape(self.mean.shape), np.float32)


def check_tape(tape: Tape, *, where: str = "the tape") -> None:
    """Check shapes, types and meaning.

    Raises:
        DatasetError: Names ``where``, the trajectory or specimen, the field, and what is wrong.
    """
    if not tape.specimens or not tape.trajectories:
        raise DatasetError(f"{where} has no specimens or no trajectories", remedy=_REMEDY)
    _check_names([specimen.name for specimen in tape.specimens], f"{where}: specimens")
    _check_names([one.id for one in tape.trajectories], f"{where}: trajectories")
    _check_mesh(tape, where)
    if not _is_number(tape.rest_pressure_pa):
        raise _wrong(where, "rest_pressure_pa", "is no finite number")
    if not isinstance(tape.source, str):
        raise _wrong(where, "source", "is no text")
    for specimen in tape.specimens:
        _check_specimen(specimen, f"{where}: specimen {specimen.name!r}")
    scaled = tape.scaled_modes()
    for one in tape.trajectories:
        _check_trajectory(one, tape, scaled, f"{where}: trajectory {one.id!r}")


def _wrong(where: str, field: str, problem: str) -> DatasetError:
    return DatasetError(f"{where}: {field} {problem}", remedy=_REMEDY)


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return math.isfinite(value)


def _check_array(
    value: object, dtype: type[np.generic], shape: tuple[int | None, ...], where: str, field: str
) -> None:
    """Dtype, shape (None = any length from 1) and finiteness."""
    if not isinstance(value, np.ndarray) or value.dtype != dtype:
        what = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise _wrong(where, field, f"is {what}, not {np.dtype(dtype)}")
    fits = value.ndim == len(shape) and all(
        (got > 0) if want is None else (got == want)
        for got, want in zip(value.shape, shape, strict=True)
    )
    if not fits:
        wanted = ", ".join("N" if n is None else str(n) for n in shape)
        raise _wrong(where, field, f"has shape {value.shape}, not ({wanted})")
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        raise _wrong(where, field, "is not finite everywhere")


def _check_names(names: list[str], where: str) -> None:
    for name in names:
        if not (isinstance(name, str) and 0 < len(name) <= _TEXT_MAX and name.isascii()):
            raise _wrong(where, "name", f"{name!r} is not 1-{_TEXT_MAX} ASCII characters")
        if not name.isprintable():
            raise _wrong(where, "name", f"{name!r} is not printable")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise _wrong(where, "name", f"{twice!r} is there twice")


def _check_mesh(tape: Tape, where: str) -> None:
    _check_array(tape.nodes, np.float32, (None, 3), where, "nodes")
    count = len(tape.nodes)
    _check_array(tape.mean, np.float32, (count, 3), where, "mean")
    _check_array(tape.modes, np.int16, (None, count, 3), where, "modes")
    _check_array(tape.mode_scales, np.float32, (len(tape.modes),), where, "mode_scales")
    for field in ("outer_faces", "inner_faces"):
        faces = getattr(tape, field)
        _check_array(faces, np.int32, (None, 3), where, field)
        if faces.min() < 0 or faces.max() >= count:
            raise _wrong(where, field, f"names nodes outside 0..{count - 1}")
    if not isinstance(tape.mesh_sha256, bytes) or len(tape.mesh_sha256) != 32:
        raise _wrong(where, "mesh_sha256", "is not 32 bytes")


def _check_specimen(specimen: TapeSpecimen, where: str) -> None:
    _check_array(specimen.rest_counts, np.float32, (ELECTRODES,), where, "rest_counts")
    for field in SPECIMEN_NUMBERS:
        value = getattr(specimen, field)
        if not _is_number(value):
            raise _wrong(where, field, f"= {value!r} is no finite number")
    for field in ("noise_counts", "gradient_sd", "creep_share"):
        if getattr(specimen, field) < 0.0:
            raise _wrong(where, field, f"= {getattr(specimen, field)} is negative")
    for field in ("heating_tau_s", "creep_tau_s"):
        if getattr(specimen, field) <= 0.0:
            raise _wrong(where, field, f"= {getattr(specimen, field)} is no time constant")
    try:
        readable = isinstance(json.loads(specimen.parameters), dict)
    except (ValueError, TypeError, RecursionError):
        readable = False
    if not readable:
        raise _wrong(where, "parameters", "is no JSON object")


def _check_trajectory(one: TapeTrajectory, tape: Tape, scaled: FloatArray, where: str) -> None:
    _check_names([one.indenter], f"{where}: indenter")
    _check_array(one.poses, np.float64, (None, 7), where, "poses")
    count = len(one.poses)
    if count < 2:
        raise _wrong(where, "poses", "has one step; a press has at least two")
    _check_array(one.force, np.float32, (count, 3), where, "force")
    _check_array(one.torque, np.float32, (count, 3), where, "torque")
    _check_array(one.fluid_pressure_pa, np.float32, (count,), where, "fluid_pressure_pa")
    _check_array(one.counts, np.float32, (len(tape.specimens), count, ELECTRODES), where, "counts")
    _check_array(one.coefficients, np.float32, (count, len(tape.modes)), where, "coefficients")
    if np.abs(np.linalg.norm(one.poses[:, 3:], axis=1) - 1.0).max() > _UNIT_NORM:
        raise _wrong(where, "poses", "has a quaternion that is not of length 1")
    if one.force[0].any() or one.torque[0].any():
        raise _wrong(where, "force", "or torque is not zero at step 0, the untouched state")
    if abs(float(one.fluid_pressure_pa[0]) - tape.rest_pressure_pa) > REST_PRESSURE_PA:
        raise _wrong(where, "fluid_pressure_pa", "at step 0 is not rest_pressure_pa")
    for specimen, counts in zip(tape.specimens, one.counts, strict=True):
        if np.abs(counts[0] - specimen.rest_counts).max() > REST_COUNTS:
            raise _wrong(where, "counts", f"at step 0 are not the rest_counts of {specimen.name!r}")
    moved = tape.mean + (one.coefficients[0] @ scaled).reshape(-1, 3)
    if np.linalg.norm(moved, axis=1).mean() > REST_FIELD_M:
        raise _wrong(where, "coefficients", "at step 0 do not decode to zero displacement")


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
_ARRAYS_BYTES_MAX = 1 << 30
_AGAIN = "copy it again from where it was made, or build it again"

Arrays = dict[str, npt.NDArray[Any]]


def write_tape(path: Path, tape: Tape) -> bytes:
    """Write a tape, whole or not at all; a file that is there is replaced.

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
    if not path.parent.is_dir():  # a misspelled folder is not made
        raise DatasetError(f"cannot write {path}", remedy="check that its folder is there")
    with written_whole(path) as part, part.open("wb") as file:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
            for name, array in members.items():
                # ZipInfo has a fixed date, unlike a file that is added: same tape, same bytes.
                member = zipfile.ZipInfo(f"{name}.npy")
                member.compress_type = zipfile.ZIP_DEFLATED
                buffer = io.BytesIO()
                np.lib.format.write_array(buffer, array, allow_pickle=False)
                archive.writestr(member, buffer.getvalue())
    return bytes.fromhex(header["sha256"])


def read_tape(path: Path) -> Tape:
    """Read a tape and check every byte of it.

    Raises:
        ConfigError: There is no such file, or it is no regular one.
        DatasetError: It is no tape, damaged, or of a schema that this palpate does not know; names
            the file and what is wrong.
    """
    try:
        with open_regular(path) as file:
            data = file.read(_FILE_BYTES_MAX + 1)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"the tape {path} cannot be read: {getattr(error, 'strerror', None) or error}",
            remedy="give the path of a tape, NAME.npz",
        ) from error
    if len(data) > _FILE_BYTES_MAX:
        raise DatasetError(
            f"{path} exceeds {_FILE_BYTES_MAX >> 20} MiB: no tape", remedy="give a tape"
        )
    try:
        members = arrays_of_npz(data, _ARRAYS_BYTES_MAX)
    except ValueError as error:
        raise DatasetError(f"{path} is no tape or damaged: {error}", remedy=_AGAIN) from error
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
    """SHA-256 of all that a tape says: independent of the packing of the archive."""
    known = {key: value for key, value in header.items() if key != "sha256"}
    digest = hashlib.sha256(json.dumps(known, sort_keys=True).encode("ascii"))
    for name in UNITS:
        array = arrays[name]
        # Type and shape go in with the bytes, which alone would allow another reading of them.
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
            {"name": specimen.name, "parameters": specimen.parameters}
            | {key: float(getattr(specimen, key)) for key in SPECIMEN_NUMBERS}
            for specimen in tape.specimens
        ],
        "trajectories": [{"id": one.id, "indenter": one.indenter} for one in presses],
    }
    arrays: Arrays = {
        "rest_counts": np.stack([specimen.rest_counts for specimen in tape.specimens]),
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
        specimens=tuple(
            TapeSpecimen(**finger, rest_counts=rest)
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
