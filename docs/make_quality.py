"""Write docs/results/quality.md and quality.json: how often flags are raised, and on what.

``python docs/make_quality.py ../shared/data``      with the recordings of two real BioTacs
``python docs/make_quality.py``                     without: the virtual fingers only

A flag is of use if a model that is wrong on a real finger says so, and no nuisance if it is silent
on presses of the finger that it was trained for. Both shares are counted here, for each bundle that
ships. Minutes on two cores.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.files.bundle import read_bundle
from palpate.files.tape import read_tape
from palpate.messages import FloatArray, QualityFlag
from palpate_deploy.demo.bundles import RATE_HZ, write_virtual_record
from palpate_gateway.virtual import tapes
from palpate_services.inference.model import Runtime, load
from palpate_services.inference.repository import resolve
from palpate_training.datasets.ingest import ingest_record

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "results" / "quality.md"
RESULTS = PAGE.with_suffix(".json")

SEED = 2  # the shipped bundle was trained on seed 1
FRAMES = 20_000
NOISE_COUNTS = 2.0
EVERY = 10
"""Every so many rows of a real recording are looked at: successive ones are alike."""

WRONG_N, WRONG_SHARE = 0.5, 0.5
"""An estimate is wrong if its force is off by more than both [N] and share of the truth."""

DRIFTS_COUNTS = (10.0, 20.0, 40.0)
DRIFTED_ROWS = 200
TIMED_RUNS = 2000


def runtime_of(name: str) -> Runtime:
    """A shipped bundle, as a service has it."""
    bundle = read_bundle(resolve(name))
    return load(bundle, bundle.manifest.task)


def looked_at(runtime: Runtime, rows: FloatArray) -> tuple[Any, Any, Any]:
    """Of each row: whether its input and its output are flagged, and the estimated force [N]."""
    unlike, beyond, force = [], [], []
    for row in rows:
        outputs = runtime.run(row)
        assert outputs is not None
        size = float(np.linalg.norm(outputs["force"])) if "force" in outputs else 0.0
        touching = size >= runtime.contact_threshold_n
        without = () if touching else ("contact_location", "contact_location_sd")
        flags = runtime.range.flags(row, outputs, without=without)
        unlike.append(QualityFlag.OUT_OF_RANGE in flags)
        beyond.append(QualityFlag.EXTRAPOLATING in flags)
        force.append(size)
    return np.array(unlike), np.array(beyond), np.array(force)


def silent_where_trained(name: str, rows: FloatArray, what: str) -> dict[str, Any]:
    """Shares of flagged rows of the finger that a bundle was trained for."""
    unlike, beyond, _ = looked_at(runtime_of(name), rows)
    return {
        "bundle": name,
        "rows": len(rows),
        "what": what,
        "out_of_range_share": float(unlike.mean()),
        "extrapolating_share": float(beyond.mean()),
        "any_share": float((unlike | beyond).mean()),
    }


def virtual_rows() -> FloatArray:
    """Presses of the virtual finger by formulas that no bundle was trained on."""
    with tempfile.TemporaryDirectory() as scratch:
        record = Path(scratch) / "virtual.mcap"
        write_virtual_record(record, frames=FRAMES, seed=SEED, rate_hz=RATE_HZ)
        data = ingest_record(record, command="docs/make_quality.py", licence="Apache-2.0")
    return data.tared_counts[::5]


def tape_rows() -> FloatArray:
    """All steps of the shipped tape on its three specimens, with noise; never trained on."""
    (path,) = Path(tapes.__path__[0]).glob("*.npz")
    tape = read_tape(path)
    rows = np.concatenate(
        [
            counts - specimen.rest_counts
            for one in tape.trajectories
            for specimen, counts in zip(tape.specimens, one.counts, strict=True)
        ]
    )
    noise = np.random.default_rng(0).normal(0.0, NOISE_COUNTS, rows.shape)
    return (rows + noise).astype(np.float32)


def loud_where_wrong(name: str, archive: Any, finger: int) -> dict[str, Any]:
    """Shares of flagged rows of a real finger, that no bundle was trained for."""
    baseline = archive[f"finger{finger}_baseline_mean"].astype(np.float32)
    rows = archive[f"finger{finger}_electrodes_raw"][::EVERY].astype(np.float32) - baseline
    truth = np.linalg.norm(archive[f"finger{finger}_force_N"][::EVERY], axis=1)
    idle = archive[f"finger{finger}_baseline_stream_raw"][::EVERY].astype(np.float32) - baseline
    runtime = runtime_of(name)
    unlike, beyond, force = looked_at(runtime, rows)
    flagged = unlike | beyond
    found: dict[str, Any] = {"bundle": name, "finger": finger, "rows": len(rows)}
    if runtime.manifest.task == "features":
        wrong = np.abs(force - truth) > np.maximum(WRONG_N, WRONG_SHARE * truth)
        found |= {
            "truth_median_n": float(np.median(truth)),
            "estimate_median_n": float(np.median(force)),
            "wrong_share": float(wrong.mean()),
            "flagged_of_wrong_share": float(flagged[wrong].mean()),
            "flagged_of_right_share": float(flagged[~wrong].mean()) if (~wrong).any() else None,
        }
    idle_unlike, idle_beyond, _ = looked_at(runtime, idle)
    return found | {
        "flagged_share": float(flagged.mean()),
        "flagged_untouched_share": float((idle_unlike | idle_beyond).mean()),
    }


def force_of_drift(name: str, drift_counts: float) -> dict[str, Any]:
    """Force that a bundle estimates of an untouched finger whose electrodes have all drifted."""
    runtime = runtime_of(name)
    noise = np.random.default_rng(0).normal(0.0, NOISE_COUNTS, (DRIFTED_ROWS, 19))
    medians = []
    for drifted in (noise + drift_counts, noise - drift_counts):
        _, _, force = looked_at(runtime, drifted.astype(np.float32))
        medians.append(float(np.median(force)))
    return {
        "bundle": name,
        "drift_counts": drift_counts,
        "rising_force_n": medians[0],
        "falling_force_n": medians[1],
    }


def check_us(name: str) -> float:
    """Median time of one comparison with the training range [us], in a hot loop."""
    bundle = read_bundle(resolve(name))
    runtime = load(bundle, bundle.manifest.task)
    row = bundle.golden[bundle.manifest.inputs[0].name][0]
    outputs = runtime.run(row)
    assert outputs is not None
    times = []
    for _ in range(TIMED_RUNS):
        began_ns = time.perf_counter_ns()
        runtime.range.flags(row, outputs, without=())
        times.append(time.perf_counter_ns() - began_ns)
    return float(np.median(times)) * 1e-3


def percent(value: float | None) -> str:
    """A share for people; nothing where there is none."""
    return "" if value is None else f"{100 * value:.1f} %"


def table(rows: Sequence[dict[str, Any]], columns: dict[str, str]) -> list[str]:
    """Lines of a table with these keys and headings."""
    lines = ["| " + " | ".join(columns.values()) + " |", "|" + "---|" * len(columns)]
    for row in rows:
        cells = []
        for key in columns:
            value = row.get(key, "")
            is_share = key.endswith("_share")
            cells.append(
                percent(value) if is_share and value != "" else
                f"{value:.2f}" if isinstance(value, float) else f"{value}"
            )  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def main(data: Path | None) -> None:
    """Measure and write both files."""
    tape = tape_rows()
    results: dict[str, Any] = {
        "command": "python docs/make_quality.py" + (" ../shared/data" if data else ""),
        "trained_finger": [
            silent_where_trained("features-virtual", virtual_rows(), "formulas, another seed"),
            silent_where_trained("features-twin", tape, "tape, three specimens"),
            silent_where_trained("field-twin", tape, "tape, three specimens"),
        ],
        "real_fingers": [],
        "drift": [
            force_of_drift(name, drift)
            for name in ("features-virtual", "features-twin")
            for drift in DRIFTS_COUNTS
        ],
        "check_median_us": {
            name: check_us(name)
            for name in ("features-virtual", "features-twin", "field-twin", "synthesis-twin")
        },
    }
    if data is not None:
        with np.load(data / "lasa_force_calibration" / "force_calibration.npz") as archive:
            results["real_fingers"] = [
                loud_where_wrong(name, archive, finger)
                for name in ("features-virtual", "features-twin", "field-twin")
                for finger in (1, 2)
            ]
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    lines = [
        "# Flags of estimates: how often, and on what",
        "",
        f"Written by `{results['command']}`; numbers in [quality.json](quality.json). What",
        "the flags mean: [ADR 0021](../adr/0021-what-an-estimate-is-worth.md).",
        "",
        "## Presses of the finger that a bundle was trained for, never trained on",
        "",
        *table(
            results["trained_finger"],
            {
                "bundle": "bundle", "what": "presses", "rows": "rows",
                "out_of_range_share": "`OUT_OF_RANGE`",
                "extrapolating_share": "`EXTRAPOLATING`", "any_share": "any",
            },
        ),
        "",
        "On presses at other points than those of the training, and on specimens never met:",
        "[intervals.md](intervals.md).",
        "",
        "## Two real BioTacs, for which none of these bundles was trained",
        "",
        f"An estimate counts as *wrong* if its force is off by more than {WRONG_N:g} N and by more",
        f"than {WRONG_SHARE:.0%} of the measured force. The finger is pressed in all columns but",
        "the last.",
        "",
        *table(
            results["real_fingers"],
            {
                "bundle": "bundle", "finger": "finger", "rows": "rows",
                "truth_median_n": "measured [N]", "estimate_median_n": "estimated [N]",
                "wrong_share": "wrong", "flagged_of_wrong_share": "wrong: flagged",
                "flagged_of_right_share": "not wrong: flagged",
                "flagged_share": "all rows: flagged",
                "flagged_untouched_share": "untouched: flagged",
            },
        ),
        "",
        "## Why a tare is doubtful after a kelvin",
        "",
        "Force that is estimated of an untouched finger when all electrodes have drifted alike;",
        "a kelvin moves them by about 20 counts.",
        "",
        *table(
            results["drift"],
            {
                "bundle": "bundle", "drift_counts": "drift [counts]",
                "rising_force_n": "rising [N]", "falling_force_n": "falling [N]",
            },
        ),
        "",
        "## Cost",
        "",
        "One comparison, median in a hot loop [us]: "
        + ", ".join(f"`{k}` {v:.0f}" for k, v in results["check_median_us"].items())
        + ".",
    ]  # fmt: skip
    PAGE.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
