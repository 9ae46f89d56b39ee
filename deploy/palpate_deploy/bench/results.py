"""Latencies to the few numbers that are reported, and where they are kept."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Latency:
    """Of one side: percentiles [s], how many estimates, how many frames got none."""

    p50_s: float
    p99_s: float
    max_s: float
    count: int
    lost: int


def latency(rows: npt.NDArray[np.int64], *, warm_up: int, lost: int) -> Latency:
    """Numbers of rows of one side.

    Args:
        rows: Sequence, stamp [ns] and arrival [ns], shape ``(N, 3)``.
        warm_up: Estimates left out after each pause: links and caches wake up.
        lost: Frames that got no estimate.
    """
    kept = np.concatenate([part[warm_up:] for part in rounds(rows)])
    ages_s = (kept[:, 2] - kept[:, 1]) * 1e-9
    p50, p99 = np.percentile(ages_s, (50, 99))
    return Latency(float(p50), float(p99), float(ages_s.max()), len(ages_s), lost)


def rounds(rows: npt.NDArray[np.int64], *, pause_s: float = 0.3) -> list[npt.NDArray[np.int64]]:
    """Rows cut where the source paused."""
    gaps = np.flatnonzero(np.diff(rows[:, 1]) > pause_s * 1e9) + 1
    return [part for part in np.split(rows, gaps) if len(part)]


def plain(side: Latency) -> dict[str, Any]:
    """Numbers as JSON."""
    return asdict(side)


def machine() -> dict[str, Any]:
    """What it was measured on."""
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


def append_history(name: str, values: dict[str, Any]) -> Path:
    """Append one line to ``tests/benchmarks/history.jsonl`` of the working tree.

    Raises:
        ConfigError: The command was not given in palpate's working tree.
    """
    folder = Path("tests/benchmarks")
    if not folder.is_dir():
        raise ConfigError(
            f"--save: {folder.absolute()} does not exist",
            remedy="run it from the top of palpate's working tree, or leave out --save",
        )
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
    path = folder / "history.jsonl"
    with open(path, "a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")
    return path
