"""Trials put together to the data sets, in an order that does not depend on who finished first."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.dataset import ELECTRODES, Provenance
from palpate_training.twin.basis import encode
from palpate_training.twin.content import (
    ExperimentDataset,
    FieldBasis,
    FloatArray,
    MixedDataset,
    SkinMesh,
)
from palpate_training.twin.processing import trial_name
from palpate_training.twin.trials import MixedRows, TrialRows


def assemble_experiment(
    trials: Iterable[TrialRows], provenance: Provenance, *, unit_names: tuple[str, ...] = ()
) -> ExperimentDataset:
    """The purely experimental data set, sorted by unit and trajectory.

    Args:
        trials: Processed trials, in any order.
        provenance: Where they come from.
        unit_names: Names and order of the units; those of the trials, sorted, if not given.

    Raises:
        DatasetError: A trial is there twice, has wrong shapes, values that are not finite or a unit
            that is not named; or one trajectory has two indenters. Names the trial.
    """
    return _experiment(list(trials), provenance, unit_names)[0]


def assemble_mixed(
    mixed: Iterable[MixedRows],
    basis: FieldBasis,
    mesh: SkinMesh,
    provenance: Provenance,
    *,
    unit_names: tuple[str, ...] = (),
) -> MixedDataset:
    """The mixed data set; fields are compressed one by one, so ``mixed`` may be a stream.

    Args:
        mixed: Trials with their simulation, in any order.
        basis: From ``fit_basis`` of the same fields.
        mesh: Whose nodes move.
        provenance: Where they come from.
        unit_names: As in ``assemble_experiment``.

    Raises:
        DatasetError: As in ``assemble_experiment``, or a field is of another mesh.
    """
    found = [_compress(one, basis, mesh) for one in mixed]
    experiment, order = _experiment([one.rows for one in found], provenance, unit_names)
    return MixedDataset(
        experiment=experiment,
        simulated_force=np.concatenate([found[i].simulated_force for i in order]),
        coefficients=np.concatenate([found[i].coefficients for i in order]),
        basis=basis,
        mesh=mesh,
    )


@dataclass(frozen=True, slots=True)
class _Compressed:
    rows: TrialRows
    simulated_force: FloatArray
    coefficients: FloatArray


def _compress(mixed: MixedRows, basis: FieldBasis, mesh: SkinMesh) -> _Compressed:
    count = len(mixed.rows.travel_m)
    for what, shape, expected in (
        ("displacement", mixed.displacement.shape, (count, *mesh.nodes.shape)),
        ("simulated force", mixed.simulated_force.shape, (count, 3)),
    ):
        if shape != expected:
            raise DatasetError(
                f"{trial_name(mixed.rows.header)}: {what} has shape {shape}, expected {expected}",
                remedy="simulate with the mesh that the data set names",
            )
    for what, values in (
        ("displacement", mixed.displacement),
        ("simulated force", mixed.simulated_force),
    ):
        _check_finite(mixed.rows, what, values)
    return _Compressed(
        mixed.rows,
        mixed.simulated_force.astype(np.float32),
        encode(basis, mixed.displacement),
    )


def _experiment(
    trials: list[TrialRows], provenance: Provenance, unit_names: tuple[str, ...]
) -> tuple[ExperimentDataset, list[int]]:
    """The data set, and the order in which it holds the trials."""
    indenter = _checked(trials)
    units = unit_names or tuple(sorted({rows.header.unit for rows in trials}))
    for rows in trials:
        if rows.header.unit not in units:
            raise DatasetError(
                f"{trial_name(rows.header)}: its unit is not among {', '.join(units)}",
                remedy="name all units",
            )
    trajectories = tuple(sorted(indenter))
    place = {trajectory: i for i, trajectory in enumerate(trajectories)}
    keys = [(units.index(rows.header.unit), place[rows.header.trajectory]) for rows in trials]
    order = sorted(range(len(trials)), key=keys.__getitem__)
    held = [trials[i] for i in order]
    experiment = ExperimentDataset(
        unit_names=units,
        trajectories=trajectories,
        indenters=tuple(indenter[trajectory] for trajectory in trajectories),
        trial_unit=np.array([keys[i][0] for i in order], np.int32),
        trial_trajectory=np.array([keys[i][1] for i in order], np.int32),
        trial_rest=np.array([rows.rest for rows in held], np.float32),
        trial=np.repeat(
            np.arange(len(held), dtype=np.int32), [len(rows.travel_m) for rows in held]
        ),
        travel_m=np.concatenate([rows.travel_m for rows in held]).astype(np.float32),
        tared=np.concatenate([rows.tared for rows in held]).astype(np.float32),
        force=np.concatenate([rows.force for rows in held]).astype(np.float32),
        location=np.concatenate([rows.location for rows in held]).astype(np.float32),
        provenance=provenance,
    )
    return experiment, order


def _checked(trials: list[TrialRows]) -> dict[str, str]:
    """Check every trial; the indenter of each unique trajectory."""
    if not trials:
        raise DatasetError("no trials", remedy="process or ingest at least one")
    seen: set[tuple[str, str]] = set()
    indenter: dict[str, str] = {}
    for rows in trials:
        name = trial_name(rows.header)
        key = (rows.header.unit, rows.header.trajectory)
        if key in seen:
            raise DatasetError(
                f"{name} is there twice",
                remedy="a unit executes a trajectory once; remove one of the trials",
            )
        seen.add(key)
        known = indenter.setdefault(rows.header.trajectory, rows.header.indenter)
        if known != rows.header.indenter:
            raise DatasetError(
                f"{name}: indenter {rows.header.indenter}, on another unit {known}",
                remedy="give each trajectory one indenter; its id begins with it",
            )
        _check_trial(rows)
    return indenter


def _check_trial(rows: TrialRows) -> None:
    count = len(rows.travel_m)
    for what, values, shape in (
        ("rest", rows.rest, (ELECTRODES,)),
        ("travel_m", rows.travel_m, (count,)),
        ("tared", rows.tared, (count, ELECTRODES)),
        ("force", rows.force, (count, 3)),
        ("location", rows.location, (count, 3)),
    ):
        if values.shape != shape or count == 0:
            raise DatasetError(
                f"{trial_name(rows.header)}: {what} has shape {values.shape}, expected {shape}"
                " with at least one row",
                remedy="give one row of every quantity for each displacement",
            )
        if what != "rest":  # NaN there says that the source does not tell
            _check_finite(rows, what, values)


def _check_finite(rows: TrialRows, what: str, values: npt.NDArray[np.floating]) -> None:
    bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
    if bad.size:
        raise DatasetError(
            f"{trial_name(rows.header)}: {what} is not finite in row {bad[0]}",
            remedy="drop the row or the trial",
        )
