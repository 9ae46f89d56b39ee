r"""Write docs/results/calibrate.md, .json and .png: what `palpate calibrate` learns, by estimator.

    palpate fem units draw 20 --seed 5 --out drawn.json
    palpate data generate runs/calibrate --points 3 --angled 2 --seed 11
    palpate data generate runs/drawn --points 2 --angled 2 --seed 13 --units drawn.json
    python docs/make_calibrate.py runs ../shared/data       or without both: the page alone

Simulated specimens learn from so many of their presses and are tested on all others; real fingers
from their first seconds, tested on the rest, with the other real finger and without. Beside each
error the one on presses held out, by which the estimator is chosen. Numbers only are written, no
rows.
"""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnxruntime import InferenceSession
from rich.console import Console

from palpate.files.bundle import read_bundle
from palpate_training.datasets.experiment import read_mixed
from palpate_training.datasets.export import features
from palpate_training.datasets.features import NOMINAL_PERIOD_S, FeatureDataset
from palpate_training.datasets.ingest import PRESS_N, ingest_lasa
from palpate_training.evaluation.transfer import (
    PRESS_S,
    Finger,
    fingers_of,
    first_seconds,
)
from palpate_training.figures.style import markdown_table, new_figure, save
from palpate_training.learning.force_process import KnownRows
from palpate_training.learning.intervals import bounds, covered, terms_of
from palpate_training.learning.metrics import force_errors, location_errors
from palpate_training.learning.other_fingers import (
    PRESSES_OF_OTHERS,
    OtherFinger,
    OtherFingers,
    SharedForce,
)
from palpate_training.learning.splits import GUARD_S
from palpate_training.tasks.finger import (
    ESTIMATORS,
    LIKE_OTHERS,
    LIKE_SIMULATED,
    ROWS_MOST,
    TOLD,
    chosen,
    estimate_of,
    full_estimate_of,
    held_out_errors,
    train_finger,
    unlike,
    unlike_others,
)
from palpate_training.tasks.other_fingers import fingers_in, train_unpressed

Floats = NDArray[np.float64]

OUT = Path(__file__).parent / "results" / "calibrate"
SETS = {"calibrate": "the three that ship", "drawn": "drawn ones"}
SHOTS = (6, 10, 20)
SPECIMENS_MOST = 8
DRAWS = 3
OWN_S = (30, 60, 120)
ERRORS_OF = {"force_magnitude": "magnitude_n", "force": "vector_n"}
CONSOLE = Console()


def measured(known: KnownRows, rest: Floats, tared: Floats, force: Floats) -> dict[str, Any]:
    """Errors of every estimator on rows that were not learned from, and on presses held out."""
    found: dict[str, Any] = {}
    errors = {name: held_out_errors(one, known, rest) for name, one in ESTIMATORS.items()}
    hard = np.linalg.norm(force, axis=1) >= 2.0
    for name, estimator in ESTIMATORS.items():
        error = force_errors(estimate_of(estimator(known, rest), tared), force)
        found[name] = {
            "magnitude_n": float(np.median(error["magnitude_n"])),
            "from_2n_percent": float(100.0 * np.median(error["magnitude_over_norm"][hard])),
            "held_out_n": float(errors[name].mean()),
        }
    found["unlike"] = unlike(errors[TOLD], known.force)
    found["chosen"] = chosen(errors, known.force)
    return found


def simulated(path: Path) -> list[dict[str, Any]]:
    """Every specimen of a mixed data set, with so many presses known."""
    data = features(read_mixed(path))
    cells = []
    for specimen in range(min(SPECIMENS_MOST, len(data.sensor_names))):
        own = np.flatnonzero(data.sensor == specimen)
        presses = pressed(data, own)
        for shots in SHOTS:
            for draw in range(DRAWS):
                rng = np.random.default_rng([draw, specimen])
                some = rng.permutation(presses)[:shots]
                if len(some) == shots and shots < len(presses):
                    cells.append(one_draw(data, own, some) | {"shots": shots, "draw": draw})
    return cells


def one_draw(data: FeatureDataset, own: NDArray[np.integer], presses: Any) -> dict[str, Any]:
    """A specimen that learns from some presses, tested on its others."""
    learned, others = dealt(data, own, presses)
    known = KnownRows(
        data.tared_counts[learned].astype(np.float64),
        data.force[learned].astype(np.float64),
        data.group[learned],
    )
    rest = data.baseline[own].mean(axis=0, dtype=np.float64)
    tared = data.tared_counts[others].astype(np.float64)
    found = measured(known, rest, tared, data.force[others].astype(np.float64))
    place = full_estimate_of(ESTIMATORS[TOLD](known, rest), tared)[:, 3:6]
    assert data.contact_location is not None
    apart = location_errors(place, data.contact_location[others])["distance_m"]
    found[TOLD]["location_mm"] = float(1e3 * np.nanmedian(apart))
    return found | {"specimen": data.sensor_names[data.sensor[own[0]]]}


def bundles_bounds(path: Path, shots: int) -> dict[str, Any]:
    """How often the bounds of specimens' own bundles hold on their other presses."""
    data = features(read_mixed(path))
    held: dict[str, list[tuple[float, float]]] = {}
    for specimen in range(min(SPECIMENS_MOST, len(data.sensor_names))):
        own = np.flatnonzero(data.sensor == specimen)
        presses = pressed(data, own)
        some = np.random.default_rng([0, specimen]).permutation(presses)[:shots]
        if shots >= len(presses):
            continue
        learned, others = dealt(data, own, some)
        columns: dict[str, Any] = {name: values[learned] for name, values in data.arrays().items()}
        columns["sensor"] = np.zeros(len(learned), np.int32)
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch) / "bundle"
            known = replace(data, **columns, sensor_names=(data.sensor_names[specimen],))
            train_finger(known, folder, name="features-one")
            formulas = read_bundle(folder).manifest.intervals
            session = InferenceSession((folder / "model.onnx").read_bytes())
        given = session.run(None, {"electrodes": data.tared_counts[others]})
        answers = dict(zip([one.name for one in session.get_outputs()], given, strict=True))
        size = np.linalg.norm(answers["force"].astype(np.float64), axis=1)
        found = force_errors(answers["force"], data.force[others])
        errors = {"force_magnitude": found["magnitude_n"], "force": found["vector_n"]}
        if "contact_location" in answers:
            assert data.contact_location is not None
            apart = location_errors(answers["contact_location"], data.contact_location[others])
            errors["contact_location"] = apart["distance_m"]
        terms = terms_of(size, np.zeros(len(size)), np.zeros(len(size)))
        for one in formulas.formulas if formulas else ():
            bound = bounds(one, terms)
            share = covered(errors[one.name], bound, data.group[others])
            held.setdefault(one.name, []).append((share, float(np.median(bound))))
    return {
        name: {
            "held": float(np.mean([share for share, _ in values])),
            "worst": min(share for share, _ in values),
            "bound": float(np.mean([bound for _, bound in values])),
            "specimens": len(values),
        }
        for name, values in held.items()
    }


def pressed(data: FeatureDataset, own: NDArray[np.integer]) -> NDArray[np.integer]:
    """Presses of a specimen that are hard enough to learn from, given its rows."""
    size = np.linalg.norm(data.force[own], axis=1)
    return np.unique(data.group[own][size >= PRESS_N])


def dealt(
    data: FeatureDataset, own: NDArray[np.integer], presses: Any
) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    """A specimen's rows of some presses, to learn from, and the touched ones of its others."""
    known = np.isin(data.group[own], presses)
    touched = np.linalg.norm(data.force[own], axis=1) >= PRESS_N
    return own[known], own[~known & touched]


def real(finger: Finger, seconds: int, others: list[OtherFinger]) -> dict[str, Any]:
    """A real finger from its own first seconds, tested on all that comes later."""
    force, tared = finger.recording.force, finger.tared.astype(np.float64)
    known, rest, later = first_seconds(finger, seconds, most=ROWS_MOST)
    found = measured(known, rest, tared[later], force[later])
    met = OtherFingers(others, rest)
    constant = np.broadcast_to(known.force.mean(axis=0), force[later].shape)
    for name, estimate in (
        ("constant", constant),
        ("others", estimate_of(met, tared[later])),
        ("shared", estimate_of(SharedForce(met, known, rest), tared[later])),
        ("alone", estimate_of(ESTIMATORS[found["chosen"]](known, rest), tared[later])),
    ):
        found[name] = of_magnitude(estimate, force[later])
    found["unlike_others"] = unlike_others(met, known)
    return found | {"finger": finger.name, "seconds": seconds}


def of_magnitude(estimate: Floats, force: NDArray[np.floating]) -> dict[str, float]:
    """Median and 95th percentile of the magnitude's error [N], median angle [rad]."""
    error = force_errors(estimate, force)
    return {
        "magnitude_n": float(np.median(error["magnitude_n"])),
        "p95_n": float(np.percentile(error["magnitude_n"], 95.0)),
        "angle_rad": float(np.nanmedian(error["angle_rad"])),
    }


def real_bounds(data: FeatureDataset, seconds: int, others: list[OtherFinger]) -> dict[str, Any]:
    """How often the bounds of a real finger's bundle hold later on; 0 s = it was never pressed."""
    first = np.arange(round(seconds / NOMINAL_PERIOD_S))
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "bundle"
        if seconds:
            columns: dict[str, Any] = {name: one[first] for name, one in data.arrays().items()}
            press = (first // round(PRESS_S / NOMINAL_PERIOD_S)).astype(np.int32)
            known = replace(data, **columns | {"group": press, "block": press})
            report = train_finger(known, folder, name="features-one", others=others)
        else:
            rest = data.baseline.mean(axis=0, dtype=np.float64)
            report = train_unpressed(others, rest, folder, name="features-one")
        formulas = read_bundle(folder).manifest.intervals
        session = InferenceSession((folder / "model.onnx").read_bytes())
    later = slice(round((seconds + GUARD_S) / NOMINAL_PERIOD_S) if seconds else 0, None)
    force = session.run(["force"], {"electrodes": data.tared_counts[later]})[0].astype(np.float64)
    error = force_errors(force, data.force[later])
    size = np.linalg.norm(force, axis=1)
    terms = terms_of(size, np.zeros(len(size)), np.zeros(len(size)))
    held = {
        one.name: float(np.mean(error[ERRORS_OF[one.name]] <= bounds(one, terms)))
        for one in ((formulas.formulas if seconds else formulas.others) if formulas else ())
    }
    return {
        "finger": data.sensor_names[0],
        "seconds": seconds,
        "holds": report.estimator,
        "held": held,
        **of_magnitude(force, data.force[later]),
    }


def foreign(real_sets: list[FeatureDataset], paths: list[Path]) -> dict[str, float]:
    """How unlike each other real and simulated fingers are: the least of each direction."""
    real_ones = [one for data in real_sets for one in fingers_in(data)]
    sets = [fingers_in(features(read_mixed(path)))[:SPECIMENS_MOST] for path in paths]
    pairs = {
        "real": [(some, one) for some in sets for one in real_ones],
        "simulated": [(real_ones, one) for some in sets for one in some],
    }
    return {
        which: min(unlike_others(OtherFingers(others, one.rest), one.rows) for others, one in some)
        for which, some in pairs.items()
    }


def page(facts: dict[str, Any]) -> str:
    """The Markdown page of the facts."""
    names = list(ESTIMATORS)
    rows = []
    for key, cells in facts["simulated"].items():
        for shots in SHOTS:
            some = [one for one in cells if one["shots"] == shots]
            if not some:
                continue
            right = np.mean([one["chosen"] == TOLD for one in some])
            rows.append(
                [f"{SETS[key]}, {shots} presses", str(len({one["specimen"] for one in some})),
                 *(f"{mean(some, name, 'magnitude_n'):.3f} N,"
                   f" {mean(some, name, 'from_2n_percent'):.0f} %" for name in names),
                 f"{100.0 * right:.0f} %", f"{mean(some, TOLD, 'location_mm'):.2f} mm"]
            )  # fmt: skip
    real_rows = [
        [f"{one['finger']}, {one['seconds']} s",
         *(f"{one[name]['magnitude_n']:.3f} ({one[name]['held_out_n']:.2f})" for name in names),
         one["chosen"]]
        for one in facts["real"]
    ]  # fmt: skip
    held = [
        [f"{SETS[key]}, {shots} presses", name, f"{100.0 * one['held']:.1f} %",
         f"{100.0 * one['worst']:.0f} %",
         f"{1e3 * one['bound']:.2g} mm" if "location" in name else f"{one['bound']:.2f} N"]
        for key, by_shots in facts["bounds"].items()
        for shots, found in by_shots.items()
        for name, one in found.items()
    ]  # fmt: skip
    head = ["specimens", "number", *names, "how often this network is chosen", "its location"]
    twin = [one["unlike"] for cells in facts["simulated"].values() for one in cells]
    others = [one["unlike"] for one in facts["real"]]
    like = [one["unlike_others"] for one in facts["real"]]
    with_other = [
        [f"{one['finger']}, {one['seconds']} s",
         *(three(one[name]) for name in ("alone", "others", "shared", "constant"))]
        for one in facts["real"]
    ]  # fmt: skip
    real_held = [
        [one["finger"], f"{one['seconds']} s" if one["seconds"] else "never pressed",
         one["holds"], three(one),
         *(f"{100.0 * one['held'][name]:.0f} %" if name in one["held"] else "no bound"
           for name in ERRORS_OF)]
        for one in facts["real_bounds"]
    ]  # fmt: skip
    held_head = ["finger", "known of it", "the bundle holds", "error",
                 *(f"bound of {name}" for name in ERRORS_OF)]  # fmt: skip
    shipped = json.loads((OUT.parent / "shipped.json").read_text(encoding="utf-8"))
    own_n, own_m = (
        next(one["value"] for one in shipped["points"][0]["figures"] if one["name"] == name)
        for name in ("force_magnitude", "contact_location")
    )
    least, most, real_least, real_most = min(twin), max(twin), min(others), max(others)
    return f"""# What a finger learns from its own presses

How exact the forces of a finger are after `palpate calibrate`, on simulated and on real fingers.
Made by `python docs/make_calibrate.py runs ../shared/data`; its docstring names the commands that
make the data. `palpate calibrate` [chooses](../adr/0025-calibrated-fingers.md) among four
estimators by their mean error on presses held out. The network may be chosen only if the finger is
like simulated ones: its error there, divided by the sum of 0.5 N and the force, must be
{LIKE_SIMULATED} at most in the median. It is {least:.2f} to {most:.2f} on the simulated specimens
below, and {real_least:.2f} to {real_most:.2f} on the real fingers.

![errors](calibrate.png)

## Simulated fingers

Specimens of the twin; the [population's network](population.md) was trained neither on them nor on
their skin. Median error of the force on all presses that were not learned from, and from 2 N in
percent of the force; means over specimens and {facts["draws"]} draws of the presses. *Line*: linear
fit on tared counts. *Gaussian processes*: the mean of the line and two of them; with a larger
*locality* a
press counts for less where signals are unlike its own. *Told by the presses*: the network gets the
finger's presses as input. A force/torque
sensor does not measure where a finger is touched; the network estimates it (the last column is the
median error of the contact location).
`features-twin`, which was trained on the three that ship, has {own_n:.3f} N and
{1e3 * own_m:.2f} mm on [presses like these](shipped.md).

{markdown_table(head, rows)}
The next table shows how often the 90 % bounds of such a finger's bundle hold on its other presses,
each press counting the same. With ten presses the bounds are wider than needed, because the next
press is counted as one more, with an error of any size:

{markdown_table(["specimens", "bound of", "holds", "worst specimen", "median bound"], held)}
## Real fingers

The two fingers of the LASA force calibration. Each is learned from its first seconds and tested on
the rest: median error of the magnitude [N], and in brackets the mean error on presses held out, by
which the estimator is chosen.

{markdown_table(["", *names, "chosen"], real_rows)}
So the network of simulated fingers is chosen for a finger that is like them, and not for a real
one, where presses held out show that it does not fit. The smooth finger that the gateway invents
(`virtual`) is not like them either: 0.57 to 1.17 in eight draws of sixteen presses. By the mean
error alone the network would wrongly have been chosen in five of them (training/LOG.md).

## With another finger

`palpate calibrate --others FILE` also learns from presses of fingers that were pressed before, here
of the other LASA finger. The estimate from them uses one frame, without the electrodes' common mode
([ADR 25](../adr/0025-calibrated-fingers.md)). Median error of the magnitude [N] / 95 % of the
errors are below [N] / median angle [rad], on all that comes after the first seconds:

{markdown_table(["", "its presses", "the other finger", "both", "always the mean"], with_other)}
*Its presses*: the estimator that is chosen above. *Always the mean*: that of its presses. On finger
1, presses held out would choose the estimator of its own presses alone, because they follow closely
on those that were learned from, and baselines drift for longer than a minute. So other fingers are
used whenever the finger is like them. This is tested before any press of it is learned from: their
median error, divided by the force plus 0.5 N, must be {LIKE_OTHERS} at most. It is
{min(like):.2f} to {max(like):.2f} from one LASA finger to the other,
{facts["foreign"]["real"]:.2f} and more from simulated specimens to these, and
{facts["foreign"]["simulated"]:.2f} and more from these to simulated specimens.
{PRESSES_OF_OTHERS} presses of its own count as much as all others. These two numbers were chosen
on these two fingers, by the worse of the two directions; they were not tested on a third finger.

The last table shows how often the 90 % bounds of such bundles hold on all that comes later. A
finger that was *never pressed* (`--presses 0`) is flagged `UNCALIBRATED`; its bounds come from the
one other finger, each half of which is estimated by the other half.

{markdown_table(held_head, real_held)}"""


def three(errors: dict[str, Any]) -> str:
    """Errors of a magnitude and an angle, in a cell."""
    return f"{errors['magnitude_n']:.3f} / {errors['p95_n']:.2f} / {errors['angle_rad']:.3f}"


def mean(cells: list[dict[str, Any]], name: str, figure: str) -> float:
    """Of an estimator's figure over cells."""
    return float(np.mean([one[name][figure] for one in cells]))


def draw(facts: dict[str, Any]) -> None:
    """Errors by number of presses."""
    figure = new_figure(9.0, 3.2)
    colours = ("0.75", "#d9a441", "#b5541c", "#1f5a94")
    for axis, (key, cells) in zip(
        figure.subplots(1, 2, sharey=True), facts["simulated"].items(), strict=True
    ):
        for number, (name, colour) in enumerate(zip(ESTIMATORS, colours, strict=True)):
            shots = [n for n in SHOTS if any(one["shots"] == n for one in cells)]
            values = [
                mean([one for one in cells if one["shots"] == n], name, "magnitude_n")
                for n in shots
            ]
            places = np.arange(len(shots)) + 0.2 * (number - 1.5)
            axis.bar(places, values, 0.19, color=colour, label=name)
        axis.set_xticks(range(len(shots)), [str(n) for n in shots])
        axis.set_title(f"simulated specimens: {SETS[key]}", fontsize=9)
        axis.set_xlabel("presses of the finger that are known")
        axis.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("median error of the force [N]")
    figure.axes[0].set_ylim(top=1.35)  # room for the legend
    figure.axes[1].legend(frameon=False, fontsize=8)
    save(figure, OUT.with_suffix(".png"))


def main(arguments: list[str]) -> None:
    """Measure, if folders are given, and write what was measured."""
    if arguments:
        runs, data = map(Path, arguments)
        facts: dict[str, Any] = {"draws": DRAWS, "simulated": {}, "bounds": {}, "real": []}
        for key in SETS:
            CONSOLE.print(f"simulated: {SETS[key]}")
            path = runs / key / "mixed.h5"
            facts["simulated"][key] = simulated(path)
            facts["bounds"][key] = {str(n): bundles_bounds(path, n) for n in SHOTS[1:]}
        archive = data / "lasa_force_calibration" / "force_calibration.npz"
        sets = [ingest_lasa(archive, fingers=[number]) for number in (1, 2)]
        facts["real_bounds"] = []
        for mine, theirs in (sets, sets[::-1]):
            (finger,), others = fingers_of(mine), fingers_in(theirs)
            CONSOLE.print(f"real: {finger.name}")
            facts["real"] += [real(finger, seconds, others) for seconds in OWN_S]
            facts["real_bounds"] += [real_bounds(mine, seconds, others) for seconds in (0, *OWN_S)]
        facts["foreign"] = foreign(sets, [runs / key / "mixed.h5" for key in SETS])
        text = json.dumps(facts, indent=1)
        OUT.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    kept = json.loads(OUT.with_suffix(".json").read_text(encoding="utf-8"))
    OUT.with_suffix(".md").write_text(page(kept), encoding="utf-8")
    draw(kept)


if __name__ == "__main__":
    main(sys.argv[1:])
