"""Write docs/results/fleet.md, and the table in docs/fleet.md, from docs/results/fleet.json.

``python docs/make_fleet.py``          writes both
``python docs/make_fleet.py --check``  exits 1 if they are not what the file says

``palpate bench fleet --out docs/results/fleet.json``, as root, measures everything anew.
"""

from __future__ import annotations

import json
import runpy
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from statistics import median
from typing import Any

FRESH = runpy.run_path(str(Path(__file__).with_name("fresh.py")))
_table: Callable[[str, Iterable[Iterable[str]]], str] = FRESH["table"]
DOCS = Path(__file__).parent
FILE = DOCS / "results" / "fleet.json"
RESULTS = DOCS / "results" / "fleet.md"
PAGE = DOCS / "fleet.md"
BEGIN, END = "<!-- written by docs/make_fleet.py -->", "<!-- end -->"
SHARE = 0.5
"""Share of one core that the site's router may take in the plan."""
BEYOND = 2
"""Times the largest fleet that was measured: the plan says nothing of larger ones."""

PHASES = {
    "nobody": "nobody",
    "features": "estimates of every station",
    "electrodes": "raw frames of every station",
}
FAULTS = {"kill": "killed", "stop": "stopped (SIGSTOP)", "cut": "cable pulled"}


def _per_station(scale: list[dict[str, Any]], phase: str, value: str) -> float:
    """Growth with each station: of the largest fleet against the smallest."""
    first, last = scale[0], scale[-1]
    grown = last["phases"][phase][value] - first["phases"][phase][value]
    return float(grown / (last["stations"] - first["stations"]))


def results_page(values: Mapping[str, Any]) -> str:
    """The whole page of results."""
    scale, machine = values["scale"], values["machine"]
    beside = all("floor_beside" in one for one in scale)
    rows = [
        [
            str(one["stations"]),
            PHASES[phase],
            f"{of['bytes_hz_each'] / 1e3:.1f}",
            f"{100 * of['site_cpu_ratio']:.1f}",
            f"{of['site_rss_bytes'] / 1e6:.0f}",
            f"{100 * of['station_router_cpu_ratio']:.1f}",
            f"{1e3 * of['p50_s']:.2f}, {1e3 * of['p99_s']:.1f}" if "p50_s" in of else "-",
            f"{of['lost']} of {of['received'] + of['lost']}" if "lost" in of else "-",
        ]
        for one in scale
        for phase, of in one["phases"].items()
    ]
    floors = [
        [
            str(one["stations"]),
            f"{1e3 * one['floor']['p50_s']:.2f}, {1e3 * one['floor']['p99_s']:.1f}",
            f"{one['phases']['electrodes']['p50_s'] / one['floor']['p50_s']:.2f}",
            f"{one['phases']['electrodes']['p99_s'] / one['floor']['p99_s']:.2f}",
        ]
        for one in scale
    ]
    whole = [
        [name, f"{100 * one['cpu_ratio']:.1f}", f"{one['rss_bytes'] / 1e6:.0f}"]
        for name, one in values["station"].items()
    ]
    impaired = [
        [
            one["netem"],
            one.get("not_measured")
            or f"p50 {1e3 * one['p50_s']:.1f} ms, p99 {1e3 * one['p99_s']:.1f} ms, "
            f"lost {one['lost']} of {one['received'] + one['lost']}",
        ]
        for one in values["impaired"]
    ]
    takeovers = [
        [
            FAULTS[one["fault"]],
            f"{one['gap_s']:.2f}"
            if one["estimates_after_heal"]
            else f"none came, for {one['gap_s']:.2f}",
            str(one["twice"]),
            str(one["out_of_order"]),
        ]
        for one in sorted(
            values.get("takeovers", []), key=lambda one: [*FAULTS].index(one["fault"])
        )
    ]
    asked = [
        [FAULTS[one["fault"]], f"{one['after_s']:.2f}", one["outcome"]]
        for one in sorted(
            values.get("asked_again", []), key=lambda one: [*FAULTS].index(one["fault"])
        )
    ]
    return f"""# Fleets: what stations behind a site's router cost

<!-- Written by docs/make_fleet.py from fleet.json; do not edit. -->
Measured by `palpate bench fleet --out docs/results/fleet.json`, as root. Every station, the site
and the consumer is a network namespace of one host; virtual cables (veth) join them, with mutual
TLS. All of them share
{machine["cpus"]} cores ({machine["cpu"]}; load {
        machine["load_1min"]
    } at the end), so that latencies of
many stations are those of a full host, not of a network. How to use these numbers:
[fleet.md](../fleet.md).

## What crosses, and what it costs

A station is its own router and one process that publishes frames and estimates of one finger at
100 Hz each. "Listens": what one consumer at the site subscribes to. kB/s are of one station's
cable, both ways, with all framing. Latency is from the stamp to the consumer, through both routers.

{
        _table(
            "stations | listens | kB/s each | site router, % of a core | MB | station's router, %"
            " | p50, p99 ms | lost",
            rows,
        )
    }
The floor is the latency of the same process to a consumer that is linked to it directly, over one
cable and without a router, {
        "while the raw frames are listened to"
        if beside
        else "from the start of the stations to the end of all three phases"
    }.

{_table("stations | floor p50, p99 ms | raw frames: times the floor's p50 | p99", floors)}
## A whole station

Router, gateway of one virtual finger and features service, each a process.

{_table("process | % of a core | MB", whole)}
## Delay and loss on the cable

{_table("tc netem | what one consumer of one station saw", impaired)}
## A standby takes over

Two features services on two hosts serve one finger; the host of the active one fails. Each line is
one trial. The gap is the longest pause between estimates at a consumer; "twice" counts estimates of
one frame that came from both services, until 8 s after the fault was over. A subscriber of palpate
drops and counts those; this consumer took everything that crossed the cable.

{_table("the active one is | gap, s | twice | out of order", takeovers)}
## A simulation is asked again

Two finite-element services on two hosts; the one that computes fails. The time is until the other
one has taken the same request.

{_table("the one that computes is | after, s | outcome", asked)}"""


def plan_table(values: Mapping[str, Any]) -> str:
    """How many stations one site's router carries."""
    scale = values["scale"]
    largest = BEYOND * scale[-1]["stations"]
    rows = []
    for phase, words in PHASES.items():
        cpu = _per_station(scale, phase, "site_cpu_ratio")
        memory = _per_station(scale, phase, "site_rss_bytes")
        rate = median(one["phases"][phase]["bytes_hz_each"] for one in scale)
        most = str(int(SHARE / cpu)) if cpu * largest > SHARE else f"more than {largest}"
        rows.append([words, f"{rate / 1e3:.1f}", f"{100 * cpu:.2f}", f"{memory / 1e6:.2f}", most])
    table = _table(
        "one consumer listens to | kB/s a station | site router, % of a core a station"
        f" | MB a station | stations at {100 * SHARE:.0f} % of a core",
        rows,
    )
    last = scale[-1]
    waits = (last["phases"][phase] for phase in ("features", "electrodes"))
    told = " and ".join(f"{1e3 * one['p50_s']:.0f} ms" for one in waits)
    return (
        f"{table}\nAt most {last['stations']} stations were measured; we do not extrapolate beyond"
        f" {largest}. Low processor time does not mean low latency: with {last['stations']} and all"
        f" else on those cores a message took {told} in the median (estimates, raw frames)."
    )


def page_with(text: str, table: str) -> str:
    """The planning page with its table."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n\n{table}\n{END}{after}"


if __name__ == "__main__":
    values = json.loads(FILE.read_text(encoding="utf-8"))
    wanted = {
        RESULTS: results_page(values).rstrip() + "\n",
        PAGE: page_with(PAGE.read_text(encoding="utf-8"), plan_table(values)),
    }
    sys.exit(FRESH["write_or_check"](wanted))
