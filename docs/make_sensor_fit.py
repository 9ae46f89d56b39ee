"""Write docs/results/twin/sensor-fit.md, .json and .png: a specimen fitted to one real sensor.

``python docs/make_sensor_fit.py FOLDER STORES`` takes the folder of public data, and a folder for
two stores of presses, by a plate and by a sphere, which it makes or completes first. For each
finger of the force logs it fits specimens to the rest and to the first touches, as ``palpate fem
units fit --recording`` does, and compares what they read with the later touches, beside ridge
regressions learned on the same ones.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from palpate.rigid import rotation_matrices
from palpate_deploy.experiment import SOLVER, parameters_of
from palpate_fem.cli.identify import ELECTRICAL
from palpate_fem.electrodes.model import ElectrodeModel
from palpate_fem.electrodes.specimen import SENSING, SpecimenParameters
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.load_stepping import SolverSettings
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac
from palpate_fem.population.explain import TouchExplainer
from palpate_fem.population.press_library import PressLibrary, read_library
from palpate_fem.population.responses import geometry_of
from palpate_fem.population.sensor_fit import SensorFit, fit_sensor
from palpate_fem.population.touches import SensorTouches, touches_of
from palpate_fem.result import IndentationOutcome, IndentationStep
from palpate_fem.service.biotac import BiotacTip
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter
from palpate_training.datasets.ingest import ingest_lasa
from palpate_training.experiment.generate.simulator import ExperimentSpec
from palpate_training.figures.style import (
    INK,
    MARK,
    finish,
    grid,
    label,
    markdown_table,
    new_figure,
    unit_colour,
)

Floats = NDArray[np.float64]

OUT = Path(__file__).parent / "results" / "twin"

EDGE_M = 0.8e-3
PRESSES = {"plate": 256, "sphere_large": 96}
"""What the fingers are taken to have touched; and another guess, to see what it matters."""
LEAN_DEG, SIDE_DEG, OBLIQUE_DEG = (-55.0, 20.0), (-45.0, 45.0), 35.0
"""Of the indenter along the finger (negative = onto the tip) and across; of its way to its axis."""
STEP_M, STEPS = 0.15e-3, 25
MOST_N = 8.0
PLATE, SPHERE = PRESSES
SETTINGS = SolverSettings(smallest_increment=float(SOLVER["smallest_increment"]))

TOUCHES = (4, 8, 12, 20)
HEADLINE = 12
GROUPS = 4
"""A quarter of the electrodes is given, every fourth one; the others are told. Each in its turn."""
RIDGE = 10.0 ** np.arange(-2, 3)
DRAWS = 2000

GIVEN = ("force", "force and 5 electrodes", "all electrodes")
METHODS = (
    "constant",
    "ridge",
    "nominal specimen",
    "fitted to the rest",
    "fitted to rest and touches",
)


def complete_library(path: Path, indenter: str) -> None:
    """Press wherever it is not done yet: from all sides, obliquely, up to 8 N."""
    geometry = biotac(edge_m=EDGE_M, layers=2)
    tip = Fingertip.pressurised(geometry, parameters_of(ExperimentSpec()), SETTINGS)
    made = make_indenter(indenter)
    with StoreWriter(path, BiotacTip(tip).describe(), shared=True) as store:
        draws = qmc.Sobol(4, seed=1).random(max(PRESSES.values()))
        for number, draw in enumerate(draws[: PRESSES[indenter]]):
            name = f"{indenter}/{number:04d}/tilted"
            if name in store.done():
                continue
            last = [0.0]

            def on_step(step: IndentationStep, last: list[float] = last) -> None:
                last[0] = float(np.linalg.norm(step.force))

            def should_stop(last: list[float] = last) -> IndentationOutcome | None:
                return IndentationOutcome.FORCE_LIMIT if last[0] > MOST_N else None

            path_at = tilted_path(tip.nodes, draw)
            store.write(name, tip.indent(made, path_at, on_step=on_step, should_stop=should_stop))


def tilted_path(nodes: Floats, draw: Floats) -> Floats:
    """Poses of an indenter whose tip meets the skin where a plate would, (K, 7), from 4 numbers."""
    lean = np.radians(LEAN_DEG[0] + (LEAN_DEG[1] - LEAN_DEG[0]) * draw[0])
    side = np.radians(SIDE_DEG[0] + (SIDE_DEG[1] - SIDE_DEG[0]) * draw[1])
    oblique, azimuth = np.radians(OBLIQUE_DEG) * np.sqrt(draw[2]), 2 * np.pi * draw[3]
    # +z turned towards +x by the lean, then towards +y by the side.
    y, x = lean / 2, -side / 2
    quaternion = np.array(
        [
            np.cos(y) * np.cos(x),
            np.cos(y) * np.sin(x),
            np.sin(y) * np.cos(x),
            -np.sin(y) * np.sin(x),
        ]
    )
    turned = rotation_matrices(quaternion)
    normal = turned[:, 2]
    across = np.cos(azimuth) * turned[:, 0] + np.sin(azimuth) * turned[:, 1]
    way = np.cos(oblique) * normal + np.sin(oblique) * across
    start = nodes[np.argmin(nodes @ normal)] - 2e-6 * normal
    step = STEP_M / np.cos(oblique)
    return np.array([[*(start + way * step * k), *quaternion] for k in range(STEPS + 1)])


@dataclass
class Scores:
    """Squared and absolute errors of one method and one kind of what is given.

    Attributes:
        square: Of each touch and electrode, summed over the groups that it was told in, (N, 19).
        total: The same of the mean of the later touches: what there is to explain, (N, 19).
        absolute: Absolute errors [counts].
        told: Mean of what was told, shape (N, 19).
    """

    square: Floats
    total: Floats
    absolute: Floats
    told: Floats

    @classmethod
    def of(
        cls, tell: Callable[[NDArray[np.bool_]], Floats], test: SensorTouches, what: str
    ) -> Scores:
        """Score estimates of tared counts, shape (N, 19), that are made from given electrodes."""
        given = {
            "force": [np.zeros(SENSING, bool)],
            "force and 5 electrodes": [np.arange(SENSING) % GROUPS == k for k in range(GROUPS)],
            "all electrodes": [np.ones(SENSING, bool)],
        }[what]
        shape = test.tared.shape
        square, total, told, times = (np.zeros(shape) for _ in range(4))
        away = (test.tared - test.tared.mean(axis=0)) ** 2
        absolute = []
        for known in given:
            some = ~known if what != "all electrodes" else known
            estimate = tell(known)
            error = (estimate - test.tared)[:, some]
            square[:, some] += error**2
            total[:, some] += away[:, some]
            told[:, some] += estimate[:, some]
            times[:, some] += 1
            absolute.append(np.abs(error).ravel())
        return cls(square, total, np.concatenate(absolute), told / times)

    def summary(self) -> dict[str, Any]:
        """Explained share, pooled and by electrode, its interval over touches; median error."""
        rng = np.random.default_rng(0)
        by_touch = np.stack([self.square.sum(axis=1), self.total.sum(axis=1)])
        some = rng.integers(0, by_touch.shape[1], (DRAWS, by_touch.shape[1]))
        left, there = by_touch[:, some].sum(axis=2)
        return {
            "explained": 1 - float(self.square.sum() / self.total.sum()),
            "explained_5_95": np.percentile(1 - left / there, [5, 95]).tolist(),
            "explained_by_electrode": (
                1 - self.square.sum(axis=0) / self.total.sum(axis=0)
            ).tolist(),
            "median_error_counts": float(np.median(self.absolute)),
        }


def ridge(inputs: Floats, outputs: Floats, asked: Floats) -> Floats:
    """Ridge regression on standardised inputs, its strength by leaving out one row at a time."""
    middle, scale = inputs.mean(axis=0), inputs.std(axis=0) + 1e-9
    x, mean = (inputs - middle) / scale, outputs.mean(axis=0)
    best: tuple[float, Floats] | None = None
    for strength in RIDGE:
        solve = np.linalg.solve(x.T @ x + strength * np.eye(x.shape[1]), x.T)
        left = outputs - mean - x @ solve @ (outputs - mean)
        leverage = np.einsum("ni,in->n", x, solve) + 1 / len(x)
        error = float(((left / (1 - leverage)[:, None]) ** 2).mean())
        if best is None or error < best[0]:
            best = error, solve @ (outputs - mean)
    assert best is not None
    return np.asarray(mean + (asked - middle) / scale @ best[1])


def told_by(
    explainer: TouchExplainer, train: SensorTouches, test: SensorTouches, known: NDArray[np.bool_]
) -> Floats:
    """Tared counts that a specimen tells of touches, shape (N, 19), after learning from others."""
    return explainer.explain(test, explainer.learn(train).learned, given=known).tared


def compared(
    sensor: ElectrodeModel,
    library: PressLibrary,
    train: SensorTouches,
    test: SensorTouches,
    fitted: dict[str, SpecimenParameters],
) -> dict[tuple[str, str], Scores]:
    """Scores by method and by what is given."""
    found: dict[tuple[str, str], Scores] = {}
    for what in GIVEN[:2]:
        found["constant", what] = Scores.of(
            lambda _: np.tile(train.tared.mean(axis=0), (len(test), 1)), test, what
        )
        found["ridge", what] = Scores.of(
            lambda known: ridge(
                np.concatenate([train.force, train.tared[:, known]], axis=1),
                train.tared,
                np.concatenate([test.force, test.tared[:, known]], axis=1),
            ),
            test,
            what,
        )
    for method, specimen in fitted.items():
        tell = partial(
            told_by, TouchExplainer(sensor.with_specimen(specimen), library), train, test
        )
        for what in GIVEN:
            found[method, what] = Scores.of(tell, test, what)
    return found


def touches_of_fingers(folder: Path) -> list[SensorTouches]:
    """Held touches of the two fingers of the force logs."""
    data = ingest_lasa(folder / "lasa_force_calibration" / "force_calibration.npz")
    found = []
    for k, name in enumerate(data.sensor_names):
        mine = data.sensor == k
        found.append(
            touches_of(
                name,
                data.baseline[mine][0].astype(float),
                data.electrodes[mine].astype(float),
                data.force[mine].astype(float),
            )
        )
    return found


@dataclass
class Finger:
    """One finger's touches, fits by number of touches, and scores."""

    touches: SensorTouches
    test: SensorTouches
    fits: dict[int, SensorFit]
    scores: dict[int, dict[tuple[str, str], Scores]]


def studied(
    sensor: ElectrodeModel,
    library: PressLibrary,
    touches: SensorTouches,
    counts: tuple[int, ...] = TOUCHES,
) -> Finger:
    """Fit to the first touches of one finger, and compare with its second half."""
    half = len(touches) // 2
    test = touches.some(slice(half, len(touches)))
    finger = Finger(touches, test, {0: fit_sensor(sensor, library, touches.some(slice(0, 0)))}, {})
    for count in counts:
        train = touches.some(slice(0, count))
        finger.fits[count] = fit_sensor(sensor, library, train)
        fitted = {
            METHODS[2]: SpecimenParameters(),
            METHODS[3]: finger.fits[0].specimen,
            METHODS[4]: finger.fits[count].specimen,
        }
        if count != HEADLINE:  # the others do not change with the touches but for their prior
            fitted = {METHODS[4]: fitted[METHODS[4]]}
        finger.scores[count] = compared(sensor, library, train, test, fitted)
    return finger


def draw(path: Path, fingers: list[Finger]) -> None:
    """Measured and told electrodes of one later touch of each finger; and what is explained."""
    figure = new_figure(13.0, 8.0)
    axes = figure.subplots(2, 2, width_ratios=(1.2, 1.0))
    places = np.arange(SENSING)
    what = GIVEN[1]
    for row, finger in zip(axes, fingers, strict=True):
        scores = finger.scores[HEADLINE]
        # The touch whose error under the fitted specimen is the median one.
        order = np.argsort(scores[METHODS[4], what].square.sum(axis=1))
        touch = int(order[len(order) // 2])
        row[0].bar(places, finger.test.tared[touch], 0.8, color="#c9ced6", label="measured")
        for k, method in enumerate(METHODS[1:]):
            told = scores[method, what].told[touch]
            marks = {"color": unit_colour(k), "label": method}
            row[0].plot(places + 0.14 * (k - 1.5), told, "o", ms=4.5, **marks)
        force = np.linalg.norm(finger.test.force[touch])
        label(
            row[0], "", "tared [counts]", f"{finger.touches.name}, a later touch of {force:.1f} N"
        )
        for k, method in enumerate(METHODS[1:]):
            share = np.array(scores[method, what].summary()["explained_by_electrode"])
            row[1].plot(places, np.maximum(share, -1.0), "o", ms=4.5, color=unit_colour(k))
        row[1].axhline(0.0, color=MARK, lw=0.8)
        row[1].set_ylim(-1.08, 1.05)
        label(row[1], "", "explained", "all later touches; below -1 drawn at -1")
        for axis in row:
            axis.set_xticks(places, [f"E{i + 1}" for i in places], rotation=60, fontsize=7)
            axis.axhline(0.0, color=INK, lw=0.5)
            grid(axis, "y")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=5, frameon=False, fontsize=8)
    finish(
        figure,
        path,
        f"Later touches, from their force and five electrodes; fitted to {HEADLINE} touches",
        "Left: of all later touches the one whose error is the median under the fitted specimen."
        " Each electrode is told without its own quarter; the mean of the three is shown."
        " Right: 1 = all of an electrode's variance over the later touches, 0 = none.",
    )


HEAD = """# A specimen fitted to one real sensor

Made by `python docs/make_sensor_fit.py ../shared/data runs/presses` (four minutes, and half an
hour for the simulations the first time). The two fingers of the force logs are always touched, at 3
to 7 N; where, by what and under which angle was not recorded. A touch is a stretch of half a second
in which no electrode moves by more than 100 counts: {counts}.
Specimens are fitted to the counts at rest and to the first touches in order of time, as
`palpate fem units fit plate.sim --recording FILE.h5 --touches {headline}` does, and judged by the
second half of the touches.

The library is {presses} presses by a plate (40 x 24 mm), mesh of {edge:.1f} mm, {fill:.2f} ml. It
leans by {lean_low:.0f} to {lean_high:.0f} degrees along the finger and by {side_low:.0f} to
{side_high:.0f} across it, and moves up to {oblique:.0f} degrees off its normal, until {most:.0f} N.
For each touch, each press gives one candidate: its state with the same size of force. How probable
each is follows from the direction of the force, the given electrodes, and where the first touches
were, given their force; place and temperature are then averaged over. All numbers:
[sensor-fit.json](sensor-fit.json).

![Measured and predicted electrodes](sensor-fit.png)

## Later touches, after {headline}

Explained: share of the variance of the tared counts over the later touches, all electrodes pooled,
with the 5th and 95th percentile over draws of touches; a method that only knew the mean of these
later touches would explain 0. In brackets: median absolute error [counts]. With five electrodes
given (every fourth one, in four turns) the others are predicted; ridge regression gets the same
inputs and learns from the same touches. With all given nothing is predicted: it shows how near
presses come.

"""

CURVE = """
## How many touches it takes

Explained by ridge regression and by the fitted specimen, from the force and five electrodes.

"""

GUESSES = """
## What was touched, and how finely the library covers it

Explained by the specimen fitted to the counts at rest and {headline} touches, on other libraries.

"""

PARAMETERS = """
## What was fitted

"""

NOTES = """
## What it explains, and what it does not

* **Touches matter; counts at rest alone do not.** With force and five electrodes the specimen
  fitted
  to the counts at rest and 12 touches explains 0.24 and 0.63 of the other electrodes, the nominal
  one -0.58 and
  0.22. The one fitted to the counts at rest alone explains -0.93 and 0.33: on finger 1 it is worse
  than the nominal one, although its counts at rest are right to 39 counts.
* **Ridge regression is as good after 12 touches, and better after 8 and 20** (after 20: 0.68 and
  0.79 against 0.27 and 0.67). The fit is ahead after 4 (0.18 and 0.60 against -0.15 and 0.24): it
  learns fast, and ends at what the model can do. It gives a twin of the sensor. For the
  electrodes alone, from 8 touches on, use the regression.
* **Force alone predicts little.** Nothing explains finger 1; on finger 2 the fit explains 0.23 and
  ridge regression 0.21. The same force is at different places.
* **Proximal electrodes.** On the real fingers E19 rises in each touch, by 20 to 160 counts, and E18
  in most; simulated ones fall when the pad is pressed near them. Their variance is small, so a
  wrong mean gives -5 to -57. E15 is predicted badly, too.
* **E17**, under the pad, falls by up to 1,300 and 1,900 counts; in the touch of finger 2 that is
  drawn the real one falls by more than twice what is predicted.
* **Skin and fill are the twin's.** At which force the skin meets the core, and with what pressure,
  depends on both; a real finger with less fluid closes its film at a smaller force. Fitting them
  needs a library for each; nothing here says what they would explain of what is left.
* **What was touched** hardly shows: with spheres of 14 mm instead of a plate about as much is
  explained. Fewer presses explain less on finger 1.
* **Parameters are not measurements.** With touches the core sits half as far forward as the counts
  at
  rest alone say, the counts at rest are left with 58 instead of 36 to 39, and the clamp goes to its
  bound. Film at infinite pressure, squeeze pressure and exponent stay at their priors: touches of 3
  to 7 N under an unknown place say nothing of them.
* **Temperature.** The idle sensor beside rose by 160 counts in the three minutes of finger 1, by
  70 in those of finger 2: as much as E18 and E19 move. Each touch has its own temperature, but how
  much of it the other parameters take up is not known.
* **Not blind.** That a recording's places are learned from its first touches, the prior of the
  temperature and the weight of the counts at rest were chosen after a look at the later touches of
  both fingers.
  There is no third one to test them on. Nor was it tried blind whether the real force has the axes
  that it is read in, which rest on a correlation.
"""


def cell(finger: dict[str, Any], count: int, method: str, what: str) -> str:
    """What one method explains, of the numbers of one finger."""
    found = finger["scores"][str(count)].get(f"{method}; {what}")
    if found is None:
        return "-"
    low, high = found["explained_5_95"]
    return (
        f"{found['explained']:.2f} ({low:.2f} to {high:.2f}) [{found['median_error_counts']:.0f}]"
    )


def page_of(content: dict[str, Any]) -> str:
    """The page, of all numbers."""
    plate = f"plate, {PRESSES[PLATE]} presses"
    fingers = content[plate]["fingers"]
    given = [f"given: {what}" for what in GIVEN]
    rows = [
        [name, method, *(cell(finger, HEADLINE, method, what) for what in GIVEN)]
        for name, finger in fingers.items()
        for method in METHODS
    ]
    curve = [
        [name, method, *(cell(finger, count, method, GIVEN[1]) for count in TOUCHES)]
        for name, finger in fingers.items()
        for method in (METHODS[1], METHODS[4])
    ]
    guesses = [
        [name, library]
        + [cell(some["fingers"][name], HEADLINE, METHODS[4], what) for what in GIVEN]
        for name in fingers
        for library, some in content.items()
    ]
    columns = {"nominal": SpecimenParameters()}
    left = ["counts at rest, left by the fit", "-"]
    for name, finger in fingers.items():
        for count, words in ((0, "rest"), (HEADLINE, "and touches")):
            fit = finger["fits"][str(count)]
            columns[f"{name}, {words}"] = SpecimenParameters.from_json(json.dumps(fit["specimen"]))
            left.append(f"{fit['found']['rest_error_counts']:.0f}")
    parameters = [
        [words, *(f"{of(one):.3g}" for one in columns.values())] for words, of in ELECTRICAL
    ]
    head = HEAD.format(
        counts=" and ".join(f"{one['touches']} of {name}" for name, one in fingers.items()),
        headline=HEADLINE,
        presses=PRESSES[PLATE],
        lean_low=LEAN_DEG[0],
        lean_high=LEAN_DEG[1],
        side_low=SIDE_DEG[0],
        side_high=SIDE_DEG[1],
        oblique=OBLIQUE_DEG,
        most=MOST_N,
        edge=EDGE_M * 1e3,
        fill=ExperimentSpec().fluid_volume_m3 * 1e6,
    )
    return "".join(
        [
            head,
            markdown_table(["finger", "method", *given], rows, words=2),
            CURVE,
            markdown_table(
                ["finger", "method", *(f"{n} touches" for n in TOUCHES)], curve, words=2
            ),
            GUESSES.format(headline=HEADLINE),
            markdown_table(["finger", "library", *given], guesses, words=2),
            PARAMETERS,
            markdown_table(["", *columns], [*parameters, left]),
            NOTES,
        ]
    )


def as_json(fingers: list[Finger]) -> dict[str, Any]:
    """All numbers of one library."""
    return {
        "headline": HEADLINE,
        "fingers": {
            finger.touches.name: {
                "touches": len(finger.touches),
                "tested": len(finger.test),
                "force_n_0_50_100": np.percentile(
                    np.linalg.norm(finger.touches.force, axis=1), [0, 50, 100]
                ).tolist(),
                "fits": {
                    str(count): {
                        "specimen": asdict(fit.specimen),
                        "found": fit.member(count).found,
                        "rounds": fit.rounds,
                    }
                    for count, fit in finger.fits.items()
                },
                "scores": {
                    str(count): {f"{m}; {w}": one.summary() for (m, w), one in scores.items()}
                    for count, scores in finger.scores.items()
                },
            }
            for finger in fingers
        },
    }


def library_of(folder: Path, indenter: str) -> tuple[ElectrodeModel, PressLibrary]:
    """The library of an indenter, with the nominal specimen on its fingertip."""
    path = folder / f"{indenter}.sim"
    complete_library(path, indenter)
    store = SimulationStore.open(path)
    sensor = ElectrodeModel(geometry_of(store.fingertip()))
    return sensor, read_library(store, sensor)


def first(library: PressLibrary, presses: int) -> PressLibrary:
    """The library of the first presses alone."""
    count = int(np.searchsorted(library.press, presses))
    return PressLibrary(
        library.rest,
        library.gaps[:count],
        library.force[:count],
        library.place[:count],
        library.press[:count],
    )


def main(folder: Path, stores: Path) -> None:
    """Simulate what lacks, fit, compare, write."""
    sensor, library = library_of(stores, PLATE)
    fingers = [studied(sensor, library, one) for one in touches_of_fingers(folder)]
    few = PRESSES[SPHERE]
    others = {
        f"plate, {few} presses": [
            studied(sensor, first(library, few), one.touches, (HEADLINE,)) for one in fingers
        ],
        f"sphere of 14 mm, {few} presses": [
            studied(*library_of(stores, SPHERE), one.touches, (HEADLINE,)) for one in fingers
        ],
    }
    draw(OUT / "sensor-fit.png", fingers)
    every = {f"plate, {library.presses} presses": fingers, **others}
    content = {name: as_json(some) for name, some in every.items()}
    text = json.dumps(content, indent=1) + "\n"
    (OUT / "sensor-fit.json").write_text(text, encoding="utf-8")
    (OUT / "sensor-fit.md").write_text(page_of(content), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
