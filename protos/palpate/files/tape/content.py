"""What a tape holds, and the rules that a player relies on.

Trajectories are quasi-static: a step is a settled state, so a player may run through them at any
speed, stop, and come back along the same states. Displacements are kept as coefficients of a basis
whose modes are whole numbers with a scale each; `build` says why.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.messages import FloatArray

Array = npt.NDArray[np.float64]

ELECTRODES = 19
"""Electrodes of a BioTac."""

REST_COUNTS = 0.5
"""A step 0 whose ideal counts are farther from the untouched unit's is not untouched [counts]."""

REST_PRESSURE_PA = 18.25
"""The same for the pressure: half a count of PDC [Pa]."""

REST_FIELD_M = 20e-6
"""The same for the mean displacement of a node [m]: a basis of few modes decodes not quite zero."""

_UNIT_NORM = 1e-6
_TEXT_MAX = 128
_REMEDY = "build the tape again with palpate.files.tape.build_tape"


@dataclass(frozen=True, slots=True, eq=False)
class TapeUnit:
    """One sensor: what a player needs beside the ideal counts.

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


UNIT_NUMBERS = tuple(
    name
    for name in TapeUnit.__dataclass_fields__
    if name not in ("name", "parameters", "rest_counts")
)
"""The fields of a unit that are single numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class TapeTrajectory:
    """One press: K settled states, the first untouched. Sensor frame.

    Attributes:
        id: Name of the trajectory.
        indenter: Name of the indenter.
        poses: Tip [m] and unit quaternion w x y z of the indenter, which presses along its +z,
            float64, shape ``(K, 7)``.
        force: Force on the BioTac [N], float32, shape ``(K, 3)``; step 0 is zero.
        torque: Torque on the BioTac about the sensor frame's origin [N m], float32, shape
            ``(K, 3)``; step 0 is zero.
        fluid_pressure_pa: Pressure of the fluid above ambient [Pa], float32, shape ``(K,)``.
        counts: Ideal counts of each unit before noise and rounding, float32, shape
            ``(U, K, 19)``; step 0 is the unit's ``rest_counts``.
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
    """Simulated presses of one fingertip with one or more units. Sensor frame, SI.

    Attributes:
        units: The sensors; the mechanics is the same for all.
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

    units: tuple[TapeUnit, ...]
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

    Args:
        tape: The tape.
        where: File or object, for the error.

    Raises:
        DatasetError: Names ``where``, the trajectory or unit, the field, and what is wrong.
    """
    if not tape.units or not tape.trajectories:
        raise DatasetError(f"{where} has no units or no trajectories", remedy=_REMEDY)
    _check_names([unit.name for unit in tape.units], f"{where}: units")
    _check_names([one.id for one in tape.trajectories], f"{where}: trajectories")
    _check_mesh(tape, where)
    if not _is_number(tape.rest_pressure_pa):
        raise _wrong(where, "rest_pressure_pa", "is no finite number")
    if not isinstance(tape.source, str):
        raise _wrong(where, "source", "is no text")
    for unit in tape.units:
        _check_unit(unit, f"{where}: unit {unit.name!r}")
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


def _check_unit(unit: TapeUnit, where: str) -> None:
    _check_array(unit.rest_counts, np.float32, (ELECTRODES,), where, "rest_counts")
    for field in UNIT_NUMBERS:
        value = getattr(unit, field)
        if not _is_number(value):
            raise _wrong(where, field, f"= {value!r} is no finite number")
    for field in ("noise_counts", "gradient_sd", "creep_share"):
        if getattr(unit, field) < 0.0:
            raise _wrong(where, field, f"= {getattr(unit, field)} is negative")
    for field in ("heating_tau_s", "creep_tau_s"):
        if getattr(unit, field) <= 0.0:
            raise _wrong(where, field, f"= {getattr(unit, field)} is no time constant")
    try:
        readable = isinstance(json.loads(unit.parameters), dict)
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
    _check_array(one.counts, np.float32, (len(tape.units), count, ELECTRODES), where, "counts")
    _check_array(one.coefficients, np.float32, (count, len(tape.modes)), where, "coefficients")
    if np.abs(np.linalg.norm(one.poses[:, 3:], axis=1) - 1.0).max() > _UNIT_NORM:
        raise _wrong(where, "poses", "has a quaternion that is not of length 1")
    if one.force[0].any() or one.torque[0].any():
        raise _wrong(where, "force", "or torque is not zero at step 0, the untouched state")
    if abs(float(one.fluid_pressure_pa[0]) - tape.rest_pressure_pa) > REST_PRESSURE_PA:
        raise _wrong(where, "fluid_pressure_pa", "at step 0 is not rest_pressure_pa")
    for unit, counts in zip(tape.units, one.counts, strict=True):
        if np.abs(counts[0] - unit.rest_counts).max() > REST_COUNTS:
            raise _wrong(where, "counts", f"at step 0 are not the rest_counts of {unit.name!r}")
    moved = tape.mean + (one.coefficients[0] @ scaled).reshape(-1, 3)
    if np.linalg.norm(moved, axis=1).mean() > REST_FIELD_M:
        raise _wrong(where, "coefficients", "at step 0 do not decode to zero displacement")
