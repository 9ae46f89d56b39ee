r"""Measure the method for fingers that were never met on simulated ones: transfer-simulated.json.

    palpate fem units draw 8 --seed 77 --out drawn8.json
    palpate data generate runs/others --random 560 --fingertips 8 --units drawn8.json \
        --edge-mm 1.2 --seed 77
    palpate data features runs/others/fingertip-0?/mixed.h5 others.h5
    python docs/make_transfer_simulated.py others.h5
    python docs/make_transfer.py

The constants of the method were chosen on two real fingers. Simulated ones have other skins, fills,
core's places and electrodes. Each is pressed ``PRESSES`` times, at random points by random
indenters; a recording is made of these presses, with the drift of real sensors. Each finger is
tested after each other one alone was learned from. What is done where a finger is more sensitive
than others was found on the first `LOOKED_AT` of them.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from scipy.signal import lfilter

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

LOOKED_AT = 4

TOLD = (*FIGURES, "coverage_90", "shots", "unlike", "impedance_ratio", "ridge", "constant")


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


def recording_of(data: FeatureDataset, sensor: int, random: np.random.Generator) -> Finger:
    """A recording of a simulated finger as a lab would make it."""
    own = np.flatnonzero(data.sensor == sensor)
    rest = data.baseline[own].mean(axis=0, dtype=np.float64)
    presses = random.permutation(np.unique(data.group[own]))[:PRESSES]
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


def main(path: Path) -> None:
    """Measure all pairs, and write the result."""
    data, line = open_dataset(path), read_line()
    random = np.random.default_rng(0)
    fingers = [recording_of(data, sensor, random) for sensor in range(len(data.sensor_names))]
    results: list[dict[str, Any]] = []
    for known in fingers:
        for tested in fingers:
            if tested is known:
                continue
            looked_at = max(fingers.index(known), fingers.index(tested)) < LOOKED_AT
            for shots in SHOTS:
                found = run_transfer([known], tested, shots=shots, draws=DRAWS, line=line)
                told = {"train": known.name, "test": tested.name, "looked_at": looked_at}
                results.append(told | {key: found[key] for key in TOLD})
                CONSOLE.print(*told.values(), shots, *(round(one[FIGURES[0]], 3) for one in
                              (found, found["ridge"], found["constant"])))  # fmt: skip
    report = {
        "schema": "palpate.transfer-simulated 1",
        "content_sha256": data.content_sha256(),
        "fingers": len(fingers),
        "presses": PRESSES,
        "draws": DRAWS,
        "results": results,
    }
    OUT.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
