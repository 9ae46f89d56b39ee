"""The voltage divider and its converter: impedances to counts and back.

A short pulse drives the excitation electrodes; the electrode that is asked stands in series with a
load, whose voltage is converted with 12 bits (SP manual; learning notes, sections 0.4 and 4.1)::

    E = 4095 R_L / (R_L + Z + Z_s) (1 + gain) + offset
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_fem.electrodes.unit import UnitParameters

Floats = NDArray[np.float64]
Counts = NDArray[np.uint16]

FULL_SCALE = 4095


def ideal_counts(impedance: Floats, unit: UnitParameters) -> Floats:
    """Counts before noise, rounding and the converter's ends.

    Args:
        impedance: Z of the film [Ohm], shape (..., 19).
        unit: The sensor.

    Returns:
        Counts, shape (..., 19).
    """
    total = unit.load_ohm + unit.series_ohm + unit.asymmetry_array * impedance
    ideal = FULL_SCALE * unit.load_ohm / total
    return np.asarray(ideal * (1 + unit.gain_array) + unit.offset_array)


def counts_slope(impedance: Floats, unit: UnitParameters) -> Floats:
    """Derivative d counts / d Z [1/Ohm], shape (..., 19); negative."""
    total = unit.load_ohm + unit.series_ohm + unit.asymmetry_array * impedance
    slope = -FULL_SCALE * unit.load_ohm / total**2 * unit.asymmetry_array
    return np.asarray(slope * (1 + unit.gain_array))


def convert(ideal: Floats) -> Counts:
    """What the converter says: the nearest of 0..4095."""
    return np.clip(np.rint(ideal), 0, FULL_SCALE).astype(np.uint16)


def impedance_of(counts: Floats | Counts, unit: UnitParameters) -> Floats:
    """Z that reads as these counts [Ohm], shape (..., 19): the inverse of `ideal_counts`.

    NaN at and beyond the ends of the range, where no positive impedance reads so.
    """
    ideal = (np.asarray(counts, np.float64) - unit.offset_array) / (1 + unit.gain_array)
    good = (ideal > 0) & (ideal < FULL_SCALE)
    total = FULL_SCALE * unit.load_ohm / np.where(good, ideal, np.nan)
    film = (total - unit.load_ohm - unit.series_ohm) / unit.asymmetry_array
    return np.asarray(np.where(film > 0, film, np.nan))


def log_response(counts: Floats | Counts, rest: Floats | Counts, unit: UnitParameters) -> Floats:
    """ln(Z0 / Z), shape (..., 19): does not depend on the conductivity (section 0.5)."""
    return np.asarray(np.log(impedance_of(rest, unit) / impedance_of(counts, unit)))
