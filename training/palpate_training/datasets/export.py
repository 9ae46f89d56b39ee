"""Data sets for others: the published layout, and a table of text.

The experiment's rows as rows of features, for ``palpate train features``.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import DatasetError
from palpate.files.atomic import written_whole
from palpate.files.hdf5 import new_file
from palpate.messages import COUNTS_MAX
from palpate_training.datasets.container import StoredColumn, write_array
from palpate_training.datasets.experiment import ExperimentDataset, MixedDataset
from palpate_training.datasets.features import ELECTRODES, FeatureDataset, FloatArray
from palpate_training.datasets.published import published_file

CSV_COLUMNS = (
    "unit",
    "trajectory",
    "indenter",
    "travel_m",
    *(f"e{i + 1}_tared" for i in range(ELECTRODES)),
    *(f"force_{axis}_n" for axis in "xyz"),
    *(f"location_{axis}_m" for axis in "xyz"),
)

SIMULATED_COLUMNS = tuple(f"simulated_force_{axis}_n" for axis in "xyz")
"""What a mixed table has in addition; its fields are in HDF5 only."""


def export_published(folder: Path, data: ExperimentDataset | MixedDataset) -> list[Path]:
    """Write ``biotac1.hdf5`` and so on, one file for each unit.

    The number is the one that the unit's name ends with (``biotac-3``), else its place. Groups
    ``electrode_vals``, ``contact_loc`` [m], ``force_vec`` [N] and ``indenter_type`` have an array
    ``data`` each; the attribute ``names`` of the last maps its numbers to indenters. The
    group ``trajectory`` names the trajectory of each row, by places in its array ``names``. Of a
    mixed data set ``biotac1_simulated.hdf5`` and so on hold the simulated force ``force_res`` [N]
    and the nodal displacement ``nodal_res`` [m], row by row. The folder must not exist, and appears
    complete or not at all.

    Returns:
        The files.

    Raises:
        DatasetError: The folder exists, or the disk refused.
    """
    rows = data.experiment if isinstance(data, MixedDataset) else data
    names: list[str] = []

    def write(partial: Path) -> None:
        partial.mkdir(parents=True)
        for unit, number in enumerate(_numbers(rows.unit_names)):
            trials = np.flatnonzero(rows.trial_unit == unit)
            path = published_file(partial, number)
            _write_unit(path, rows, trials)
            names.append(path.name)
            if isinstance(data, MixedDataset):
                simulated = path.with_name(f"{path.stem}_simulated.hdf5")
                _write_simulated(simulated, data, trials)
                names.append(simulated.name)

    written_new(folder, write)
    return [folder / name for name in names]


def export_csv(path: Path, data: ExperimentDataset | MixedDataset) -> int:
    """Write one line for each row, with a heading that carries the units; returns their number.

    The file must not exist, and appears complete or not at all.

    Raises:
        DatasetError: The file exists, or the disk refused.
    """
    rows = data.experiment if isinstance(data, MixedDataset) else data
    simulated = data.simulated_force if isinstance(data, MixedDataset) else None

    def write(partial: Path) -> None:
        with partial.open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(CSV_COLUMNS + (() if simulated is None else SIMULATED_COLUMNS))
            for row, (unit, trajectory) in enumerate(
                zip(rows.row_unit, rows.row_trajectory, strict=True)
            ):
                numbers = [rows.travel_m[row], *rows.tared[row], *rows.force[row]]
                numbers += [*rows.location[row]]
                if simulated is not None:
                    numbers += [*simulated[row]]
                table.writerow(
                    [
                        rows.unit_names[unit],
                        rows.trajectories[trajectory],
                        rows.indenters[trajectory],
                        *(np.format_float_positional(number, trim="-") for number in numbers),
                    ]
                )

    written_new(path, write)
    return len(rows)


def _numbers(unit_names: tuple[str, ...]) -> list[int]:
    ends = [re.search(r"[0-9]+$", name) for name in unit_names]
    numbers = [int(end[0]) for end in ends if end is not None]
    whole = len(set(numbers)) == len(unit_names)
    return numbers if whole else list(range(1, len(unit_names) + 1))


def written_new(path: Path, write: Callable[[Path], None]) -> None:
    """Write a file or folder beside its place, then move it there.

    Raises:
        DatasetError: It exists, or the disk refused.
    """
    if path.exists():
        raise DatasetError(f"{path} exists", remedy="remove it, or give another name")
    with written_whole(path) as partial:
        write(partial)


def _write_unit(path: Path, rows: ExperimentDataset, trials: Any) -> None:
    mine = np.isin(rows.trial, trials)
    kinds = sorted(set(rows.indenters))
    number = np.array([kinds.index(indenter) for indenter in rows.indenters], np.int64)
    with new_file(path, extra="training") as file:
        file.attrs.update({f"provenance.{k}": v for k, v in asdict(rows.provenance).items()})
        for group, values in (
            ("electrode_vals", rows.tared[mine]),
            ("contact_loc", rows.location[mine]),
            ("force_vec", rows.force[mine]),
            ("indenter_type", number[rows.row_trajectory[mine]][:, None]),
        ):
            dataset = file.create_dataset(
                f"{group}/data", data=values, compression="gzip", shuffle=True
            )
            if group == "indenter_type":
                dataset.attrs["names"] = kinds
        mine_at = rows.row_trajectory[mine]
        held, place = np.unique(mine_at, return_inverse=True)
        write_array(file, "trajectory/data", StoredColumn("1", np.int64), place)
        names = np.array([rows.trajectories[i] for i in held], dtype=object)
        write_array(file, "trajectory/names", StoredColumn("1", str), names)


def _write_simulated(path: Path, data: MixedDataset, trials: Any) -> None:
    mine = np.isin(data.experiment.trial, trials)
    shape = (int(mine.sum()), *data.mesh.nodes.shape)
    with new_file(path, extra="training") as file:
        file.create_dataset("force_res", data=data.simulated_force[mine])
        field = file.create_dataset(
            "nodal_res",
            shape,
            np.float32,
            chunks=(1, *shape[1:]),
            compression="gzip",
            shuffle=True,
        )
        field.attrs["unit"] = "m"
        at = 0
        for trial in trials:  # one at a time, as all fields together may not fit in memory
            displacement = data.displacement(data.experiment.rows_of(int(trial)))
            field[at : at + len(displacement)] = displacement
            at += len(displacement)


UNTOUCHED_ROWS = 3
"""Rows without contact added to each trial, so that a network learns that nothing is nothing."""


def features(
    data: ExperimentDataset | MixedDataset,
    *,
    untouched_rows: int = UNTOUCHED_ROWS,
    assumed_rest: int | None = None,
) -> FeatureDataset:
    """Turn tared values back into raw counts with their baseline.

    Rounding to counts moves a tared value by up to 0.5 counts (1.2e-4 of full scale).

    Args:
        data: Every row is at 0.5 N or more, so in contact. A mixed data set may know the centre of
            pressure and the contact normal.
        untouched_rows: Rows put before each trial at rest: baseline counts, zero force, no contact
            location.
        assumed_rest: Rest of every electrode [counts] in trials without one, such as
            published ones. Only differences count for the features; 3300 leaves room for the
            published ranges, -0.78 to 0.17 of full scale.

    Returns:
        Rows of one unique trajectory have one group, and are held out together over all units.

    Raises:
        DatasetError: The rest of a trial is not known, and none is to be assumed, or one with which
            electrodes leave their range.
    """
    contact = data.contact if isinstance(data, MixedDataset) else None
    data = data.experiment if isinstance(data, MixedDataset) else data
    rest = data.trial_rest.copy()
    unknown = np.isnan(rest).any(axis=1)
    if unknown.any():
        if assumed_rest is None:
            raise DatasetError(
                f"rest of {data.trial_name(int(np.flatnonzero(unknown)[0]))} is not known"
                f" ({unknown.sum()} of {data.trials} trials)",
                remedy="state the rest to assume: --assumed-rest 3300",
            )
        change = data.tared[np.isin(data.trial, np.flatnonzero(unknown))] * COUNTS_MAX
        low, high = np.ceil(-change.min()), np.floor(COUNTS_MAX - change.max())
        if not low <= assumed_rest <= high:
            raise DatasetError(
                f"with a rest of {assumed_rest} counts electrodes read from"
                f" {assumed_rest + change.min():.0f} to {assumed_rest + change.max():.0f}, not from"
                f" 0 to {COUNTS_MAX}",
                remedy=f"assume a rest from {low:.0f} to {high:.0f}"
                if low <= high
                else "see whether they are shares of the full scale",
            )
        rest[unknown] = assumed_rest
    # Where each row of the result comes from: a row of the data, or the rest of a trial (-1).
    starts = np.searchsorted(data.trial, np.arange(data.trials))
    source = np.insert(np.arange(len(data)), np.repeat(starts, untouched_rows), -1)
    trial = np.insert(
        data.trial,
        np.repeat(starts, untouched_rows),
        np.repeat(np.arange(data.trials), untouched_rows),
    )
    touching = source >= 0
    baseline = rest[trial]
    counts = np.rint(baseline + _where(touching, data.tared[source], 0.0) * COUNTS_MAX)
    group = data.trial_trajectory[trial]
    return FeatureDataset(
        electrodes=np.clip(counts, 0, COUNTS_MAX).astype(np.uint16),
        baseline=baseline,
        force=_where(touching, data.force[source], 0.0),
        group=group,
        block=group.copy(),
        sensor=data.trial_unit[trial],
        sensor_names=data.unit_names,
        provenance=data.provenance,
        contact_location=_where(touching, data.location[source], np.nan),
        centre_of_pressure=None
        if contact is None
        else _where(touching, contact.centre[source], np.nan),
        contact_normal=None
        if contact is None
        else _where(touching, contact.normal[source], np.nan),
        in_contact=touching,
    )


def _where(
    touching: np.ndarray[tuple[int], np.dtype[np.bool_]], rows: FloatArray, else_: float
) -> FloatArray:
    return np.where(touching[:, None], rows, np.float32(else_)).astype(np.float32, copy=False)
