r"""Write docs/results/population.md: a large simulated set, and one network for its specimens.

    palpate fem units draw 120 --seed 2 --out units.json
    palpate data generate FOLDER --random 20000 --fingertips 20 --seed 2 --units units.json \
        --units-each 2 ...
    python docs/make_population.py --set FOLDER/fingertip-*             statistics of the set
    palpate data features FOLDER/fingertip-*/mixed.h5 features.h5
    palpate train population features.h5 OUT                            OUT/population.json
    python docs/make_population.py --network OUT                        keeps that report
    ... draw 240 --seed 3, --random 40000 --fingertips 40 --seed 3 and a plate (LOG), OUT of it
    python docs/make_population.py --second OUT                         network and report ship
    python docs/make_population.py                                      page and pictures

What the commands wrote is in docs/results/population.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_fem.random_presses import segments_of
from palpate_training.datasets.experiment import MixedDataset, read_mixed
from palpate_training.figures.style import (
    finish,
    grid,
    label,
    markdown_table,
    new_figure,
    unit_colour,
)
from palpate_training.learning.population_net import WEIGHTS
from palpate_training.learning.told_finger import REPORT

Floats = NDArray[np.floating[Any]]

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "results" / "population"
PAGE = FOLDER.with_suffix(".md")
SET = "set.json"
SHIPPED = ROOT / "training" / "palpate_training" / "samples"
"""Takes network and report of the second set."""

ENDS = (5.0, 50.0, 95.0)
SKINS = {
    "skin's thickness [mm]": ("skin_thickness_m", 1e3),
    "skin's shear modulus [kPa]": ("shear_modulus_pa", 1e-3),
    "fluid [ml]": ("fluid_volume_m3", 1e6),
    "friction [1]": ("friction_coefficient", 1.0),
}
HARD_N = 2.0
CELLS = {
    "seen_specimen_seen_press": "learned from",
    "seen_specimen_unseen_press": "press not met",
    "unseen_specimen_seen_press": "specimen not met",
    "unseen_specimen_unseen_press": "fingertip not met",
}
FIGURES = {
    "force_magnitude_n": "force [N]",
    "force_from_2n_percent": "force from 2 N [%]",
    "force_angle_rad": "its angle [rad]",
    "contact_location_mm": "contact location [mm]",
    "centre_of_pressure_mm": "centre of pressure [mm]",
    "normal_angle_rad": "contact normal [rad]",
}

BOUND_OF = {"force_magnitude": ("force", 1.0, "N"), "contact_location": ("location", 1e3, "mm")}
"""What a bound is of, by name; the factor of its unit."""


def statistics(folders: list[Path]) -> dict[str, Any]:
    """Numbers and bands of a set on one or several fingertips, each in a folder of its own."""
    rows: dict[str, list[Floats]] = {}
    planned: dict[str, list[float]] = {key: [] for key in ("tilt", "depth", "slide", "twist")}
    skins: dict[str, list[float]] = {key: [] for key in SKINS}
    indenters: Counter[str] = Counter()
    count: Counter[str] = Counter()
    loss_um, digests, maps = [], [], []
    for folder in folders:
        data = read_mixed(folder / "mixed.h5")
        spec = json.loads((folder / "experiment.json").read_text(encoding="utf-8"))["spec"]
        for name, column in columns(data).items():
            rows.setdefault(name, []).append(column)
        for name in data.experiment.trajectories:
            first, *move = segments_of(spec["seed"], number_of(name))
            planned["tilt"].append(math.degrees(first.angle_rad))
            planned["depth"].append(1e3 * (first.amount or 0.0))
            for one in move:
                far = abs(one.amount or 0.0)
                planned[one.kind].append(1e3 * far if one.kind == "slide" else math.degrees(far))
        for name, (key, factor) in SKINS.items():
            skins[name].append(factor * spec[key])
        indenters.update(data.experiment.indenters)
        count["presses planned"] += spec["presses"]
        count["presses with rows"] += len(data.experiment.trajectories)
        count["trials"] += data.experiment.trials
        count["rows"] += len(data)
        count["specimens"] += len(data.experiment.unit_names)
        loss_um.append([1e6 * data.basis.loss_mean, float(len(data.basis.modes))])
        digests.append(data.experiment.provenance.input_sha256)
        maps.append(placed(data))
    values = {name: np.concatenate(some) for name, some in rows.items()}
    loss, modes = np.transpose(loss_um)
    bands: dict[str, Any] = {
        "tilt [deg]": planned["tilt"],
        "depth [mm]": planned["depth"],
        "slide, of those that do [mm]": planned["slide"],
        "twist, of those that do [deg]": planned["twist"],
        **values,
        **skins,
    }
    return {
        "numbers": {
            "fingertips": len(folders),
            **count,
            "presses that slide": len(planned["slide"]),
            "presses that twist": len(planned["twist"]),
            f"share of rows from {HARD_N:g} N": float(np.mean(values["force [N]"] >= HARD_N)),
            "share of rows from 8 N": float(np.mean(values["force [N]"] >= 8.0)),
            "modes of the displacement, mean of the fingertips": float(modes.mean()),
            "mean error of the modes [um]": float(loss.mean()),
            "indenters": dict(sorted(indenters.items())),
        },
        "input_sha256": digests,
        "bands": {
            name: np.percentile(some, ENDS).tolist() for name, some in bands.items() if len(some)
        },
        "map": maps[0] | {"rows": np.sum([one["rows"] for one in maps], axis=0).tolist()},
    }


def number_of(name: str) -> int:
    """Number of a press at random, by its name."""
    found = re.fullmatch(r"[^/]+/(\d+)/random", name)
    if found is None:
        raise SystemExit(f"{name} is no press at random")
    return int(found[1])


def columns(data: MixedDataset) -> dict[str, Floats]:
    """Values of every row that bands are made of."""
    experiment, contact = data.experiment, data.contact
    assert contact is not None
    force = np.linalg.norm(experiment.force, axis=1)
    along = np.abs(np.sum(data.simulated_force * contact.normal, axis=1))
    across = np.sqrt(np.maximum(np.sum(data.simulated_force**2, axis=1) - along**2, 0.0))
    tared = 4095.0 * experiment.tared.astype(np.float64)
    hard = tared[force >= HARD_N]
    last = np.flatnonzero(np.diff(experiment.trial, append=-1))
    found: dict[str, Floats] = {
        "force [N]": force,
        "largest force of a press [N]": np.maximum.reduceat(
            force, np.flatnonzero(np.diff(experiment.trial, prepend=-1))
        ),
        "shear over normal force [1]": across / np.maximum(along, 1e-9),
        "travel from 0.5 N to the end [mm]": 1e3 * experiment.travel_m[last],
        "contact location x [mm]": 1e3 * experiment.location[:, 0],
        "contact location y [mm]": 1e3 * experiment.location[:, 1],
        "centre of pressure x [mm]": 1e3 * contact.centre[:, 0],
        "centre of pressure y [mm]": 1e3 * contact.centre[:, 1],
        "location to centre of pressure [mm]": 1e3
        * np.linalg.norm(experiment.location - contact.centre, axis=1),
        "contact normal to straight down [deg]": np.degrees(
            np.arccos(np.clip(-contact.normal[:, 2], -1.0, 1.0))
        ),
        f"electrodes that rise, from {HARD_N:g} N": (hard > 0.0).sum(axis=1).astype(np.float64),
        f"most negative electrode from {HARD_N:g} N [counts]": hard.min(axis=1),
        f"most positive electrode from {HARD_N:g} N [counts]": hard.max(axis=1),
        f"mean of the electrodes from {HARD_N:g} N [counts]": hard.mean(axis=1),
    }
    for electrode in (1, 7, 8, 10, 17, 19):
        found[f"E{electrode} at rest [counts]"] = experiment.trial_rest[:, electrode - 1]
        found[f"E{electrode} from {HARD_N:g} N [counts]"] = hard[:, electrode - 1]
    return {name: np.asarray(values, np.float64) for name, values in found.items()}


def placed(data: MixedDataset) -> dict[str, Any]:
    """How many rows have their centre of pressure where, on a grid of 0.5 mm."""
    assert data.contact is not None
    points = data.contact.centre
    x, y = np.arange(-18.0, 8.01, 0.5), np.arange(-8.0, 8.01, 0.5)
    count, _, _ = np.histogram2d(1e3 * points[:, 0], 1e3 * points[:, 1], bins=(x, y))
    return {"x_mm": x.tolist(), "y_mm": y.tolist(), "rows": count.astype(int).tolist()}


def draw_set(found: dict[str, Any], path: Path) -> None:
    """Where and how hard the set was pressed, and what electrodes make of it."""
    figure = new_figure(9.5, 3.4)
    where, electrodes = figure.subplots(1, 2)
    grid_of = found["map"]
    rows = np.array(grid_of["rows"], float).T
    rows[rows == 0.0] = np.nan
    where.pcolormesh(grid_of["x_mm"], grid_of["y_mm"], rows, cmap="Blues")
    where.set_aspect("equal")
    label(where, "x, to the tip [mm]", "y [mm]", "rows by centre of pressure")
    names = [name for name in found["bands"] if name.startswith("E") and "from" in name]
    for k, name in enumerate(names):
        low, middle, high = found["bands"][name]
        electrodes.plot([k, k], [low, high], color=unit_colour(0), lw=5, solid_capstyle="butt")
        electrodes.plot([k], [middle], "o", color="white", ms=4)
    electrodes.set_xticks(range(len(names)), [name.split()[0] for name in names])
    label(electrodes, "", "tared counts", f"5 to 95 % of rows from {HARD_N:g} N, and median")
    grid(electrodes, "y")
    finish(figure, path, "The set", "Pad seen through the skin; the clamp is at x = -14 mm.")


def draw_network(report: dict[str, Any], path: Path) -> None:
    """Errors on presses that were not met, beside those of ridge and constant."""
    figure = new_figure(11.0, 3.2)
    shown = [key for key in FIGURES if key != "force_angle_rad"]
    met, never = (report["cells"][cell] for cell in list(CELLS)[1::2])
    shots = never["shots"]
    known = [key for key in shots if key.isdigit()]
    for k, (axes, key) in enumerate(zip(figure.subplots(1, len(shown)), shown, strict=True)):
        bars = [
            ("finger met", met["network"][key], unit_colour(0)),
            *((f"{n} known", shots[n]["network"][key], unit_colour(1)) for n in known),
            ("ridge", never["ridge"][key], "0.7"),
            ("constant", never["constant"][key], "0.85"),
        ]
        axes.bar([name for name, _, _ in bars], [value for _, value, _ in bars],
                 color=[colour for _, _, colour in bars])  # fmt: skip
        axes.tick_params(axis="x", rotation=60)
        label(axes, "", "median error" if k == 0 else "", FIGURES[key])
        grid(axes, "y")
    told = (
        "Presses that were not met, of specimens that were (finger met) and of fingertips that "
        "were not, of which so many other presses are known; ridge and constant on the latter. "
        f"Seed {report['seed']}."
    )
    finish(figure, path, "One network for all fingers", told)


def cells_table(reports: list[dict[str, Any]]) -> str:
    """A row for each quantity; means over the seeds, their range, and the rivals."""
    rows = []
    for key, name in FIGURES.items():
        cells = []
        for cell in CELLS:
            values = [report["cells"][cell]["network"][key] for report in reports]
            spread = f" ({min(values):.3g}-{max(values):.3g})" if len(values) > 1 else ""
            cells.append(f"{np.mean(values):.3g}{spread}")
        never = [last_cell(report) for report in reports]
        rivals = [np.mean([one[rival][key] for one in never]) for rival in ("ridge", "constant")]
        rows.append([name, *cells, *(f"{value:.3g}" for value in (moved(never, key), *rivals))])
    head = ["median error", *CELLS.values(), "all electrodes off by 0.05", "ridge", "constant"]
    return markdown_table(head, rows)


def moved(cells: list[dict[str, Any]], figure: str) -> float:
    """Error with all electrodes off by 0.05: the worse of both signs, means over the seeds."""
    return max(
        float(np.mean([cell[f"network, all {offset}"][figure] for cell in cells]))
        for offset in ("+0.05", "-0.05")
    )


def shots_table(reports: list[dict[str, Any]]) -> str:
    """A row for each quantity: errors by number of known presses, of fingers met and not met."""
    met, never = (
        [report["cells"][cell]["shots"] for report in reports] for cell in list(CELLS)[1::2]
    )
    shots = sorted((key for key in never[0] if key.isdigit()), key=int)
    most = shots[-1]
    rows = []
    for figure, name in FIGURES.items():
        known = np.array([[one[n]["network"][figure] for n in shots] for one in never])
        of_met = np.array([one[most]["network"][figure] for one in met])
        factor = np.mean([one[most]["one factor"][figure] for one in never])
        off = moved([one[most] for one in never], figure)
        ratio = known[:, -1] / of_met
        rows.append(
            [name, f"{of_met.mean():.3g}", *(f"{value:.3g}" for value in known.mean(axis=0)),
             f"{ratio.mean():.2f}"
             + f" ({ratio.min():.2f}-{ratio.max():.2f})" * (len(reports) > 1),
             f"{factor:.3g}" if "force" in figure else "", f"{off:.3g}"]
        )  # fmt: skip
    head = ["median error", f"finger met, {most}", *(f"not met, {key}" for key in shots)]
    return markdown_table([*head, "ratio", f"one factor, {most}", "all off by 0.05"], rows)


def show(value: float) -> str:
    """A number of a band."""
    return f"{value:,.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def page(found: dict[str, Any], reports: list[dict[str, Any]], second: dict[str, Any]) -> str:
    """All of it."""
    numbers, first = found["numbers"], reports[0]
    bands = [[name, *(show(value) for value in values)] for name, values in found["bands"].items()]
    counted = ", ".join(f"{name} {count:,}" for name, count in numbers["indenters"].items())
    facts = "\n".join(
        f"* {name}: {value:,.3f}" if isinstance(value, float) else f"* {name}: {value:,}"
        for name, value in numbers.items()
        if name != "indenters"
    )
    table = markdown_table(["of all rows, trials or presses", "5 %", "median", "95 %"], bands)
    text = [HEAD, found["told"], "", facts, f"* presses by indenter: {counted}", ""]
    text += ["![the set](population/set.png)", "", table]
    unseen = len(first["unseen_specimens"])
    text.append(
        NETWORK.format(
            **first["rows"],
            specimens=first["specimens"],
            fingertips=first["fingertips"],
            presses=first["presses"],
            sha=first["data_sha256"],
            unseen=unseen,
            seeds=len(reports),
        )
    )
    text += [cells_table(reports), SHOTS.format(**last_cell(first)["shots"]), shots_table(reports)]
    text += ["![network](population/network.png)", "", *second_set(second), told(reports, second)]
    return "\n".join(text)


def second_set(report: dict[str, Any]) -> list[str]:
    """Errors and bounds on the fingertips of the second set that were not met."""
    shots = last_cell(report)["shots"]
    head = SECOND_SET.format(
        **report["rows"],
        presses=report["presses"],
        fingertips=report["fingertips"],
        specimens=report["specimens"],
        sha=report["data_sha256"],
        seed=report["seed"],
        epochs=report["config"]["epochs"],
        count=shots["specimens"],
        rows=shots["rows"],
    )
    return [head, shots_table([report]), BOUNDS, bounds_table(shots)]


def bounds_table(shots: dict[str, Any]) -> str:
    """How often bounds hold, by quantity and number of known presses."""
    rows = []
    for name, (what, factor, unit) in BOUND_OF.items():
        for known in sorted((key for key in shots if key.isdigit()), key=int):
            one = shots[known]["bounds"][name]
            low, high = (100.0 * end for end in one["ci95"])
            error, bound = (f"{factor * one[key]:.3g} {unit}" for key in ("error", "bound"))
            rows.append(
                [f"{what}, {known} presses known", f"{100.0 * one['held']:.1f} %",
                 f"{low:.1f} to {high:.1f} %", f"{100.0 * one['worst']:.0f} %", bound, error]
            )  # fmt: skip
    head = ["bound of", "holds", "95 % interval", "worst specimen", "median bound", "median error"]
    return markdown_table(head, rows)


def last_cell(report: dict[str, Any]) -> dict[str, Any]:
    """That of fingertips that were not met."""
    return dict(report["cells"][list(CELLS)[-1]])


HEAD = """# A population of simulated BioTacs

A large set of presses on many different simulated fingertips, and how well one network estimates
forces on fingers that it was not trained on.
Made by `python docs/make_population.py`; its docstring names the commands that make the data.
Everything here is simulated. A *fingertip* has a skin, fill and friction of its own and is indented
by finite elements. Each fingertip has several *specimens*, which differ in electrodes, fluid, place
of the core, noise and warmth ([priors](twin/units.md), `palpate_fem.population.fingertips`).

## The set
"""

SECOND_SET = """## A second set, and bounds

{presses:,} more presses ({all:,} rows) on {fingertips} other fingertips with {specimens} other
specimens; a plate is among the indenters ([LOG](../../training/LOG.md)). Content of the features
file: sha256 {sha}.
The same network, learned from {train:,} of these rows (seed {seed}, {epochs} passes), ships. It is
[one of the estimators](../adr/0025-calibrated-fingers.md) of `palpate calibrate`. Its errors on
{count} specimens of fingertips not met, on the same {rows:,} rows for any number of known presses:
"""

BOUNDS = """Bounds of 90 % were learned on presses of one half of these fingertips and tested on
the other half, then the other way round. So neither the network nor the bound was learned on the
tested specimen or its skin. Goal: a bound holds in 90 ± 3 %, where each specimen counts the same,
and so does each of its presses:
"""

NETWORK = """## One network for all specimens

`palpate train population` ({all:,} rows of {presses:,} presses, of which {train:,} rows are learned
from; content of the features file: sha256 {sha}). The inputs are the change of the logarithm of
each impedance since rest and, if some presses of the specimen are known, these presses (by FiLM).
Not in the training are:

* *fingertip not met*: three of the {fingertips} fingertips, with all their specimens and presses;
* *specimen not met*: 15 % of the specimens of the other fingertips (their presses are met, on other
  specimens). With the former, {unseen} of {specimens} specimens are not met;
* *press not met*: a tenth of the presses on the other fingertips.

Rows have at least 0.5 N. The network was trained on one H200, 50 to 60 passes in 1 to 2 minutes.

In the first table no press is known: means over {seeds} seeds, and their range in brackets.
Each seed leaves out other fingertips; settings were chosen on those of seed 0. The last three
columns are means as well, for the fingertips not met: the network when all electrodes are off by
0.05 of a logarithm, as with a fluid that has warmed since the tare (the worse of both signs), and
two simple estimators on the same inputs.
"""

SHOTS = """In the second table presses of the finger are known. *Not met* and the number of known
presses: {specimens} specimens of fingertips not met, {draws} draws of known presses of each, tested
on presses at other points, none of them in the training; the same {rows:,} rows for any number of
presses. *Finger met*: specimens that were met, tested on presses that were not. *Ratio*: error on
fingers not met over that on fingers met, both with ten presses (goal 1.2). *One factor*: the
network's estimate without a press, times the one factor that fits the known presses best.
"""

TOLD = """## What it says

* **With ten presses, a finger that training has not met is estimated as well as one that it has**:
  errors of {force_10:.3f} and {met:.3f} N, a ratio of {ratio:.2f} (goal 1.2). Without a press the
  error is {force_0:.2f} N, because all forces of a finger are too small or too large by one factor;
  with one press it is {force_1:.2f} N, with five {force_5:.2f} N. If only one factor is fitted to
  the ten presses, it is {factor:.2f} N. Centre and normal have ratios of {ratio_centre:.2f} and
  {ratio_normal:.2f}; on the second set all ratios are {ratio_second}.
* **The electrodes at rest are not an input of the network.** With them it would recognise each
  specimen of the training: known presses then do not help, and errors on fingers not met are twice
  as large ([LOG](../../training/LOG.md)).
* **A new skin is no worse than a new specimen on a known skin**: on specimens not met the force is
  off by {specimen:.2f} N without a press and by {specimen_10:.2f} N with ten.
* **The place of the contact hardly depends on known presses**: with ten presses, the errors are
  {centre:.2f} mm for the centre of pressure and {normal:.1f} degrees for the contact normal (a
  constant: {centre_constant:.0f} mm and {normal_constant:.0f} degrees). Ten presses reduce the
  error of the location from {location_0:.2f} to {location_10:.2f} mm (goal 0.8).
* **From 2 N on the force is inaccurate**: off by {hard:.0f} % with ten presses, by {hard_met:.0f} %
  on specimens that were met (goal 8). Beside the pad the skin is pinched on the core, and forces
  grow while electrodes hardly change. Wider networks and more passes overfit: they are better on
  presses of the training and worse on others. With half as many presses again, 31 % become 29 %
  (LOG).
* **Bounds hold on specimens and skins that were not met**, once a press is known: for {held_1:.0f}
  % of the forces and {held_location:.0f} % of the locations (nominal 90). Without a press the bound
  of force holds in {held_0:.0f} %, because whole specimens are off by one factor.
* **A common offset hardly matters**: with 0.05 of a logarithm on all electrodes, the force is off
  by {offset:.2f} N with ten presses.
* **On real fingers the network does not help** the method for [fingers never met](transfer.md):
  mixing a quarter of its magnitude into the estimate makes it worse on both fingers (LOG). What
  touched these fingers is not known. A plate explains their signals as well as any indenter
  ([fit to a sensor](twin/sensor-fit.md)), but a network of the second set, which contains a plate,
  is not better on them.\
"""


def told(reports: list[dict[str, Any]], second: dict[str, Any]) -> str:
    """What the page says of the reports, by means over the seeds."""

    def mean(of: Callable[[dict[str, Any]], float]) -> float:
        return float(np.mean([of(report["cells"]) for report in reports]))

    _, met, specimen, never = CELLS
    key, hard = "force_magnitude_n", "force_from_2n_percent"

    def known(cell: str, shots: str, figure: str = key, who: str = "network") -> float:
        return mean(lambda cells: cells[cell]["shots"][shots][who][figure])

    def ratio(figure: str) -> float:
        return mean(
            lambda cells: (
                cells[never]["shots"]["10"]["network"][figure]
                / cells[met]["shots"]["10"]["network"][figure]
            )
        )

    def constant(figure: str) -> float:
        return mean(lambda cells: cells[never]["constant"][figure])

    shots = last_cell(second)["shots"]
    held = {
        f"held_{key}": 100.0 * shots[known]["bounds"][name]["held"]
        for key, known, name in (
            ("0", "0", "force_magnitude"),
            ("1", "1", "force_magnitude"),
            ("location", "1", "contact_location"),
        )
    }
    met_second, never_second = (
        second["cells"][cell]["shots"]["10"]["network"] for cell in (met, never)
    )
    ratios = [never_second[figure] / met_second[figure] for figure in FIGURES]
    return TOLD.format(
        **held,
        ratio_second=f"{min(ratios):.2f} to {max(ratios):.2f}",
        met=known(met, "10"),
        **{f"force_{n}": known(never, n) for n in ("0", "1", "5", "10")},
        ratio=ratio(key),
        factor=known(never, "10", who="one factor"),
        ratio_centre=ratio("centre_of_pressure_mm"),
        ratio_normal=ratio("normal_angle_rad"),
        specimen=known(specimen, "0"),
        specimen_10=known(specimen, "10"),
        location_0=known(never, "0", "contact_location_mm"),
        location_10=known(never, "10", "contact_location_mm"),
        centre=known(never, "10", "centre_of_pressure_mm"),
        normal=math.degrees(known(never, "10", "normal_angle_rad")),
        centre_constant=constant("centre_of_pressure_mm"),
        normal_constant=math.degrees(constant("normal_angle_rad")),
        hard=known(never, "10", hard),
        hard_met=known(met, "10", hard),
        offset=moved([last_cell(report)["shots"]["10"] for report in reports], key),
    )


def main() -> None:
    """Keep statistics or a report, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--set", type=Path, nargs="+", help="folders of presses at random")
    parser.add_argument("--told", default="", help="what is to be said of the set")
    parser.add_argument("--network", type=Path, metavar="FOLDER", help="a report to keep")
    parser.add_argument("--second", type=Path, metavar="FOLDER", help="that of the second set")
    options = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    if options.set:
        found = statistics(options.set)
        text = json.dumps({"told": options.told} | found, indent=1)
        (FOLDER / SET).write_text(text + "\n", encoding="utf-8")
        return
    if options.second:
        for name in (WEIGHTS, REPORT):
            shutil.copyfile(options.second / name, SHIPPED / name)
        return
    if options.network:
        report = json.loads((options.network / REPORT).read_text(encoding="utf-8"))
        path = FOLDER / f"network-seed{report['seed']}.json"
        path.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        return
    found = json.loads((FOLDER / SET).read_text(encoding="utf-8"))
    kept = sorted(FOLDER.glob("network-*.json"))
    reports = [json.loads(path.read_text(encoding="utf-8")) for path in kept]
    draw_set(found, FOLDER / "set.png")
    draw_network(reports[0], FOLDER / "network.png")
    second = json.loads((SHIPPED / REPORT).read_text(encoding="utf-8"))
    PAGE.write_text(page(found, reports, second).rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
