"""The level of the untouched sensor, and how far it has drifted from the tare.

Stillness alone does not tell: a constant press is still too. What tells is how the sensor got to
where it rests. As long as nothing moves it stays untouched, and what its level does is drift. After
a movement it is untouched again only if it rests where it rested before, give or take what heat and
a relaxing skin do: they move all electrodes alike and the pressure little, a press moves some
electrodes and the pressure much.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
import numpy.typing as npt

from palpate.messages import Tare
from palpate_gateway.condition.blocks import Floats

EVEN_COUNTS, EVEN_SHARE = 25.0, 0.2
"""Drift moves no electrode by more than this beside the median of all [counts], and this share of
it: of real sensors that drifted by 169 counts in three minutes untouched none moved by more than 31
beside it; a hand that held a finger lightly moved some by 230, and the median by 3."""

PDC_BAND_COUNTS = 40.0
"""Drift moves PDC by less [counts]; a hand that held the finger lightly moved it by 330."""

_Usable = npt.NDArray[np.bool_]


class Touch(Enum):
    """What is known of touches."""

    UNKNOWN = "not tared yet"
    UNTOUCHED = "untouched"
    MOVING = "touched or moving"
    HELD = "still, but not where it rested untouched"


class UntouchedLevel:
    """Follows one sensor from block to block.

    Args:
        electrodes: Number of electrodes.
    """

    def __init__(self, electrodes: int) -> None:
        self.touch = Touch.UNKNOWN
        self._electrodes = electrodes
        self._level: tuple[Floats, float] | None = None
        self._tare: tuple[Floats, float] | None = None
        self.drift_counts = 0.0
        """Greatest distance of an electrode from the tare, when it was last untouched [counts]."""
        self.drift_electrode = 0
        """Which one, from 0."""

    @property
    def known(self) -> bool:
        """Whether there is a tare to compare with."""
        return self._tare is not None

    def tared(self, tare: Tare) -> None:
        """Somebody, or the gateway, took the present level for untouched."""
        self._tare = self._level = tare.electrodes.astype(np.float64), tare.pdc
        self.drift_counts = 0.0

    def moved(self) -> None:
        """The sensor is not still."""
        if self.touch is not Touch.UNKNOWN or self.known:
            self.touch = Touch.MOVING

    def rests_at(self, electrodes: Floats, pdc: float, usable: _Usable) -> None:
        """The sensor is still.

        Args:
            electrodes: Mean raw counts, shape ``(E,)``.
            pdc: Mean raw PDC [counts].
            usable: Electrodes that are looked at, bool, shape ``(E,)``; at least one.
        """
        if self._level is None or self._tare is None:
            return
        if not (
            is_drift(electrodes - self._level[0], pdc - self._level[1], usable)
            and is_drift(electrodes - self._tare[0], pdc - self._tare[1], usable)
        ):
            self.touch = Touch.HELD
            return
        self.touch = Touch.UNTOUCHED
        self._level = np.where(usable, electrodes, self._level[0]), pdc
        distance = np.where(usable, np.abs(electrodes - self._tare[0]), 0.0)
        self.drift_electrode = int(np.argmax(distance))
        self.drift_counts = float(distance[self.drift_electrode])


def is_drift(change: Floats, pdc_change: float, usable: _Usable) -> bool:
    """Whether a change of level is one that an untouched sensor makes.

    Args:
        change: Of the electrodes [counts], shape ``(E,)``.
        pdc_change: Of PDC [counts].
        usable: Electrodes that are looked at, bool, shape ``(E,)``.
    """
    # In plain Python, which is faster for so few.
    looked_at = sorted(change[usable].tolist())
    common = looked_at[len(looked_at) // 2]
    uneven = max(looked_at[-1] - common, common - looked_at[0])
    even: bool = uneven <= EVEN_COUNTS + EVEN_SHARE * abs(common)
    return even and abs(pdc_change) <= PDC_BAND_COUNTS
