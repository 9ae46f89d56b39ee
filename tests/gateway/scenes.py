"""What emulated devices measure in tests, and whether a reading shows it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from palpate.messages import COUNTS_MAX
from palpate_gateway.emulators.emulator import Wrench

SHARES = (1.0, -2.0, 3.0, 0.1, -0.05, 0.02)

FINE = (1e-3,) * 3 + (1e-4,) * 3
"""What a wrench may differ from the one that was felt [N] and [N m]."""

COARSE = (0.06,) * 3 + (4e-3,) * 3
"""The same of a sensor that counts 50 a newton, whose ramp is told in steps of Fz."""

_PERIOD_S = 1.3
_POSE = 1e-6
_AT_REST = np.array([*(2000 + 50 * k for k in range(19)), 2600, 2045, 1914])
_PAC = range(2040, 2045)
_CHANNELS = 44


def ramp(t: float) -> Wrench:
    """All six in fixed shares of one number: parts of two samples do not fit together."""
    level = 1.0 + 7.0 * (t % _PERIOD_S)
    fx, fy, fz, tx, ty, tz = (share * level for share in SHARES)
    return fx, fy, fz, tx, ty, tz


def was_felt(
    force: npt.ArrayLike, torque: npt.ArrayLike, tolerance: Sequence[float] = FINE
) -> bool:
    """Whether these are a wrench of the ramp."""
    told = np.concatenate([force, torque]).astype(np.float64)
    level = float(told[2]) / SHARES[2]
    near = np.abs(told - level * np.array(SHARES)) <= tolerance
    return bool(near.all()) and 0.9 < level < 1.1 + 7.0 * _PERIOD_S


def was_measured(
    electrodes: npt.ArrayLike,
    slow: Sequence[int],
    pac: npt.ArrayLike,
    validity: int,
    *,
    saturated: bool = False,
) -> bool:
    """Whether every channel that claims to be good is what the idle first finger measured.

    Args:
        electrodes: E1 to E19.
        slow: PDC, TAC, TDC.
        pac: 22 samples.
        validity: Of all 44, in this order.
        saturated: It measured full scale in all channels, or did a moment ago.
    """
    good = np.array([validity >> bit & 1 for bit in range(_CHANNELS)], np.bool_)
    told = np.concatenate([electrodes, slow, pac])
    right = np.concatenate(
        [
            told[: len(_AT_REST)] == _AT_REST,
            np.isin(told[len(_AT_REST) :], _PAC),
        ]
    )
    if saturated:
        right |= told == COUNTS_MAX
    return bool(right[good].all())


def was_approached(position: npt.ArrayLike, orientation: npt.ArrayLike) -> bool:
    """Whether this is the tip on its way down to the pad and back, as emulated robots move it."""
    x, y, z = np.asarray(position, np.float64)
    straight = abs(abs(float(np.asarray(orientation)[0])) - 1.0) < _POSE
    return straight and math.hypot(x + 0.004, y) < _POSE and -0.016 - _POSE < z < -0.009 + _POSE
