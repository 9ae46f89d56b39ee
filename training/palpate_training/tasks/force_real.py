"""Force on two real BioTacs: blocks held out, and a BioTac that was never seen.

Each recording is cut into contiguous blocks (20 of about 9 s of LASA's), 5 folds test every fifth
block each, so every row is tested once; 1 s beside every border is left out. The rows of all folds
are pooled. One network for each finger, as in the paper's "unseen trajectory"; for the unseen
BioTac, one trained on the other finger. Longer and shorter blocks are reported beside.

    palpate train force-real --data lasa.h5 --out docs/results
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.files.atomic import written_whole
from palpate.process import require
from palpate_training.datasets.features import FeatureDataset, cut_into_blocks
from palpate_training.figures.style import new_figure, save
from palpate_training.learning import baselines
from palpate_training.learning.fit import FeaturesFitConfig, fit_quantity
from palpate_training.learning.networks import predict
from palpate_training.learning.splits import RowSplit, contiguous_folds, unseen_sensor
from palpate_training.tasks.features import guard_rows
from palpate_training.tasks.results import (
    ModelResult,
    OnNetwork,
    force_result,
    force_table,
    tick,
    write_json,
)

FORCE_CONFIG = FeaturesFitConfig()
"""Chosen on validation blocks only; training/LOG.md has what was tried."""

OTHER_BLOCKS = (10, 40)
"""Blocks of a recording (LASA's: about 18 s and 4.6 s each), reported beside the data set's own."""

NETWORK = "MLP"
"""Model whose numbers are the mean over the single networks: the headline everywhere."""

FOLDS = 5


@dataclass(frozen=True, slots=True)
class ForceReport:
    """Results of the experiment, and truth against estimates for the figure."""

    results: list[ModelResult]
    panels: list[ForcePanel]
    facts: dict[str, object]


def experiment_count(
    data: FeatureDataset, seeds: int, other_blocks: Sequence[int] = OTHER_BLOCKS
) -> int:
    """How many networks the experiment trains."""
    sensors = len(data.sensor_names)
    return sensors * (seeds * (FOLDS + (sensors > 1)) + FOLDS * len(other_blocks))


def run_force_real(
    data: FeatureDataset,
    *,
    seeds: int = 5,
    config: FeaturesFitConfig = FORCE_CONFIG,
    unseen: bool = True,
    other_blocks: Sequence[int] = OTHER_BLOCKS,
    draws: int = 2000,
    on_network: OnNetwork | None = None,
) -> ForceReport:
    """Train and test everything.

    Args:
        data: A data set with one or more sensors.
        seeds: Networks for each fold.
        config: Settings of every training.
        unseen: Also test each sensor with networks of the others.
        other_blocks: Also cut each recording into so many blocks, with one network for each fold.
        draws: Draws of the bootstrap.
        on_network: Called after each training, for a progress bar.
    """
    results: list[ModelResult] = []
    panels: list[ForcePanel] = []

    def compare(source: FeatureDataset, test: str, folds: list[RowSplit], networks: int) -> None:
        rows, panel = _compare(source, test, folds, networks, config, draws, on_network)
        results.extend(rows)
        if source is data:
            panels.append(panel)

    def hold_out_blocks(source: FeatureDataset, sensor: int, networks: int) -> None:
        blocks = len(np.unique(source.block[source.sensor == sensor]))
        folds = _folds(source, sensor)
        compare(source, f"{source.sensor_names[sensor]}, {blocks} blocks", folds, networks)

    for sensor in range(len(data.sensor_names)):
        hold_out_blocks(data, sensor, seeds)
    if unseen and len(data.sensor_names) > 1:
        for sensor, name in enumerate(data.sensor_names):
            split = unseen_sensor(
                data.sensor, data.block, test_sensor=sensor, guard_rows=guard_rows(data)
            )
            compare(data, f"{name}, unseen", [split], seeds)
    for count in other_blocks:
        recut = replace(data, block=_recut(data.group, count))
        for sensor in range(len(data.sensor_names)):
            hold_out_blocks(recut, sensor, 1)
    facts: dict[str, object] = {
        "data_sha256": data.content_sha256(),
        "source": data.provenance.source,
        "licence": data.provenance.licence,
        "pairing": data.provenance.notes,
        "rows": {name: int(np.sum(data.sensor == i)) for i, name in enumerate(data.sensor_names)},
        "blocks": {
            name: len(np.unique(data.block[data.sensor == i]))
            for i, name in enumerate(data.sensor_names)
        },
        "folds": FOLDS,
        "guard_rows": guard_rows(data),
        "seeds": seeds,
        "config": asdict(config),
    }
    return ForceReport(results, panels, facts)


def _compare(
    data: FeatureDataset,
    test: str,
    folds: Sequence[RowSplit],
    networks: int,
    config: FeaturesFitConfig,
    draws: int,
    on_network: OnNetwork | None,
) -> tuple[list[ModelResult], ForcePanel]:
    """Constant, line, single networks and their mean on the pooled test rows of all folds."""
    x, y = data.tared_counts, data.force
    tested = np.sort(np.concatenate([split.test for split in folds]))
    if len(np.unique(tested)) != len(tested):
        raise DatasetError(f"{test}: a row is tested twice", remedy="report this: a split is wrong")

    constant, linear = np.full(y.shape, np.nan), np.full(y.shape, np.nan)
    estimates = np.full((networks, *y.shape), np.nan, dtype=np.float32)
    for split in folds:
        # All settings were chosen before, so every model learns from the validation rows too.
        known = np.sort(np.concatenate([split.train, split.validation]))
        constant[split.test] = baselines.constant(x[known], y[known]).predict(x[split.test])
        linear[split.test] = baselines.linear(x[known], y[known]).predict(x[split.test])
        for seed in range(networks):
            net = fit_quantity(
                x[known], y[known], baseline=data.baseline[known], config=config, seed=seed
            )
            estimates[seed, split.test] = predict(net, x[split.test])
            tick(on_network)

    truth, block = y[tested], data.block[tested]
    mean = np.mean(estimates, axis=0)[tested]
    models: list[tuple[str, list[npt.NDArray[np.floating]]]] = [
        ("constant (training mean)", [constant[tested]]),
        ("linear fit", [linear[tested]]),
        (NETWORK, [estimate[tested] for estimate in estimates]),
    ]
    if networks > 1:
        models.append((f"mean of {networks} MLPs", [mean]))
    rows = {
        name: force_result(test, name, each, truth, block, draws=draws) for name, each in models
    }
    # The figure shows what the table's row MLP and README.md state: every single network.
    headline = rows[NETWORK].metrics
    panel = ForcePanel(
        f"{test}, {NETWORK}: median error of magnitude"
        f" {headline['force_magnitude_median_n']:.3f} N, angle"
        f" {headline['force_angle_median_rad']:.3f} rad",
        np.tile(truth, (networks, 1)),
        np.concatenate([estimate[tested] for estimate in estimates]),
    )
    return list(rows.values()), panel


def _folds(data: FeatureDataset, sensor: int) -> list[RowSplit]:
    """Folds of one sensor's blocks, as row numbers of the data set."""
    rows = np.flatnonzero(data.sensor == sensor)
    return [
        RowSplit(rows[split.train], rows[split.validation], rows[split.test], rows[split.guard])
        for split in contiguous_folds(
            data.block[rows], data.group[rows], folds=FOLDS, guard_rows=guard_rows(data)
        )
    ]


def _recut(group: npt.NDArray[np.int32], blocks: int) -> npt.NDArray[np.int32]:
    """Number so many contiguous blocks in each recording, uniquely over all."""
    block = np.empty(len(group), dtype=np.int32)
    for i, one in enumerate(np.unique(group)):
        rows = np.flatnonzero(group == one)
        block[rows] = cut_into_blocks(len(rows), blocks) + np.int32(i * blocks)
    return block


_PREFACE = """\
How electrodes and forces were paired is "pairing" in force-real.json. Inputs are raw counts minus
the untouched baseline, standardised by the training rows.

Held out are contiguous blocks, never single rows. Each recording is cut into blocks of equal
length; each of five folds tests every fifth block; 1 s beside every border is left out; the test
rows of all folds are pooled. "unseen" networks are trained on the other finger alone, and nothing
is calibrated. With longer blocks, less of what is pressed in the test was seen in training, so the
number of blocks belongs to the result; the last rows vary it.

"MLP" is the paper's 19-256-128-128-3 network. Its metrics are means over the single networks, and
so are the numbers in the figure's titles and in README.md; the figure shows the estimates of all
single networks. "mean of n MLPs" averages the networks' estimates row by row instead. Settings were
chosen on validation blocks and then kept; all models learn from all blocks that are not tested.
Each validation block is a test block of another fold: of 20 blocks ten are, so the settings were
chosen on half of the test rows, and the errors may be somewhat too small.
"""


def write_report(folder: Path, report: ForceReport, *, command: str) -> None:
    """Write ``force-real.md``, ``.json`` and ``.png``: numbers and a figure, no rows.

    Raises:
        DatasetError: The disk refused; no file is left half written.
    """
    draw_force(folder / "force-real.png", report.panels)
    write_json(folder / "force-real.json", report.results, {"command": command, **report.facts})
    with written_whole(folder / "force-real.md") as part:
        part.write_text(
            "# Force on two real BioTacs\n\n"
            f"Made by `{command}`.\n\n"
            f"Data: {report.facts['source']}. Licence of its rows: {report.facts['licence']}. This"
            f" page holds numbers only.\n\n{_PREFACE}\n"
            + force_table(report.results)
            + "\nIn brackets: 95 % interval, whole blocks resampled. `/ std`: over the standard"
            " deviation of the true magnitude; `/ norm`: over the row's true magnitude.\n\n"
            "![truth against estimate](force-real.png)\n",
            encoding="utf-8",
        )


Floats = npt.NDArray[np.float32] | npt.NDArray[np.float64]

_BINS = 64
"""Bins along each axis: densities are drawn, for the rows of a data set may not be ours to show."""


@dataclass(frozen=True, slots=True)
class ForcePanel:
    """Truth and estimate of one test, shape ``(N, 3)`` [N], and its headline."""

    title: str
    truth: Floats
    estimate: Floats


def draw_force(path: Path, panels: Sequence[ForcePanel]) -> None:
    """Truth against estimate, one row of axes for each panel: x, y, z and the magnitude."""
    figure = new_figure(11, 3.1 * len(panels))
    parts = figure.subfigures(len(panels), 1, squeeze=False)[:, 0]
    for part, panel in zip(parts, panels, strict=True):
        part.suptitle(panel.title, x=0.01, ha="left", fontsize=11)
        row = part.subplots(1, 4)
        truth, estimate = _with_norm(panel.truth), _with_norm(panel.estimate)
        shared = require("matplotlib.colors", extra="training").LogNorm()  # set by the first
        for i, (axis, name) in enumerate(zip(row, ("Fx", "Fy", "Fz", "|F|"), strict=True)):
            values = np.concatenate([truth[:, i], estimate[:, i]])
            low, high = float(values.min()), float(values.max())
            margin = 0.04 * (high - low)
            limits = (low - margin, high + margin)
            *_, drawn = axis.hist2d(
                truth[:, i],
                estimate[:, i],
                bins=_BINS,
                range=(limits, limits),
                norm=shared,
                cmap="viridis_r",
                cmin=1,
            )
            axis.plot(limits, limits, "-", lw=0.8, color="#444444", label="equal")
            axis.set(xlim=limits, ylim=limits, aspect="equal")
            axis.set_xlabel(f"true {name} [N]")
            axis.set_ylabel(f"estimated {name} [N]")
            axis.locator_params(nbins=5, integer=True)
            axis.spines[["top", "right"]].set_visible(False)
        row[0].legend(frameon=False, fontsize=8, loc="upper left")
        part.colorbar(drawn, ax=row, label="frames", shrink=0.85)
    save(figure, path)


def _with_norm(force: Floats) -> npt.NDArray[np.float64]:
    norm = np.linalg.norm(force, axis=1, keepdims=True)
    return np.hstack([force, norm]).astype(np.float64)
