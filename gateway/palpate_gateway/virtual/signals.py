"""What the virtual finger's converter makes of the physics: PAC, slow channels, 12-bit counts."""

from __future__ import annotations

import math

import numpy as np

from palpate.messages import COUNTS_MAX, PAC_SAMPLES, CountArray
from palpate_gateway.virtual.geometry import Array

ELECTRODE_NOISE = 0.5
"""Settled sensor at 100 Hz: 0.3-0.6 counts, sd (learning reference 4.5)."""

PAC_NOISE = 2.0
"""Idle sensors of public captures: about 5 counts peak, sd."""

SLOW_NOISE = 0.5
"""Of PDC, TAC and TDC [counts], sd."""

WRENCH_SERIAL = "VIRTUAL-FT"
"""Serial number of the virtual force/torque sensor."""

PAC_PA_PER_COUNT = 0.37
PAC_HIGH_PASS_S = 1.0 / (2.0 * math.pi * 10.0)
"""PAC passes 10 Hz and up: for slow pressing it reads this times the rate of pressure [s]."""

PDC_PA_PER_COUNT = 36.5

_PAC_REST = 2040.0
_TAC_REST = 2050.0
_TDC_REST = 1900.0
_TDC_WARM_UP = 60.0
_WARM_UP_S = 600.0


def warmth(time_s: Array) -> Array:
    """How far the core has warmed up since power-on, 0 to 1."""
    return 1.0 - np.exp(-time_s / _WARM_UP_S)


def pac(pressure: Array, rate_hz: float) -> Array:
    """Noise-free PAC [counts], shape ``(N, 22)``, from the pressure at N + 2 frame starts [Pa]."""
    speed = np.diff(pressure) * (rate_hz * PAC_HIGH_PASS_S / PAC_PA_PER_COUNT)
    share = np.arange(PAC_SAMPLES) / PAC_SAMPLES
    return _PAC_REST + speed[:-1, None] * (1.0 - share) + speed[1:, None] * share


def slow_channels(pressure: Array, pdc_rest: float, time_s: Array) -> Array:
    """Noise-free PDC, TAC, TDC [counts], shape ``(N, 3)``."""
    return np.stack(
        [
            pdc_rest + pressure / PDC_PA_PER_COUNT,
            np.full(len(time_s), _TAC_REST),
            _TDC_REST + _TDC_WARM_UP * warmth(time_s),
        ],
        axis=1,
    )


def converted(values: Array) -> CountArray:
    """12-bit counts."""
    return np.clip(np.rint(values), 0, COUNTS_MAX).astype(np.uint16)
