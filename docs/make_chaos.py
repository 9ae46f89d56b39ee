"""Write docs/results/chaos.md and chaos.png from docs/results/chaos.json.

``python docs/make_chaos.py``          writes page and picture
``python docs/make_chaos.py --check``  exits 1 if the page is not what the file says

``make chaos`` measures everything anew, in half an hour.
"""

from __future__ import annotations

import json
import runpy
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

FRESH = runpy.run_path(str(Path(__file__).with_name("fresh.py")))
_table: Callable[[str, Iterable[Iterable[str]]], str] = FRESH["table"]
RESULTS = Path(__file__).parent / "results"
FILE, PAGE, PICTURE = (RESULTS / f"chaos.{kind}" for kind in ("json", "md", "png"))

HEAD = """# Chaos: an installed station for half an hour, while one thing after another breaks

Made by `make chaos`, which needs root, debootstrap and a network, and by
`python docs/make_chaos.py`. `make chaos MINUTES=30 SEED=1` is this run; another seed is another
order. Its exit status is 1 if a goal is missed.

palpate is installed by `palpate install` in a Debian whose systemd runs: router, gateway, features,
field, recorder, metrics and finite elements, each with the certificates of its role, which systemd
hands over (`LoadCredential`). The finger is an emulated BioTac on a serial line. A robot on another
host, behind a cable of its own, notes every estimate and frame, and asks for a simulation each
second. A program outside of palpate causes the faults. How to operate a station:
[operations.md](../operations.md).
"""

SEEN = {
    "token": "its token is gone",
    "stale": "no fresh estimate",
    "state": "its status says so",
    "lost": "the sensor is LOST, after its last frame",
    "steps": "the step is counted",
    "rejected": "it is counted",
}


FOUND = """
## What the runs have found

Corrected:

* A robot on another host than the station's got answers but no streams: it joined as a peer,
  which other processes cannot reach there. It now joins as a client of the router
  (`tests/deploy/test_other_host.py` has two networks).
* With a disk that refuses to write, each attempt left an empty `.mcap.part`, and each
  start of the recorder warned of all of them. They are removed now.
* A disk for the recordings alone, mounted below the station's folder, keeps systemd 257 from
  starting the unit. [install.md](../install.md) says where a disk of its own belongs.
* In the namespaces of `make debian`, credentials did not reach a unit, because mounts were not
  shared as container managers share them. Now they are: in this run all processes get their
  certificates by `LoadCredential`.
* A gateway that was restarted while the finger was touched took no tare until the finger was
  released, and without a tare there is no estimate. It now goes on with its last tare
  ([tare and health](../tare-and-health.md)).
* Zombies called `palpate`, one for each time that the sensor was unplugged, were not the station's:
  the program that causes the faults ended `nsenter` before that had waited for the emulated finger.
  It waits now: unplugged 13 times in a row, it leaves none. Runs at commits before 6a113a6 have
  them.
* Of four full disks one was not in the log: the recorder logged it only if its health was not
  DEGRADED already, for another reason or still from the last time. Since then five of five are.
* A finger that is unplugged is shown as lost after 0.02 s. Runs at commits before c2646cc report
  0.22 s: the program looked only after it had finished unplugging, and saw the second status.

Not corrected:

* Other processes notice that a process hangs only after the lease of a link, which is 2 s by
  default; the goal of 1.5 s assumes a lease of 1 s. On a busy host a shorter lease closes links
  that are well.
* On a machine that is busy with other things, everything that starts Python again waits for a
  processor: the whole stack after a kill of its unit, and the finite elements. On an idle one
  `palpate bench restart` finds 1 to 3 s ([serving](serving.md)).
"""


def _yes(met: bool) -> str:
    return "pass" if met else "**miss**"


def _s(seconds: float | None) -> str:
    return "never" if seconds is None else f"{seconds:.2f} s"


def _goals(found: dict[str, Any]) -> str:
    rows = ((goal["what"], goal["found"], _yes(goal["met"])) for goal in found["goals"])
    return _table("what must hold | found | ", rows)


def _availability(found: dict[str, Any]) -> str:
    share, estimates, load = found["availability"], found["estimates"], found["load"]
    asked, queries, records = share["asked"], found["queries"], found["recordings"]
    said = ", ".join(f"{count} {what}" for what, count in queries["said"].items())
    return (
        "The robot had a fresh estimate (30 ms old at most; the finger and its line take 12 of "
        f"them) for {100 * share['all']:.1f} % of the time, and for "
        f"{100 * share['between_faults']:.1f} % of the {share['between_faults_s']:.0f} s outside "
        "of faults. A controller that asked "
        f"{asked['asked']:,} times got one {asked['fresh']:,} times, and an error "
        f"{asked['too_old']:,} times. The machine was not idle: "
        f"{found['machine']['cpus']} cores, load {load['median']:.1f} in the median, "
        f"{load['least']:.1f} to {load['most']:.1f}.\n\n"
        f"{estimates['received']:,} estimates came, {1e3 * estimates['p50_s']:.1f} ms old in the "
        f"median, {1e3 * estimates['p99_s']:.1f} ms for 99 %.\n\n"
        f"Simulations: {queries['asked']} asked, {said}; {_s(queries['p50_s'])} in the median, "
        f"{_s(queries['longest_s'])} at most (5 s were given).\n\n"
        f"Recordings: {records['files']} files, {records['bytes'] / 1e6:.0f} MB, "
        f"{records['recovered']} of them recovered after a kill; {records['frames']:,} frames, "
        f"with {100 * records['of_the_robots']:.2f} % of those that the robot got.\n"
    )


def _faults(found: dict[str, Any]) -> str:
    rows = []
    for one in found["faults"]:
        if not one["alone"]:
            continue
        seen = SEEN[one["seen"].partition(" ")[0]] if one["seen"] else ""
        noticed = f"{_s(one['seen_p50_s'])} ({one['seen_goal_s']:g} s), {seen}" if seen else ""
        own = " (own)" if one["own"] else ""
        rows.append(
            (
                one["fault"],
                str(one["alone"]),
                noticed,
                _s(one["p50_s"]),
                _s(one["max_s"]),
                f"{one['goal_s']:g} s{own}",
                _yes(not one["missed"]),
                _yes(not one["seen_missed"]) if seen else "",
            )
        )
    return _table(
        "fault | times | noticed, median (goal) | over, median | at most | goal | over | noticed",
        rows,
    )


def _pairs(found: dict[str, Any]) -> str:
    rows = (
        (" + ".join(one["faults"]), ", ".join(map(_s, one["back_s"])), f"{one['goal_s']:g} s",
         _yes(one["met"]))
        for one in found["pairs"]
    )  # fmt: skip
    return _table("at once | over | goal | ", rows)


def _spoiled(found: dict[str, Any]) -> str:
    """What the program itself failed to mend; empty = nothing."""
    if not found["spoiled"]:
        return ""
    return (
        f"\nNot counted above: {', '.join(found['spoiled'])}. The program itself failed to undo "
        "the first of these, so that nothing could be well until it was undone otherwise.\n"
    )


def _uses(found: dict[str, Any]) -> str:
    start, end = (found["uses"][when]["processes"] for when in ("start", "end"))
    rows = (
        (
            name,
            f"{start[name]['rss_bytes'] / 1e6:.0f} to {end[name]['rss_bytes'] / 1e6:.0f} MB",
            f"{start[name]['threads']} to {end[name]['threads']}",
            f"{start[name]['descriptors']} to {end[name]['descriptors']}",
        )
        for name in start
    )
    return _table("process | memory | threads | descriptors", rows)


def page(found: dict[str, Any]) -> str:
    """The page of a result."""
    faults = sum(one["times"] for one in found["faults"])
    return (
        f"{HEAD}\n{found['minutes']:g} minutes, seed {found['seed']}, {faults} faults.\n\n"
        f"![Share of time with a fresh estimate, and the faults](chaos.png)\n"
        f"\n## What must hold\n\n{_goals(found)}"
        f"\n## What the robot had\n\n{_availability(found)}"
        f"\n## Each fault\n\n*Over* counts from the fault, or from its end if it lasts, until what "
        "it broke works again: estimates, the process's token, its status, or an answer. Goals "
        "were set before anything was measured.\n\n"
        f"{_faults(found)}"
        f"\n## Two at once\n\n{_pairs(found)}"
        f"{_spoiled(found)}"
        f"\n## At the start and at the end\n\n{_uses(found)}{FOUND}"
    )


def draw(found: dict[str, Any]) -> None:
    """The share of each second with a fresh estimate, and every fault, over time."""
    import numpy as np
    from matplotlib.figure import Figure

    seconds = max(1, round(60 * found["minutes"]))
    gone = np.zeros(seconds)
    for begin, length in found["holes"]:
        for second in range(int(begin), min(seconds, int(begin + length) + 1)):
            gone[second] += max(0.0, min(second + 1, begin + length) - max(second, begin))
    names = sorted({one["fault"] for one in found["events"]})
    figure = Figure(figsize=(13, 4 + 0.21 * len(names)), facecolor="white", layout="constrained")
    share, marks = figure.subplots(2, 1, sharex=True, height_ratios=(2, max(2, 0.21 * len(names))))
    minutes = (np.arange(seconds) + 0.5) / 60.0
    share.fill_between(minutes, 100.0 * (1.0 - gone), step="mid", color="#5b8e7d", lw=0)
    share.set_ylabel("% of each second\nnot in a gap over 0.1 s")
    share.set_ylim(0, 100)
    title = "estimates at most 30 ms old at the robot, and what was broken meanwhile"
    share.set_title(title, loc="left")
    for one in found["events"]:
        row = names.index(one["fault"])
        end_s = one["at_s"] + one["lasted_s"] + (one["well_s"] or 90.0)
        colour = "#d1495b" if one["well_s"] is None else "#e6a04a"
        marks.plot([one["at_s"] / 60.0, end_s / 60.0], [row, row], lw=5, color=colour,
                   solid_capstyle="butt")  # fmt: skip
        marks.plot([one["at_s"] / 60.0], [row], marker="|", ms=9, color="#333333")
    marks.set_yticks(range(len(names)), names, fontsize=9)
    marks.set_ylim(len(names) - 0.4, -0.6)
    marks.grid(axis="x", color="#dddddd")
    marks.set_xlim(0, seconds / 60.0)
    marks.set_xlabel("time [min]; a bar lasts from the fault until all is well again")
    figure.savefig(PICTURE, dpi=100)


if __name__ == "__main__":
    found = json.loads(FILE.read_text(encoding="utf-8"))
    if "--check" not in sys.argv[1:]:
        draw(found)
    sys.exit(FRESH["write_or_check"]({PAGE: page(found)}))
