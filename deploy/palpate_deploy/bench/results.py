"""Results of a benchmark: from latencies to percentiles, printed and kept in the history."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from palpate.errors import ConfigError, LinkError
from palpate_deploy.bench.harness import STAGES


@dataclass(frozen=True, slots=True)
class Latency:
    """Latency of one side: percentiles [s], number of estimates, number of frames without one."""

    p50_s: float
    p99_s: float
    max_s: float
    count: int
    lost: int


def latency(rows: npt.NDArray[np.int64], *, warm_up: int, lost: int) -> Latency:
    """Latency from the rows of one side: sequence, stamp and arrival [ns], shape ``(N, 3)``.

    ``warm_up`` estimates are left out after each pause: caches are cold, links slow. ``lost``
    frames got no estimate.

    Raises:
        LinkError: No estimate is left.
    """
    kept = np.concatenate([rows[:0], *(part[warm_up:] for part in rounds(rows))])
    if not len(kept):
        raise LinkError(
            f"{len(rows)} estimates came, none beyond the first {warm_up} after a pause",
            remedy="measure for longer, or on a host that does nothing else",
        )
    ages_s = (kept[:, 2] - kept[:, 1]) * 1e-9
    p50, p99 = np.percentile(ages_s, (50, 99))
    return Latency(float(p50), float(p99), float(ages_s.max()), len(ages_s), lost)


STOPPED_S = 0.5
"""A stream that is silent for so long before the end has stopped [s]."""


def owed(arrivals_ns: npt.NDArray[np.int64], end_ns: int) -> int:
    """Messages that a stream which has stopped would have sent until the end, at its rate so far.

    Arrivals [ns] in order, shape ``(N,)``; of one whose rate is not known: 1, or 0 if none came.
    """
    if not len(arrivals_ns) or (silent_ns := end_ns - arrivals_ns[-1]) < STOPPED_S * 1e9:
        return 0
    sent_ns = arrivals_ns[-1] - arrivals_ns[0]
    return max(1, round((len(arrivals_ns) - 1) * silent_ns / sent_ns)) if sent_ns else 1


def rounds(rows: npt.NDArray[np.int64]) -> list[npt.NDArray[np.int64]]:
    """Rows cut where the source paused for more than 0.3 s."""
    gaps = np.flatnonzero(np.diff(rows[:, 1]) > 0.3e9) + 1
    return [part for part in np.split(rows, gaps) if len(part)]


def stage_medians(rows: npt.NDArray[np.int64]) -> dict[str, float]:
    """Median of each of ``STAGES`` [s], whose columns follow the first three of the rows [ns]."""
    columns = zip(STAGES, rows.T[3:], strict=False)
    return {
        name: float(np.median(known)) * 1e-9
        for name, column in columns
        if len(known := column[column >= 0])
    }


def progress_bar() -> Progress:
    """A progress bar on stderr, shown only in a terminal."""
    columns = (TextColumn("{task.description:32}"), BarColumn(), TimeElapsedColumn())
    return Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty())


def finish(
    name: str,
    values: dict[str, Any],
    show: Callable[[], None],
    *,
    as_json: bool,
    save: bool,
    out: Path | None = None,
) -> None:
    """Print a result, by ``show`` or as JSON; append it to the history, or write ``out``.

    Raises:
        ConfigError: The history is not there, see ``append_history``.
    """
    text = json.dumps({**values, "machine": machine()}, indent=2)
    if as_json:
        print(text)
    else:
        show()
    if out is not None:
        write_result(out, text + "\n")
    if save:
        append_history(name, values)


def write_result(path: Path, text: str) -> None:
    """Write a file of a result; its folder is made if there is none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def machine() -> dict[str, Any]:
    """The machine that it was measured on."""
    return {
        "cpus": os.cpu_count(),
        "cpu": _cpu_model(),
        "python": platform.python_version(),
        "load_1min": round(os.getloadavg()[0], 2),
    }


def _cpu_model() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:  # not Linux
        pass
    return platform.processor() or platform.machine()


def history_folder() -> Path:
    """Where ``history.jsonl`` is: ``tests/benchmarks`` of the working tree.

    Raises:
        ConfigError: The command does not run in palpate's working tree.
    """
    folder = Path("tests/benchmarks")
    if not folder.is_dir():
        raise ConfigError(
            f"--save: {folder.absolute()} does not exist",
            remedy="run it from the top of palpate's working tree, or leave out --save",
        )
    return folder


def append_history(name: str, values: dict[str, Any]) -> Path:
    """Append one line to ``tests/benchmarks/history.jsonl`` of the working tree.

    Raises:
        ConfigError: The command does not run in palpate's working tree.
    """
    path = history_folder() / "history.jsonl"
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    line = {
        "benchmark": name,
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "commit": commit or None,
        "machine": machine(),
        **values,
    }
    with open(path, "a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")
    return path
