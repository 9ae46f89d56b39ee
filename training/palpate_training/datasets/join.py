"""Mixed data sets of several fingertips as one: the same mesh, fields in common modes.

Skins of other thickness and fill have other positions, but the same nodes and faces. So a field,
which is a displacement of each node, means the same on all.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.datasets.basis import (
    FieldLoss,
    lost,
    mean_and_largest,
    rounded,
    with_signs,
    with_step,
)
from palpate_training.datasets.container import Provenance, joined_provenance, refuse_repeated
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    FieldBasis,
    FloatArray,
    MixedDataset,
    SimulatedContact,
    content_sha256,
    read_mixed,
    write_mixed,
)

SAME_PRESS_M = 2e-3
"""The tip of the indenter begins a press nearer than this on two specimens [m]: robots are off by a
millimetre or so, and random points are further apart."""

_ROWS = 256
"""Rows whose fields are in memory at once."""

PressStarts = Mapping[str, tuple[str, FloatArray]]
"""By trajectory of one plan: its indenter, and the tip where it begins [m], sensor frame, (3,)."""

Fields = Sequence[tuple[FieldBasis, FloatArray]]
"""Bases, each with the coefficients (N, K) of the rows that it holds."""


def join_files(
    paths: Sequence[Path], out: Path, *, modes: int, force_modes: int, command: str
) -> MixedDataset:
    """Write mixed data sets as one, whole or not at all; parts are called as their files.

    Where files of several folders have the same name, parts are called as the folders.

    Raises:
        DatasetError: A file is missing, damaged or no mixed data set, ``out`` exists, two parts
            have the same name or hold the same presses or trajectories, the disk refuses, or as in
            ``join_mixed``.
    """
    if out.exists():
        raise DatasetError(f"{out} exists", remedy="remove it, or give another name")
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        names = [path.resolve().parent.name for path in paths]
    if len(set(names)) < len(names):
        raise DatasetError(
            f"parts are called {', '.join(names)}",
            remedy="give files, or folders of them, different names",
        )
    parts = [read_mixed(path) for path in paths]
    refuse_repeated(paths, [(part.experiment.tared, part.experiment.force) for part in parts])
    starts = [press_starts(part.experiment).values() for part in parts]
    for (a, one), (b, other) in itertools.combinations(zip(paths, starts, strict=True), 2):
        if any(pressed_alike(*pair) for pair in itertools.product(one, other)):
            raise DatasetError(
                f"{a} and {b} hold the same trajectories, pressed on different specimens",
                remedy="make one data set of all specimens: joined, a trajectory would be learned "
                "from on one and tested on another",
            )
    joined = join_mixed(
        parts,
        names,
        modes=modes,
        force_modes=force_modes,
        command=command,
    )
    write_mixed(out, joined)
    return joined


def join_mixed(
    parts: Sequence[MixedDataset],
    names: Sequence[str],
    *,
    modes: int,
    force_modes: int,
    command: str = "",
) -> MixedDataset:
    """Put mixed data sets together; what the common modes lose is beside the given fields.

    What these had lost already comes on top; the provenance says how much.

    Args:
        parts: At least one; all with contact forces, or none.
        names: Of each part; trajectories are called after it: presses of different fingertips may
            have the same names.
        modes: Of the displacement, at most.
        force_modes: Of the contact forces.
        command: For provenance.

    Returns:
        Its mesh is the first part's.

    Raises:
        DatasetError: They are of different meshes, know different things, or differ in licence.
    """
    first = parts[0]
    for name, part in zip(names, parts, strict=True):
        same = part.mesh.nodes.shape == first.mesh.nodes.shape and np.array_equal(
            part.mesh.outer_faces, first.mesh.outer_faces
        )
        if not same or (part.contact is None) != (first.contact is None):
            raise DatasetError(
                f"{name} has another mesh than {names[0]}, or only one of them knows how the"
                " indenter bears on the skin",
                remedy="join data sets that were made with one edge of the mesh",
            )
    apart = max(float(np.abs(part.mesh.nodes - first.mesh.nodes).max()) for part in parts)
    basis, coefficients = _recoded([(one.basis, one.coefficients) for one in parts], modes)
    contacts = [part.contact for part in parts if part.contact is not None]
    contact = None
    if contacts:
        of_forces, numbers = _recoded([(c.basis, c.coefficients) for c in contacts], force_modes)
        contact = SimulatedContact(
            centre=np.concatenate([one.centre for one in contacts]),
            normal=np.concatenate([one.normal for one in contacts]),
            coefficients=numbers,
            basis=of_forces,
        )
    note = (
        f"nodes are those of {names[0]}, the others' up to"
        f" {apart * 1e3:.2f} mm away; losses of fields are beside theirs, which themselves lose up"
        f" to {_largest_losses([one.basis for one in parts], 'm of the displacement')}"
    )
    if contacts:
        note += f", {_largest_losses([c.basis for c in contacts], 'N of the contact forces')}"
    # Notes of a part that was joined or shrunk itself say what was lost before.
    where = joined_provenance(
        [part.experiment.provenance for part in parts], [*map(content_sha256, parts)], command, note
    )
    return MixedDataset(
        experiment=join_experiments([part.experiment for part in parts], names, where),
        simulated_force=np.concatenate([part.simulated_force for part in parts]),
        coefficients=coefficients,
        basis=basis,
        mesh=first.mesh,
        contact=contact,
    )


def _largest_losses(bases: Sequence[FieldBasis], what: str) -> str:
    mean, most = max(one.loss_mean for one in bases), max(one.loss_max for one in bases)
    return f"{mean:.3g} {what} on average, {most:.3g} at most"


def press_starts(data: ExperimentDataset) -> dict[str, PressStarts]:
    """Where each trajectory begins, by the first trial of it.

    Returns:
        By what joining put before the ids of a part, such as ``one/``, or nothing, its trajectories
        by their own ids, which begin with the indenter.
    """
    numbers, trial = np.unique(data.trial_trajectory, return_index=True)
    tips = data.location[np.searchsorted(data.trial, trial)]
    parts: dict[str, dict[str, tuple[str, FloatArray]]] = {}
    for number, tip in zip(numbers, tips, strict=True):
        name, indenter = data.trajectories[number], data.indenters[number]
        own = max(0, f"/{name}".rfind(f"/{indenter}/"))
        parts.setdefault(name[:own], {})[name[own:]] = (indenter, tip)
    return dict(parts)


def pressed_alike(one: PressStarts, other: PressStarts) -> bool:
    """Whether the trajectories that two experiments both name are the same presses.

    So it is where one plan was pressed on specimens whose files are apart. Other plans give the
    same names to other indenters, or to other points.
    """
    names = one.keys() & other.keys()
    if not names or any(one[name][0] != other[name][0] for name in names):
        return False
    apart = [float(np.linalg.norm(one[name][1] - other[name][1])) for name in names]
    return float(np.median(apart)) < SAME_PRESS_M


def join_experiments(
    parts: Sequence[ExperimentDataset], names: Sequence[str], provenance: Provenance
) -> ExperimentDataset:
    """Put experiments together; units of the same name are the same."""
    units = tuple(dict.fromkeys(unit for part in parts for unit in part.unit_names))
    unit, trajectory, trial = [], [], []
    trajectories = trials = 0
    for part in parts:
        unit.append(np.array([units.index(one) for one in part.unit_names])[part.trial_unit])
        trajectory.append(part.trial_trajectory + trajectories)
        trial.append(part.trial + trials)
        trajectories, trials = trajectories + len(part.trajectories), trials + part.trials

    def stacked(name: str) -> npt.NDArray[np.float32]:
        return np.concatenate([getattr(part, name) for part in parts])

    return ExperimentDataset(
        unit_names=units,
        trajectories=tuple(
            f"{name}/{one}"
            for name, part in zip(names, parts, strict=True)
            for one in part.trajectories
        ),
        indenters=tuple(one for part in parts for one in part.indenters),
        trial_unit=np.concatenate(unit).astype(np.int32),
        trial_trajectory=np.concatenate(trajectory).astype(np.int32),
        trial_rest=stacked("trial_rest"),
        trial=np.concatenate(trial).astype(np.int32),
        travel_m=stacked("travel_m"),
        tared=stacked("tared"),
        force=stacked("force"),
        location=stacked("location"),
        provenance=provenance,
    )


def _recoded(parts: Fields, count: int) -> tuple[FieldBasis, FloatArray]:
    """Common modes of fields, and the coefficients of all rows.

    Every field lies in the span of the parts' modes and means. So modes are sought there, and whole
    fields are made only to measure what is lost.
    """
    rows = sum(len(numbers) for _, numbers in parts)
    shape = parts[0][0].mean.shape
    flat = [basis.modes.reshape(len(basis.modes), -1).astype(np.float64) for basis, _ in parts]
    means = [basis.mean.reshape(-1).astype(np.float64) for basis, _ in parts]
    mean = np.zeros(math.prod(shape))
    for part, own, (_, numbers) in zip(flat, means, parts, strict=True):
        mean += (len(numbers) * own + numbers.sum(axis=0, dtype=np.float64) @ part) / rows
    # A row is its part's coefficients, and 1 for how its part's mean differs from that of all.
    ends = np.cumsum([0] + [len(part) + 1 for part in flat])
    span, within = np.linalg.qr(
        np.vstack([[*part, own - mean] for part, own in zip(flat, means, strict=True)]).T
    )
    turns = [within[:, first:end].T for first, end in itertools.pairwise(ends)]
    scatter = np.zeros((span.shape[1], span.shape[1]))
    for turn, (_, numbers) in zip(turns, parts, strict=True):
        own = numbers.astype(np.float64) @ turn[:-1] + turn[-1]
        scatter += own.T @ own
    _, directions = np.linalg.eigh(scatter)
    modes = with_signs((span @ directions[:, ::-1][:, : min(count, rows)]).T)
    directions = span.T @ modes.T
    exact = [
        numbers @ (turn[:-1] @ directions) + turn[-1] @ directions
        for turn, (_, numbers) in zip(turns, parts, strict=True)
    ]

    def losses(kept: FieldBasis) -> Iterator[FieldLoss]:
        for numbers, (basis, given) in zip(exact, parts, strict=True):
            for first in range(0, len(given), _ROWS):
                block = slice(first, first + _ROWS)
                yield lost(
                    basis.decode(given[block]) - kept.decode(rounded(numbers[block], kept.step))
                )

    def measure(kept: FieldBasis) -> FieldBasis:
        loss_mean, loss_max = mean_and_largest(losses(kept))
        return replace(kept, loss_mean=loss_mean, loss_max=loss_max)

    shaped = modes.reshape(-1, *shape).astype(np.float32)
    common = FieldBasis(mean.reshape(shape).astype(np.float32), shaped, 0.0, 0.0)
    common = with_step(measure(common), measure)
    return common, np.concatenate([rounded(numbers, common.step) for numbers in exact])
