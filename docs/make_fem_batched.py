"""Write docs/results/fem-batched.md and its picture from what the benchmark has measured on a GPU.

    python tests/benchmarks/bench_batched.py ... --out slots.json
    python tests/benchmarks/bench_batched.py --edge-mm ... --out meshes.json
    python tests/benchmarks/bench_batched_factor.py ... --out factor.json
    python tests/benchmarks/bench_served.py ... --out served.json
    python tests/benchmarks/bench_sweep.py ... --out sweeps.json
    python docs/make_fem_batched.py

These files are in docs/results/fem-batched. ``few.json`` holds runs of two commits in turns, each
as the first command writes them. ``sweeps.json`` holds what was told of large data sets,
too.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from palpate_training.figures.style import (
    finish,
    grid,
    label,
    markdown_table,
    new_figure,
    unit_colour,
)

ROOT = Path(__file__).resolve().parents[1]
SAME_M = 1e-6
"""Skins that are farther apart than this after the last step are two equilibria [m]."""

FOLDER = ROOT / "docs" / "results" / "fem-batched"
PAGE = FOLDER.with_suffix(".md")

CAMPAIGNS = ROOT / "docs" / "results" / "fem"
"""Summaries of stores, by ``docs/make_fem_results.py STORE NAME``."""

HEAD = """# Many indentations at once on a GPU

How fast a GPU simulates presses, and how well it agrees with the solver on a core.
`python docs/make_fem_batched.py` makes this page from what the commands below measured. How it
works: [ADR 26](../adr/0026-many-at-once.md). The presses are the twin's: nine indenters, 3 mm along
the normal and 1.5 mm at 30 degrees to it, 20 steps, friction and core contact. A *trajectory* is
one press; a *slot* is a place for one press on the GPU.

At the end of a batch some slots are empty, because no press is left. In a long sweep this end is a
small part, so the table also has the time with all slots taken.
"""


def read(name: str) -> dict[str, Any]:
    """What a program wrote."""
    values: dict[str, Any] = json.loads((FOLDER / name).read_text(encoding="utf-8"))
    return values


def outcomes(run: dict[str, Any]) -> str:
    """How the presses of a run ended."""
    return ", ".join(f"{count} {how}" for how, count in sorted(run["outcomes"].items()))


def processes(run: dict[str, Any]) -> str:
    """How many processes shared the device, and whether under MPS."""
    return f"{run.get('together', 1)}{', MPS' * run.get('mps', False)}"


def times(runs: list[dict[str, Any]]) -> str:
    """A row for each number of slots and each mesh."""
    head = ["mesh [mm]", "unknowns", "slots", "processes", "presses", "ms a trajectory",
            "with all slots taken", "iterations", "factorisations", "outcomes",
            "kernels of"]  # fmt: skip
    return markdown_table(
        head,
        [
            [
                f"{run['edge_mm']:g}", f"{run['unknowns']:,}", str(run["slots"]),
                processes(run), str(run["presses"]), f"{run['ms_a_trajectory']:.0f}",
                f"**{run['ms_while_full']:.0f}**", f"{run['iterations']:.0f}",
                f"{run['factorisations']:.0f}", outcomes(run), run["commit"],
            ]
            for run in runs
        ],
    )  # fmt: skip


def in_turns(runs: list[dict[str, Any]]) -> str:
    """A row for each number of slots, a column for each commit."""
    commits = list(dict.fromkeys(run["commit"] for run in runs))
    rows = []
    for slots in sorted({run["slots"] for run in runs}):
        ours = [run for run in runs if run["slots"] == slots]
        times = [
            ", ".join(f"{run['ms_while_full']:.0f}" for run in ours if run["commit"] == commit)
            for commit in commits
        ]
        rows.append([str(slots), str(ours[0]["presses"]), *times])
    return markdown_table(["slots", "presses", *(f"{c} [ms]" for c in commits)], rows)


def agreement(report: dict[str, Any], folder: Path) -> str:
    """How far the GPU and the CPU are apart, with the default tolerances and with tighter ones."""
    both = {
        "default": report["against_cpu"],
        "a tenth of them": report["against_cpu_tightened"],
    }
    figure = new_figure(7.0, 2.6)
    by_force, by_field = figure.subplots(1, 2)
    head = ["tolerances", "presses", "outcomes equal", "other equilibrium", "force within 1e-6",
            "median", "largest", "skin within 0.01 um", "median [um]", "largest [um]",
            "iterations", "time on a core [s]"]  # fmt: skip
    table = []
    for colour, (name, rows) in enumerate(both.items()):
        near = [row for row in rows if row["last_field_m"] <= SAME_M]
        force = np.array([row["force_relative"] for row in near])
        field = 1e6 * np.array([row["last_field_m"] for row in near])
        for axes, values in ((by_force, force), (by_field, field)):
            shares = np.arange(1, len(values) + 1) / len(values)
            axes.semilogx(np.sort(values), shares, color=unit_colour(colour),
                          drawstyle="steps-post", label=name)  # fmt: skip
        table.append(
            [
                name, str(len(rows)),
                str(sum(row["outcome"][0] == row["outcome"][1] for row in rows)),
                str(len(rows) - len(near)),
                f"**{sum(force <= 1e-6)}**", f"{np.median(force):.1e}", f"{force.max():.1e}",
                f"**{sum(field <= 0.01)}**", f"{np.median(field):.4f}", f"{field.max():.4f}",
                f"{np.mean([row['iterations'] for row in rows]):.0f}",
                f"{np.mean([row['cpu_s'] for row in rows]):.0f}",
            ]
        )  # fmt: skip
    label(by_force, "difference of force, share of the largest", "share of presses", "")
    label(by_field, "difference of skin [um]", "", "")
    by_force.axvline(1e-6, color="0.3", lw=0.9, ls="--")
    by_field.axvline(0.01, color="0.3", lw=0.9, ls="--")
    by_force.legend(title="tolerances", frameon=False)
    for axes in (by_force, by_field):
        grid(axes)
    finish(figure, folder / "agreement.png", "GPU against CPU", "Dashed: the goals.")
    return "\n".join(
        [
            "Each press is also computed on a core, with the same tolerances. *Force*: largest"
            " difference of a component in any step, over the press's largest force. *Skin*:"
            " largest distance of a node after the last step. More than 1 um is another"
            " equilibrium; such a press is left out of medians and largest"
            " values.\n\nGPU and core solve the same equations: with the default tolerances they"
            " differ by what these allow (above all 1 % of the largest friction at a node).\n",
            markdown_table(head, table),
            "\n![agreement](fem-batched/agreement.png)",
        ]
    )


def kernels(runs: list[dict[str, Any]]) -> str:
    """Where the time of a factorisation and of a solve goes."""
    names = dict.fromkeys(name for run in reversed(runs) for name in run["kernels_ms"])
    head = ["kernel", *(f"slots: {run['slots']} [ms]" for run in runs)]
    rows = [[name, *(show(run["kernels_ms"].get(name)) for run in runs)] for name in names]
    whole = [
        [f"**{what}, a slot**", *(f"**{run[key]:.2f}**" for run in runs)]
        for what, key in (("factorisation", "factor_ms_a_slot"), ("solve", "solve_ms_a_slot"))
    ]
    return markdown_table(head, [*whole, *rows])


def show(value: float | None) -> str:
    """A time [ms]; nothing where it was not noted."""
    return "" if value is None else f"{value:.2f}"


def draw(runs: list[dict[str, Any]], path: Path) -> None:
    """Time against slots and against the size of the mesh."""
    figure = new_figure(8.0, 3.0)
    by_slots, by_size = figure.subplots(1, 2)
    first = [run for run in runs if run["edge_mm"] == runs[0]["edge_mm"]]
    by_slots.loglog([run["slots"] for run in first], [run["ms_while_full"] for run in first], "o-",
                    color=unit_colour(0), ms=4)  # fmt: skip
    by_slots.axhline(100.0, color="0.3", lw=0.9, ls="--")
    label(by_slots, "slots", "ms a trajectory", f"{runs[0]['unknowns']:,} unknowns")
    slots = [run["slots"] for run in runs if run["edge_mm"] != runs[0]["edge_mm"]]
    same = sorted(
        (run["unknowns"], run["ms_while_full"])
        for run in runs
        if slots and run["slots"] == slots[0]
    )
    by_size.plot(*np.array(same).T, "o-", color=unit_colour(1), ms=4)
    label(by_size, "unknowns", "", f"{slots[0]} slots")
    by_slots.set_xticks([run["slots"] for run in first], [str(run["slots"]) for run in first])
    by_slots.set_yticks([round(run["ms_while_full"]) for run in first])
    by_slots.yaxis.set_major_formatter(lambda value, _: f"{value:.0f}")
    by_slots.minorticks_off()
    by_size.set_ylim(0.0)
    by_size.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    for axes in (by_slots, by_size):
        grid(axes)
    finish(figure, path, "Time of a trajectory with all slots taken", "Dashed: the goal.")


def served(report: dict[str, Any]) -> str:
    """Callers of the service, beside the same presses without it."""
    rows = []
    for run, bare in zip(report["served"], report["bare"], strict=True):
        ratio = run["ms_a_trajectory"] / bare["ms_a_trajectory"]
        rows.append(
            [
                str(run["callers"]), str(run["presses"]), f"{run['ms_a_trajectory']:.0f}",
                f"{bare['ms_a_trajectory']:.0f}", f"{ratio:.2f}", f"{run['first_step_s']:.2f}",
                f"{run['whole_s']:.1f}", f"{run['longest_s']:.1f}", outcomes(run),
            ]
        )  # fmt: skip
    head = ["callers", "presses", "ms a trajectory", "bare", "ratio", "first step [s]",
            "answer, median [s]", "longest [s]", "answers"]  # fmt: skip
    return markdown_table(head, rows)


def swept(runs: list[dict[str, Any]]) -> str:
    """Sweeps, from the command to the disk."""
    head = ["command", "machine", "presses", "ms a trajectory", "first [s]", "99 % [s]",
            "last [s]", "whole [s]", "outcomes", "code of"]  # fmt: skip
    return markdown_table(
        head,
        [
            [
                f"`{run['command']}`", f"{run['machine']}, {run['cores']} cores",
                f"{run['results']:,}", f"**{run['ms_a_trajectory']:.0f}**",
                f"{run['first_s']:.0f}", f"{run['most_s']:.0f}", f"{run['last_s']:.0f}",
                f"{run['whole_s']:.0f}", outcomes(run), run["commit"],
            ]
            for run in runs
        ],
    )  # fmt: skip


def campaign(told: str) -> str:
    """The paper's trajectories, on a GPU and on cores: those that end differently."""
    on_cores, on_gpu = (
        {run["name"]: run for run in json.loads((CAMPAIGNS / f"{name}.json").read_text())}
        for name in ("campaign", "campaign-gpu")
    )
    both = {name: (one, on_gpu[name]) for name, one in on_cores.items()}
    same = [pair for pair in both.values() if pair[0]["outcome"] == pair[1]["outcome"]]
    last = [abs(a["force_n"] / b["force_n"] - 1) for a, b in same if a["steps"] == b["steps"]]
    rows = [
        [name, *(f"{run['outcome']}, {run['travel_mm']:.2f} mm, {run['force_n']:.1f} N"
                 for run in pair)]
        for name, pair in both.items()
        if pair not in same
    ]  # fmt: skip
    return "\n".join(
        [
            f"{told} {len(same)} of {len(both)} end equally on both. Of these,"
            f" {sum(one <= 1e-5 for one in last)} of {len(last)} with equally many steps have a"
            f" last force equal within 1e-5, {sum(one <= 1e-3 for one in last)} within 1e-3; the"
            f" largest difference is {max(last):.1%}. The others, all close to the force at which"
            " pinched skin snaps:\n",
            markdown_table(["trajectory", "on cores", "on the GPU"], rows),
        ]
    )


def main() -> None:
    """Write page and pictures."""
    report, meshes = read("slots.json"), read("meshes.json")
    factor, sweeps, few = read("factor.json"), read("sweeps.json"), read("few.json")
    runs = report["runs"] + meshes["runs"]
    draw([run for run in runs if "together" not in run], FOLDER / "time.png")
    sections = [
        HEAD,
        f"## Time\n\n{report['device']}: `{report['command']}` and `{meshes['command']}`. "
        f"{report['told']}\n\n*Processes* on one GPU share the slots of their row; for several,"
        " give `--device cuda:0` as often. *MPS*: NVIDIA's Multi-Process Service was running"
        " (`nvidia-cuda-mps-control -d`), so that kernels of all processes run at once.\n",
        times(runs),
        "\n![time](fem-batched/time.png)\n",
        f"Few slots, {few['device']}: `{few['command']}`. The table has the time of a trajectory"
        f" with all slots taken. {few['told']}\n",
        in_turns(few["runs"]),
        "",
        f"## Agreement with the solver on a core\n\n`{report['agreement_command']}`, and the same"
        f" with `--tightened 10`. {report['agreement_told']}\n",
        agreement(report, FOLDER),
        f"\n## All 450 trajectories\n\n{campaign(report['campaign_told'])}",
        "\n## A factorisation and a solve\n",
        f"All fronts are factorised: `{factor['command']}`. {factor['told']}\n",
        kernels(factor["runs"]),
        f"\n## Sweeps\n\n{sweeps['told']}\n",
        swept(sweeps["runs"]),
        f"\n{sweeps['told_sets']}\n",
        markdown_table(
            ["command", "presses", "ms a trajectory", "outcomes"],
            [
                [f"`{run['command']}`", f"{run['presses']:,}", f"{run['ms']:.0f}", run["outcomes"]]
                for run in sweeps["sets"]
            ],
        ),
    ]
    asked = read("served.json")
    sections += [
        f"\n## Served\n\n{asked['device']}, `palpate fem serve --device cuda:0 --slots"
        f" {asked['slots']}` behind a router; each caller sends one request after the other:"
        f" `{asked['command']}` (code of {asked['commit']}). *Bare*: the same presses in one"
        " process, without the service.\n",
        served(asked),
        f"\nThe solver's process was killed (SIGKILL) while 32 callers had requests there:"
        f" `{asked['killed']['command']}`. All were answered: first workers on cores took them,"
        " then the solver's next process took those that still waited.\n",
        served(asked["killed"]),
    ]
    PAGE.write_text("\n".join(sections) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
