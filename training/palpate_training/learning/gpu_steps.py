"""Training steps on a GPU: a step is recorded once and then launched as a whole.

A step of a small network is some ninety kernels of a few microseconds, about as long as it takes to
launch one. What a training takes is in training/LOG.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

_WARM_UP_STEPS = 3
"""Steps before the recording, as torch asks: they make what is made once."""


def recorded(step: Callable[[Tensor], None], batch_rows: int) -> Callable[[Tensor], None]:
    """A step that is launched as one; batches of another size are taken kernel by kernel.

    Args:
        step: Trains on the rows of these numbers; must not read anything back from the GPU.
        batch_rows: Rows in all batches but the last.
    """
    picked = torch.zeros(batch_rows, dtype=torch.int64)
    beside = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    graph = torch.cuda.CUDAGraph()
    taken = 0

    def take(rows: Tensor) -> None:
        nonlocal taken
        if len(rows) != batch_rows:
            step(rows)
            return
        picked.copy_(rows)
        taken += 1
        if taken <= _WARM_UP_STEPS:
            beside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(beside):
                step(picked)
            torch.cuda.current_stream().wait_stream(beside)
            return
        if taken == _WARM_UP_STEPS + 1:
            with torch.cuda.graph(graph):
                step(picked)
        graph.replay()

    return take


class CosineRate:
    """What ``CosineAnnealingLR`` does to a learning rate that lies on the GPU, in one launch.

    Args:
        rate: The learning rate, shape (); starts with the value that it has.
        steps: In which it falls.
        end: Value after them.
    """

    def __init__(self, rate: Tensor, steps: int, end: float) -> None:
        self._rate = rate
        self._start, self._end, self._steps = float(rate), end, steps
        self._taken = 0

    def step(self) -> None:
        """Lower it, once after each training step."""
        self._taken += 1
        share = 0.5 * (1.0 + math.cos(math.pi * self._taken / self._steps))
        self._rate.fill_(self._end + (self._start - self._end) * share)
