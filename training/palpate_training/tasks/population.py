"""One network for a population of specimens, measured on specimens and presses it has not met.

Specimens are dealt to those that are learned from, those that the training stops on, and those that
are unseen; points of the skin likewise, with all presses there. Reported are four cells: seen and
unseen specimens by seen and unseen presses; beside a constant and a ridge regression on the same
inputs; and the unseen cell again with all electrodes off by the same, as a fluid that has warmed
since the tare. Of many fingertips some are unseen, too: the last cell is theirs, with all their
specimens and presses.

    palpate train population features.h5 runs/population
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from palpate.errors import BundleError, ConfigError, DatasetError
from palpate.files.atomic import written_whole
from palpate_training.datasets.features import (
    OF_CONTACT,
    FeatureDataset,
    open_dataset,
)
from palpate_training.learning import baselines
from palpate_training.learning.networks import training_device
from palpate_training.learning.population_fit import (
    TOUCHED_N,
    PopulationRows,
    StopRows,
    fit_population,
    noise_of,
)
from palpate_training.learning.population_net import (
    WEIGHTS,
    CountsGraph,
    PopulationConfig,
    PopulationNet,
    inputs_of,
    load_population_net,
    save_population_net,
)
from palpate_training.learning.told_finger import REPORT
from palpate_training.tasks.population_errors import Estimate, cell, draw_shots, shots_table

FloatArray = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

ONNX = "population.onnx"

UNSEEN_SPECIMENS = 0.15
STOPPED_SPECIMENS = 0.05
UNSEEN_POINTS = 0.1
STOPPED_POINTS = 0.05

FINGERTIPS_LEAST = 8
"""With fewer fingertips only specimens are dealt: too few skins would be left to learn from."""

SAME_POINT_M = 3e-3
"""Presses that follow one another and touch within this are taken for presses of one point: of the
twin's 36 pairs of presses that are, 34 do."""

STOP_SHOTS = 3
"""Presses that are known of a specimen at most, where the training stops."""


@dataclass(frozen=True, slots=True)
class PopulationSplit:
    """Which rows are on which side.

    Attributes:
        train: Rows to learn from.
        validation: Sets of rows to stop on: specimens that are learned from, and others.
        cells: Rows of each cell that is reported, by name.
        specimens: Names of the unseen specimens, of unseen fingertips and of others.
        points: Number of points that were dealt.
        fingertips: Number of fingertips, which were dealt if they are ``FINGERTIPS_LEAST``.
    """

    train: Mask
    validation: tuple[Mask, ...]
    cells: dict[str, Mask]
    specimens: tuple[str, ...]
    points: int
    fingertips: int


def split_population(data: FeatureDataset, *, seed: int) -> PopulationSplit:
    """Deal specimens, points, and fingertips where there are many.

    Raises:
        DatasetError: There are fewer than three specimens or points, or a side has no rows.
    """
    rng = np.random.default_rng(seed)
    specimen = _dealt(rng, data.sensor, UNSEEN_SPECIMENS, STOPPED_SPECIMENS, "specimens")
    point = points_of(data)
    press = _dealt(rng, point, UNSEEN_POINTS, STOPPED_POINTS, "points")
    never = (specimen == _UNSEEN) & (press == _UNSEEN)
    other = (specimen == _STOPPED) & (press == _STOPPED)
    known = np.ones(len(data), bool)
    fingertip = fingertips_of(data)
    fingertips = len(np.unique(fingertip))
    if fingertips >= FINGERTIPS_LEAST:  # presses of one that is never met are never met either
        tip = _dealt(rng, fingertip, UNSEEN_SPECIMENS, STOPPED_SPECIMENS, "fingertips")
        never, other, known = tip == _UNSEEN, tip == _STOPPED, tip == _LEARNED
    learned, unseen = (known & (specimen == side) for side in (_LEARNED, _UNSEEN))
    train = learned & (press == _LEARNED)
    validation = (learned & (press == _STOPPED), other)
    cells = {
        "seen_specimen_seen_press": train,
        "seen_specimen_unseen_press": learned & (press == _UNSEEN),
        "unseen_specimen_seen_press": unseen & (press == _LEARNED),
        "unseen_specimen_unseen_press": never,
    }
    touched = np.linalg.norm(data.force, axis=1) >= TOUCHED_N
    sides = {"train": train, "validation": validation[0], **cells}
    for name, rows in sides.items():
        if not (rows & touched).any():
            raise DatasetError(
                f"{data.name}: {name} has no row of at least {TOUCHED_N:g} N",
                remedy="use a data set with more presses of more specimens, or another seed",
            )
    return PopulationSplit(
        train,
        tuple(rows for rows in validation if (rows & touched).any()),
        cells,
        tuple(data.sensor_names[i] for i in np.unique(data.sensor[unseen | never])),
        len(np.unique(point)),
        fingertips,
    )


_LEARNED, _STOPPED, _UNSEEN = range(3)


def _dealt(
    rng: np.random.Generator,
    label: npt.NDArray[np.integer],
    unseen_share: float,
    stopped_share: float,
    what: str,
) -> npt.NDArray[np.int64]:
    """Side of every row, so that rows of one label are on one side."""
    names, number = np.unique(label, return_inverse=True)
    if len(names) < 3:
        raise DatasetError(
            f"{len(names)} {what} cannot be dealt to training, validation and test",
            remedy="use a data set of a population: `palpate fem units draw`",
        )
    side = np.full(len(names), _LEARNED)
    dealt = rng.permutation(len(names))
    unseen = max(1, round(unseen_share * len(names)))
    stopped = max(1, round(stopped_share * len(names)))
    side[dealt[:unseen]] = _UNSEEN
    side[dealt[unseen : unseen + stopped]] = _STOPPED
    return side[number]


def fingertips_of(data: FeatureDataset) -> npt.NDArray[np.int64]:
    """Fingertip of each row, shape ``(N,)``: specimens that executed one trajectory have one skin.

    A simulated trajectory is of one skin, and a features file has one group for it. Where no two
    specimens share a trajectory each counts as a fingertip.
    """
    groups, group = np.unique(data.group, return_inverse=True)
    sensors = len(data.sensor_names)
    pairs = np.unique(np.stack([data.sensor, sensors + group]), axis=1)
    size = sensors + len(groups)
    shares = coo_matrix((np.ones(pairs.shape[1]), (pairs[0], pairs[1])), shape=(size, size))
    found: npt.NDArray[np.int64] = connected_components(shares, directed=False)[1][data.sensor]
    return found


def points_of(data: FeatureDataset) -> npt.NDArray[np.int64]:
    """Point of the skin that each row belongs to, shape ``(N,)``.

    A features file does not name points, but has the presses of one point after one another. So
    groups that follow one another and touch nearly the same place count as one point: now and then
    two that are not, which does no harm. Where no contact is known every group is a point.
    """
    groups, number = np.unique(data.group, return_inverse=True)
    where = np.full((len(groups), 3), np.nan)
    if data.contact_location is not None:
        known = np.flatnonzero(np.isfinite(data.contact_location).all(axis=1))
        first_known, rows = np.unique(number[known], return_index=True)
        where[first_known] = data.contact_location[known[rows]]
    apart = np.linalg.norm(np.diff(where, axis=0), axis=1)
    other = ~(apart <= SAME_POINT_M)  # not known is another one
    point: npt.NDArray[np.int64] = np.concatenate([[0], np.cumsum(other)])[number]
    return point


def train_population(
    path: Path,
    out: Path,
    *,
    config: PopulationConfig,
    device: str = "auto",
    seed: int | None = None,
    measure: bool = False,
    on_epoch: Callable[[], None] | None = None,
) -> tuple[PopulationNet, dict[str, Any]]:
    """Train, measure, and write weights and report into a folder.

    Args:
        path: Features file of a population.
        out: Folder; a network that is there is not replaced.
        config: Settings.
        device: Where it is trained: cpu, cuda, or auto = on a GPU if there is one.
        seed: Of split, weights, order of the rows and noise; None = 0, or that of the network that
            is measured.
        measure: Whether the network that the folder holds is measured again, not trained.
        on_epoch: Called after each epoch, for a progress bar.

    Returns:
        The network, and what the report holds.

    Raises:
        ConfigError: There is no GPU, but one is wanted; or a network is measured with another seed
            than its own.
        DatasetError: The data breaks its schema, is no population, or not what the network that is
            measured was trained on; the folder holds a network; or the disk refused.
    """
    where = training_device(device)
    if not measure and (out / WEIGHTS).exists():  # refuse before hours of training, not after
        raise DatasetError(
            f"{out} holds a network that is trained",
            remedy="name another folder, or measure that network again with --measure",
        )
    data = open_dataset(path)
    quantities, rows = rows_of(data)
    targets = rows.targets
    trained: dict[str, Any] = {}
    if measure:
        net = load_population_net(out / WEIGHTS)
        seed, trained = _trained_before(out / REPORT, data, seed)
    seed = seed or 0
    split = split_population(data, seed=seed)
    if not measure:
        begun = time.monotonic()
        with torch.device(where):
            if where == "cuda":
                torch.set_float32_matmul_precision("high")
            net = fit_population(
                rows.where(split.train),
                [stop_rows(rows, chosen, seed=seed) for chosen in split.validation],
                quantities,
                config=config,
                seed=seed,
                on_epoch=on_epoch,
            )
        trained = {"device": where, "trained_s": round(time.monotonic() - begun, 1)}
        save_population_net(out / WEIGHTS, net)
    rivals = _rivals(net, rows.inputs, targets, split)
    cells = {name: cell(rows, chosen, net, rivals) for name, chosen in split.cells.items()}
    for name, of_cell in cells.items():
        if name != "seen_specimen_seen_press":
            never = name == "unseen_specimen_unseen_press"
            of_cell["shots"] = shots_table(
                rows, split.cells[name], net, fingertips_of(data) if never else None, seed=seed
            )
    facts: dict[str, Any] = {
        "data": data.provenance.source,
        "data_sha256": data.content_sha256(),
        "rows": {"all": len(data), "train": int(split.train.sum())},
        "presses": len(np.unique(data.group)),
        "points": split.points,
        "fingertips": split.fingertips,
        "specimens": len(data.sensor_names),
        "unseen_specimens": split.specimens,
        "quantities": quantities,
        "config": asdict(net.config),
        "seed": seed,
        **trained,
        "cells": cells,
    }
    if shots := cells["unseen_specimen_unseen_press"]["shots"]:
        facts["told"] = shots.pop("told") | {"specimens": shots["specimens"]}
    facts["onnx"] = _export(out / ONNX, net, data, split.cells["unseen_specimen_unseen_press"])
    with written_whole(out / REPORT) as part:
        part.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    return net, facts


def _trained_before(
    report: Path, data: FeatureDataset, seed: int | None
) -> tuple[int, dict[str, Any]]:
    """Seed of the network that is measured again, and where it was trained, by its report.

    With other rows or another seed some that it has learned from would count as unseen. What the
    report does not tell the caller must: a training that was ended before its report has none.

    Raises:
        ConfigError: It was trained with another seed.
        DatasetError: It was trained on other data, or neither report nor caller tells the seed.
    """
    try:
        known = json.loads(report.read_text(encoding="utf-8"))
        own, digest = int(known["seed"]), known["data_sha256"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        if seed is not None:
            return seed, {}
        raise DatasetError(
            f"{report} does not say what the network was trained with: {error!r}",
            remedy="give --seed as it was trained, and the same data set",
        ) from error
    if digest != data.content_sha256():
        raise DatasetError(
            f"{data.name} is not the data set of {report}: presses that the network has learned "
            "from would count as unseen",
            remedy=f"give the one it was trained on, with content_sha256 {digest}",
        )
    if seed not in (None, own):
        raise ConfigError(
            f"--seed {seed} is not that of {report}, {own}", remedy="leave --seed out"
        )
    return own, {key: known[key] for key in ("device", "trained_s") if key in known}


def stop_rows(rows: PopulationRows, chosen: Mask, *, seed: int) -> list[StopRows]:
    """Rows of each specimen to stop on: with nothing known, and with some of its presses."""
    drawn = draw_shots(rows, chosen, most=STOP_SHOTS, draws=1, seed=seed)
    if not drawn:  # too few presses to know some: only nothing is known
        return [
            StopRows(rows.inputs[own], rows.targets[own], [rows.calibration(own[:0])])
            for own in (np.flatnonzero(chosen),)
        ]
    return [
        StopRows(
            rows.inputs[draw.tested],
            rows.targets[draw.tested],
            [rows.calibration(draw.known(shots)) for shots in (0, 1, STOP_SHOTS)],
        )
        for draw in drawn
    ]


def rows_of(data: FeatureDataset) -> tuple[tuple[str, ...], PopulationRows]:
    """Names of what a data set knows, force first, and its rows with these values."""
    known = data.arrays()
    names = ("force", *(name for name in OF_CONTACT if name in known))
    targets = np.hstack([np.asarray(known[name], np.float32) for name in names])
    if data.in_contact is not None:
        targets[~data.in_contact, 3:] = np.nan
    rows = PopulationRows(
        inputs_of(data.electrodes, data.baseline), noise_of(data.electrodes), targets,
        data.sensor, data.group, points_of(data),
    )  # fmt: skip
    return names, rows


def _rivals(
    net: PopulationNet, inputs: FloatArray, targets: FloatArray, split: PopulationSplit
) -> dict[str, Estimate]:
    """Constant and ridge regression on what the network reads; one for each quantity."""

    def read(rows: FloatArray) -> FloatArray:
        with torch.inference_mode():
            return np.asarray(net.read(torch.from_numpy(rows)).numpy())

    chosen = np.logical_or.reduce(split.validation)
    fitted: dict[str, list[baselines.AffineModel]] = {"constant": [], "ridge": []}
    for part in np.split(targets, targets.shape[1] // 3, axis=1):
        known = np.isfinite(part).all(axis=1)
        rows, ends = split.train & known, chosen & known
        x, y = read(inputs[rows]), part[rows]
        fitted["constant"].append(baselines.constant(x, y))
        ends = ends if ends.any() else rows
        fitted["ridge"].append(baselines.ridge(x, y, read(inputs[ends]), part[ends]))

    def estimate(models: list[baselines.AffineModel]) -> Estimate:
        return lambda rows: np.hstack([model.predict(read(rows)) for model in models])

    return {name: estimate(models) for name, models in fitted.items()}


def _export(path: Path, net: PopulationNet, data: FeatureDataset, rows: Mask) -> dict[str, Any]:
    """Write the network as ONNX, if that can be done here; what came of it."""
    try:
        # A machine that trains need not have what a bundle takes.
        from palpate_training.learning.export import check_parity, frame_s, onnx_bytes
    except ImportError as error:
        return {"left out": str(error)}
    some = np.flatnonzero(rows)
    some = some[np.unique(np.linspace(0, len(some) - 1, 256).astype(int))]
    # Codes of presses lie between -1 and 1, mostly.
    code = np.random.default_rng(0).uniform(-1.0, 1.0, (len(some), 2 * net.config.code))
    known = np.hstack([data.electrodes[some], data.baseline[some], code]).astype(np.float32)
    graph = CountsGraph(net).eval()

    def largest(_: int, right: FloatArray) -> FloatArray:
        """Of each quantity, for each of its values."""
        parts = np.abs(right).reshape(len(right), -1, 3)
        return np.asarray(np.repeat(parts.max(axis=(0, 2)), 3))

    try:
        model = onnx_bytes(graph, "known", torch.zeros(4, known.shape[1]), ["estimates"])
        parity = check_parity(graph, model, "known", ["estimates"], known, largest)
    except (ImportError, BundleError) as error:  # what was trained and measured is there
        return {"left out": str(error)}
    with written_whole(path) as part:
        part.write_bytes(model)
    return {"parity_max": parity, "milliseconds": 1e3 * frame_s(model, "known", known[:1])}
