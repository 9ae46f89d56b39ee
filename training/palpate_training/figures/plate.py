"""A real BioTac under a flat plate: what its electrodes do, from the LASA contact-normal logs.

Rules, ours: the sensor's untouched pressure is the count it shows most often (untouched it stays
within a count or two, in contact it spreads over hundreds); a sample within 10 counts of it is
untouched, one more than 30 counts (about 1 kPa) above it is touched. The plate is ventral when its
normal is within 20 degrees of the pad's.

Which electrodes rise and fall under a ventral plate: the real sensor beside the twin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.messages import COUNTS_MAX
from palpate_training.datasets.container import read_archive
from palpate_training.datasets.experiment import ExperimentDataset
from palpate_training.figures.boxes import ELECTRODE_NAMES
from palpate_training.figures.skin import final_rows
from palpate_training.figures.style import (
    GRID,
    INK,
    REAL_COLOURS,
    finish,
    grid,
    label,
    new_figure,
    unit_colour,
)

Floats = npt.NDArray[np.float64]

CONTACT_NORMAL = Path("lasa_contact_normal") / "contact_normal_logs.npz"
"""Where the logs are, in the folder of public data."""

UNTOUCHED_COUNTS = 10
TOUCHED_COUNTS = 30
TOUCH_GAP_S = 0.5
"""Untouched for so long, and the next touch begins [s]."""

VENTRAL_COS = float(np.cos(np.radians(20.0)))
"""A press is ventral within so much of +z, the direction in which a plate pushes the finger."""

_UNTOUCHED_SAMPLES = 20
"""Fewer give no baseline; the log is left out."""


@dataclass(frozen=True, slots=True)
class PlateLog:
    """One log of a plate that is pressed on the pad.

    Attributes:
        name: In the archive.
        time_s: Wall clock [s], shape (T,).
        pdc: Raw static pressure [counts], shape (T,).
        electrodes: Raw counts [counts], shape (T, 19).
        normal: Direction in which the plate pushes, sensor frame, unit, shape (T, 3); +z is
            ventral. The archive holds the last known one where nothing touches.
    """

    name: str
    time_s: Floats
    pdc: Floats
    electrodes: Floats
    normal: Floats


@dataclass(frozen=True, slots=True)
class TouchedRows:
    """When a log is touched.

    Attributes:
        rows: Rows in which it is touched, shape (S,).
        touch: Number of the touch of each, from zero, shape (S,).
        rest: Mean of the untouched rows [counts], shape (19,).
    """

    rows: npt.NDArray[np.int64]
    touch: npt.NDArray[np.int64]
    rest: Floats


@dataclass(frozen=True, slots=True)
class PlateResponse:
    """What electrodes do under a ventral plate.

    Attributes:
        tared: Mean tared electrodes over full scale [1], shape (19,).
        samples: How many samples it is the mean of.
        logs: From how many logs they come.
    """

    tared: Floats
    samples: int
    logs: int


def read_plate_logs(folder: Path) -> tuple[PlateLog, ...]:
    """All logs, in order of name; empty where the archive is absent.

    Raises:
        DatasetError: The archive is there but damaged or another one.
    """
    path = folder / CONTACT_NORMAL
    if not path.is_file():
        return ()
    parts = ("unix_time_s", "pdc_raw", "electrodes_raw", "contact_normal")

    def wanted(held: Sequence[str]) -> list[str]:
        logs = sorted({key.partition("_")[0] for key in held})
        return [f"{log}_{part}" for log in logs for part in parts]

    remedy = "give the archive of the LASA contact-normal logs"
    arrays = read_archive(path, wanted, remedy=remedy)
    logs = dict.fromkeys(key.partition("_")[0] for key in arrays)
    return tuple(
        PlateLog(log, *(arrays[f"{log}_{part}"].astype(np.float64) for part in parts))
        for log in logs
    )


def touched_rows(log: PlateLog) -> TouchedRows | None:
    """When a log is touched; None if never, or if nothing tells how it reads untouched."""
    values, often = np.unique(log.pdc, return_counts=True)
    above = log.pdc - values[np.argmax(often)]
    untouched = np.abs(above) <= UNTOUCHED_COUNTS
    rows = np.flatnonzero(above > TOUCHED_COUNTS)
    if np.count_nonzero(untouched) < _UNTOUCHED_SAMPLES or not rows.size:
        return None
    touch = np.concatenate([[0], np.cumsum(np.diff(log.time_s[rows]) > TOUCH_GAP_S)])
    return TouchedRows(rows, touch, log.electrodes[untouched].mean(axis=0))


def plate_response(logs: Sequence[PlateLog]) -> PlateResponse | None:
    """Mean tared electrodes of all samples with a ventral plate on the pad; None = none.

    Args:
        logs: Each is tared by its own untouched samples; those without any, or never touched by a
            ventral plate, are left out.
    """
    touched = [part for log in logs if len(part := _ventral(log))]
    if not touched:
        return None
    rows = np.concatenate(touched)
    return PlateResponse(rows.mean(axis=0), len(rows), len(touched))


def _ventral(log: PlateLog) -> Floats:
    """Tared electrodes under a ventral plate, shape (S, 19)."""
    found = touched_rows(log)
    if found is None:
        return np.empty((0, log.electrodes.shape[1]))
    ventral = found.rows[log.normal[found.rows, 2] > VENTRAL_COS]
    return np.asarray((log.electrodes[ventral] - found.rest) / COUNTS_MAX)


FLAT_INDENTERS = ("cube",)
"""Indenters whose face is a plate to the pad."""

UNDECIDED = 0.005
"""A mean nearer to zero than this has no sign [1]: the baseline of the real logs wanders by up to
13 counts, 0.003 of full scale, and what is left of noise and creep is added."""


@dataclass(frozen=True, slots=True)
class FlatPress:
    """Mean answer of a unit to flat indenters that press the pad from below.

    Attributes:
        unit: Index of the unit.
        name: Its name.
        tared: Mean tared electrodes over full scale [1], shape (19,).
        rows: How many rows it is the mean of.
        trials: From how many trials they come.
    """

    unit: int
    name: str
    tared: Floats
    rows: int
    trials: int


def flat_presses(data: ExperimentDataset) -> tuple[FlatPress, ...]:
    """Mean answer of each unit that a flat indenter pressed along the normal, from below.

    A trial counts when its trajectory's id ends in ``/normal`` and its final force is within 20
    degrees of +z, as the plate's normal must be.
    """
    last = final_rows(data)
    force = data.force[last]
    from_below = force[:, 2] > VENTRAL_COS * np.linalg.norm(force, axis=1)
    chosen = []
    for row, below in zip(last, from_below, strict=True):
        trajectory = data.row_trajectory[row]
        normal = data.trajectories[trajectory].endswith("/normal")
        if below and normal and data.indenters[trajectory] in FLAT_INDENTERS:
            chosen.append(data.trial[row])
    used = np.isin(data.trial, chosen)
    found = []
    for unit, name in enumerate(data.unit_names):
        rows = used & (data.row_unit == unit)
        if rows.any():
            mean = data.tared[rows].mean(axis=0, dtype=np.float64)
            trials = len(np.unique(data.trial[rows]))
            found.append(FlatPress(unit, name, mean, int(rows.sum()), trials))
    return tuple(found)


def signs(tared: Floats) -> npt.NDArray[np.int64]:
    """+1 rises, -1 falls, 0 undecided, of each electrode, shape (19,)."""
    return np.where(np.abs(tared) < UNDECIDED, 0, np.sign(tared)).astype(np.int64)


def agreement(real: Floats, twin: Floats) -> tuple[int, int]:
    """How many electrodes have the real sign, of how many whose real sign is decided."""
    theirs, ours = signs(real), signs(twin)
    decided = theirs != 0
    return int(np.count_nonzero(decided & (theirs == ours))), int(np.count_nonzero(decided))


def draw_signs(path: Path, real: PlateResponse, presses: Sequence[FlatPress]) -> str:
    """Draw the mean tared value of each electrode, real and of each unit; returns the caption."""
    counted = [
        "{} {} of {}".format(press.name, *agreement(real.tared, press.tared)) for press in presses
    ]
    text = (
        "Mean tared value of each electrode while something flat presses the pad from below, within"
        f" 20 degrees. Real: plate on one BioTac, {real.samples:,} samples of {real.logs} logs;"
        " twin: the cube along the normal. The axis is linear in the grey band (nearer to zero"
        f" than {UNDECIDED:g}: undecided), logarithmic outside. Same sign as the real sensor, of"
        f" the electrodes it decides: {', '.join(counted) or 'no unit was pressed so'}."
    )
    series = [("real", real.tared, REAL_COLOURS[0])]
    series += [(press.name, press.tared, unit_colour(press.unit)) for press in presses]
    figure = new_figure(12.0, 4.8)
    axes = figure.subplots()
    width = 0.8 / len(series)
    places = np.arange(len(ELECTRODE_NAMES))
    axes.axhspan(-UNDECIDED, UNDECIDED, color=GRID, lw=0, zorder=0)
    for i, (name, values, colour) in enumerate(series):
        at = places + (i - (len(series) - 1) / 2) * width
        axes.bar(at, values, 0.92 * width, color=colour, label=name, zorder=2)
    axes.axhline(0, color=INK, lw=0.7, zorder=3)
    axes.set_yscale("symlog", linthresh=UNDECIDED, linscale=0.4)
    ticks = [-0.5, -0.1, -0.05, -0.01, 0, 0.01, 0.05, 0.1]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks], minor=False)
    axes.set_yticks([], minor=True)
    axes.set_xticks(places, ELECTRODE_NAMES)
    axes.set_xlim(-0.6, len(places) - 0.4)
    label(axes, "electrode", "mean tared counts / full scale [1]")
    grid(axes, "y")
    figure.legend(
        loc="outside upper right", ncols=len(series), frameon=False, fontsize=9, labelcolor=INK
    )
    return finish(figure, path, "Rise and fall under a flat ventral press", text)
