"""Making a tape from arrays: the basis, its rounding, and the electrical parameters of a specimen.

The basis is the leading left part of a singular value decomposition of all displacements, not
centred, so that no displacement has no coefficients and decodes to exactly zero. Modes are rounded
to whole numbers of a step that is the same *displacement* for every mode at its largest
coefficient: a strong mode gets many levels, a weak one few, and DEFLATE makes the file small.
Measured on 6,900 nodes and 360 smooth fields up to 3 mm: this rounding costs 1 um of mean nodal
error in half the bytes of float16, eight bits with one scale a mode 2.5 um (12 um in the deepest
step); docs/adr/0012-virtual-finger-stand-in.md has the table.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.files.tape import SPECIMEN_NUMBERS, Tape, TapeSpecimen, TapeTrajectory, check_tape
from palpate.messages import FloatArray

Array = npt.NDArray[Any]

MODES = 48
"""Modes kept at most: weak ones cost little, and 48 of them leave less than the rounding does."""

STEP_M = 2e-6
"""Displacement of one step of a mode at its largest coefficient [m]."""

_INT16 = 32767


@dataclass(frozen=True, slots=True, eq=False)
class TapePress:
    """One press as a simulation leaves it: a ``TapeTrajectory`` with arrays of any float type.

    Attributes:
        displacement: Of each node from the pressurised state [m], shape ``(K, V, 3)``; the tape
            keeps its coefficients instead.
    """

    id: str
    indenter: str
    poses: Array
    force: Array
    torque: Array
    fluid_pressure_pa: Array
    counts: Array
    displacement: Array


def tape_specimen(name: str, parameters: str, rest_counts: npt.ArrayLike) -> TapeSpecimen:
    """A specimen from the JSON of its electrical parameters, and its counts at rest, ``(19,)``.

    The JSON object has a number for each of ``SPECIMEN_NUMBERS`` and is kept as it is.

    Raises:
        DatasetError: No JSON object, or a number is missing; names specimen and key.
    """
    try:
        values = json.loads(parameters)
    except ValueError as error:
        raise DatasetError(
            f"parameters of specimen {name!r} are no JSON: {error}", remedy="give a JSON object"
        ) from error
    numbers: dict[str, float] = {}
    for key in SPECIMEN_NUMBERS:
        value = values.get(key) if isinstance(values, Mapping) else None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise DatasetError(
                f"parameters of specimen {name!r} have no number {key!r}",
                remedy="give all electrical parameters of the specimen as a JSON object",
            )
        numbers[key] = float(value)
    return TapeSpecimen(
        name=name,
        parameters=parameters,
        rest_counts=np.asarray(rest_counts, np.float32),
        **numbers,
    )


def build_tape(
    *,
    specimens: Sequence[TapeSpecimen],
    presses: Sequence[TapePress],
    rest_pressure_pa: float,
    nodes: npt.ArrayLike,
    outer_faces: npt.ArrayLike,
    inner_faces: npt.ArrayLike,
    mesh_sha256: bytes,
    source: str = "",
    modes: int = MODES,
    step_m: float = STEP_M,
) -> Tape:
    """A tape, checked; ``Tape`` explains the arguments.

    Specimens stand in the order of the presses' counts. At most ``modes`` modes are kept, rounded
    to steps of ``step_m`` of displacement.

    Raises:
        DatasetError: The arrays make no tape; names the trajectory and the field.
    """
    if not presses:
        raise DatasetError("a tape needs at least one press", remedy="give presses")
    points = np.ascontiguousarray(nodes, np.float32)
    wanted = points.shape
    for one in presses:
        if one.displacement.ndim != 3 or one.displacement.shape[1:] != wanted:
            raise DatasetError(
                f"displacement of trajectory {one.id!r} has shape {one.displacement.shape}, "
                f"not (K, {', '.join(map(str, wanted))})",
                remedy="give a displacement for each node of the mesh",
            )
    fields = np.concatenate(
        [one.displacement.reshape(len(one.displacement), -1) for one in presses]
    )
    if not np.isfinite(fields).all():
        raise DatasetError("a displacement is not finite", remedy="leave failed steps out")
    steps, scales, coefficients = _basis(fields.astype(np.float32), modes, step_m)
    ends = np.cumsum([len(one.displacement) for one in presses])[:-1]
    tape = Tape(
        specimens=tuple(specimens),
        trajectories=tuple(
            TapeTrajectory(
                id=one.id,
                indenter=one.indenter,
                poses=np.ascontiguousarray(one.poses, np.float64),
                force=np.ascontiguousarray(one.force, np.float32),
                torque=np.ascontiguousarray(one.torque, np.float32),
                fluid_pressure_pa=np.ascontiguousarray(one.fluid_pressure_pa, np.float32),
                counts=np.ascontiguousarray(one.counts, np.float32),
                coefficients=np.ascontiguousarray(part),
            )
            for one, part in zip(presses, np.split(coefficients, ends), strict=True)
        ),
        rest_pressure_pa=float(rest_pressure_pa),
        mean=np.zeros_like(points),
        modes=steps.reshape(-1, *wanted),
        mode_scales=scales,
        nodes=points,
        outer_faces=np.ascontiguousarray(outer_faces, np.int32),
        inner_faces=np.ascontiguousarray(inner_faces, np.int32),
        mesh_sha256=bytes(mesh_sha256),
        source=source,
    )
    check_tape(tape)
    return tape


def _basis(
    fields: FloatArray, modes: int, step_m: float
) -> tuple[npt.NDArray[np.int16], FloatArray, FloatArray]:
    """Rounded modes (C, 3V), their scales (C,), and coefficients (S, C) of fields (S, 3V)."""
    # The left singular vectors come from the small Gram matrix: few fields, many nodes.
    gram = (fields @ fields.T).astype(np.float64)
    values, vectors = np.linalg.eigh(gram)
    # Modes below the rounding of float32 fields are noise.
    kept = np.flatnonzero(values > 1e-10 * max(float(values[-1]), 1e-30))[::-1][: max(modes, 1)]
    if not len(kept):
        raise DatasetError("no press displaces anything", remedy="give presses that touch")
    sizes = np.sqrt(values[kept])
    exact = (vectors[:, kept] / sizes).T @ fields.astype(np.float64)
    largest = np.abs(vectors[:, kept] * sizes).max(axis=0)
    # Rounded to whole steps; a mode too strong for 16 bits gets a coarser step.
    scales = np.maximum(step_m / largest, np.abs(exact).max(axis=1) / _INT16).astype(np.float32)
    steps = np.rint(exact / scales[:, None].astype(np.float64)).astype(np.int16)
    # Coefficients are fitted to the modes as they are kept, not as they were.
    used = steps * scales[:, None].astype(np.float64)
    fitted = np.linalg.lstsq(used @ used.T, used @ fields.T.astype(np.float64), rcond=None)[0]
    return steps, scales, np.ascontiguousarray(fitted.T, np.float32)
