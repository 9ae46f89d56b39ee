r"""Measure the method for fingers that were never met on simulated ones: transfer-simulated.json.

    palpate fem units draw 8 --seed 77 --out drawn8.json
    palpate data generate runs/others --random 560 --fingertips 8 --units drawn8.json \
        --edge-mm 1.2 --seed 77
    palpate data features runs/others/fingertip-0?/mixed.h5 others.h5
    ... the same with seed 78, units of their own and runs/new ...
    palpate data features runs/new/fingertip-0[123]/mixed.h5 new.h5
    python docs/make_transfer_simulated.py others.h5 new.h5
    python docs/make_transfer.py

The constants of the method were chosen on two real fingers. Simulated ones have other skins, fills,
core's places and electrodes. Each is pressed ``PRESSES`` times, at random points by random
indenters; a recording is made of these presses, with the drift of real sensors. Each finger is
tested after each other one alone was learned from. What is done where a finger is more sensitive
than others, and with the line beside, was found on fingers of an earlier draw, whose skins and
cores went together; with these nothing was chosen. Without a press those of the first file are
tested once more, pressed by the harder half of their presses alone: then larger signals do not mean
a more sensitive finger.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from scipy.signal import lfilter
from threadpoolctl import threadpool_limits

from palpate.messages import COUNTS_MAX
from palpate_training.datasets.features import FeatureDataset, open_dataset
from palpate_training.evaluation.transfer import FIGURES, Finger, fingers_of, run_transfer
from palpate_training.learning.twin_line import read_line
from palpate_training.systems.samples import counts_at, impedance_ohm

OUT = Path(__file__).resolve().parent / "results" / "transfer-simulated.json"
CONSOLE = Console(width=120)

Floats = npt.NDArray[np.float64]

RATE_HZ = 100.0
PRESSES = 60
PRESS_S, UNTOUCHED_S = 2.0, 0.3

COMMON, COMMON_S = 0.02, 60.0
"""Drift of the logarithm of all impedances: standard deviation, and time constant [s]."""

EACH, EACH_S = 0.005, 20.0
"""The same of each electrode on its own."""

NOISE_COUNTS = 2.0

SHOTS = (0, 1, 5, 10)
DRAWS = 4

RIVALS = ("ridge", "constant")
TOLD = (*FIGURES, "coverage_90", "shots", "unlike", "impedance_ratio", "signal_ratio", *RIVALS)

NEW, HARDER = "new", "pressed harder"
"""Kinds of pairs: one of the two is from the second file; the tested one is pressed harder."""

PROCESSES = 2


def drift(random: np.random.Generator, rows: int, deviation: float, seconds: float) -> Floats:
    """An Ornstein-Uhlenbeck process, shape (rows,)."""
    kept = np.exp(-1.0 / (RATE_HZ * seconds))
    steps = random.normal(0.0, deviation * np.sqrt(1.0 - kept * kept), rows)
    steps[0] = random.normal(0.0, deviation)
    return np.asarray(lfilter([1.0], [1.0, -kept], steps))


def pressed(
    data: FeatureDataset, rows: npt.NDArray[np.intp], reach: float
) -> tuple[Floats, Floats]:
    """A press and its release, from the rows of its way in, and some time untouched.

    Args:
        data: The presses.
        rows: Of one press.
        reach: Share of the way that is gone.

    Returns:
        Logarithms of the impedances over those at rest, (N, 19), and forces [N], (N, 3).
    """
    log = np.log(impedance_ohm(data.electrodes[rows]) / impedance_ohm(data.baseline[rows]))
    known = np.hstack([log, data.force[rows].astype(np.float64)])
    known = known[np.argsort(np.linalg.norm(known[:, 19:], axis=1), kind="stable")]
    known = np.vstack([np.zeros(22), known])
    along = np.sin(np.linspace(0.0, np.pi, round(PRESS_S * RATE_HZ)))
    at = reach * (len(known) - 1) * along
    before = np.minimum(at.astype(int), len(known) - 2)
    share = (at - before)[:, None]
    way = (1.0 - share) * known[before] + share * known[before + 1]
    whole = np.vstack([way, np.zeros((round(UNTOUCHED_S * RATE_HZ), 22))])
    return whole[:, :19], whole[:, 19:]


def recording_of(
    data: FeatureDataset, sensor: int, random: np.random.Generator, *, harder: bool
) -> Finger:
    """A recording of a simulated finger as a lab would make it.

    Args:
        data: Presses of all fingers.
        sensor: Which finger.
        random: Which of its presses, how deep, and drift.
        harder: Whether only the half of its presses is used that has the largest forces.
    """
    own = np.flatnonzero(data.sensor == sensor)
    rest = data.baseline[own].mean(axis=0, dtype=np.float64)
    presses = np.unique(data.group[own])
    if harder:
        force = np.linalg.norm(data.force[own], axis=1)
        most = np.array([force[data.group[own] == press].max() for press in presses])
        presses = presses[most > np.median(most)]
    presses = random.permutation(presses)[:PRESSES]
    parts = [
        pressed(data, own[data.group[own] == press], random.uniform(0.3, 1.0)) for press in presses
    ]
    log, force = (np.vstack(one) for one in zip(*parts, strict=True))
    rows = len(force)
    log += drift(random, rows, COMMON, COMMON_S)[:, None]
    log += np.stack([drift(random, rows, EACH, EACH_S) for _ in range(19)], axis=1)
    counts = counts_at(np.exp(log) * impedance_ohm(rest))
    counts = np.rint(counts + random.normal(0.0, NOISE_COUNTS, counts.shape))
    (finger,) = fingers_of(
        FeatureDataset(
            electrodes=np.clip(counts, 0, COUNTS_MAX).astype(np.uint16),
            baseline=np.tile(rest.astype(np.float32), (rows, 1)),
            force=force.astype(np.float32),
            group=np.zeros(rows, np.int32),
            block=np.zeros(rows, np.int32),
            sensor=np.zeros(rows, np.int32),
            sensor_names=(data.sensor_names[sensor],),
            provenance=data.provenance,
        )
    )
    return finger


def fingers_in(path: Path, seed: int, *, harder: bool = False) -> list[Finger]:
    """A recording of each finger of a file."""
    data, random = open_dataset(path), np.random.default_rng(seed)
    sensors = range(len(data.sensor_names))
    return [recording_of(data, sensor, random, harder=harder) for sensor in sensors]


def measure(pair: tuple[Finger, Finger, str]) -> list[dict[str, Any]]:
    """A finger that is learned from, one that is tested, and what is told of the two."""
    known, tested, kind = pair
    results = []
    with threadpool_limits(1):
        for shots in SHOTS[:1] if kind == HARDER else SHOTS:
            found = run_transfer([known], tested, shots=shots, draws=DRAWS, line=read_line())
            told = {"train": known.name, "test": tested.name, "kind": kind}
            results.append(told | {key: found[key] for key in TOLD})
    return results


def main(path: Path, path_of_new: Path) -> None:
    """Measure all pairs, and write the result."""
    first, harder = fingers_in(path, 0), fingers_in(path, 2, harder=True)
    new = [replace(one, name=f"new-{one.name}") for one in fingers_in(path_of_new, 1)]
    pairs = [(*pair, "") for pair in permutations(first, 2)]
    pairs += [
        (*pair, NEW)
        for pair in permutations([*first, *new], 2)
        if any(one is other for one in pair for other in new)
    ]
    pairs += [
        (known, harder[k], HARDER)
        for known in first
        for k, tested in enumerate(first)
        if tested is not known
    ]
    results: list[dict[str, Any]] = []
    with multiprocessing.get_context("spawn").Pool(PROCESSES) as pool:
        for found in pool.imap(measure, pairs):
            results += found
            for one in found:
                figures = (one[FIGURES[0]], *(one[rival][FIGURES[0]] for rival in RIVALS))
                CONSOLE.print(len(results), one["train"], one["test"], one["kind"], one["shots"],
                              *(round(figure, 3) for figure in figures))  # fmt: skip
    report = {
        "schema": "palpate.transfer-simulated 2",
        "content_sha256": open_dataset(path).content_sha256(),
        "content_sha256_of_new": open_dataset(path_of_new).content_sha256(),
        "fingers": len(first),
        "new_fingers": len(new),
        "presses": PRESSES,
        "draws": DRAWS,
        "results": results,
    }
    OUT.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
