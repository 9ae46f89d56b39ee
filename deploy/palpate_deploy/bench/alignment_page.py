"""The page of results of ``palpate bench alignment``."""

from __future__ import annotations

from typing import Any

from palpate_deploy.bench.alignment_account import Spread

_HEAD = """\
# Alignment on one host: what was measured

Made by `palpate bench alignment --seconds {seconds:g} --page docs/results/alignment.md`
on {machine}.

Emulated devices, each in a process of its own, and a robot's program show one signal whose time is
known by the host's monotonic clock: a ramp up and down, 0.25 s each. They go the whole way through
driver, pipeline and bus to a client. Nothing here is hardware: what a real device delays before it
sends (filters, conversion, adapters) comes on top, and is the same for every reading of it
([time.md](../time.md#what-no-stamp-can-know)). The clocks of finger, RDT and Bota run 200 ppm fast,
the robot's is another than the host's and 40 ppm fast.

The host is shared, and puts emulators aside as it never does with sensors: what they sent more
than 5 ms late, and what lies around it, is left out. {kept:.0%} of the time counts.

## Stamps

A reading's stamp less the instant at which its value was there; late is positive. Median with its
sign, the others of the sizes.

{stamps}

Of the finger every channel counts at its own instant (`palpate.sampling`); a count is worth
0.07 ms here, which is part of the numbers. The row "all at the stamp" is the same readings for
whoever forgets that a frame takes 10 ms.

## Electrodes, wrench and pose

Every stream brought to the instant of each electrode (`palpate.alignment`); how far apart in
time what the two show was there. The goal is 1 ms.

{apart}

## What the gateway told

{gauges}
"""


def page_of(
    seconds: float,
    kept: float,
    stamps: dict[str, Spread],
    apart: dict[str, Spread],
    gauges: dict[str, float],
    machine: dict[str, Any],
) -> str:
    """The page as Markdown."""
    told = ["| gauge | |", "| --- | ---: |"]
    told += [f"| `{name}` | {value:.6g} |" for name, value in gauges.items()]
    return _HEAD.format(
        seconds=seconds,
        kept=kept,
        machine=f"{machine['cpus']} CPUs ({machine['cpu']}), load {machine['load_1min']}",
        stamps=_table(stamps),
        apart=_table(apart),
        gauges="\n".join(told),
    )


def _table(rows: dict[str, Spread]) -> str:
    out = [
        "| | readings | median | 95 % | 99 % | largest |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name, one in rows.items():
        numbers = (one.median_s, one.p95_s, one.p99_s, one.max_s)
        cells = " | ".join(f"{1e3 * value:.3f} ms" for value in numbers)
        out.append(f"| {name} | {one.count:,} | {cells} |")
    return "\n".join(out)
