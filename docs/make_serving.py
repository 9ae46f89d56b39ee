"""Write docs/results/serving.md from the files of ``palpate bench`` in docs/results/serving/.

``python docs/make_serving.py``          writes the page
``python docs/make_serving.py --check``  exits 1 if the page is not what the files say

``make serving`` measures everything anew, which takes two hours on an idle machine.
"""

from __future__ import annotations

import json
import runpy
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import median
from typing import Any

from palpate_deploy.bench.growth import LIMIT_MB_PER_H

FRESH = runpy.run_path(str(Path(__file__).with_name("fresh.py")))
_table: Callable[[str, Iterable[Iterable[str]]], str] = FRESH["table"]
FOLDER = Path(__file__).parent / "results" / "serving"
PAGE = FOLDER.with_suffix(".md")

HEAD = """# Serving: latency, load, faults, exchange of models, a long run

Each table shows the output of the command above it. `make serving` runs all commands, and
`python docs/make_serving.py` writes this page. The goals were set before anything was
measured. Hostile files have [a page of their own](hostile-files.md), as have [faults of
devices](faults.md).
"""


def _read(name: str) -> Any:
    return json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))


def _section(title: str, command: str, values: Any, text: str) -> str:
    machine = values["machine"]
    where = f"{machine['cpus']} cores, {machine['cpu']}"
    return f"\n## {title}\n\n`{command}`; {where}.\n\n{text}"


def _yes(met: bool | None) -> str:
    return {True: "yes", False: "**no**", None: "not tried"}[met]


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.2f} ms"


def _latency() -> str:
    values = _read("e2e")
    rows = [
        (
            name,
            *(_ms(values[f"e2e.{name}"][key]) for key in ("p50_s", "p99_s")),
            # A median would hide what a single run has met.
            _ms(max(run[name]["max_s"] for run in values["e2e.runs"])),
            str(sum(run[name]["lost"] for run in values["e2e.runs"])),
        )
        for name in ("palpate", "floor")
    ]
    for key, goal in (("p50", 1.15), ("p99", 1.3)):
        ratios = [run[f"{key}_ratio"] for run in values["e2e.runs"]]
        rows.append(
            (
                f"ratio of {key}, median of {len(ratios)} runs ({min(ratios):.2f} to "
                f"{max(ratios):.2f}); goal {goal:g}",
                *(f"{median(ratios):.2f}" if name == key else "" for name in ("p50", "p99", "max")),
                "",
            )
        )
    text = (
        "The *floor* is the same path without palpate's code, and runs the same network: that of "
        f"`{values.get('e2e.bundle', 'features-virtual')}`, which is small. Both run in turns of a "
        "few seconds, so that they meet the same disturbances of the host.\n\n"
    )
    text += _table(
        "frame stamp to estimate in the client, medians of runs | p50 | p99 | max of all runs "
        "| lost in all runs",
        rows,
    )
    stages = ", ".join(
        f"{name.replace('_', ' ')} {_ms(value)}" for name, value in values["e2e.stages_s"].items()
    )
    text += f"\nMedian time of each stage, as the service notes it: {stages}.\n"
    text += "\n" + _table(
        "load | frames | lost | p50 | p99",
        (
            (
                f"{load['sensors']} fingers at {load['rate_hz']:g} Hz, {name}",
                f"{load['published']:,}",
                str(load["lost"]),
                _ms(load["p50_s"]),
                _ms(load["p99_s"]),
            )
            for name in ("features", "field")
            if (load := values.get(f"load.{name}"))
        ),
    )
    text += _other_hosts()
    command = f"palpate bench e2e --runs {len(values['e2e.runs'])}"
    return _section("Latency beside a bare floor", command, values, text)


def _other_hosts() -> str:
    """The same on other hosts, and with the largest network that ships."""
    rows = []
    for name, host in (
        ("e2e-16-cores", "a quiet one of 16 cores"),
        ("e2e-16-cores-twin", "the same"),
        ("e2e-twin", "a busy one of 2 cores"),
        ("e2e-slow-host", "a busy one, half as fast"),
    ):
        values = _read(name)
        ours, floor, load = (
            values.get(key) for key in ("e2e.palpate", "e2e.floor", "load.features")
        )
        machine, runs = values["machine"], len(values["e2e.runs"])
        rows.append(
            (
                f"{host} ({machine['cpus']}, {machine['cpu']})",
                f"`{values.get('e2e.bundle', 'features-virtual')}`",
                str(runs),
                f"{_ms(ours['p50_s'])}, {_ms(ours['p99_s'])}",
                f"{_ms(floor['p50_s'])}, {_ms(floor['p99_s'])}",
                f"{values['e2e.p50_ratio']:.2f}, {values['e2e.p99_ratio']:.2f}",
                str(int(sum(run["palpate"]["lost"] for run in values["e2e.runs"]))),
                f"{load['lost']:,} of {load['published']:,}" if load else "",
            )
        )
    return (
        "\n**Other hosts, and a larger network.** `features-twin`, which the profile `virtual` "
        "serves, has weights of 11 MB, which the processor has to fetch for each frame "
        "(`palpate bench e2e --runs N`, with `--bundle features-twin` where it is named).\n\n"
        + _table(
            "host | bundle | runs | p50, p99 | floor | ratios (goals 1.15, 1.3) | lost "
            "| 40 fingers: lost",
            rows,
        )
        + "\nAll hosts are virtual machines.\n"
    )


def _restarts() -> str:
    values = _read("restart")
    more = _read("restart-more") if (FOLDER / "restart-more.json").is_file() else {"restart": []}
    goals = {"kill": 3.0, "hang": 10.0, "end": 2.0}
    rows = []
    for trials in (*values["restart"], *more["restart"]):
        # For a process that is told to end: until the next one is there. Others publish again.
        times = trials["process_s" if trials["fault"] == "end" else "publishing_s"]
        tried = len(times) + trials["failed"]
        rows.append(
            (
                trials["service"],
                trials["fault"],
                f"{len(times)}/{tried}",
                f"{median(times):.2f} s" if times else "",
                f"{max(times):.2f} s" if times else "",
                f"{goals[trials['fault']]:g} s" if trials["fault"] in goals else "",
                f"{trials['floor_s']:.2f} s",
                _yes(trials["met"]),
            )
        )
    text = (
        "Times are until the process publishes again; for *end* (SIGTERM) until the next process "
        "is there. *Floor*: a bare program that a bare supervisord restarts, and the imports of "
        "the foreign packages (not for *end*), and for *hang* the time that may pass without a "
        "heartbeat.\n\n"
    )
    text += _table("process | fault | back | p50 | max | goal | floor | met", rows)
    return _section(
        "Killed and hung processes until they publish again",
        "palpate bench restart --times 20`, and with `--only fem --only metrics",
        values,
        text,
    )


def _status() -> str:
    values = _read("status")
    result = values["status"]
    text = (
        f"{result['complete']} of {result['calls']} answers of `palpate status` were complete "
        f"({result['processes']} processes; {result['burners']} busy loops loaded the cores). A "
        f"call took {result['p50_s']:.2f} s in the median, {result['max_s']:.2f} s at most.\n"
    )
    return _section("Status under load", "palpate bench status --count 200", values, text)


def _swaps() -> str:
    values = _read("swap")
    rows = [
        (
            name.replace("_", " "),
            f"{account['frames']:,}",
            str(account["lost"]),
            str(account["repeated"]),
            str(account["mixed"]),
            _ms(account["gap_max_s"]),
        )
        for name in ("undisturbed", "changing")
        for account in [values[f"swap.{name}"]]
    ]
    text = "*Mixed*: estimates whose bytes are those of no single bundle.\n\n" + _table(
        "part | frames | lost | repeated | mixed | longest gap", rows
    )
    loads, backs = values["swap.load_s"], values["swap.roll_back_s"]
    text += (
        f"\n{values['swap.changes']} changes: a load took {_ms(loads['p50'])} in the median and "
        f"{_ms(loads['max'])} at most, a roll back {_ms(backs['p50'])} in the median and "
        f"{_ms(backs['max'])} at most (its goal is 100 ms).\n"
    )
    return _section("Exchange of models at 100 Hz", "palpate bench swap", values, text)


def _faults() -> str:
    values = _read("faults")
    rows = (
        (
            result["fault"],
            result["goal"],
            _yes(result["met"]),
            ", ".join(f"{name} {_figure(value)}" for name, value in result["figures"].items())
            or result["why"],
        )
        for result in values["faults"]
    )
    return _section(
        "Faults around a station",
        "palpate bench faults",
        values,
        _table("fault | goal | met | measured", rows),
    )


def _figure(value: float | int | str) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _soak() -> str:
    values = _read("soak")
    result = values["soak"]
    rows = (
        (
            name,
            f"{one['rss_mb']:.0f} MB",
            f"{one['slope_mb_per_h']:+.2f} +- {one['slope_ci95_mb_per_h']:.2f} MB/h",
            one["verdict"] if one["verdict"] == "steady" else f"**{one['verdict']}**",
            " to ".join(map(str, one["threads"])),
            " to ".join(map(str, one["descriptors"])),
            str(one["restarts"]),
        )
        for name, one in result["processes"].items()
    )
    table = _table(
        "process | memory | its slope (95 %) | verdict | threads | descriptors | restarts", rows
    )
    lost = sum(result["lost"].values())
    received = result["received"]
    fewer = received["electrodes"] - received["features"]
    text = (
        f"Slopes and losses leave out the first {result['warm_up_minutes']:.0f} of "
        f"{result['minutes']:.0f} minutes, in which caches fill; the messages are those of all. "
        f"Goal: each process is shown to grow by less than {LIMIT_MB_PER_H:g} MB/h, and nothing is "
        "lost; "
        f"*undecided* is a slope that the run was too short to tell. Goal met: "
        f"{_yes(values['soak.goal_met'])}.\n\n{table}\n"
        f"{result['fingers']} fingers, {sum(received.values()):,} messages received, {lost} lost. "
        f"Over the whole run the client got {fewer:,} features fewer than frames; a finger has "
        "none while it is tared. Records and views "
        f"grew by {result['disk_mb_per_h']:.0f} MB an hour. They took {result['disk_peak_mb']:.0f} "
        f"MB at most, {result['disk_limit_mb']:.0f} MB are allowed; {result['removed_records']} "
        "records were removed.\n"
        "\n![Memory of each process](serving/soak.png)\n"
    )
    return _section("A long run of the whole station", "palpate bench soak", values, text)


SECTIONS = {
    "e2e": _latency,
    "restart": _restarts,
    "status": _status,
    "swap": _swaps,
    "faults": _faults,
    "soak": _soak,
}
"""By the name of the file: what was not measured yet is left out."""


def page() -> str:
    """The page as the files say it."""
    there = [make for name, make in SECTIONS.items() if (FOLDER / f"{name}.json").is_file()]
    return HEAD + "".join(make() for make in there)


if __name__ == "__main__":
    sys.exit(FRESH["write_or_check"]({PAGE: page()}))
