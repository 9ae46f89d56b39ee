"""What the sensor's electronics make of physical quantities, and back: counts of every channel.

A short pulse drives the excitation electrodes. Each sensing electrode in turn is in series with a
load, whose voltage is converted with 12 bits (SP manual; learning notes, sections 0.4 and 4.1)::

    E = 4095 R_L / (R_L + Z + Z_s) (1 + gain) + offset

Warmth, a slow response (creep) and noise change the electrodes over time, and each electrode is
read at its own time in a frame. All states are updated exactly for any time between two readings.
PDC, PAC, TDC and TAC follow the SP manual (learning notes, section 4.6). Low-passes above the rate
at which a channel is read are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate_fem.electrodes.specimen import SENSING, SpecimenParameters

Floats = NDArray[np.float64]
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
    total = specimen.load_ohm + specimen.series_ohm + specimen.asymmetry_array * impedance
    ideal = FULL_SCALE * specimen.load_ohm / total
    return np.asarray(ideal * (1 + specimen.gain_array) + specimen.offset_array)


def counts_slope(impedance: Floats, specimen: SpecimenParameters) -> Floats:
    """Derivative d counts / d Z [1/Ohm], shape (..., 19); negative."""
    total = specimen.load_ohm + specimen.series_ohm + specimen.asymmetry_array * impedance
    slope = -FULL_SCALE * specimen.load_ohm / total**2 * specimen.asymmetry_array
    return np.asarray(slope * (1 + specimen.gain_array))


def convert(ideal: Floats) -> Counts:
    """Output of the converter: the nearest of 0..4095."""
    return np.clip(np.rint(ideal), 0, FULL_SCALE).astype(np.uint16)


def impedance_of(counts: Floats | Counts, specimen: SpecimenParameters) -> Floats:
    """Impedance Z for these counts [Ohm], shape (..., 19): the inverse of `ideal_counts`.

    NaN at and beyond the ends of the range, where no positive impedance gives such counts.
    """
    ideal = (np.asarray(counts, np.float64) - specimen.offset_array) / (1 + specimen.gain_array)
    good = (ideal > 0) & (ideal < FULL_SCALE)
    total = FULL_SCALE * specimen.load_ohm / np.where(good, ideal, np.nan)
    film = (total - specimen.load_ohm - specimen.series_ohm) / specimen.asymmetry_array
    return np.asarray(np.where(film > 0, film, np.nan))


def log_response(
    counts: Floats | Counts, rest: Floats | Counts, specimen: SpecimenParameters
) -> Floats:
    """ln(Z0 / Z), shape (..., 19), which does not depend on the conductivity (section 0.5)."""
    return np.asarray(np.log(impedance_of(rest, specimen) / impedance_of(counts, specimen)))


def core_temperature_c(since_on_s: float, ambient_c: float, specimen: SpecimenParameters) -> float:
    """Temperature of the core [degrees C], which its electronics heat with one time constant."""
    return ambient_c + specimen.heating_k * -math.expm1(-since_on_s / specimen.heating_tau_s)


def log_sigma(temperature_c: float, specimen: SpecimenParameters) -> float:
    """Logarithm of the conductivity over its value at the reference temperature."""
    return specimen.temperature_coefficient * (temperature_c - specimen.reference_c)


def spatial_modes() -> Floats:
    """Two smooth modes over the electrodes, shape (2, 19): along the finger, and to the sides.

    Both have zero mean and unit mean square, so `gradient_sd` is the deviation of one electrode.
    """
    raw = np.stack([ELECTRODE_POSITIONS[:, 0], np.abs(ELECTRODE_POSITIONS[:, 1])])
    raw = raw - raw.mean(axis=1, keepdims=True)
    return np.asarray(raw / raw.std(axis=1, keepdims=True))


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

    def read(self, ideal: Floats, elapsed_s: float, *, warmth: float = 1.0) -> Counts:
        """Counts of one reading.

        Args:
            ideal: Ideal counts, shape (19,), at the core's present temperature.
            elapsed_s: Time since the last reading [s].
            warmth: How far the core has warmed up, 0..1; spatial differences of temperature grow
                with it.

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
            elapsed_s: Time since the reading before, shape (T,) [s].
            warmth: As in `read`.
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
        warm = self._modes * warmth + np.broadcast_to(log_sigma, len(ideal))[:, None]
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


PDC_PA = 36.5
"""Pressure of one count of PDC [Pa]."""

PAC_PA = 0.37
"""Pressure of one count of PAC [Pa]."""

PAC_RATE_HZ = 2200.0
"""Readings of PAC per second: 22 in a frame of 10 ms."""

PAC_HIGH_PASS_HZ = 10.0
TAC_BAND_HZ = (0.45, 22.6)
TAC_GAIN = 98.0
KELVIN = 273.15
# A thermistor of 0.6444 exp(4025 / T) Ohm against 30 kOhm; the maker states the result in this
# form.
BETA_K, UPPER, LOWER = 4025.0, 155183.0, 46555.0


def pdc_of(
    pressure_pa: Floats,
    specimen: SpecimenParameters,
    *,
    force_n: Floats | float = 0.0,
    warmer_k: Floats | float = 0.0,
) -> Floats:
    """PDC [counts] for a fluid pressure above ambient [Pa], any shape; not rounded.

    Args:
        pressure_pa: Of the fluid [Pa].
        specimen: Strain of the core and warmth leak into its PDC (section 4.6).
        force_n: Net force on the finger [N].
        warmer_k: Temperature of the core above the specimen's reference [K].
    """
    leak = specimen.pdc_strain_pa_n * np.asarray(force_n) + specimen.pdc_warmth_pa_k * np.asarray(
        warmer_k
    )
    shown = (np.asarray(pressure_pa) + leak) / PDC_PA
    return np.clip(specimen.pdc_offset + shown, 0, FULL_SCALE)


def pressure_of_pdc(counts: Floats, specimen: SpecimenParameters) -> Floats:
    """Fluid pressure above ambient [Pa] for PDC [counts], any shape."""
    return np.asarray((np.asarray(counts, np.float64) - specimen.pdc_offset) * PDC_PA)


def pressure_of_pac(counts: Floats, specimen: SpecimenParameters) -> Floats:
    """Vibration of the fluid pressure above 10 Hz [Pa] for PAC [counts], any shape."""
    return np.asarray((np.asarray(counts, np.float64) - specimen.pac_offset) * PAC_PA)


def tdc_of(temperature_c: Floats) -> Floats:
    """TDC [counts] for a core temperature [degrees C], any shape; not rounded."""
    ratio = np.exp(BETA_K / (np.asarray(temperature_c, np.float64) + KELVIN))
    return np.clip(FULL_SCALE * UPPER / (ratio + LOWER), 0, FULL_SCALE)


def temperature_of_tdc(counts: Floats) -> Floats:
    """Core temperature [degrees C] for TDC [counts] in 1..4095, any shape."""
    x = np.asarray(counts, np.float64) / FULL_SCALE
    return np.asarray(BETA_K / np.log((UPPER - LOWER * x) / x) - KELVIN)


@dataclass
class HighPass:
    """First-order high-pass, exact for inputs that are linear between readings.

    It starts in equilibrium with the first input.
    """

    corner_hz: float
    rate_hz: float
    _slow: float | None = field(default=None, init=False)
    _last: float = field(default=0.0, init=False)

    def __call__(self, samples: Floats) -> Floats:
        """Filter the next samples (n,), any specimen."""
        way = 2 * math.pi * self.corner_hz / self.rate_hz
        keep = math.exp(-way)
        # Weight of the newer end of a linear piece.
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
    """Cooling of the thermistor by an indenter of constant temperature: one pole (section 4.6).

    Attributes:
        specimen: Its `cooling_share` and `cooling_tau_s` are used.
        indenter_c: Temperature of the indenter [degrees C].
    """

    specimen: SpecimenParameters
    indenter_c: float = 22.0
    _cooler: float = field(default=0.0, init=False)

    def read(self, core_c: float, touched: float, elapsed_s: float) -> float:
        """Temperature at the thermistor [degrees C].

        Args:
            core_c: Of the core, far from the contact [degrees C].
            touched: Share of the pad that is touched, 0..1.
            elapsed_s: Time since the last reading [s].
        """
        goal = self.specimen.cooling_share * touched * (core_c - self.indenter_c)
        keep = math.exp(-elapsed_s / self.specimen.cooling_tau_s)
        self._cooler = goal + (self._cooler - goal) * keep
        return core_c - self._cooler


@dataclass
class PressureVibration:
    """PAC from the fluid's pressure.

    Attributes:
        specimen: Its offset is used.
        rate_hz: Readings per second.
    """

    specimen: SpecimenParameters
    rate_hz: float = PAC_RATE_HZ

    def __post_init__(self) -> None:
        self._pass = HighPass(PAC_HIGH_PASS_HZ, self.rate_hz)

    def read(self, pressure_pa: Floats) -> Floats:
        """PAC [counts], shape (n,), for the next pressures [Pa], shape (n,); not rounded."""
        return np.clip(self.specimen.pac_offset + self._pass(pressure_pa) / PAC_PA, 0, FULL_SCALE)


@dataclass
class TemperatureChange:
    """TAC from the core's temperature: TDC, band-passed and amplified.

    Attributes:
        specimen: Its offset is used.
        rate_hz: Readings per second.
    """

    specimen: SpecimenParameters
    rate_hz: float = 100.0

    def __post_init__(self) -> None:
        self._slow = HighPass(TAC_BAND_HZ[0], self.rate_hz)
        self._fast = HighPass(TAC_BAND_HZ[1], self.rate_hz)

    def read(self, temperature_c: Floats) -> Floats:
        """TAC [counts], shape (n,), for the next temperatures [degrees C]; not rounded."""
        change = self._slow(tdc_of(temperature_c))
        low = change - self._fast(change)
        return np.clip(self.specimen.tac_offset + TAC_GAIN * low, 0, FULL_SCALE)
