"""The sensor's other channels, both ways: static and dynamic pressure, static and dynamic warmth.

Constants are those of the SP manual (learning notes, section 4.6). Low-passes above the rate at
which a channel is read are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from palpate_fem.electrodes.circuit import FULL_SCALE
from palpate_fem.electrodes.unit import UnitParameters

Floats = NDArray[np.float64]

PDC_PA = 36.5
"""Pressure of one count of PDC [Pa]."""

PAC_PA = 0.37
"""Pressure of one count of PAC [Pa]."""

PAC_RATE_HZ = 2200.0
"""Readings of PAC a second: 22 in a frame of 10 ms."""

PAC_HIGH_PASS_HZ = 10.0
TAC_BAND_HZ = (0.45, 22.6)
TAC_GAIN = 98.0
KELVIN = 273.15
# Thermistor 0.6444 exp(4025 / T) Ohm against 30 kOhm, as the maker writes the result.
BETA_K, UPPER, LOWER = 4025.0, 155183.0, 46555.0


def pdc_of(
    pressure_pa: Floats,
    unit: UnitParameters,
    *,
    force_n: Floats | float = 0.0,
    warmer_k: Floats | float = 0.0,
) -> Floats:
    """PDC [counts] of a fluid pressure above ambient [Pa], any shape; not rounded.

    Args:
        pressure_pa: Of the fluid [Pa].
        unit: The sensor; strain of the core and warmth leak into its PDC (section 4.6).
        force_n: Net force on the finger [N].
        warmer_k: Core's temperature above the unit's reference [K].
    """
    leak = unit.pdc_strain_pa_n * np.asarray(force_n) + unit.pdc_warmth_pa_k * np.asarray(warmer_k)
    shown = (np.asarray(pressure_pa) + leak) / PDC_PA
    return np.clip(unit.pdc_offset + shown, 0, FULL_SCALE)


def pressure_of_pdc(counts: Floats, unit: UnitParameters) -> Floats:
    """Fluid pressure above ambient [Pa] of PDC [counts], any shape."""
    return np.asarray((np.asarray(counts, np.float64) - unit.pdc_offset) * PDC_PA)


def pressure_of_pac(counts: Floats, unit: UnitParameters) -> Floats:
    """Vibration of the fluid pressure, above 10 Hz [Pa], of PAC [counts], any shape."""
    return np.asarray((np.asarray(counts, np.float64) - unit.pac_offset) * PAC_PA)


def tdc_of(temperature_c: Floats) -> Floats:
    """TDC [counts] of a core temperature [degrees C], any shape; not rounded."""
    ratio = np.exp(BETA_K / (np.asarray(temperature_c, np.float64) + KELVIN))
    return np.clip(FULL_SCALE * UPPER / (ratio + LOWER), 0, FULL_SCALE)


def temperature_of_tdc(counts: Floats) -> Floats:
    """Core temperature [degrees C] of TDC [counts] in 1..4095, any shape."""
    x = np.asarray(counts, np.float64) / FULL_SCALE
    return np.asarray(BETA_K / np.log((UPPER - LOWER * x) / x) - KELVIN)


@dataclass
class HighPass:
    """First-order high-pass, exact for inputs that are straight between readings.

    It starts at rest with the first input.
    """

    corner_hz: float
    rate_hz: float
    _slow: float | None = field(default=None, init=False)
    _last: float = field(default=0.0, init=False)

    def __call__(self, samples: Floats) -> Floats:
        """Filter the next samples (n,), any unit."""
        way = 2 * math.pi * self.corner_hz / self.rate_hz
        keep = math.exp(-way)
        # Weight of the newer end of a straight piece.
        newer = 1 - (1 - keep) / way
        out = np.empty(len(samples))
        for i, value in enumerate(np.asarray(samples, np.float64)):
            now = float(value)
            if self._slow is None:
                self._slow = self._last = now
            self._slow = keep * self._slow + (1 - keep - newer) * self._last + newer * now
            self._last = now
            out[i] = now - self._slow
        return out


@dataclass
class ContactCooling:
    """How an indenter of constant temperature cools the thermistor: one pole (section 4.6).

    Attributes:
        unit: The sensor; its `cooling_share` and `cooling_tau_s` are used.
        indenter_c: Temperature of the indenter [degrees C].
    """

    unit: UnitParameters
    indenter_c: float = 22.0
    _cooler: float = field(default=0.0, init=False)

    def read(self, core_c: float, touched: float, elapsed_s: float) -> float:
        """Temperature at the thermistor [degrees C].

        Args:
            core_c: Of the core, far from the contact [degrees C].
            touched: Share of the pad that is touched, 0..1.
            elapsed_s: Since the last reading [s].
        """
        goal = self.unit.cooling_share * touched * (core_c - self.indenter_c)
        keep = math.exp(-elapsed_s / self.unit.cooling_tau_s)
        self._cooler = goal + (self._cooler - goal) * keep
        return core_c - self._cooler


@dataclass
class PressureVibration:
    """PAC from the fluid's pressure.

    Attributes:
        unit: The sensor.
        rate_hz: Readings a second.
    """

    unit: UnitParameters
    rate_hz: float = PAC_RATE_HZ

    def __post_init__(self) -> None:
        self._pass = HighPass(PAC_HIGH_PASS_HZ, self.rate_hz)

    def read(self, pressure_pa: Floats) -> Floats:
        """PAC [counts], shape (n,), of the next pressures [Pa], shape (n,); not rounded."""
        return np.clip(self.unit.pac_offset + self._pass(pressure_pa) / PAC_PA, 0, FULL_SCALE)


@dataclass
class TemperatureChange:
    """TAC from the core's temperature: TDC, band-passed and amplified.

    Attributes:
        unit: The sensor.
        rate_hz: Readings a second.
    """

    unit: UnitParameters
    rate_hz: float = 100.0

    def __post_init__(self) -> None:
        self._slow = HighPass(TAC_BAND_HZ[0], self.rate_hz)
        self._fast = HighPass(TAC_BAND_HZ[1], self.rate_hz)

    def read(self, temperature_c: Floats) -> Floats:
        """TAC [counts], shape (n,), of the next temperatures [degrees C]; not rounded."""
        change = self._slow(tdc_of(temperature_c))
        low = change - self._fast(change)
        return np.clip(self.unit.tac_offset + TAC_GAIN * low, 0, FULL_SCALE)
