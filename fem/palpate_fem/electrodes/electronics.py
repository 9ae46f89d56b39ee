"""What the electronics make of the electrodes' impedances, and back: counts over time.

A short pulse drives the excitation electrodes. Each sensing electrode in turn is in series with a
load, whose voltage is converted with 12 bits (SP manual; learning notes, sections 0.4 and 4.1)::

    E = 4095 R_L / (R_L + Z + Z_s) (1 + gain) + offset

Warmth, a slow response (creep) and noise change the electrodes over time, and each electrode is
read at its own time in a frame. All states are updated exactly for any time between two readings.
Pressures and temperatures follow from PDC, PAC and TDC as the SP manual says (learning notes,
section 4.6); the gateway's virtual finger goes the other way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from palpate.anatomy import spatial_modes
from palpate_fem.arrays import Floats
from palpate_fem.electrodes.specimen import SENSING, SpecimenParameters

Counts = NDArray[np.uint16]

FULL_SCALE = 4095


def ideal_counts(impedance: Floats, specimen: SpecimenParameters) -> Floats:
    """Counts before noise, rounding and the converter's ends.

    Args:
        impedance: Z of the film [Ohm], shape (..., 19).
        specimen: Its load, gain and offset are used.

    Returns:
        Counts, shape (..., 19).
    """
    total = specimen.load_ohm + specimen.series_ohm + np.array(specimen.asymmetry) * impedance
    ideal = FULL_SCALE * specimen.load_ohm / total
    return np.asarray(ideal * (1 + np.array(specimen.gain)) + np.array(specimen.offset))


def counts_slope(impedance: Floats, specimen: SpecimenParameters) -> Floats:
    """Derivative d counts / d Z [1/Ohm], shape (..., 19); negative."""
    total = specimen.load_ohm + specimen.series_ohm + np.array(specimen.asymmetry) * impedance
    slope = -FULL_SCALE * specimen.load_ohm / total**2 * np.array(specimen.asymmetry)
    return np.asarray(slope * (1 + np.array(specimen.gain)))


def convert(ideal: Floats) -> Counts:
    """Output of the converter: the nearest of 0..4095."""
    return np.clip(np.rint(ideal), 0, FULL_SCALE).astype(np.uint16)


def impedance_of(counts: Floats | Counts, specimen: SpecimenParameters) -> Floats:
    """Impedance Z for these counts [Ohm], shape (..., 19): the inverse of `ideal_counts`.

    NaN at and beyond the ends of the range, where no positive impedance gives such counts.
    """
    ideal = (np.asarray(counts, np.float64) - np.array(specimen.offset)) / (
        1 + np.array(specimen.gain)
    )
    good = (ideal > 0) & (ideal < FULL_SCALE)
    total = FULL_SCALE * specimen.load_ohm / np.where(good, ideal, np.nan)
    film = (total - specimen.load_ohm - specimen.series_ohm) / np.array(specimen.asymmetry)
    return np.asarray(np.where(film > 0, film, np.nan))


def core_temperature_c(since_on_s: float, ambient_c: float, specimen: SpecimenParameters) -> float:
    """Temperature of the core [degrees C], which its electronics heat with one time constant."""
    return ambient_c + specimen.heating_k * -math.expm1(-since_on_s / specimen.heating_tau_s)


def log_sigma(temperature_c: float, specimen: SpecimenParameters) -> float:
    """Logarithm of the conductivity over its value at the reference temperature."""
    return specimen.temperature_coefficient * (temperature_c - specimen.reference_c)


FRAME_S = 10e-3
SLOTS = 44
"""Slots of a frame: 22 of PAC, between them the other channels (learning notes, section 4.6)."""


def slot_offsets_s() -> Floats:
    """Reading times of E1..E19 after the start of their frame [s], shape (19,): 0.23 to 8.4 ms.

    Every second slot of a frame belongs to PAC.
    """
    return np.asarray((1 + 2 * np.arange(SENSING)) * (FRAME_S / SLOTS))


def skewed(ideal: Floats, time_s: Floats) -> Floats:
    """Ideal counts at the time when each electrode is read, which is after its frame begins.

    Args:
        ideal: Ideal counts at the starts of frames, shape (T, 19).
        time_s: Those starts [s], shape (T,), increasing.

    Returns:
        Interpolated counts, shape (T, 19); those of the last frame are held.
    """
    offsets = slot_offsets_s()
    columns = [np.interp(time_s + offsets[i], time_s, ideal[:, i]) for i in range(SENSING)]
    return np.stack(columns, axis=1)


@dataclass
class ElectrodeSignals:
    """Counts of one specimen's electrodes over time: with warmth, slow response and noise.

    Attributes:
        specimen: Its noise, slow response and thermal parameters are used.
        rest: Ideal counts when untouched, shape (19,); the slow response starts from them.
        seed: For noise and spatial modes; the same seed gives the same counts.
    """

    specimen: SpecimenParameters
    rest: Floats
    seed: int = 0
    _creep: Floats = field(init=False, repr=False)
    _modes: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._creep = np.zeros(SENSING)
        size = self.specimen.gradient_sd / math.sqrt(2) * self._rng.standard_normal(2)
        self._modes = size @ spatial_modes()

    def stream(
        self, ideal: Floats, elapsed_s: Floats, *, log_sigma: Floats | float = 0.0
    ) -> Counts:
        """Counts of many readings in a row.

        Args:
            ideal: Ideal counts, shape (T, 19), at the core's present temperature.
            elapsed_s: Time since the reading before, shape (T,) [s].
            log_sigma: ln of the conductivity over the one that the ideal counts were computed with,
                shape (T,) or one number: a drift of the temperature.

        Returns:
            Counts, uint16, shape (T, 19).
        """
        specimen = self.specimen
        # The slow response replaces a share of the immediate one, so the settled counts are the
        # ideal.
        late = specimen.creep_share * (ideal - self.rest)
        creep = _followed(late, elapsed_s / specimen.creep_tau_s, self._creep)
        if len(creep):
            self._creep = creep[-1].copy()
        impedance = np.nan_to_num(impedance_of(ideal, specimen))
        warm = self._modes + np.broadcast_to(log_sigma, len(ideal))[:, None]
        # d Z = -Z d ln sigma: the film's impedance goes with 1 / sigma.
        drift = -counts_slope(impedance, specimen) * impedance * warm
        noise = specimen.noise_counts * self._rng.standard_normal(ideal.shape)
        return convert(ideal - late + creep + drift + noise)


# The lag is summed in blocks with exponentials of the accumulated time: short enough that no digits
# are lost (exp(20) of 1e16), long enough that NumPy does the work.
_BLOCK, _LONGEST = 256, 20.0


def _followed(goal: Floats, ways: Floats, start: Floats) -> Floats:
    """First-order lag behind a goal that is constant between readings, shape (T, n).

    Args:
        goal: Shape (T, n).
        ways: Time from the reading before over the time constant, shape (T,).
        start: Value before the first reading, shape (n,).
    """
    out = np.empty_like(goal)
    for begin in range(0, len(goal), _BLOCK):
        piece, way = goal[begin : begin + _BLOCK], ways[begin : begin + _BLOCK]
        if way.sum() > _LONGEST:  # exp of the sum would lose digits, so go one by one
            for i, (one, step) in enumerate(zip(piece, way, strict=True)):
                start = one + (start - one) * math.exp(-step)
                out[begin + i] = start
            continue
        grown = np.exp(np.cumsum(way))[:, None]
        gain = -np.expm1(-way)[:, None] * grown
        out[begin : begin + _BLOCK] = (start + np.cumsum(gain * piece, axis=0)) / grown
        start = out[min(begin + _BLOCK, len(goal)) - 1]
    return out
