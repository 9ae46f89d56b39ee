"""The one signal that everything measures in ``palpate bench alignment``, and reading time off it.

A press that rises and falls evenly, twice a second, by the host's monotonic clock: whoever knows a
value and about when it was taken knows when it was taken.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

RAMP_S = 0.25
"""How long it rises, and falls [s]."""

MARGIN_S = 0.025
"""Readings nearer to a turning point are left out: there a value has two times [s]."""


def share_at(time_s: Floats) -> Floats:
    """How far it is pressed, 0..1, at monotonic times [s]."""
    place = np.mod(time_s / RAMP_S, 2.0)
    return np.asarray(1.0 - np.abs(place - 1.0))


def time_of(share: Floats, about_s: Floats) -> Floats:
    """When it was pressed so far [s]; NaN near turning points.

    Args:
        share: 0..1.
        about_s: When that was, to a tenth of a ramp [s]; of the same shape.
    """
    ramp = np.floor(about_s / RAMP_S)
    rising = np.mod(ramp, 2.0) == 0.0
    time_s = RAMP_S * (ramp + np.where(rising, share, 1.0 - share))
    past_s = about_s - RAMP_S * ramp
    clear = (past_s > MARGIN_S) & (past_s < RAMP_S - MARGIN_S)
    return np.where(clear, time_s, np.nan)
