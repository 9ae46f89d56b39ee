"""What time does to the electrodes: warmth, creep, noise; and when the converter reads them.

All states are updated exactly for any time between two readings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from palpate.fem.electrodes.circuit import Counts, convert, counts_slope, impedance_of
from palpate.fem.electrodes.table import POSITIONS, SENSING
from palpate.fem.electrodes.unit import UnitParameters

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
    raw = np.stack([POSITIONS[:, 0], np.abs(POSITIONS[:, 1])])
    raw = raw - raw.mean(axis=1, keepdims=True)
    return np.asarray(raw / raw.std(axis=1, keepdims=True))


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
        late = self.unit.creep_share * (ideal - self.rest)
        self._creep = late + (self._creep - late) * math.exp(-elapsed_s / self.unit.creep_tau_s)
        impedance = np.nan_to_num(impedance_of(ideal, self.unit))
        # d Z = -Z d ln sigma: the film's impedance goes with 1 / sigma.
        drift = -counts_slope(impedance, self.unit) * impedance * self._modes * warmth
        noise = self.unit.noise_counts * self._rng.standard_normal(SENSING)
        return convert(ideal - late + self._creep + drift + noise)
