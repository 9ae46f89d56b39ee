"""The place of a slot in its stream, of one and of many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Place:
    """Where a slot belongs.

    Attributes:
        run: Counts connections and changes of the sequence, from 0.
        frame: Frame number from 0, with those that were lost.
        position: Place in the sequence.
        time_s: When it was sampled [s], by the clock of the stamps: on the grid of slots, which
            begins anew where frames were lost; the stamp itself if stamps are exact.
    """

    run: int
    frame: int
    position: int
    time_s: float


@dataclass(frozen=True, slots=True)
class Places:
    """Where slots belong; see ``Place``.

    Attributes:
        kept: Which of the slots have a place, int64, shape ``(N,)``.
        run: int64, shape ``(N,)``, as are frame and position.
        frame: Frame numbers.
        position: Places in the sequence.
        time_s: When they were sampled [s], float64, shape ``(N,)``.
    """

    kept: Ints
    run: Ints
    frame: Ints
    position: Ints
    time_s: Floats

    def __len__(self) -> int:
        return len(self.kept)
