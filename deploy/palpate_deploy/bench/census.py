"""``palpate bench status``: whether every answer of ``palpate status`` is complete, under load.

A station of its own is started with ``palpate up``, every core is loaded with a loop that does
nothing else, and ``palpate status`` runs again and again, each time as a new process that has to
find everybody anew.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from rich.console import Console
from rich.table import Table

from palpate.census import ROUTER, SUPERVISOR
from palpate.errors import ErrorCode, RemoteError
from palpate_deploy.bench.results import finish, progress_bar
from palpate_deploy.station.host import private_profile
from palpate_deploy.station.logs import FAILED
from palpate_deploy.station.processes import FiniteRun
from palpate_deploy.station.profile import plain_values

_START_S = 120.0
_CALL_S = 60.0
_BURN = "while True: pass"


@dataclass(frozen=True, slots=True)
class StatusCall:
    """One call of ``palpate status``.

    Attributes:
        complete: Whether it told the state of every process.
        ready: Whether it exited with 0: all are ready. A sensor that is lost because its gateway
            got no processor time is honestly not.
        seconds: How long the command took, the start of Python included [s].
        missing: Processes whose state it did not tell.
        troubles: What it said is wrong.
    """

    complete: bool
    ready: bool
    seconds: float
    missing: tuple[str, ...] = ()
    troubles: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class StatusResult:
    """Calls of ``palpate status`` with every core loaded.

    Attributes:
        calls: How many there were.
        complete: How many told the state of every process.
        ready: How many of these said that all is well.
        processes: Processes of the station, supervisor and router included.
        burners: Loops that loaded the cores.
        p50_s: Median time of a call [s]; ``max_s`` is the longest.
        others: The calls that were not complete or not ready.
    """

    calls: int
    complete: int
    ready: int
    processes: int
    burners: int
    p50_s: float
    max_s: float
    others: tuple[StatusCall, ...]


def measure_status(count: int, burners: int) -> StatusResult:
    """Start a station, load the cores, and ask ``count`` times.

    Raises:
        RemoteError: The station does not become ready.
    """
    with ExitStack() as stack:
        run = stack.enter_context(FiniteRun("bench-status"))
        profile = private_profile(
            "virtual", recorder={"out": str(run.folder / "records")}, log={"level": "warning"}
        )
        # Not under the name at which `palpate status` looks for the profile of a run: this one
        # only belongs to `palpate up`, which has a folder of its own.
        path = run.folder / "station.toml"
        path.write_text(tomli_w.dumps(plain_values(profile)), encoding="utf-8")
        run.start_module("up", "__main__", "up", "--profile", path)
        wanted = frozenset({*profile.processes, SUPERVISOR[0]})
        where = ("--connect", profile.link.connect[0], "--station", profile.station)
        deadline = time.monotonic() + _START_S
        while not _call(where, wanted).ready:
            if time.monotonic() > deadline:
                raise RemoteError(
                    f"the station is not ready within {_START_S:g} s",
                    remedy=f"see {run.log('up')}",
                    code=ErrorCode.UNAVAILABLE,
                )
        for number in range(burners):
            run.start(f"burner-{number}", [sys.executable, "-c", _BURN])
        calls = []
        bar = stack.enter_context(progress_bar())
        for _ in bar.track(range(count), description="palpate status"):
            calls.append(_call(where, wanted))
    seconds = [call.seconds for call in calls]
    return StatusResult(
        count,
        sum(call.complete for call in calls),
        sum(call.complete and call.ready for call in calls),
        len(wanted),
        burners,
        float(np.median(seconds)),
        max(seconds),
        tuple(call for call in calls if not (call.complete and call.ready)),
    )


def _call(where: tuple[str, ...], wanted: frozenset[str]) -> StatusCall:
    command = [sys.executable, "-m", "palpate_deploy", "status", "--json", *where]
    began_s = time.monotonic()
    all_missing = tuple(sorted(wanted))
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_CALL_S, check=False)
    except subprocess.TimeoutExpired:
        late = f"no answer within {_CALL_S:g} s"
        return StatusCall(False, False, time.monotonic() - began_s, all_missing, (late,))
    seconds = time.monotonic() - began_s
    try:
        told: dict[str, Any] = json.loads(done.stdout)
    except ValueError:  # the command failed, and said so on stderr
        return StatusCall(False, False, seconds, all_missing, (done.stderr.strip(),))
    # The router has no state of its own: it lives if the command reached it.
    known = {one["service"] for one in told["processes"] if "state" in one}
    if told["router"]:
        known.add(ROUTER[0])
    missing = tuple(sorted(wanted - known))
    said = tuple(f"{one['service']}: {one['problem']}" for one in told["troubles"])
    return StatusCall(not missing, done.returncode == 0, seconds, missing, said)


def run_status_bench(*, count: int, as_json: bool, save: bool, out: Path | None) -> int:
    """Measure and print; 1 if an answer was incomplete.

    Raises:
        PalpateError: The station does not start, or there is no history to append to.
    """
    result = measure_status(count, os.cpu_count() or 1)
    values = {"status": asdict(result), "status.goal_met": result.complete == result.calls}
    finish("status", values, lambda: _show(result), as_json=as_json, save=save, out=out)
    return 0 if result.complete == result.calls else FAILED


def _show(result: StatusResult) -> None:
    table = Table(title="palpate status", title_justify="left", show_header=False)
    table.add_row("complete answers", f"{result.complete} of {result.calls}")
    table.add_row("of these: all is ready", str(result.ready))
    table.add_row("processes of the station", str(result.processes))
    table.add_row("loops that load the cores", str(result.burners))
    table.add_row("a call takes", f"{result.p50_s:.2f} s (median), {result.max_s:.2f} s at most")
    console = Console()
    console.print(table)
    for call in result.others:
        console.print(
            f"missing {', '.join(call.missing) or 'nothing'}; {'; '.join(call.troubles)}",
            markup=False,
        )
