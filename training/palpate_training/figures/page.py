"""The page of a data set: statistics, pictures, and the command that made it.

The statistics as Markdown tables, beside the paper's numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from palpate.errors import DatasetError
from palpate.files.atomic import written_whole
from palpate_training.datasets.experiment import ExperimentDataset, MixedDataset, content_sha256
from palpate_training.figures.boxes import ELECTRODE_NAMES, draw_electrode_boxes, draw_force_boxes
from palpate_training.figures.noise import IdleStream, draw_noise, drift, spectrum
from palpate_training.figures.plate import (
    FlatPress,
    PlateLog,
    PlateResponse,
    agreement,
    draw_signs,
    flat_presses,
    plate_response,
    signs,
)
from palpate_training.figures.skin import draw_contacts, draw_motion, motion_share
from palpate_training.figures.statistics import (
    ELECTRODE_GROUPS,
    ELECTRODE_MEANS,
    PAPER_ROWS,
    PAPER_SHEARED,
    PAPER_TRAJECTORIES,
    PAPER_TRIALS,
    PAPER_UNITS,
    SHEARED,
    DatasetStatistics,
    SpecimenStatistics,
    dataset_statistics,
)
from palpate_training.figures.style import markdown_table

PAGE = "statistics.md"


@dataclass(frozen=True, slots=True)
class PageSources:
    """What a page is made from.

    Attributes:
        experiment: The purely experimental data set.
        mixed: The mixed one; None leaves out skin motion, and the skin under the contacts.
        idle: Untouched streams of the twin, of real sensors, or both; empty leaves out noise.
        plate: Logs of a real sensor under a plate; empty leaves out the sign pattern.
    """

    experiment: ExperimentDataset
    mixed: MixedDataset | None = None
    idle: tuple[IdleStream, ...] = ()
    plate: tuple[PlateLog, ...] = ()


def write_page(
    folder: Path,
    sources: PageSources,
    *,
    command: str,
    on_step: Callable[[str], None] = lambda step: None,
) -> DatasetStatistics:
    """Write ``statistics.md`` and its pictures; returns the statistics.

    Raises:
        DatasetError: A unit of the data set has no trial, a stream is too short, or the
            disk refused.
    """
    data = sources.experiment
    on_step("statistics")
    statistics = dataset_statistics(data)
    unused = [unit for unit in data.unit_names if unit not in {u.name for u in statistics.units}]
    if unused:
        raise DatasetError(
            f"there is no trial of {', '.join(unused)}",
            remedy="generate or ingest trials of every unit that the data set names",
        )
    # The paper's BioTacs have no names; ours are put beside them in order.
    paper = [i if i < len(PAPER_UNITS) else None for i in range(len(data.unit_names))]
    parts = [
        "# Statistics of a data set of the experiment\n",
        f"Made by `{command}`.\n",
        _provenance(data),
        "## Size\n",
        size_table(statistics),
        "## Units\n",
        unit_table(statistics.units, paper),
        "The normal of the last line is that of the core's form under the indenter's tip, so it is"
        " a rough number for long and flat indenters.\n",
    ]
    mesh = sources.mixed.mesh if sources.mixed is not None else None
    pictures: tuple[tuple[str, str, Callable[[Path], str]], ...] = (
        ("contact locations", "contacts.png", lambda path: draw_contacts(path, data, mesh)),
        ("force", "force.png", lambda path: draw_force_boxes(path, data)),
        ("electrodes", "electrodes.png", lambda path: draw_electrode_boxes(path, data)),
    )
    for what, name, draw in pictures:
        on_step(what)
        parts += [f"## {what.capitalize()}\n", *_picture(name, draw(folder / name))]
    parts += [
        "Targets: real sensors, dominated by light contacts.\n",
        group_table(statistics.units),
        electrode_table(statistics.units),
    ]
    if sources.mixed is not None:
        on_step("skin motion")
        parts += _motion(folder, sources.mixed)
    if sources.idle:
        on_step("noise and drift")
        parts += _noise(folder, sources.idle)
    if sources.plate:
        on_step("sign pattern")
        parts += _signs(folder, data, sources.plate)
    with written_whole(folder / PAGE) as partial:
        partial.write_text("\n".join(parts), encoding="utf-8")
    return statistics


def _motion(folder: Path, mixed: MixedDataset) -> list[str]:
    share = motion_share(mixed)
    text = draw_motion(folder / "motion.png", mixed.mesh, share, len(mixed))
    loss = (
        f"Fields are kept as {len(mixed.basis.modes)} coefficients a row; that loses"
        f" {1e6 * mixed.basis.loss_mean:.3g} um in the mean and at most"
        f" {1e6 * mixed.basis.loss_max:.3g} um of any node.\n"
    )
    return ["## Skin motion\n", *_picture("motion.png", text), loss]


def _noise(folder: Path, streams: Sequence[IdleStream]) -> list[str]:
    text = draw_noise(folder / "noise.png", streams)
    missing = (
        [] if any(not s.real for s in streams) else ["No idle stream of the twin was given.\n"]
    )
    return [
        "## Noise and drift\n",
        *missing,
        *_picture("noise.png", text),
        noise_table(streams),
        "Median of the 19 electrodes, in brackets lowest to highest; drift: slope of a line over"
        " the whole stream; in common: share of the squared change that one course common to all"
        " electrodes explains.\n",
    ]


def _signs(folder: Path, data: ExperimentDataset, logs: Sequence[PlateLog]) -> list[str]:
    real = plate_response(logs)
    if real is None:
        return ["## Rise and fall\n", "No log has a ventral plate on the pad.\n"]
    presses = flat_presses(data)
    text = draw_signs(folder / "signs.png", real, presses)
    return ["## Rise and fall\n", *_picture("signs.png", text), sign_table(real, presses)]


def _picture(name: str, text: str) -> list[str]:
    return [f"![{name.removesuffix('.png')}]({name})\n", f"*{text}*\n"]


def _provenance(data: ExperimentDataset) -> str:
    where = data.provenance
    made_by = f"`{where.command}`" if where.command else "-"
    return (
        f"* source: {where.source}\n"
        f"* data set made by: {made_by} (palpate {where.palpate_version})\n"
        f"* content sha256: {content_sha256(data)}\n"
        f"* input sha256: {where.input_sha256 or '-'}\n"
        f"* licence: {where.licence}\n"
        f"* notes: {where.notes or '-'}\n"
    )


_SIGN_WORDS = {1: "rises", -1: "falls", 0: "-"}


def size_table(statistics: DatasetStatistics) -> str:
    """Counts of the whole data set beside the paper's."""
    return markdown_table(
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


def unit_table(units: Sequence[SpecimenStatistics], paper: Sequence[int | None]) -> str:
    """The numbers of each unit, beside those of the paper's BioTac of that index, if any."""
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
        [
            "rows a trial: fewest, mean, most",
            *("{}, {:.1f}, {}".format(*unit.rows_per_trial) for unit in units),
        ],
        ["tared electrodes, lowest to highest [1]", *tared],
        ["largest force [N]", *force],
        ["median force [N]", *(f"{unit.force_median_n:.2f}" for unit in units)],
        ["trials planned angled", *(_percent(unit.angled_share) for unit in units)],
        [
            f"trials that end with tangential over whole force > {SHEARED:g}",
            *(_percent(unit.sheared_share) for unit in units),
        ],
    ]
    return markdown_table(["in brackets: the paper", *(unit.name for unit in units)], rows)


def group_table(units: Sequence[SpecimenStatistics]) -> str:
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
    return markdown_table(
        ["standard deviation [1]", "target", *(unit.name for unit in units)], rows
    )


def electrode_table(units: Sequence[SpecimenStatistics]) -> str:
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
    return markdown_table(headings, rows)


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
    return markdown_table(headings, rows)


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
    return markdown_table(
        ["electrode", "real, plate", *(f"{press.name}, cube" for press in presses)], rows
    )


def _percent(share: float) -> str:
    return "not known" if np.isnan(share) else f"{100 * share:.0f} %"


def _range(values: np.ndarray, digits: int) -> str:
    middle, low, high = np.median(values), values.min(), values.max()
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"
