"""What time does to the electrodes: warmth, creep, noise; and when the converter reads them.

All states are updated exactly for any time between two readings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate_fem.electrodes.circuit import Counts, convert, counts_slope, impedance_of
from palpate_fem.electrodes.table import SENSING
from palpate_fem.electrodes.unit import UnitParameters

Floats = NDArray[np.float64]


def core_temperature_c(since_on_s: float, ambient_c: float, unit: UnitParameters) -> float:
    """Temperature of the core [degrees C]: its own electronics heat it with one time constant."""
    return ambient_c + unit.heating_k * -math.expm1(-since_on_s / unit.heating_tau_s)


def log_sigma(temperature_c: float, unit: UnitParameters) -> float:
    """Logarithm of the conductivity over its value at the reference temperature."""
    return unit.temperature_coefficient * (temperature_c - unit.reference_c)


def spatial_modes() -> Floats:
    """Two smooth modes over the electrodes, shape (2, 19): along the finger, and to the sides.

    Of zero mean and unit mean square, so that `gradient_sd` is what an electrode sees.
    """
    raw = np.stack([ELECTRODE_POSITIONS[:, 0], np.abs(ELECTRODE_POSITIONS[:, 1])])
    raw = raw - raw.mean(axis=1, keepdims=True)
    return np.asarray(raw / raw.std(axis=1, keepdims=True))


FRAME_S = 10e-3
SLOTS = 44
"""Readings in a frame: 22 of PAC, the other channels between them (learning notes, section 4.6)."""


def slot_offsets_s() -> Floats:
    """When E1..E19 are read after the start of their frame [s], shape (19,): 0.23 to 8.4 ms.

    Every second reading of a frame is PAC's.
    """
    return np.asarray((1 + 2 * np.arange(SENSING)) * (FRAME_S / SLOTS))


def skewed(ideal: Floats, time_s: Floats) -> Floats:
    """What each electrode of a frame sees, as none is read when its frame begins.

    Args:
        ideal: Ideal counts at the starts of frames, shape (T, 19).
        time_s: Those starts [s], shape (T,), increasing.

    Returns:
        Ideal counts when each electrode is read, shape (T, 19); the last frame's stay.
    """
    offsets = slot_offsets_s()
    columns = [np.interp(time_s + offsets[i], time_s, ideal[:, i]) for i in range(SENSING)]
    return np.stack(columns, axis=1)


@dataclass
class ElectrodeSignals:
    """The electrodes of one unit over time.

    Attributes:
        unit: The sensor.
        rest: Ideal counts of the untouched sensor, shape (19,): what creep is counted from.
        seed: Of noise and of the spatial modes; the same seed gives the same counts.
    """

    unit: UnitParameters
    rest: Floats
    seed: int = 0
    _creep: Floats = field(init=False, repr=False)
    _modes: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._creep = np.zeros(SENSING)
        size = self.unit.gradient_sd / math.sqrt(2) * self._rng.standard_normal(2)
        self._modes = size @ spatial_modes()

    def read(self, ideal: Floats, elapsed_s: float, *, warmth: float = 1.0) -> Counts:
        """Counts that are read from an ideal answer.

        Args:
            ideal: Ideal counts, shape (19,), at the core's present temperature.
            elapsed_s: Since the last reading [s].
            warmth: How far the core has warmed up, 0..1; temperature differs over it with that.

        Returns:
            Counts, uint16, shape (19,).
        """
        one: Counts = self.stream(ideal[None], np.array([elapsed_s]), warmth=warmth)[0]
        return one

    def stream(
        self,
        ideal: Floats,
        elapsed_s: Floats,
        *,
        warmth: float = 1.0,
        log_sigma: Floats | float = 0.0,
    ) -> Counts:
        """Counts of many readings in a row.

        Args:
            ideal: Ideal counts, shape (T, 19).
            elapsed_s: Since the reading before, shape (T,) [s].
            warmth: As in `read`.
            log_sigma: ln of the conductivity over that which the ideal counts were made with, shape
                (T,) or one number: a drift of the temperature.

        Returns:
            Counts, uint16, shape (T, 19).
        """
        unit = self.unit
        late = unit.creep_share * (ideal - self.rest)
        creep = _followed(late, elapsed_s / unit.creep_tau_s, self._creep)
        if len(creep):
            self._creep = creep[-1].copy()
        impedance = np.nan_to_num(impedance_of(ideal, unit))
        warm = self._modes * warmth + np.broadcast_to(log_sigma, len(ideal))[:, None]
        # d Z = -Z d ln sigma: the film's impedance goes with 1 / sigma.
        drift = -counts_slope(impedance, unit) * impedance * warm
        noise = unit.noise_counts * self._rng.standard_normal(ideal.shape)
        return convert(ideal - late + creep + drift + noise)


def _followed(goal: Floats, ways: Floats, start: Floats) -> Floats:
    """A first-order lag's way after a goal that is constant between readings, shape (T, n).

    Args:
        goal: Shape (T, n).
        ways: Time from the reading before over the time constant, shape (T,).
        start: Where it is before, shape (n,).
    """
    out = np.empty_like(goal)
    for begin in range(0, len(goal), _BLOCK):
        piece, way = goal[begin : begin + _BLOCK], ways[begin : begin + _BLOCK]
        if way.sum() > _LONGEST:  # exp would lose digits: one by one
            for i, (one, step) in enumerate(zip(piece, way, strict=True)):
                start = one + (start - one) * math.exp(-step)
                out[begin + i] = start
            continue
        grown = np.exp(np.cumsum(way))[:, None]
        gain = -np.expm1(-way)[:, None] * grown
        out[begin : begin + _BLOCK] = (start + np.cumsum(gain * piece, axis=0)) / grown
        start = out[min(begin + _BLOCK, len(goal)) - 1]
    return out


_BLOCK, _LONGEST = 256, 20.0
