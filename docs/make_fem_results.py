"""Write docs/results/fem.md from the output of the commands that it names.

``python docs/make_fem_results.py [STORE [NAME]]`` reads docs/results/fem/*.json. The indentations
of a store are first summarised in docs/results/fem/NAME.json; without a name, in campaign.json.
"""

from __future__ import annotations

import json
import sys
import textwrap
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from palpate_training.figures.style import finish, grid, label, new_figure, unit_colour

RESULTS = Path(__file__).parent / "results"
DATA = RESULTS / "fem"

HEAD = """# The fingertip in finite elements: measured results

Measured on two cores of a shared virtual machine, unless a section names another. A dense matrix
product on both cores reaches {peak:.0f} GFlop/s in double and {single:.0f} in single precision.
`python docs/make_fem_results.py` writes this page from the output of the commands below, which is
kept in `fem/`.
"""


def load(name: str) -> Any:
    """Output of a command."""
    return json.loads((DATA / f"{name}.json").read_text())


def table(headings: list[str], rows: list[list[str]]) -> str:
    """Markdown table whose first column is text."""
    rule = ["---", *["---:"] * (len(headings) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in [headings, rule, *rows]) + "\n"


def sum_up(path: Path, name: str = "campaign") -> None:
    """Summarise a store, one line for each indentation."""
    from palpate_fem.store.read import SimulationStore

    store, rows = SimulationStore.open(path), []
    for trajectory in store.ids():
        run = store.trajectory(trajectory)
        rows.append(
            {
                "name": trajectory,
                "outcome": run.outcome.value,
                "reason": run.reason,
                "steps": len(run.steps),
                "travel_mm": round(run.travel_m * 1e3, 4),
                "force_n": round(float(np.linalg.norm(run.forces[-1])), 4) if run.steps else None,
                "penetration_um": round(
                    1e6 * max((s.convergence.penetration_m for s in run.steps), default=0.0), 3
                ),
                "iterations": sum(s.convergence.iterations for s in run.steps),
                "seconds": round(run.seconds, 2),
            }
        )
    text = ",\n".join(json.dumps(row) for row in rows)
    (DATA / f"{name}.json").write_text(f"[\n{text}\n]\n")


def speed() -> str:
    """The benchmark."""
    bench = load("bench")
    rows = []
    for name, what in (("normal", "3 mm along the normal"), ("angled", "1.5 mm at 30 degrees")):
        parts = [bench[f"{name}.{part}_s"] for part in PARTS]
        rows.append(
            [what, f"**{bench[f'{name}.seconds']:.1f}**", *[f"{part:.1f}" for part in parts]]
            + [f"{bench[f'{name}.{count}']:.0f}" for count in ("iterations", "factorisations")]
        )
    return (
        f"""
## Speed

`palpate fem bench --json`: sphere of 7 mm, friction and core contact, 20 steps,
{bench["system.unknowns"]:,.0f} unknowns. The goal is {bench["goal.trajectory_s"]:.0f} s; the
paper's model took 420 s on six processors. The columns from *factorise* to *rest* are seconds, too.

"""
        + table(["indentation", "seconds", *PARTS, "iterations", "factorisations"], rows)
        + f"""
The fingertip is filled once, in {bench["pressurise.seconds"]:.1f} s. A whole factorisation takes
{bench["solver.whole_factorisation_s"] * 1e3:.0f} ms for {bench["solver.factor_gflop"]:.1f} GFlop,
that is {bench["solver.factor_gflops"]:.0f} GFlop/s or
{bench["solver.factor_share_of_single_peak"]:.0%} of the peak in single precision. A solve takes
{bench["solver.solve_s"] * 1e3:.0f} ms and is limited by memory bandwidth. Peak memory is
{bench["memory.peak_mib"]:.0f} MiB. [Mesh and steps](#mesh-and-steps) shows the cost against the
size of the mesh.
"""
    )


PARTS = ["factorise", "solve", "assemble", "residual", "rest"]


CLAMP = """
The long cylinder is as long as the finger. Where it is tilted towards the tip (`angled-0`), its
other end meets the rim that the clamp holds: the force is that of the rim, not of a pinch.

The skin *snaps* if the force falls while a ball or a cylinder moves in; the trajectory ends
before that step. It happens where 1.2 to 1.4 mm of the 1.57 mm of skin are squeezed
away. Before the snap the force does not depend on the mesh: at 3.35 mm under `sphere_medium` it is
12.15 N with edges of 0.6 mm and 12.14 N with 0.45 mm. The force at the snap does: 17 and 22.5 N. A
volume barrier five times as stiff moves it to 22 N. So the force at which the skin snaps is a
property of the elements, which are stretched to three times their length there, and not of the
finger.
"""

PAPER_MM = {"normal": 3.0, "angled": 1.5}
CLEARANCE_MM = 0.05


def kind_of(run: dict[str, Any]) -> str:
    """Along the normal, or at an angle."""
    return "normal" if run["name"].endswith("normal") else "angled"


def outcome_of(run: dict[str, Any]) -> str:
    """How a run ended, in words of the table."""
    if run["outcome"] == "diverged":
        return "snapped" if "snaps" in run["reason"] else "no equilibrium"
    return str(run["outcome"])


def as_deep_as_the_paper(run: dict[str, Any]) -> bool:
    """Whether a run reached the paper's depth, or the largest force before it."""
    wanted = PAPER_MM[kind_of(run)] + CLEARANCE_MM - 1e-3
    return bool(run["travel_mm"] >= wanted or run["outcome"] == "force limit")


def ended_well(run: dict[str, Any]) -> bool:
    """Whether a path reached its end, or the force that ends it."""
    return bool(run["outcome"] in ("complete", "force limit"))


def early_ends(runs: Iterable[dict[str, Any]]) -> str:
    """A list of the paths that ended before their end, and why."""
    found = [
        f"* {run['name']}: {run['reason'].split(', ')[0]}, {run['travel_mm']:.2f} mm along the path"
        for run in runs
        if not ended_well(run)
    ]
    return ("\n".join(found) or "* none") + "\n"


def campaign() -> str:
    """Nine indenters, ten points, five ways."""
    runs = load("campaign")
    good = [run for run in runs if ended_well(run)]
    deep = [run for run in runs if as_deep_as_the_paper(run)]
    rows = []
    for name in dict.fromkeys(run["name"].split("/")[0] for run in runs):
        mine = [run for run in runs if run["name"].startswith(f"{name}/")]
        cells = [name]
        for kind in ("normal", "angled"):
            some = [run for run in mine if kind_of(run) == kind]
            force = [run["force_n"] for run in some if run["force_n"] is not None]
            count = Counter(map(outcome_of, some))
            cells += [
                ", ".join(f"{n} {how}" for how, n in count.items()),
                f"{min(force):.1f}-{max(force):.1f}",
            ]
        cells += [f"{np.mean([run['iterations'] for run in mine]):.0f}"]
        rows.append(cells)
    bad = {run["name"] for run in runs if not ended_well(run)}
    others_too = {}
    for mesh in ("0.47mm", "0.47mm-4-layers"):
        finer = {run["name"] for run in load(f"campaign-{mesh}") if not ended_well(run)}
        others_too[mesh] = f"{len(runs) - len(finer)} ({len(finer & bad)} fail on both meshes)"
    return (
        f"""
## Robustness

The paper's {len(runs)} trajectories, as `palpate data generate runs/twin` simulates them: edges of
0.6 mm, 0.60 ml of fluid, steps of 0.1 mm, friction. The paper presses 3 mm along the normal and
1.5 mm at 30 degrees. Here the *full depth* is 0.6 mm more: **{len(good)} of {len(runs)}
({len(good) / len(runs):.1%}) reach the full depth or 32 N** (the goal is 98 %), {len(deep)} reach
the paper's depth or 32 N. The deepest penetration of any converged step is
{max(run["penetration_um"] for run in runs):.2f} um.

A finer mesh does not help. Full depth or 32 N is reached by {others_too["0.47mm"]} with edges of
0.47 mm (`--edge-mm 0.47`), and by {others_too["0.47mm-4-layers"]} with four layers as well
(`--layers 4`).

These campaigns and the random paths ran on cores of other machines, 304 of the angled trajectories
with four layers on a GPU. With `--device cuda:0` 426 of the 450 reach the full depth or 32 N
([where they differ](fem-batched.md#all-450-trajectories)).

![All trajectories by indenter](../pictures/fem-campaign.png)

"""
        + table(
            ["indenter", "normal", "force [N]", "angled", "force [N]", "mean iterations"],
            rows,
        )
        + CLAMP
        + "\nNot to full depth or 32 N:\n\n"
        + early_ends(runs)
    )


def stiffening() -> str:
    """The same campaign with skins that stiffen."""
    softest = {run["name"]: run for run in load("campaign")}
    campaigns = {"none (neo-Hooke)": list(softest.values())}
    campaigns |= {value: load(f"campaign-stiffening-{value}") for value in ("0.004", "0.01")}
    rows = []
    for value, runs in campaigns.items():
        good = sum(map(ended_well, runs))
        larger = [
            run["force_n"] / softest[run["name"]]["force_n"] - 1
            for run in runs
            if kind_of(run) == "angled"
            and run["outcome"] == softest[run["name"]]["outcome"] == "complete"
        ]
        rows.append(
            [
                value,
                f"{good} of {len(runs)} ({good / len(runs):.1%})",
                str(sum(outcome_of(run) == "snapped" for run in runs)),
                str(sum(outcome_of(run) == "no equilibrium" for run in runs)),
                f"+{np.median(larger):.2%}, +{max(larger):.1%}" if any(larger) else "-",
                f"{np.mean([run['iterations'] for run in runs]):.0f}",
            ]
        )
    curves = load("stiffening-curves")
    return (
        """
## Skin that stiffens

Why skin snaps below small indenters: [ADR 23](../adr/0023-mortar-contact.md#why-it-snaps). The same
campaign with `palpate data generate FOLDER --strain-stiffening 0.004`, a value that published
constants of a soft silicone give, and with 0.01; firmer silicone stiffens more than that
([ADR 13](../adr/0013-skin-model-and-solver.md)). The goal is 98 % that reach the full depth or
32 N, and no snap: **with 0.01 no press snaps.** How much larger the force is at the end of presses
at 30 degrees (median, largest) says what a stiffening changes where no skin snaps.

"""
        + table(
            [
                "strain stiffening",
                "reach full depth or 32 N",
                "snap",
                "no equilibrium",
                "force at 30 degrees",
                "iterations each",
            ],
            rows,
        )
        + f"""
The picture shows two presses, each with three skins: `{curves["command"]}`, and the same with
`{curves["other"]}`.

![{draw_stiffening(curves, DATA / "stiffening.png")}](fem/stiffening.png)

"""
        + "\n".join(
            f"Not to full depth or 32 N with {value}:\n\n{early_ends(campaigns[value])}"
            for value in ("0.004", "0.01")
        )
    )


def draw_stiffening(study: dict[str, Any], path: Path) -> str:
    """Two presses that pinch the skin, with three skins; the caption."""
    figure = new_figure(8.0, 3.4)
    for axes, (indenter, skins) in zip(figure.subplots(1, 2), study["curves"].items(), strict=True):
        for number, (stiffening, run) in enumerate(skins.items()):
            axes.plot(
                run["depth_mm"][: len(run["force_n"])],
                run["force_n"],
                color=unit_colour(number),
                label="neo-Hooke" if stiffening == "none" else f"stiffening {stiffening}",
            )
            if not ended_well(run):
                axes.plot(run["depth_mm"][-1], run["force_n"][-1], "x", color="black")
        label(axes, "depth [mm]", "force [N]", indenter)
        axes.set_xlim(1.0)
        grid(axes)
    axes.legend(frameon=False, fontsize=8)
    return finish(
        figure,
        path,
        "Force where the skin is pinched, beside the middle of the pad",
        "Up to 2.8 mm the forces of the three are within 6 %. Cross: the skin snaps.",
    )


def paths() -> str:
    """Random paths, if they were run."""
    if not (DATA / "paths.json").exists():
        return ""
    study = load("paths")
    rows, cells = study["rows"], []
    whole = [row for row in rows if row["outcome"] == "complete"]
    for name in dict.fromkeys(row["indenter"] for row in rows):
        mine = [row for row in rows if row["indenter"] == name]
        done = [row for row in mine if row in whole]
        friction = [1e6 * row["friction_j"] for row in done]
        cells.append(
            [
                name,
                f"{len(done)} of {len(mine)}",
                f"{min(friction, default=0.0):.0f}-{max(friction, default=0.0):.0f}",
                f"{1e6 * min(row['friction_least_j'] for row in mine):.1g}",
                f"{1e6 * max((row['undone_m'] for row in done), default=0.0):.4f}",
                f"{np.mean([row['seconds'] for row in mine]):.0f}",
            ]
        )
    others = [
        f"* {row['indenter']} at {row['at_mm'][0]:g} {row['at_mm'][1]:g}, "
        f"`{row['words']}`: {row['outcome']} after {row['done']} of {row['steps']} steps, "
        f"{row['reason']}"
        for row in rows
        if row not in whole or row["friction_j"] < 0.0
    ]
    most = 1e6 * max(row["undone_m"] for row in whole)
    near = sum(row["undone_m"] <= 0.01e-6 for row in whole)
    gap = np.median([row["work_j"] / row["friction_j"] for row in whole])
    return (
        f"""
## Random paths

`palpate fem study paths --count {len(rows)} --edge-mm {1e3 * study["edge_m"]:g} --json`. A path is
a press of 0.5 to 2.5 mm, up to 30 degrees from the normal, then one to four segments (slide to
2 mm, twist to 40 degrees, roll to 20 degrees, press further, unload in part), and out of the skin.
**{len(whole)} of {len(rows)} ({len(whole) / len(rows):.1%}) complete** (the goal is 97 %).

* *Left*: the largest displacement of a node after a whole path, {most:.4f} um at most; {near} of
  {len(whole)} meet the goal of 0.01 um. It comes from the tolerance of contact's gaps, 1 nm; with
  0.1 um the same paths left up to 0.1 um, and took 1 % fewer iterations.
* *Friction*: traction times slip times area, summed over increments. The solver's tolerance allows
  that one increment gives back 1e-4 of a path's work.
* The work of the indenter should be that of friction. It is {gap:.2f} times as much in the median,
  because the mean of the wrench at both ends of an increment misses how it rises in between.

"""
        + table(
            ["indenter", "complete", "friction [uJ]", "least friction of an increment [uJ]",
             "left [um]", "mean seconds"],
            cells,
        )
        + "\nNot complete, or friction gave work back:\n\n"
        + ("\n".join(others) or "* none")
        + "\n"
    )  # fmt: skip


def studies() -> str:
    """Mesh and steps."""
    text = """
## Mesh and steps

`palpate fem study mesh --png mesh.png --json` and `palpate fem study steps --json`: three
indentations of 3 mm, and the *pinch*, a ball of 7 mm pressed 4 mm deep, which pinches the skin on
the core. A change is from one refinement to the next; that of displacement is over the whole outer
skin. Accepted is a last change of 2 % of the force and 0.02 mm of the mean displacement.

![What refinement changes](../pictures/fem-mesh-study.png)

"""
    text += half_the_size() + "\n"
    for name, first in (("mesh", "edge [mm]"), ("steps", "steps")):
        rows = [
            [
                row["press"],
                f"{row['edge_m'] * 1e3:g}" if name == "mesh" else str(row["steps"]),
                f"{row['unknowns']:,}",
                f"{row['force_n']:.4f}",
                *(
                    ["", "", ""]
                    if row["force_change"] is None
                    else [
                        f"{100 * row['force_change']:+.3f}",
                        f"{1e6 * row['displacement_change_m']:.2f}",
                        f"{1e6 * row['largest_change_m']:.1f}",
                    ]
                ),
                str(row["iterations"]),
                f"{row['seconds']:.1f}",
            ]
            for row in load(name)
        ]
        headings = ["press", first, "unknowns", "force [N]", "change [%]", "mean change [um]"]
        text += table([*headings, "largest change [um]", "iterations", "seconds"], rows) + "\n"
    return text


def half_the_size() -> str:
    """How far forces are from those of a mesh of half the size, where it has 35,000 unknowns."""
    rows = load("mesh")
    force = {(row["press"], row["edge_m"]): row["force_n"] for row in rows}
    edges = [edge for _, edge in force if ("pinch", edge / 2) in force]
    edge = min(edges)
    apart = {
        press: abs(force[press, edge] / force[press, edge / 2] - 1.0)
        for press, one in force
        if one == edge
    }
    told = ", ".join(f"{press} {value:.1%}" for press, value in apart.items())
    unknowns = next(row["unknowns"] for row in rows if row["edge_m"] == edge)
    return (
        f"Difference of the force on edges of {1e3 * edge:g} mm ({unknowns:,} unknowns) from that "
        f"on edges of half the length: {told} (goal: 2 %, in the pinch too).\n"
    )


def recovery() -> str:
    """Recovery of known parameters."""
    rows = []
    for path in sorted(DATA.glob("recover-*.json")):
        found = json.loads(path.read_text())
        rows.append(
            [path.stem.removeprefix("recover-"), f"{found['noise_n']:g}", str(found["seed"])]
            + [f"{100 * error:+.2f}" for error in found["error"].values()]
            + [str(found["simulations"]), "yes" if found["passed"] else "**no**"]
        )
    goals = ["goal", "", "", "2", "2", "5", "1", "", ""]
    return """
## Calibration recovers known parameters

`palpate fem recover --json` (and `--edge-mm 0.9 --seed N`): five indentations are
simulated with thickness 1.45 mm, modulus 330 kPa and friction 0.25, and noise is added to each axis
of the force. The calibration starts from its scan; the table has its errors. The same simulator
makes the forces and fits them, so this tests search and data processing, not the model.

""" + table(
        ["mesh", "noise [N]", "seed", "thickness [%]", "modulus [%]", "friction [%]", "volume [%]",
         "runs", "within"],
        [*rows, goals],
    )  # fmt: skip


def main() -> None:
    """Write the page."""
    if len(sys.argv) > 1:
        sum_up(Path(sys.argv[1]), *sys.argv[2:])
    bench = load("bench")
    page = HEAD.format(
        peak=bench["machine.peak_gflops"], single=bench["machine.single_peak_gflops"]
    )
    page += speed() + campaign() + stiffening() + paths() + studies() + recovery()
    (RESULTS / "fem.md").write_text("\n\n".join(map(flowing, page.strip().split("\n\n"))) + "\n")


def flowing(block: str) -> str:
    """Wrap a paragraph; leave tables, lists and headings as they are."""
    if block.lstrip()[:1] in ("|", "#", "*", "!"):
        return block.strip("\n")
    return textwrap.fill(" ".join(block.split()), 110, break_on_hyphens=False)


if __name__ == "__main__":
    main()
