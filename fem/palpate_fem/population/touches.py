"""Touches of one real sensor that were held still, with their force: what a fit takes.

A recording with a force sensor below the finger does not say where the finger was touched, nor by
what. What it gives are counts and a force at the same time. Where a touch is held, both are free of
the sensor's slow response and of the lag between the two instruments.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import DatasetError
from palpate.files.hdf5 import Hdf5Schema, check_rows, opened, read_array, rows_sha256, text
from palpate_fem.electrodes.electronics import FULL_SCALE
from palpate_fem.electrodes.specimen import SENSING

Floats = NDArray[np.float64]

FEATURES = Hdf5Schema("palpate.features", 1, "use a file made by `palpate data ingest-...`")
COLUMNS = {"electrodes": "counts", "baseline": "counts", "force": "N", "sensor": "1"}
DIGESTED = (
    *("electrodes", "baseline", "force", "group", "block", "sensor", "contact_location"),
    *("centre_of_pressure", "contact_normal", "in_contact", "time_ns"),
)
"""All columns that such a file may have, in the order of its digest."""

HELD_ROWS = 50
"""Half a second at 100 Hz."""

STILL_COUNTS = 100.0
"""A touch is held while no electrode moves by more [counts], and it is another if one does. Real
ones creep by some tens of counts; a change of place moves them by hundreds."""

LEAST_N = 0.5
"""Lighter touches are left out [N]: the force sensor's error is then a large share of the force."""

_REMEDY = "give raw counts of E1..E19, untouched and touched, and the force on the sensor in N"


@dataclass(frozen=True)
class SensorTouches:
    """Resting counts of one sensor, and touches with force, in order of time.

    Attributes:
        name: Of the sensor.
        rest: Counts of the untouched sensor, shape (19,).
        counts: Of each touch, raw, shape (N, 19).
        force: On the sensor [N], sensor frame, shape (N, 3).
        baseline: Counts of the untouched sensor in force at each touch, shape (N, 19): it may have
            been tared again; None = at all of them the rest.

    Raises:
        DatasetError: Shapes do not fit together, a value is not finite or no count, there is no
            rest, or a touch has no force.
    """

    name: str
    rest: Floats
    counts: Floats
    force: Floats
    baseline: Floats | None = None

    def __post_init__(self) -> None:
        count = len(self.counts)
        raw = {"rest": (self.rest, (SENSING,)), "counts": (self.counts, (count, SENSING))}
        if self.baseline is not None:
            raw["baseline"] = (self.baseline, (count, SENSING))
        for label, (values, wanted) in {**raw, "force": (self.force, (count, 3))}.items():
            if values.shape != wanted:
                raise DatasetError(
                    f"{self.name}: {label} has shape {values.shape}, expected {wanted}",
                    remedy=_REMEDY,
                )
            if not np.isfinite(values).all():
                raise DatasetError(f"{self.name}: {label} is not finite", remedy=_REMEDY)
        for label, (values, _) in raw.items():
            if values.size and not (0 < values.min() and values.max() < FULL_SCALE):
                raise DatasetError(
                    f"{self.name}: {label} is from {values.min():g} to {values.max():g}, not within"
                    f" 0 and {FULL_SCALE}",
                    remedy="give raw counts, nothing subtracted; leave out electrodes at their end",
                )
        size = np.linalg.norm(self.force, axis=1)
        if (size == 0).any():
            raise DatasetError(
                f"{self.name}: touch {int(np.argmin(size))} has no force",
                remedy="give the force on the sensor in N for each touch",
            )

    def __len__(self) -> int:
        return len(self.counts)

    @property
    def tared(self) -> Floats:
        """Counts minus the untouched ones, shape (N, 19)."""
        return self.counts - (self.rest if self.baseline is None else self.baseline)

    def some(self, chosen: slice | NDArray[np.integer[Any]]) -> SensorTouches:
        """Some of the touches."""
        baseline = None if self.baseline is None else self.baseline[chosen]
        return SensorTouches(
            self.name, self.rest, self.counts[chosen], self.force[chosen], baseline
        )


def held(counts: Floats, *, rows: int = HELD_ROWS, still: float = STILL_COUNTS) -> list[slice]:
    """Stretches of a recording in which all electrodes are still, each as long as it can be.

    Args:
        counts: In order of time, shape (T, 19).
        rows: Shortest stretch.
        still: See `STILL_COUNTS`.

    Returns:
        Stretches in order of time; of several in a row that differ by less than ``still`` in all
        electrodes only the first, because they are one touch.
    """
    found: list[slice] = []
    last: Floats | None = None
    start = 0
    while start + rows <= len(counts):
        window = counts[start : start + rows]
        low, high = window.min(axis=0), window.max(axis=0)
        if (high - low).max() > still:
            start += 1
            continue
        end = start + rows
        while end < len(counts):
            low, high = np.minimum(low, counts[end]), np.maximum(high, counts[end])
            if (high - low).max() > still:
                break
            end += 1
        mean = counts[start:end].mean(axis=0)
        if last is None or np.abs(mean - last).max() > still:
            found.append(slice(start, end))
            last = mean
        start = end
    return found


def touches_of(
    name: str,
    rest: Floats,
    counts: Floats,
    force: Floats,
    *,
    baseline: Floats | None = None,
    group: NDArray[np.integer[Any]] | None = None,
    rows: int = HELD_ROWS,
    still: float = STILL_COUNTS,
    rest_alone: bool = False,
) -> SensorTouches:
    """Touches that were held, each the mean of its stretch.

    Args:
        name: Of the sensor.
        rest: Counts of the untouched sensor, shape (19,).
        counts: Raw, in order of time, shape (T, 19).
        force: On the sensor [N], shape (T, 3).
        baseline: Untouched counts in force at each row, shape (T, 19); None = the rest.
        group: Recording or press of each row, shape (T,): a touch is within one; None = all rows
            are of one.
        rows: Shortest stretch.
        still: See `STILL_COUNTS`.
        rest_alone: Whether no touch at all will do.

    Raises:
        DatasetError: As `SensorTouches`; or nothing was held.
    """
    if rows < 1 or still <= 0:
        raise DatasetError(
            f"{name}: touches of {rows} rows that move by {still:g} counts",
            remedy="give at least one row and more than 0 counts",
        )
    others: dict[str, NDArray[Any] | None] = {"force": force, "baseline": baseline, "group": group}
    for label, values in others.items():
        if values is not None and len(values) != len(counts):
            raise DatasetError(
                f"{name}: {len(counts)} rows of counts, {len(values)} of {label}", remedy=_REMEDY
            )
    if not (np.isfinite(counts).all() and np.isfinite(force).all()):
        raise DatasetError(f"{name}: counts or force are not finite", remedy=_REMEDY)
    tared = np.asarray(counts if baseline is None else counts - baseline, np.float64)
    cuts: list[int] = [] if group is None else (np.flatnonzero(np.diff(group)) + 1).tolist()
    stretches = [
        slice(start + one.start, start + one.stop)
        for start, end in pairwise([0, *cuts, len(counts)])
        for one in held(tared[start:end], rows=rows, still=still)
    ]
    kept = [one for one in stretches if np.linalg.norm(force[one].mean(axis=0)) >= LEAST_N]
    if not kept and not rest_alone:
        raise DatasetError(
            f"{name}: no touch of {LEAST_N} N was held for {rows} rows",
            remedy="hold each touch for half a second, or ask for fewer rows",
        )

    def means(values: Floats) -> Floats:
        found = [values[one].mean(axis=0) for one in kept]
        return np.array(found, np.float64).reshape(len(kept), values.shape[1])

    return SensorTouches(
        name,
        np.asarray(rest, np.float64),
        means(counts),
        means(force),
        None if baseline is None else means(baseline),
    )


def read_touches(
    path: Path, *, sensor: str = "", rows: int = HELD_ROWS, rest_alone: bool = False
) -> SensorTouches:
    """Touches of one sensor of a data set (schema ``palpate.features``).

    Args:
        path: Made by ``palpate data ingest-...``: counts, untouched counts in force at each row,
            forces, and which rows are of one recording or press. The rest is that of the first row.
        sensor: Its name; empty = the only one.
        rows: Shortest stretch that counts as held.
        rest_alone: Whether no touch at all will do.

    Raises:
        DatasetError: Not such a file; a column is missing; the rows were changed; the sensor is
            not there, or one of several has to be named; or as `touches_of`.
    """
    with opened(path, extra="fem", missing="make it: palpate data ingest-record") as file:
        FEATURES.check(path, file)
        columns = {name: read_array(path, file, name, unit) for name, unit in COLUMNS.items()}
        group = read_array(path, file, "group", "1") if "group" in file else None
        names = [text(name) for name in file.attrs.get("sensor_names", ())]
        if stated := text(file.attrs.get("content_sha256", "")):
            there = {name: file[name].attrs.get("unit", "") for name in DIGESTED if name in file}
            arrays = {
                name: read_array(path, file, name, text(unit)) for name, unit in there.items()
            }
            check_rows(path, stated, rows_sha256(names, arrays))
    if sensor not in names and not (sensor == "" and len(names) == 1):
        raise DatasetError(
            f"{path}: {'no sensor ' + repr(sensor) if sensor else 'it holds several sensors'}",
            remedy=f"name one of: {', '.join(names) or 'none'}",
        )
    mine = columns["sensor"] == (names.index(sensor) if sensor else 0)
    if not mine.any():
        raise DatasetError(f"{path}: no row of {sensor or names[0]}", remedy=_REMEDY)
    baseline = columns["baseline"][mine].astype(np.float64)
    return touches_of(
        sensor or names[0],
        baseline[0],
        columns["electrodes"][mine].astype(np.float64),
        columns["force"][mine].astype(np.float64),
        baseline=baseline,
        group=None if group is None else group[mine],
        rows=rows,
        rest_alone=rest_alone,
    )
