"""Counts to physical units, by the maker's formulas (hardware reference 1.9).

palpate publishes counts and learns from counts; physical units are for people and plots. The
formulas are the maker's nominal ones, not a calibration of the single sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.messages import COUNTS_MAX

Floats = npt.NDArray[np.float64]

LOAD_OHM = 10e3
"""Resistor below the electrode in its voltage divider [Ohm]."""

ZERO_CELSIUS_K = 273.15

_BETA_K, _UPPER, _LOWER = 4025.0, 155183.0, 46555.0


@dataclass(frozen=True, slots=True)
class PressureScale:
    """Pressure per count of one model.

    Attributes:
        pdc_pa: Static pressure per count [Pa].
        pac_pa: Dynamic pressure per count [Pa].
    """

    pdc_pa: float
    pac_pa: float


BIOTAC = PressureScale(pdc_pa=36.5, pac_pa=0.37)
BIOTAC_SP = PressureScale(pdc_pa=36.5, pac_pa=0.37)
NUMATAC = PressureScale(pdc_pa=12.94, pac_pa=0.13)

PRESSURE_SCALES: dict[str, PressureScale] = {
    "biotac": BIOTAC,
    "biotac_sp": BIOTAC_SP,
    "numatac": NUMATAC,
}
"""Scales by the name of the model, for settings."""


def tared(counts: npt.ArrayLike, baseline: npt.ArrayLike) -> Floats:
    """Counts minus their untouched mean [counts].

    TAC has no other unit: the maker's formula gives a nearly constant negative rate at rest, where
    the temperature does not change, so it is not given in K/s.

    Args:
        counts: Raw counts, any shape.
        baseline: Untouched mean [counts], of a shape that broadcasts.
    """
    # Subtracting unsigned counts would wrap around.
    return np.asarray(counts, np.float64) - np.asarray(baseline, np.float64)


def electrode_impedance(counts: npt.ArrayLike) -> Floats:
    """Impedance between an electrode and the excitation [Ohm], in the shape of the counts.

    Pressing thins the fluid, so the impedance rises and the counts fall. They saturate at 0, where
    the impedance is infinite.

    Args:
        counts: Raw counts, not tared, any shape.
    """
    raw = np.asarray(counts, np.float64)
    with np.errstate(divide="ignore"):
        return np.asarray((COUNTS_MAX / raw - 1.0) * LOAD_OHM, np.float64)


def pdc_pressure(
    counts: npt.ArrayLike, baseline: npt.ArrayLike, scale: PressureScale = BIOTAC
) -> Floats:
    """Static pressure above the untouched one [Pa].

    Args:
        counts: Raw counts, any shape.
        baseline: Untouched mean [counts].
        scale: The model's scale.
    """
    return tared(counts, baseline) * scale.pdc_pa


def pac_pressure(
    counts: npt.ArrayLike, baseline: npt.ArrayLike, scale: PressureScale = BIOTAC
) -> Floats:
    """Dynamic pressure about the untouched one [Pa].

    Args:
        counts: Raw counts, any shape.
        baseline: Untouched mean [counts].
        scale: The model's scale.
    """
    return tared(counts, baseline) * scale.pac_pa


def tdc_temperature(counts: npt.ArrayLike) -> Floats:
    """Temperature of the heated core [K], in the shape of the counts; NaN at 0 counts.

    Three public data sets disagree by 20 K at rest: differences mean more than levels.

    Args:
        counts: Raw counts, not tared, any shape.
    """
    share = np.asarray(counts, np.float64) / COUNTS_MAX
    share = np.where(share > 0.0, share, np.nan)
    return np.asarray(_BETA_K / np.log((_UPPER - _LOWER * share) / share), np.float64)


def celsius(kelvin: npt.ArrayLike) -> Floats:
    """Degrees Celsius, for people."""
    return np.asarray(kelvin, np.float64) - ZERO_CELSIUS_K
