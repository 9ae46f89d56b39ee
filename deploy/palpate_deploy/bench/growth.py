"""What processes use while they run: samples of /proc, and whether memory grows.

The memory of a working process goes up and down; what it never gives back is the lower edge of
that. So the slope is fitted through the smallest value of each of ``BINS`` parts of the time, and
its uncertainty comes from how far these lie from the line.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

import numpy as np
import numpy.typing as npt

MEGABYTE = 1e6
BINS = 12
"""Parts of the time after warm-up; in 20 minutes each has 100 s, so two rotations of a record."""

LIMIT_MB_PER_H = 1.0
_TWO_SIDED_95 = 2.228  # Student's t with BINS - 2 degrees of freedom
_SERVICE = re.compile(r"palpate_deploy\0run\0(\w+)")


@dataclass(frozen=True, slots=True)
class Use:
    """What one process uses: resident memory [bytes], threads, open descriptors."""

    rss_bytes: int
    threads: int
    descriptors: int


class Verdict(StrEnum):
    """Whether a process keeps within its memory."""

    STEADY = "steady"
    GROWS = "grows"
    UNDECIDED = "undecided"


def use_of(pid: int) -> Use | None:
    """What a process uses now; None if it has ended."""
    try:
        text = Path(f"/proc/{pid}/status").read_text("utf-8", "replace")
        descriptors = len(os.listdir(f"/proc/{pid}/fd"))
    except OSError:
        return None
    rows = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    if "VmRSS" not in rows:  # ended, but not yet waited for
        return None
    return Use(int(rows["VmRSS"].split()[0]) << 10, int(rows["Threads"]), descriptors)


def processes_below(root: int) -> dict[str, int]:
    """Ids of a station's processes by service; ``root`` is that of ``palpate up``.

    supervisord, and ``palpate up`` itself, are among them.
    """
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):  # ended meanwhile, or no process
            pid = int(entry.name)
            parent = int((entry / "stat").read_text("utf-8").rpartition(")")[2].split()[1])
            children.setdefault(parent, []).append(pid)
    found = {"up": root}
    waiting = list(children.get(root, []))
    while waiting:
        pid = waiting.pop()
        waiting += children.get(pid, [])
        with contextlib.suppress(OSError):
            command = Path(f"/proc/{pid}/cmdline").read_text("utf-8", "replace")
            if match := _SERVICE.search(command):
                found.setdefault(match[1], pid)
            elif "supervisord" in command:
                found.setdefault("supervisord", pid)
    return found


@dataclass(frozen=True, slots=True)
class Growth:
    """How the use of one process develops after warm-up.

    Attributes:
        rss_mb: Resident memory at the end, smallest of the last part [MB].
        slope_mb_per_h: Growth of the memory [MB/h].
        slope_ci95_mb_per_h: Half the width of its 95 % confidence interval [MB/h].
        threads: Smallest number in the first and in the last third of the time.
        descriptors: The same of open descriptors.
        restarts: How often another process had its place.
        verdict: Of the memory.
    """

    rss_mb: float
    slope_mb_per_h: float
    slope_ci95_mb_per_h: float
    threads: tuple[int, int]
    descriptors: tuple[int, int]
    restarts: int
    verdict: Verdict

    @property
    def constant(self) -> bool:
        """Whether threads and descriptors are no more than they were."""
        return all(last <= first for first, last in (self.threads, self.descriptors))

    @property
    def fine(self) -> bool:
        """Whether nothing grows, as far as this measurement can tell."""
        return self.constant and not self.restarts and self.verdict is not Verdict.GROWS


@dataclass(slots=True)
class History:
    """Samples of one process."""

    times_s: list[float] = field(default_factory=list)
    uses: list[Use] = field(default_factory=list)
    pids: list[int] = field(default_factory=list)

    def add(self, time_s: float, pid: int, use: Use) -> None:
        """Add a sample."""
        self.times_s.append(time_s)
        self.pids.append(pid)
        self.uses.append(use)

    def samples_since(self, since_s: float) -> int:
        """How many samples there are from a time on."""
        return len(self.times_s) - int(np.searchsorted(self.times_s, since_s))

    def growth(self, since_s: float) -> Growth:
        """How it develops after ``since_s``, which is the end of the warm-up.

        Raises:
            ValueError: There are fewer than two samples for each of ``BINS`` parts.
        """
        first = int(np.searchsorted(self.times_s, since_s))
        times = np.array(self.times_s[first:])
        if len(times) < 2 * BINS:
            raise ValueError(f"{len(times)} samples after the warm-up, {2 * BINS} are needed")
        uses = self.uses[first:]
        rss = np.array([use.rss_bytes for use in uses]) / MEGABYTE
        slope, half = slope_of(times / 3600.0, rss)
        third = len(uses) // 3
        return Growth(
            rss_mb=float(rss[-max(2, len(rss) // BINS) :].min()),
            slope_mb_per_h=slope,
            slope_ci95_mb_per_h=half,
            threads=_ends([use.threads for use in uses], third),
            descriptors=_ends([use.descriptors for use in uses], third),
            restarts=len(set(self.pids)) - 1,
            verdict=verdict_of(slope, half),
        )


def _ends(values: Sequence[int], third: int) -> tuple[int, int]:
    return min(values[:third]), min(values[-third:])


def slope_of(
    times: npt.NDArray[np.float64], values: npt.NDArray[np.float64]
) -> tuple[float, float]:
    """Slope of the lower edge, and half of its 95 % confidence interval, in values per time."""
    parts = np.array_split(np.arange(len(times)), BINS)
    lowest = np.array([part[np.argmin(values[part])] for part in parts])
    x, y = times[lowest], values[lowest]
    centred = x - x.mean()
    spread = float(centred @ centred)
    slope = float(centred @ y) / spread
    residuals = y - y.mean() - slope * centred
    error = float(np.sqrt(residuals @ residuals / (BINS - 2) / spread))
    return slope, _TWO_SIDED_95 * error


def verdict_of(slope: float, half: float) -> Verdict:
    """Whether a slope is below the limit, above it, or not known well enough."""
    if slope + half < LIMIT_MB_PER_H:
        return Verdict.STEADY
    return Verdict.GROWS if slope - half > LIMIT_MB_PER_H else Verdict.UNDECIDED


def growths(histories: Mapping[str, History], since_s: float) -> dict[str, Growth]:
    """Growth of each process, in order of names; without those that were there too short a time."""
    return {
        name: history.growth(since_s)
        for name, history in sorted(histories.items())
        if history.samples_since(since_s) >= 2 * BINS
    }
