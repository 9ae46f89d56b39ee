"""Slots made one by one, for tests that write them down."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from palpate_gateway.biotac.slots import UNKNOWN, SlotBlock


class Slot(NamedTuple):
    """One sampled channel: id, raw counts, parity good, device time [s], batch and frame index."""

    channel: int
    value: int
    good: bool
    time_s: float
    batch: int
    frame: int
    position: int = UNKNOWN


def slot_block(slots: Sequence[Slot]) -> SlotBlock:
    """Single slots as a block."""
    columns = list(zip(*slots, strict=True)) or [()] * 7
    kinds = (np.int64, np.uint16, np.bool_, np.float64, np.int64, np.int64, np.int64)
    return SlotBlock(*(np.array(c, k) for c, k in zip(columns, kinds, strict=True)))
