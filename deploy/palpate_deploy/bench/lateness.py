"""When a device in software could not keep its own time: then it is no device.

A busy host puts an emulator aside for many milliseconds, which no sensor ever does. What it sends
then says nothing of the gateway, and is left out of what is measured.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import numpy.typing as npt

LATE_S = 5e-3
"""A sample that is sent later than this was due is of a starved emulator [s]."""

_BEFORE_S, _AFTER_S = 0.05, 0.3
"""What lies around such a sample is left out: slots that come in a burst, times that follow [s]."""

Floats = npt.NDArray[np.float64]


class Lateness:
    """Notes late samples of one process."""

    def __init__(self) -> None:
        self._spans: list[tuple[float, float]] = []

    def note(self, due_s: float) -> None:
        """A sample is sent now that was due then [s, monotonic]."""
        now_s = time.monotonic()
        if now_s - due_s <= LATE_S:
            return
        if self._spans and due_s <= self._spans[-1][1]:
            self._spans[-1] = (min(self._spans[-1][0], due_s), now_s)
        else:
            self._spans.append((due_s, now_s))

    def write(self, path: Path) -> None:
        """Keep what was noted, whole or not at all."""
        made = path.with_suffix(".part")
        with made.open("wb") as file:
            np.save(file, np.array(self._spans, np.float64).reshape(-1, 2))
        made.rename(path)


class OnTime:
    """Which instants count.

    Args:
        spans_s: Beginnings and ends of what does not [s, monotonic], shape ``(N, 2)``.
    """

    def __init__(self, spans_s: Floats) -> None:
        wide = spans_s + np.array([-_BEFORE_S, _AFTER_S])
        wide = wide[np.argsort(wide[:, 0])]
        self._starts = wide[:, 0]
        self._ends = np.maximum.accumulate(wide[:, 1]) if len(wide) else wide[:, 1]

    @classmethod
    def of(cls, paths: list[Path]) -> OnTime:
        """Of all devices together."""
        return cls(np.concatenate([np.zeros((0, 2)), *(np.load(path) for path in paths)]))

    def __call__(self, time_s: Floats) -> npt.NDArray[np.bool_]:
        """Whether each instant counts; of the shape of the times [s, monotonic]."""
        last = np.searchsorted(self._starts, time_s, side="right") - 1
        if not len(self._ends):
            return np.ones(np.shape(time_s), np.bool_)
        inside = (last >= 0) & (time_s <= self._ends[np.maximum(last, 0)])
        return np.asarray(~inside)
