"""The virtual finger's converter: from ideal counts and pressure to the counts of all channels.

It adds temperature, creep and noise, and makes PDC, PAC, TDC and TAC. Formulas and constants are
those of the twin's electrodes (learning notes, sections 4.5 and 4.6):

* conductivity follows the core's temperature, which its own electronics raise with one time
  constant;
* creep: a share of every change of an electrode comes late, with one time constant;
* PDC is 36.5 Pa per count; PAC, a first-order high-pass at 10 Hz, 0.37 Pa per count;
* TDC is a thermistor, TAC its amplified rate of change.

Left out: low-pass filters above the rate at which a channel is read, and the converter's gain and
offset errors in the small effect of temperature.
"""

from __future__ import annotations

import math

import numpy as np

from palpate.anatomy import spatial_modes
from palpate.files.tape import TapeSpecimen
from palpate.messages import COUNTS_MAX, PAC_SAMPLES, CountArray
from palpate_gateway.virtual.model import Array, SampledFrames

PAC_NOISE = 2.0
"""Noise of PAC [counts], sd; idle sensors of public captures show about 5 counts peak."""

SLOW_NOISE = 0.5
"""Noise of PDC, TAC and TDC [counts], sd."""

PAC_PA_PER_COUNT = 0.37
PAC_HIGH_PASS_S = 1.0 / (2.0 * math.pi * 10.0)
"""Time constant of PAC's high-pass at 10 Hz [s]: for slow changes PAC is this times the rate."""

PDC_PA_PER_COUNT = 36.5

_KELVIN = 273.15
# Thermistor 0.6444 exp(4025 / T) Ohm against 30 kOhm, as the maker writes the result.
_BETA_K, _UPPER, _LOWER = 4025.0, 155183.0, 46555.0
_TAC_GAIN = 98.0
_TAC_HIGH_PASS_S = 1.0 / (2.0 * math.pi * 0.45)


def converted(values: Array) -> CountArray:
    """Values [counts] as 12-bit counts: rounded and limited to 0..4095."""
    return np.clip(np.rint(values), 0, COUNTS_MAX).astype(np.uint16)


def tdc_of(temperature_c: Array) -> Array:
    """TDC [counts] of a core temperature [degrees C], any shape; not rounded."""
    return COUNTS_MAX * _UPPER / (np.exp(_BETA_K / (temperature_c + _KELVIN)) + _LOWER)


class TwinSensor:
    """One specimen of a tape over time.

    Its states (creep, PAC) are advanced frame by frame and exactly, so the counts do not depend on
    how many frames are computed at once.

    Args:
        on_for_s: Time since power-on at its first frame [s].
        seed: Seed of noise and of the temperature gradient over the core.
    """

    def __init__(self, unit: TapeSpecimen, *, rate_hz: float, on_for_s: float, seed: int) -> None:
        self._unit = unit
        self._rate_hz = rate_hz
        self._on_for_s = on_for_s
        self._random = np.random.default_rng([seed, 2])
        self._rest = unit.rest_counts.astype(np.float64)
        sizes = self._random.standard_normal(2) * (unit.gradient_sd / math.sqrt(2.0))
        self._modes: Array = sizes @ spatial_modes()
        self._creep: Array = np.zeros_like(self._rest)
        self._creep_kept = math.exp(-1.0 / (rate_hz * unit.creep_tau_s))
        self._vibration_pa = 0.0
        slots = np.arange(PAC_SAMPLES + 1) / PAC_SAMPLES
        self._pac_kept: Array = np.exp(-slots / (rate_hz * PAC_HIGH_PASS_S))

    def sample(self, ideal: Array, pressure_pa: Array, tick: int) -> SampledFrames:
        """Counts of the next N frames.

        Args:
            ideal: Ideal counts of the warm sensor, shape ``(N, 19)``.
            pressure_pa: Fluid pressure at the frames' starts and at the one after them [Pa], shape
                ``(N + 1,)``.
            tick: Tick of the first frame.
        """
        count = len(ideal)
        temperature_c, per_s = self._temperature(tick, count)
        # One draw per frame for all channels: blocks of any size get the same random numbers.
        noise = self._random.standard_normal((count, ideal.shape[1] + PAC_SAMPLES + 3))
        e_noise, p_noise, s_noise = np.split(noise, [ideal.shape[1], -3], axis=1)
        electrodes = self._warmed(self._crept(ideal), temperature_c)
        # Warming up is slow compared with TAC's passband, so the band-pass acts as a derivative.
        tac = _TAC_GAIN * _TAC_HIGH_PASS_S * per_s
        slow = np.stack(
            [
                self._unit.pdc_offset + pressure_pa[:count] / PDC_PA_PER_COUNT,
                self._unit.tac_offset + tac,
                tdc_of(temperature_c),
            ],
            axis=1,
        )
        return SampledFrames(
            converted(electrodes + self._unit.noise_counts * e_noise),
            converted(self._pac(pressure_pa) + PAC_NOISE * p_noise),
            converted(slow + SLOW_NOISE * s_noise),
        )

    def _temperature(self, tick: int, count: int) -> tuple[Array, Array]:
        """Core temperature [degrees C] and rate of TDC [counts/s] of N frames."""
        unit = self._unit
        on_s = self._on_for_s + np.arange(tick, tick + count) / self._rate_hz
        missing_k = unit.heating_k * np.exp(-on_s / unit.heating_tau_s)
        temperature_c = unit.reference_c - missing_k
        later_c = temperature_c + missing_k / (unit.heating_tau_s * self._rate_hz)
        return temperature_c, (tdc_of(later_c) - tdc_of(temperature_c)) * self._rate_hz

    def _crept(self, ideal: Array) -> Array:
        """Counts with creep: a share of every change decays in with one time constant."""
        # Exact solution of the first-order lag for an input that is constant during a frame.
        late = self._unit.creep_share * (ideal - self._rest)
        crept = np.empty_like(ideal)
        for k in range(len(ideal)):
            self._creep = late[k] + (self._creep - late[k]) * self._creep_kept
            crept[k] = ideal[k] - late[k] + self._creep
        return crept

    def _warmed(self, counts: Array, temperature_c: Array) -> Array:
        """Counts at a core temperature, from those of the warm sensor.

        ``counts = 4095 R / (R + Z)`` and Z goes with 1 / conductivity.
        """
        unit = self._unit
        below_k = temperature_c - unit.reference_c
        warmth = 1.0 + below_k / unit.heating_k if unit.heating_k else np.ones_like(below_k)
        # The spatial modes are relative to the warm sensor, whose counts the tape holds.
        shift = unit.temperature_coefficient * below_k[:, None] + self._modes * (
            warmth[:, None] - 1
        )
        factor = np.exp(shift)
        # With Z/R = 4095 / counts - 1, Z/R divided by ``factor`` gives the counts below; the clip
        # keeps the division defined at the ends of the range.
        inside = np.clip(counts, 0.0, COUNTS_MAX)
        warmed: Array = COUNTS_MAX * inside * factor / (COUNTS_MAX - inside + inside * factor)
        return warmed

    def _pac(self, pressure_pa: Array) -> Array:
        """Noise-free PAC [counts], shape ``(N, 22)``; pressure is linear between frames."""
        # The high-pass of a ramp with slope s tends to s times the time constant.
        steady = np.diff(pressure_pa) * (self._rate_hz * PAC_HIGH_PASS_S)
        at_start = np.empty_like(steady)
        for k, towards in enumerate(steady.tolist()):
            at_start[k] = self._vibration_pa
            self._vibration_pa = towards + (self._vibration_pa - towards) * float(
                self._pac_kept[-1]
            )
        moving = steady[:, None] + (at_start - steady)[:, None] * self._pac_kept[:-1]
        return self._unit.pac_offset + moving / PAC_PA_PER_COUNT
