"""Write docs/results/transfer.md, .json and .png: force on a real finger that training has not met.

``python docs/make_transfer.py ../shared/data`` takes the two fingers of the LASA force calibration,
each from the other: with nothing but a tare, with its electrodes without forces, and after 1 to 20
labelled presses of 2 s. Then nothing but a tare again, on electrodes that were changed as another
finger or another day changes them. Then each from its own first seconds, as
``palpate calibrate`` learns; at last the end of each from what comes before. Numbers only are
written, no rows. What the page says of simulated fingers is of ``make_transfer_simulated.py``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from palpate_training.datasets.ingest import ingest_lasa
from palpate_training.evaluation.transfer import (
    FIGURES,
    Finger,
    baselines_of,
    fingers_of,
    first_seconds,
    run_transfer,
    summary,
)
from palpate_training.figures.style import markdown_table, new_figure, save
from palpate_training.learning.force_process import ForceLine
from palpate_training.learning.twin_line import read_line
from palpate_training.systems.samples import counts_at, impedance_ohm
from palpate_training.systems.transfer import SAME_USE, ForceTransfer
from palpate_training.tasks.finger import ROWS_MOST, estimate_of, fit_finger

Floats = NDArray[np.float64]

OUT = Path(__file__).parent / "results" / "transfer"
SHOTS = (0, 1, 5, 10, 20)
OWN_S = (30, 60, 120)
LEARNED = 0.8
"""Share of a recording that is learned from, where its end is tested."""

CONSOLE = Console()
RIVALS = ("ridge", "constant")


def changed(finger: Finger, change: Callable[[Floats], Floats]) -> Finger:
    """The finger with other logarithms of the impedance over that at rest, (N, 19)."""
    recording = finger.recording
    rest = impedance_ohm(recording.baseline)
    counts = counts_at(rest * np.exp(change(np.log(impedance_ohm(recording.electrodes) / rest))))
    tared = (counts - recording.baseline).astype(np.float32)
    return replace(finger, recording=replace(recording, electrodes=counts), tared=tared)


def stresses() -> dict[str, Callable[[Floats], Floats]]:
    """Changes by name; the random ones are the same for both fingers."""
    random = np.random.default_rng(0)
    gains = np.exp(random.normal(0.0, 0.05, 19))
    offsets = random.normal(0.0, 0.01, 19)

    def ramp(logs: Floats) -> Floats:
        return np.linspace(0.0, 1.0, len(logs))[:, None]

    return {
        "as recorded": lambda logs: logs,
        "all + 0.05": lambda logs: logs + 0.05,
        "all - 0.05": lambda logs: logs - 0.05,
        "all + 0 to 0.1, as it warms": lambda logs: logs + 0.1 * ramp(logs),
        "gains, sd 5 %": lambda logs: gains * logs,
        "each drifts, sd 0.01": lambda logs: logs + offsets * ramp(logs),
    }


LINE = read_line()


def measure(fingers: list[Finger], **options: Any) -> list[dict[str, Any]]:
    """Each finger from the others."""
    return [
        run_transfer([other for other in fingers if other is not finger], finger, **options)
        for finger in fingers
    ]


def own(finger: Finger, seconds: int) -> dict[str, Any]:
    """A finger from its own first seconds, tested on all that comes later."""
    force, tared = finger.recording.force, finger.tared.astype(np.float64)
    known, rest, later = first_seconds(finger, seconds, most=ROWS_MOST)
    estimator, net = fit_finger(known, rest)
    constant = np.tile(known.force.mean(axis=0), (len(later), 1))
    return {
        "test": finger.name,
        "seconds": seconds,
        "estimator": estimator,
        **summary(estimate_of(net, tared[later]), force[later]),
        "ridge": summary(estimate_of(ForceLine(known), tared[later]), force[later]),
        "constant": summary(constant, force[later]),
    }


def later(fingers: list[Finger]) -> list[dict[str, Any]]:
    """Both fingers at once from the first part of their recordings, tested on the rest."""
    ends = [round(LEARNED * len(finger.recording.force)) for finger in fingers]
    columns = ("electrodes", "baseline", "segment", "force")
    begun = []
    for finger, end in zip(fingers, ends, strict=True):
        first = {name: getattr(finger.recording, name)[:end] for name in columns}
        recording = replace(finger.recording, **first)
        begun.append(replace(finger, recording=recording, tared=finger.tared[:end]))
    model = ForceTransfer([finger.recording for finger in begun], LINE)
    found = []
    for finger, end in zip(fingers, ends, strict=True):
        truth = finger.recording.force[end:]
        tested = np.arange(end, end + len(truth))
        estimate = model.estimate(finger.recording, unlabelled=False)[tested]
        rivals = baselines_of(begun, finger, tested[:0], tested)
        result: dict[str, Any] = {"test": finger.name, **summary(estimate, truth)}
        found.append(result | {name: summary(one, truth) for name, one in rivals.items()})
    return found


def cell(result: dict[str, Any]) -> str:
    """Magnitude, its 95 % and angle."""
    return " / ".join(f"{result[figure]:.3f}" for figure in FIGURES)


def page(facts: dict[str, Any]) -> str:
    """The Markdown page of the facts."""
    names = [result["test"] for result in facts["ways"][0]["results"]]
    head = ["", *(f"{name}, unseen" for name in names)]
    ways = []
    for way in facts["ways"]:
        results = way["results"]
        ways.append([f"**{way['name']}**", *map(cell, results)])
        ways.append(["without the twin's line", *map(cell, way["without"])])
        ways += [[f"{rival}", *(cell(one[rival]) for one in results)] for rival in RIVALS]
        ways.append(
            [
                "90 % intervals hold, half width",
                *(
                    f"{100 * one['coverage_90']:.0f} %, {one['interval_median_n']:.2f} N"
                    for one in results
                ),
            ]
        )
    stressed = [
        [name, *(cell(one) for one in results), *(cell(one["ridge"]) for one in results)]
        for name, results in facts["stressed"].items()
    ]
    calibrated = []
    for results in facts["own"]:
        calibrated.append([f"**{results[0]['seconds']} s**", *map(cell, results)])
        calibrated += [[rival, *(cell(one[rival]) for one in results)] for rival in RIVALS]
    ended = [["both fingers", *map(cell, facts["later"])]]
    ended += [[rival, *(cell(one[rival]) for one in facts["later"])] for rival in RIVALS]
    return f"""# Force on a real finger that training has not met

How exact the force on a real finger is that no network was trained on. There are two real BioTacs,
those of the LASA force calibration, always in contact, with forces of 0.4 to 10 N. The force
of each is estimated by what was learned on the other. `python docs/make_transfer.py ../shared/data`
makes this page. To make one row, use `palpate data ingest-lasa force_calibration.npz 1.h5
--finger 1`, the same for 2, and `palpate train transfer --train 1.h5 --test 2.h5 --shots 5`.

![Error against labelled presses](transfer.png)

Each cell has three figures: median error of the magnitude [N] / the error that 95 % of the rows
stay below [N] / median error of the angle [rad].

{markdown_table(head, ways)}
* *Tare only*: the estimate of a row uses the tare and the rows before it.
* *Unlabelled*: it may also use mean and spread of the electrodes over the whole recording, but no
  force.
* *Presses*: it may also use this number of pieces of 2 s with known forces, drawn at random
  {facts["draws"]} times. Rows within 1 s of them are not tested.
* *Constant*: the mean force of the first 80 % of the other finger's recording; with presses, that
  of the labelled rows.
* *Ridge*: a ridge regression on tared counts, which learns from the same rows, and with presses
  from both; the last 20 % of the other's recording choose its penalty.

With a tare only, on electrodes that were changed: the change is of the logarithm of the impedance
over that at rest, of all electrodes alike or of each.

{markdown_table(["", *head[1:], *(f"ridge, {name}" for name in names)], stressed)}
A finger that is learned from the first seconds of its own recording, as by `palpate calibrate`, and
tested on all that comes later. It uses no other finger, and no state between frames, which a bundle
cannot hold:

{markdown_table(["", *names], calibrated)}
Fingers that training has met, at a later time: learned from the first
{100 * LEARNED:.0f} % of both recordings at once, tested on the rest of each, no setting changed
(goals 0.12 and 0.16 N, 0.045 rad; the networks of the [study](study.md) have 0.085 and 0.33 N):

{markdown_table(["", *names], ended)}
{on_simulated_fingers()}
* How it works: `palpate_training/systems/transfer.py`, and `tasks/finger.py` for its own presses.
  What was tried: training/LOG.md.
* The *twin's line*: the magnitude starts from a linear fit of 20,000 presses of the
  [twin](population.md), 60 numbers; scale and axes of the fit are taken from the other finger. It
  helps where few presses are known; no network of the twin helped. `palpate calibrate` starts from
  it, too.
* A labelled press mainly corrects the rows within some ten seconds before and after it, because
  baselines drift. An estimate in real time has only the presses before it, so it gains less.
* A finger's own first minute alone is worse than the other finger and five presses drawn from the
  whole recording, because baselines drift and these fingers are never released to be tared again.
* The constants of the method were chosen on these two fingers, by the worse of the two. So the
  numbers are somewhat too good; only a third finger would be an independent test.
* A single press makes the magnitude of the first finger worse. From two presses on, a ridge
  regression that is corrected in the same way is mixed in, with a weight that is chosen on presses
  that are left out. Magnitudes gain by it; the first finger's direction with five presses does not
  (0.071 rad without it).
* The remaining errors are mostly slow: baselines drift within half a minute.
* The intervals are learned from errors between the halves of the other finger's recording, which
  are smaller than those between fingers. The more labelled presses there are, the more the
  intervals rest on these, each estimated without itself.
"""


def on_simulated_fingers() -> str:
    """The same method between simulated fingers, by what is known of the pair."""
    report = json.loads(Path(f"{OUT}-simulated.json").read_text(encoding="utf-8"))
    groups: dict[str, list[dict[str, Any]]] = {}
    for one in report["results"]:
        kind = "unlike" if one["unlike"] else "alike"
        groups.setdefault(", ".join(filter(None, (kind, one["kind"]))), []).append(one)
    rows = []
    for name, group in sorted(groups.items()):
        for shots in sorted({one["shots"] for one in group}):
            some = [one for one in group if one["shots"] == shots]
            told = {
                (rival, key): np.array([(one[rival] if rival else one)[key] for one in some])
                for rival in ("", *RIVALS)
                for key in FIGURES
            }
            magnitude, _, angle = FIGURES
            ours = told["", magnitude]
            rows.append(
                [
                    name, str(shots), str(len(some)),
                    *(f"{np.median(told[rival, magnitude]):.2f}, {told[rival, magnitude].max():.2f}"
                      for rival in ("", *RIVALS)),
                    *(str(int(np.sum(ours <= told[rival, magnitude]))) for rival in RIVALS),
                    " / ".join(f"{np.median(told[rival, angle]):.2f}" for rival in ("", *RIVALS)),
                    f"{100 * np.mean([one['coverage_90'] for one in some]):.0f} %",
                ]
            )  # fmt: skip
    head = ["pairs", "presses", "number", "magnitude [N]: median, worst", "ridge", "constant",
            "no worse than ridge", "no worse than constant", "angle [rad], ridge, constant",
            "90 % intervals hold"]  # fmt: skip
    return f"""## Simulated fingers

The constants were chosen on the two real fingers. So the method was also tested on pairs of
simulated fingers ([commands](../make_transfer_simulated.py)): it learns from one finger and is
tested on the other. {report["fingers"]} fingers have a skin, fill and electrodes of their own, are
pressed {report["presses"]} times, and drift as real ones do. No setting was chosen on them: the
rules below were found on other simulated fingers and on the real ones (training/LOG.md). The
signals of the two real ones differ by a factor of 1.4, so the rules scale nothing there.

* *Unlike*: the untouched impedance of one finger is more than twice that of the other. Without a
  press the sensitivity of such a finger is not known, so the estimate is the other's mean force.
* *Alike*: all other pairs. Here the size of the signals shows how sensitive the finger is: signals
  beyond {SAME_USE:g} times those of the other finger are scaled down, those from {SAME_USE**2:g}
  times on to the same size.
* *Pressed harder*: only the harder half of the presses is in the recording, so that larger signals
  do not mean a more sensitive finger.
* *New*: pairs with one of {report["new_fingers"]} more fingers, of another draw.

With labelled presses, each is left out in turn. The errors on them decide how the estimates are
scaled, and how much weight a ridge regression gets (on logarithms of impedances,
learned from the same presses and corrected by them in the same way).

{worse_pairs(report["results"])}

{markdown_table(head, rows)}"""


def worse_pairs(results: list[dict[str, Any]]) -> str:
    """How many pairs are worse than the constant and ridge regression, and which is worst."""
    key, lines = FIGURES[0], []
    for shots in sorted({one["shots"] for one in results}):
        some = [one for one in results if one["shots"] == shots and one["kind"] != "pressed harder"]
        worse = [sum(one[key] > one[rival][key] for one in some) for rival in ("constant", "ridge")]
        worst = max(some, key=lambda one: one[key] / one["constant"][key])
        lines.append(
            f"* {shots} press{'es' * (shots != 1)}: of {len(some)} pairs {worse[0]} are worse than"
            f" the constant, {worse[1]} than ridge regression; the worst pair has"
            f" {worst[key]:.2f} N where the constant has {worst['constant'][key]:.2f} N."
        )
    return "\n".join(
        [
            "Without a press, a finger whose signals are 1.2 to 1.5 times as large may be",
            "estimated far worse than by a constant, because a more sensitive finger and one that",
            "is pressed harder look the same. With five presses they can be distinguished:",
            "",
            *lines,
        ]
    )


def draw(facts: dict[str, Any]) -> None:
    """Errors against the number of presses."""
    figure = new_figure(9.0, 3.4)
    axes = figure.subplots(1, 2)
    ways = [way for way in facts["ways"] if way["name"] != "unlabelled"]
    shots = [way["shots"] for way in ways]
    places = np.arange(len(shots))
    for axis, key, text in zip(
        axes,
        ("magnitude_median_n", "angle_median_rad"),
        ("median error of the magnitude [N]", "median angle [rad]"),
        strict=True,
    ):
        for number, colour in enumerate(("#1f5a94", "#b5541c")):
            results = [way["results"][number] for way in ways]
            name = results[0]["test"]
            axis.plot(
                places, [one[key] for one in results], "o-", color=colour, label=f"{name}, network"
            )
            axis.plot(
                places,
                [one["ridge"][key] for one in results],
                "o--",
                color=colour,
                alpha=0.5,
                label=f"{name}, ridge",
            )
        axis.set_xticks(places, [str(count) for count in shots])
        axis.set_xlabel("labelled presses of 2 s")
        axis.set_ylabel(text)
        axis.set_ylim(bottom=0.0)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False, fontsize=8)
    save(figure, OUT.with_suffix(".png"))


def measure_all(folder: Path) -> dict[str, Any]:
    """All ways of using a finger, and all changes, with the data of a folder."""
    fingers = fingers_of(ingest_lasa(folder / "lasa_force_calibration" / "force_calibration.npz"))
    draws = 12
    ways = []
    for shots, unlabelled in ((0, False), (0, True), *((shots, True) for shots in SHOTS[1:])):
        name = (
            f"{shots} press{'es' * (shots > 1)}"
            if shots
            else "unlabelled"
            if unlabelled
            else "tare only"
        )
        options: dict[str, Any] = {"shots": shots, "unlabelled": unlabelled, "draws": draws}
        results, without = (measure(fingers, line=line, **options) for line in (LINE, None))
        ways.append({"name": name, "shots": shots, "results": results, "without": without})
        for each in (results, without):
            CONSOLE.print(name, [cell(result) for result in each])
    stressed = {}
    for name, change in stresses().items():
        stressed[name] = [
            run_transfer(
                [other for other in fingers if other is not finger],
                changed(finger, change),
                line=LINE,
            )
            for finger in fingers
        ]
        CONSOLE.print(name, [cell(result) for result in stressed[name]])
    calibrated = [[own(finger, seconds) for finger in fingers] for seconds in OWN_S]
    for results in calibrated:
        CONSOLE.print(results[0]["seconds"], "s", [cell(result) for result in results])
    ended = later(fingers)
    CONSOLE.print("later", [cell(result) for result in ended])
    facts = {"draws": draws, "ways": ways, "stressed": stressed, "own": calibrated}
    return facts | {"later": ended}


def main(arguments: list[str]) -> None:
    """Measure, if a folder is given, and write what was measured."""
    if arguments:
        facts = json.dumps(measure_all(Path(arguments[0])), indent=1)
        OUT.with_suffix(".json").write_text(facts + "\n", encoding="utf-8")
    measured = json.loads(OUT.with_suffix(".json").read_text(encoding="utf-8"))
    OUT.with_suffix(".md").write_text(page(measured), encoding="utf-8")
    draw(measured)


if __name__ == "__main__":
    main(sys.argv[1:])
