"""The statistics as Markdown tables, beside the paper's numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from palpate_training.twin_figures.electrodes import ELECTRODE_NAMES
from palpate_training.twin_figures.idle import IdleStream
from palpate_training.twin_figures.noise import drift, spectrum
from palpate_training.twin_figures.plate import PlateResponse
from palpate_training.twin_figures.signs import FlatPress, agreement, signs
from palpate_training.twin_figures.statistics import (
    ELECTRODE_GROUPS,
    ELECTRODE_MEANS,
    PAPER_ROWS,
    PAPER_SHEARED,
    PAPER_TRAJECTORIES,
    PAPER_TRIALS,
    PAPER_UNITS,
    SHEARED,
    DatasetStatistics,
    UnitStatistics,
)

_SIGN_WORDS = {1: "rises", -1: "falls", 0: "-"}


def table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first column is words, the others are numbers."""
    lines = ["| " + " | ".join(headings) + " |", "|---|" + "---:|" * (len(headings) - 1)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def size_table(statistics: DatasetStatistics) -> str:
    """Counts of the whole data set beside the paper's."""
    return table(
        ["", "this data set", "paper"],
        [
            ["unique trajectories", f"{statistics.trajectories:,}", f"{PAPER_TRAJECTORIES:,}"],
            ["trials, all units", f"{statistics.trials:,}", f"{PAPER_TRIALS:,}"],
            ["rows", f"{statistics.rows:,}", f"{PAPER_ROWS:,}"],
            [
                "unique trajectories planned angled",
                _percent(statistics.angled_share),
                f"about {100 * PAPER_SHEARED:.0f} %",
            ],
        ],
    )


def unit_table(units: Sequence[UnitStatistics], paper: Sequence[int | None]) -> str:
    """What the paper tells of each BioTac, and ours.

    Args:
        units: The units.
        paper: For each the index of the paper's BioTac to put beside it, or None.
    """
    facts = [PAPER_UNITS[i] if i is not None else None for i in paper]

    def beside(values: Sequence[str], theirs: Sequence[str]) -> list[str]:
        pairs = zip(values, theirs, facts, strict=True)
        return [f"{ours} ({other})" if fact else ours for ours, other, fact in pairs]

    tared = beside(
        [f"{unit.tared_min:.3f} to {unit.tared_max:.3f}" for unit in units],
        [f"{fact.tared_min:.2f} to {fact.tared_max:.2f}" if fact else "" for fact in facts],
    )
    force = beside(
        [f"{unit.force_max_n:.1f}" for unit in units],
        [f"{fact.force_max_n:.1f}" if fact else "" for fact in facts],
    )
    rows: list[list[str]] = [
        ["trials", *(str(unit.trials) for unit in units)],
        ["unique trajectories", *(str(unit.trajectories) for unit in units)],
        ["rows", *(f"{unit.rows:,}" for unit in units)],
        ["rows a trial: fewest, mean, most", *(_spread(unit.rows_per_trial) for unit in units)],
        ["tared electrodes, lowest to highest [1]", *tared],
        ["largest force [N]", *force],
        ["median force [N]", *(f"{unit.force_median_n:.2f}" for unit in units)],
        ["trials planned angled", *(_percent(unit.angled_share) for unit in units)],
        [
            f"trials that end with tangential over whole force > {SHEARED:g}",
            *(_percent(unit.sheared_share) for unit in units),
        ],
    ]
    return table(["in brackets: the paper", *(unit.name for unit in units)], rows)


def group_table(units: Sequence[UnitStatistics]) -> str:
    """Mean standard deviation of the tared values by group of electrodes, and the target."""
    rows = [
        [
            group.name,
            f"{group.low:.3f} to {group.high:.3f}",
            *(
                f"{unit.electrode_sd[list(group.electrodes)].mean():.3f}"
                f"{'' if group.within(unit.electrode_sd) else ' (outside)'}"
                for unit in units
            ),
        ]
        for group in ELECTRODE_GROUPS
    ]
    low, high = ELECTRODE_MEANS
    rows.append(
        [
            "means, lowest to highest",
            f"{low:g} to {high:g}",
            *(f"{u.electrode_mean.min():.3f} to {u.electrode_mean.max():.3f}" for u in units),
        ]
    )
    return table(["standard deviation [1]", "target", *(unit.name for unit in units)], rows)


def electrode_table(units: Sequence[UnitStatistics]) -> str:
    """Mean and standard deviation of each electrode."""
    headings = ["electrode", *(f"{u.name}: {what}" for u in units for what in ("mean", "sd"))]
    rows = [
        [
            name,
            *(
                f"{value:.4f}"
                for unit in units
                for value in (unit.electrode_mean[i], unit.electrode_sd[i])
            ),
        ]
        for i, name in enumerate(ELECTRODE_NAMES)
    ]
    return table(headings, rows)


def noise_table(streams: Sequence[IdleStream]) -> str:
    """Noise and drift of untouched electrodes: median, and lowest to highest of the 19."""
    rows = []
    for stream in streams:
        noise = spectrum(stream.counts, stream.rate_hz).noise_sd()
        change = drift(stream.counts, stream.rate_hz)
        rows.append(
            [
                stream.name,
                f"{len(stream.counts) / stream.rate_hz / 60:.1f}",
                _range(noise, 2),
                _range(change.per_minute(), 1),
                f"{100 * change.common_share():.1f} %",
            ]
        )
    headings = [
        "sensor", "minutes", "noise above 1 Hz, sd [counts]", "drift [counts/min]",
        "drift in common",
    ]  # fmt: skip
    return table(headings, rows)


def sign_table(real: PlateResponse, presses: Sequence[FlatPress]) -> str:
    """Mean tared value and sign of each electrode; the last row counts agreement."""
    columns = [real.tared, *(press.tared for press in presses)]
    rows = [
        [name, *(f"{_SIGN_WORDS[int(signs(c)[i])]} ({c[i]:+.3f})" for c in columns)]
        for i, name in enumerate(ELECTRODE_NAMES)
    ]
    counted = [agreement(real.tared, press.tared) for press in presses]
    rows.append(["same sign", "", *(f"**{same} of {of}**" for same, of in counted)])
    rows.append(
        [
            "mean of", f"{real.samples:,} samples, {real.logs} logs",
            *(f"{press.rows} rows, {press.trials} trials" for press in presses),
        ]
    )  # fmt: skip
    return table(["electrode", "real, plate", *(f"{press.name}, cube" for press in presses)], rows)


def _percent(share: float) -> str:
    return "not known" if np.isnan(share) else f"{100 * share:.0f} %"


def _spread(rows_per_trial: tuple[int, float, int]) -> str:
    fewest, mean, most = rows_per_trial
    return f"{fewest}, {mean:.1f}, {most}"


def _range(values: np.ndarray, digits: int) -> str:
    middle, low, high = np.median(values), values.min(), values.max()
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"
