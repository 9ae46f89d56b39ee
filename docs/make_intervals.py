"""Write docs/results/intervals.md, .json and .png: how often the bounds of estimates hold.

``python docs/make_intervals.py runs ../shared/data``   all; with the recordings of two real BioTacs
``python docs/make_intervals.py runs``                  without: virtual fingers and the twin only
``python docs/make_intervals.py``                       the page alone, from the JSON files
``python docs/make_intervals.py --virtual OUT.h5``      what features-virtual is calibrated with

``runs`` holds experiments that no training has seen; the page says the commands. ``calibrate``,
``check`` and ``scattered-1`` and ``-2`` are what the shipped bundles were calibrated with, ``test``
and ``random-500`` are other presses on the same specimens, ``drawn`` those of ``test`` on specimens
that were never met. A press is what counts: its rows are nearly copies. Minutes on two cores.
docs/intervals_page.py shows what is measured here.
"""

from __future__ import annotations

import json
import runpy
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.files.bundle import Bundle, read_bundle
from palpate.messages import QualityFlag
from palpate_deploy.demo.bundles import RATE_HZ, write_virtual_record
from palpate_services.inference.model import RangeCheck, Runtime, load
from palpate_services.inference.repository import resolve
from palpate_training.datasets.basis import subset
from palpate_training.datasets.experiment import MixedDataset, read_mixed
from palpate_training.datasets.export import features
from palpate_training.datasets.features import OF_CONTACT, FeatureDataset, write_dataset
from palpate_training.datasets.ingest import ingest_lasa, ingest_record
from palpate_training.evaluation.transfer import PRESS_S
from palpate_training.learning.force_process import KnownRows
from palpate_training.learning.intervals import bounds, fit_formulas, terms_of
from palpate_training.learning.metrics import force_errors
from palpate_training.learning.ranges import with_pattern
from palpate_training.tasks.finger import (
    FOLDS,
    ROWS_MOST,
    estimate_of,
    finger_formulas,
    fit_finger,
)
from palpate_training.tasks.intervals import (
    OF_OTHERS,
    HeldOut,
    held_out_features,
    held_out_fields,
    read_held_out,
)

FALSE_MOST = 0.01
"""Goal: share of the rows of new presses that are flagged."""

Floats = NDArray[np.float64]
Rows = NDArray[np.integer]

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "training" / "palpate_training" / "samples" / "twin.h5"

PAGE = runpy.run_path(str(Path(__file__).with_name("intervals_page.py")))
"""Names of the program that shows what this one measures."""

DRAWS = 2000
FRAMES = 20_000
VIRTUAL_SEED = 3  # features-virtual is calibrated with this seed; it was trained on seed 1
EVERY = 10
HZ = 100
OWN_S = (30, 60, 120)
SCALES, SHRINKS = (30.0, 40.0, 60.0, 80.0, 120.0), (0.003, 0.001, 0.0003, 0.0001)
"""Compressions and shrinkages of the pattern that were compared."""


def main(runs: Path, data: Path | None) -> None:
    """Measure, and write all three files."""
    cells = [*twin_cells(runs), *specimen_cells(runs), *virtual_cells()]
    facts: dict[str, Any] = {"cells": cells, "flags": twin_flags(runs)}
    if data is not None:
        fingers = real_fingers(data)
        facts["cells"] += real_cells(fingers)
        facts["cells"] += [own_cell(finger, seconds) for seconds in OWN_S for finger in fingers]
        facts["real_flags"] = real_flags(fingers)
        facts["pattern"] = pattern_choice(runs, fingers)
    PAGE["OUT"].with_suffix(".json").write_text(json.dumps(facts, indent=1) + "\n")
    PAGE["draw"](facts["cells"])
    PAGE["write_page"]()


def shipped(name: str) -> tuple[Bundle, Runtime]:
    """A bundle that ships, and as a service has it."""
    bundle = read_bundle(resolve(name))
    return bundle, load(bundle, bundle.manifest.task)


def cell(
    what: str, bundle: str, name: str, errors: Floats, bound: Floats, rows: HeldOut
) -> dict[str, Any]:
    """How often one bound holds on some rows, each press counting the same."""
    known = ~np.isnan(errors)
    errors, bound, press, force_n = (
        errors[known],
        bound[known],
        rows.press[known],
        rows.force_n[known],
    )
    found: dict[str, Any] = {
        "what": what,
        "bundle": bundle,
        "bound": name,
        **share_of(errors, bound, press),
        "bins": [],
    }
    for low, high in PAGE["BINS_N"]:
        inside = (force_n >= low) & (force_n < high)
        if len(np.unique(press[inside])) >= 3:
            part = share_of(errors[inside], bound[inside], press[inside])
            found["bins"].append({"low_n": low, "high_n": min(high, 1e3), **part})
    return found


def share_of(errors: Floats, bound: Floats, press: Rows) -> dict[str, Any]:
    """Coverage with a confidence interval over presses, the bounds, and the presses.

    ``coverage`` is the mean over the presses of the share of a press's rows that are within the
    bound, ``whole`` the share of presses all of whose rows are.
    """
    _, number, rows = np.unique(press, return_inverse=True, return_counts=True)
    each = np.bincount(number, errors <= bound) / rows
    rng = np.random.default_rng(0)
    drawn = each[rng.integers(len(each), size=(DRAWS, len(each)))].mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return {
        "presses": len(each),
        "rows": len(errors),
        "coverage": float(each.mean()),
        "whole": float((each == 1.0).mean()),
        "ci95": [float(low), float(high)],
        "bound_median": float(np.median(bound)),
        "error_median": float(np.median(errors)),
    }


def cells_of(what: str, name: str, rows: HeldOut) -> list[dict[str, Any]]:
    """A cell for each bound of a shipped bundle."""
    bundle, _ = shipped(name)
    intervals, known = bundle.manifest.intervals, bundle.known_inputs
    assert intervals is not None
    assert known is not None
    terms = rows.terms(known)
    return [
        cell(what, name, one.name, rows.errors[one.name], bounds(one, terms), rows)
        for one in intervals.formulas
        if one.name in rows.errors
    ]


def twin_sets(runs: Path) -> dict[str, Path]:
    """Presses of the twin that neither training nor calibration has seen, by what they are."""
    return {
        "other presses, specimens of the training": runs / "test" / "mixed.h5",
        "presses at random, specimens of the training": runs / "random-500" / "small.h5",
        "the presses of the sample": SAMPLE,
        "other presses, specimens never met": runs / "drawn" / "mixed.h5",
    }


def twin_cells(runs: Path) -> list[dict[str, Any]]:
    """The twin: other presses, and specimens that were never met."""
    return [
        found
        for name in ("features-twin", "field-twin")
        for what, path in twin_sets(runs).items()
        for found in cells_of(what, name, read_held_out(shipped(name)[0], path).rows)
    ]


def specimen_cells(runs: Path) -> list[dict[str, Any]]:
    """Specimens that were never met, with bounds learned on as many others of them.

    Ten specimens are too few for nine tenths of specimens to be known: what counts once in learning
    is a press on a specimen. In testing it is a specimen.
    """
    mixed = read_mixed(runs / "drawn" / "mixed.h5")
    unit = mixed.experiment.trial_unit
    sides = [unit % 2 == k for k in range(2)]
    found = []
    for name in ("features-twin", "field-twin"):
        bundle, _ = shipped(name)
        known = bundle.known_inputs
        assert known is not None
        learned, tested = (
            by_specimen(bundle, subset(mixed, np.flatnonzero(side).tolist()), whole=whole)
            for side, whole in zip(sides, (False, True), strict=True)
        )
        for one in fit_formulas(learned.errors, learned.terms(known), learned.press):
            found.append(
                cell(
                    "specimens never met, bounds learned on ten others", name, one.name,
                    tested.errors[one.name], bounds(one, tested.terms(known)), tested,
                )
            )  # fmt: skip
    return found


def by_specimen(bundle: Bundle, mixed: MixedDataset, *, whole: bool) -> HeldOut:
    """Rows of a mixed data set; what counts once is a specimen, or a press on one."""
    rows = (
        held_out_fields(bundle, mixed)
        if bundle.manifest.task == "field"
        else held_out_features(bundle, features(mixed))
    )
    data = mixed.experiment  # in the order of its rows; those in contact are all of them
    return replace(rows, press=data.row_unit if whole else data.trial)


def virtual_presses(seed: int, unit: int) -> FeatureDataset:
    """Presses of the virtual finger by formulas."""
    with tempfile.TemporaryDirectory() as scratch:
        record = Path(scratch) / "virtual.mcap"
        write_virtual_record(record, frames=FRAMES, seed=seed, unit=unit, rate_hz=RATE_HZ)
        return ingest_record(
            record,
            command=f"docs/make_intervals.py, seed {seed}, unit {unit}",
            licence="Apache-2.0",
        )


def virtual_cells() -> list[dict[str, Any]]:
    """The virtual finger: another seed, and two other specimens."""
    bundle, _ = shipped("features-virtual")
    return [
        found
        for what, seed, unit in (
            ("virtual finger, other presses", 2, 1),
            ("virtual finger, specimen 2", 4, 2),
            ("virtual finger, specimen 3", 5, 3),
        )
        for found in cells_of(
            what, "features-virtual", held_out_features(bundle, virtual_presses(seed, unit))
        )
    ]


def real_fingers(data: Path) -> list[FeatureDataset]:
    """The two of the LASA force calibration."""
    path = data / "lasa_force_calibration" / "force_calibration.npz"
    return [ingest_lasa(path, fingers=(finger,)) for finger in (1, 2)]


def real_cells(fingers: Sequence[FeatureDataset]) -> list[dict[str, Any]]:
    """Bounds for sensors that a bundle was not made for.

    Those learned on one finger and tested on another, and those that ship, which know both.
    """
    found = []
    for name in ("features-twin", "features-virtual"):
        bundle, _ = shipped(name)
        intervals, known = bundle.manifest.intervals, bundle.known_inputs
        assert intervals is not None
        assert known is not None
        rows = [held_out_features(bundle, finger) for finger in fingers]
        for k, finger in enumerate(fingers):
            tested, other = rows[k], rows[1 - k]
            who = finger.sensor_names[0]
            learned = fit_formulas(other.errors, other.terms(known), other.press, use=OF_OTHERS)
            for which, formulas in (
                (f"{who}, uncalibrated, bounds of the other finger", learned),
                (f"{who}, uncalibrated, bounds that ship", intervals.others),
                (f"{who}, as if it were the twin's", intervals.formulas),
            ):
                terms = tested.terms(known)
                own = {one.name: bounds(one, terms) for one in intervals.formulas}
                found += [
                    cell(
                        which, name, one.name, tested.errors[one.name],
                        np.maximum(bounds(one, terms), own[one.name]), tested,
                    )
                    for one in formulas
                    if one.name in tested.errors
                ]  # fmt: skip
    return found


def own_cell(data: FeatureDataset, seconds: int) -> dict[str, Any]:
    """A finger's own first seconds, as `palpate calibrate` learns; bounds of what comes later."""
    force, tared = data.force.astype(np.float64), data.tared_counts.astype(np.float64)
    piece = np.arange(len(force)) // round(PRESS_S * HZ)
    first = np.unique(np.linspace(0, seconds * HZ - 1, ROWS_MOST).astype(int))
    later = np.arange((seconds + 1) * HZ, len(force), EVERY)
    known = KnownRows(tared[first], force[first], piece[first])
    rest = data.baseline.mean(axis=0, dtype=np.float64)
    held_out = np.zeros_like(known.force)
    for part in np.array_split(np.unique(known.press), FOLDS):
        out = np.isin(known.press, part)
        held_out[out] = estimate_of(fit_finger(known.where(~out), rest)[1], known.tared[out])
    magnitude, _ = finger_formulas(held_out, known.force, known.press)
    estimate = estimate_of(fit_finger(known, rest)[1], tared[later])
    size = np.linalg.norm(estimate, axis=1)
    nothing = np.zeros(len(size))
    errors = force_errors(estimate, force[later])["magnitude_n"]
    rows = HeldOut(
        {}, size, data.tared_counts[later], np.linalg.norm(force[later], axis=1), piece[later]
    )
    what = f"{data.sensor_names[0]}, its own first {seconds} s, tested on all that comes later"
    return cell(
        what, "palpate calibrate", "force_magnitude", errors,
        bounds(magnitude, terms_of(size, nothing, nothing)), rows,
    )  # fmt: skip


def flagged(check: RangeCheck, tared: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Rows whose input is flagged as unlike the known ones, as a service finds it."""
    return np.array(
        [
            QualityFlag.OUT_OF_RANGE in check.flags(row, {}, without=("force", *OF_CONTACT, *FIELD))
            for row in tared
        ]
    )


FIELD = ("displacement", "contact_force", "coefficients")
"""Outputs of fields."""


def shares(flags: NDArray[np.bool_], press: Rows) -> dict[str, Any]:
    """Share of flagged rows, each press counting the same, with a confidence interval."""
    # What is "covered" here is what is flagged.
    found = share_of(np.where(flags, 0.0, 1.0), np.zeros(len(flags)), press)
    return {key: found[key] for key in ("presses", "rows", "coverage", "ci95")}


def twin_flags(runs: Path) -> list[dict[str, Any]]:
    """False flags: presses that nothing has seen."""
    found = []
    for name in ("features-twin", "field-twin"):
        bundle, runtime = shipped(name)
        for what, path in twin_sets(runs).items():
            rows = read_held_out(bundle, path).rows
            found.append(
                {
                    "bundle": name,
                    "what": what,
                    **shares(flagged(runtime.range, rows.tared), rows.press),
                }
            )
    bundle, runtime = shipped("features-virtual")
    rows = held_out_features(bundle, virtual_presses(2, 1))
    some = slice(None, None, EVERY)
    found.append(
        {
            "bundle": "features-virtual",
            "what": "virtual finger, other presses",
            **shares(flagged(runtime.range, rows.tared[some]), rows.press[some]),
        }
    )
    return found


def real_flags(fingers: Sequence[FeatureDataset]) -> list[dict[str, Any]]:
    """Flags on real fingers, that no bundle was trained for."""
    return [
        {
            "bundle": name,
            "what": finger.sensor_names[0],
            "share": float(flagged(runtime.range, finger.tared_counts[::EVERY]).mean()),
        }
        for name in ("features-twin", "field-twin", "features-virtual")
        for _, runtime in [shipped(name)]
        for finger in fingers
    ]


def pattern_choice(runs: Path, fingers: Sequence[FeatureDataset]) -> dict[str, Any]:
    """Settings of the pattern, chosen on one finger and tested on the other.

    Fitted to ``calibrate``; those that flag more than ``FALSE_MOST`` of ``check`` are out.
    """
    bundle, _ = shipped("features-twin")
    assert bundle.known_inputs is not None
    bare = replace(bundle.known_inputs, pattern=None)
    learned, tested = (
        read_held_out(bundle, runs / name / "mixed.h5").rows for name in ("calibrate", "check")
    )
    tried: list[dict[str, Any]] = []
    for scale in SCALES:
        for shrink in SHRINKS:
            known, _ = with_pattern(bare, learned.tared, learned.press, scale=scale, shrink=shrink)
            check = RangeCheck(bundle.manifest.training_range, known)
            over = [flagged(check, finger.tared_counts[::EVERY]) for finger in fingers]
            false = shares(flagged(check, tested.tared), tested.press)["coverage"]
            tried.append(
                {
                    "scale": scale,
                    "shrink": shrink,
                    "real": [float(flags.mean()) for flags in over],
                    "false": false,
                }
            )
    chosen = []
    for k in range(2):
        quiet = [one for one in tried if one["false"] <= FALSE_MOST]
        best = max(quiet, key=lambda one: one["real"][k])
        chosen.append(
            {
                "chosen_on": fingers[k].sensor_names[0],
                "tested_on": fingers[1 - k].sensor_names[0],
                "scale": best["scale"],
                "shrink": best["shrink"],
                "flagged_there": best["real"][1 - k],
                "false": best["false"],
            }
        )
    return {"tried": tried, "chosen": chosen}


if __name__ == "__main__":
    if sys.argv[1:2] == ["--virtual"]:
        write_dataset(Path(sys.argv[2]), virtual_presses(VIRTUAL_SEED, 1))
    elif sys.argv[1:]:
        main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
    else:
        PAGE["write_page"]()
