"""Write docs/results/fem.md from the output of the commands that it names.

``python docs/make_fem_results.py [STORE]`` reads docs/results/fem/*.json. The indentations of a
store are first summarised in docs/results/fem/campaign.json.
"""

from __future__ import annotations

import json
import sys
import textwrap
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

RESULTS = Path(__file__).parent / "results"
DATA = RESULTS / "fem"

HEAD = """# The fingertip in finite elements: measured results

Two cores of a shared virtual machine (its dense product reaches {peak:.0f} GFlop/s in double and
{single:.0f} in single precision on both). `python docs/make_fem_results.py` writes this page from
the output of the commands named below, which is kept in `fem/`.
"""


def load(name: str) -> Any:
    """Output of a command."""
    return json.loads((DATA / f"{name}.json").read_text())


def table(headings: list[str], rows: list[list[str]]) -> str:
    """Markdown table whose first column is text."""
    rule = ["---", *["---:"] * (len(headings) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in [headings, rule, *rows]) + "\n"


def sum_up(path: Path) -> None:
    """Summarise a store, one line for each indentation."""
    from palpate_fem.store.read import SimulationStore

    store, rows = SimulationStore.open(path), []
    for name in store.ids():
        run = store.trajectory(name)
        rows.append(
            {
                "name": name,
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
    (DATA / "campaign.json").write_text(f"[\n{text}\n]\n")


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
{bench["system.unknowns"]:,.0f} unknowns; the goal is {bench["goal.trajectory_s"]:.0f} s, the
paper's model took 420 s on
six processors.

"""
        + table(["indentation", "seconds", *PARTS, "iterations", "factorisations"], rows)
        + f"""
Filling the fingertip takes {bench["pressurise.seconds"]:.1f} s, once. A whole factorisation is
{bench["solver.factor_gflop"]:.1f} GFlop in {bench["solver.whole_factorisation_s"] * 1e3:.0f} ms:
{bench["solver.factor_gflops"]:.0f} GFlop/s, {bench["solver.factor_share_of_single_peak"]:.0%}
of the peak in single
precision; a solve takes {bench["solver.solve_s"] * 1e3:.0f} ms and is bound by memory. Peak memory
{bench["memory.peak_mib"]:.0f} MiB. The right picture below shows the cost
against the size of the mesh.
"""
    )


PARTS = ["factorise", "solve", "assemble", "residual", "rest"]


CLAMP = """
The angled indentation goes towards the tip (`angled-0`), but sideways for the long cylinder
(`angled-1`, with `--indenter cylinder_long --angled 2`). That cylinder is as long as the finger:
tilted towards the tip, its other end meets the rim that the clamp holds, as the first runs showed.
The runs in that direction are listed below, but not counted: their force is that of the rim (in one
of them held nodes carry 34.3 of 35.0 N), not of a pinch.
"""


def counted(run: dict[str, Any]) -> bool:
    """Whether a run belongs to the set of 180."""
    return not run["name"].startswith("cylinder_long") or not run["name"].endswith("angled-0")


def campaign() -> str:
    """Nine indenters, ten points."""
    every = load("campaign")
    runs = [run for run in every if counted(run)]
    good = [run for run in runs if run["outcome"] in ("complete", "force limit")]
    rows = []
    for name in dict.fromkeys(run["name"].split("/")[0] for run in runs):
        mine = [run for run in runs if run["name"].startswith(f"{name}/")]
        cells = [name]
        for kind in ("normal", "angled"):
            some = [run for run in mine if kind in run["name"]]
            force = [run["force_n"] for run in some if run["force_n"] is not None]
            count = Counter(run["outcome"] for run in some)
            cells += [
                ", ".join(f"{n} {how}" for how, n in count.items()),
                f"{min(force):.1f}-{max(force):.1f}",
            ]
        cells += [f"{np.mean([run['seconds'] for run in mine]):.1f}"]
        rows.append(cells)
    others = [
        f"* {run['name']}: {run['outcome']}, {run['reason']}"
        for run in every
        if run["outcome"] != "complete"
    ]
    return (
        f"""
## Robustness

`palpate fem run --sweep --points 10 --angled 1 --store paper.sim`: nine indenters, ten points
each, 3 mm along the
normal and 1.5 mm at 30 degrees. **{len(good)} of {len(runs)} ({len(good) / len(runs):.1%})
reach full depth or
32 N** (the goal is 98 %); deepest penetration of any converged step
{max(run["penetration_um"] for run in runs):.2f} um. Two ran at a time on the two cores, so
each took about twice as long as alone.

![All trajectories by indenter](../pictures/fem-campaign.png)

"""
        + table(
            ["indenter", "normal", "force [N]", "angled", "force [N]", "mean seconds"],
            rows,
        )
        + CLAMP
        + "\nNot to full depth:\n\n"
        + ("\n".join(others) or "* none")
        + "\n"
    )


def studies() -> str:
    """Mesh and steps."""
    text = """
## Mesh and steps

`palpate fem study mesh --png mesh.png --json` and `palpate fem study steps --json`: three
indentations of 3 mm. Displacement
is that of the whole outer skin. Accepted is a change of 2 % of the force and of 0.02 mm in the mean
by the last refinement.

![What refinement changes](../pictures/fem-mesh-study.png)

"""
    for name, first in (("mesh", "edge [mm]"), ("steps", "steps")):
        rows = [
            [
                row["indenter"],
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
        headings = ["indenter", first, "unknowns", "force [N]", "change [%]", "mean change [um]"]
        text += table([*headings, "largest change [um]", "iterations", "seconds"], rows) + "\n"
    return text


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
simulated with thickness 1.45 mm, modulus 330 kPa and friction 0.25, noise is added to each axis of
the force, and the calibration starts from its scan. The simulator explains its own forces here:
this tests search and data processing, not the model.

""" + table(
        ["mesh", "noise [N]", "seed", "thickness [%]", "modulus [%]", "friction [%]", "volume [%]",
         "runs", "within"],
        [*rows, goals],
    )  # fmt: skip


def main() -> None:
    """Write the page."""
    if len(sys.argv) > 1:
        sum_up(Path(sys.argv[1]))
    bench = load("bench")
    page = HEAD.format(
        peak=bench["machine.peak_gflops"], single=bench["machine.single_peak_gflops"]
    )
    page += speed() + campaign() + studies() + recovery()
    (RESULTS / "fem.md").write_text("\n\n".join(map(flowing, page.strip().split("\n\n"))) + "\n")


def flowing(block: str) -> str:
    """Wrap a paragraph; leave tables, lists and headings as they are."""
    if block.lstrip()[:1] in ("|", "#", "*", "!"):
        return block.strip("\n")
    return textwrap.fill(" ".join(block.split()), 110, break_on_hyphens=False)


if __name__ == "__main__":
    main()
