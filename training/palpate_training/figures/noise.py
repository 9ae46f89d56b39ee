"""Streams of untouched electrodes: what drift and noise are read from.

The file of an idle twin is a NumPy archive with ``rate_hz``, one number, and for each unit an array
by its name: counts [counts], shape (T, 19).

Drift and noise of untouched electrodes: spectra, and change over minutes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.process import require
from palpate_training.datasets.container import read_archive
from palpate_training.datasets.features import ELECTRODES
from palpate_training.figures.style import (
    INK,
    REAL_COLOURS,
    finish,
    grid,
    label,
    new_figure,
    unit_colour,
)

Floats = npt.NDArray[np.float64]

FORCE_CALIBRATION = Path("lasa_force_calibration") / "force_calibration.npz"
"""Where the idle real sensors are, in the folder of public data."""

REAL_RATE_HZ = 100.0
"""Of the LASA recordings: no time stamps, about 100 Hz by their authors."""

_RATE = "rate_hz"
_REAL = {  # the sensor that rests while the other one is pressed
    "finger1_idle_finger2_electrodes_raw": "real, finger 2 idle",
    "finger2_idle_finger1_electrodes_raw": "real, finger 1 idle",
}
_SHORTEST_S = 60.0
"""Drift shows over minutes; a shorter stream does not show it."""


@dataclass(frozen=True, slots=True)
class IdleStream:
    """Untouched electrodes over time.

    Attributes:
        name: Of the sensor, for people.
        rate_hz: Samples per second.
        counts: Raw counts [counts], shape (T, 19).
        real: Whether it was measured.
    """

    name: str
    rate_hz: float
    counts: Floats
    real: bool


def read_idle_twin(path: Path) -> tuple[IdleStream, ...]:
    """Idle streams of the twin's units, from an archive (see the module).

    Raises:
        DatasetError: The file is missing, damaged, has no rate, or a stream has another shape or
            lasts less than a minute.
    """
    remedy = f"write {_RATE} and an array (T, {ELECTRODES}) for each unit with numpy.savez"
    arrays = read_archive(path, lambda held: held, remedy=remedy)
    rate = arrays.pop(_RATE, np.zeros(0))
    hertz = float(rate.item()) if rate.size == 1 else 0.0
    if not hertz > 0:
        raise DatasetError(f"{path}: {_RATE} is missing or not one positive number", remedy=remedy)
    if not arrays:
        raise DatasetError(f"{path}: there is no stream in it", remedy=remedy)
    return tuple(
        _checked(path, name, IdleStream(name, hertz, counts.astype(np.float64), real=False))
        for name, counts in arrays.items()
    )


def read_idle_real(folder: Path) -> tuple[IdleStream, ...]:
    """The idle sensors beside the pressed ones, LASA force calibration; empty where absent.

    Raises:
        DatasetError: The archive is there but damaged or another one.
    """
    path = folder / FORCE_CALIBRATION
    if not path.is_file():
        return ()
    remedy = "give the archive of the LASA force calibration"
    arrays = read_archive(path, lambda _: _REAL, remedy=remedy)
    return tuple(
        _checked(path, key, IdleStream(name, REAL_RATE_HZ, arrays[key].astype(float), real=True))
        for key, name in _REAL.items()
    )


def _checked(path: Path, key: str, stream: IdleStream) -> IdleStream:
    if stream.counts.ndim != 2 or stream.counts.shape[1] != ELECTRODES:
        raise DatasetError(
            f"{path}: {key} has shape {stream.counts.shape}",
            remedy=f"give counts of shape (T, {ELECTRODES})",
        )
    if len(stream.counts) < _SHORTEST_S * stream.rate_hz:
        raise DatasetError(
            f"{path}: {key} lasts {len(stream.counts) / stream.rate_hz:.3g} s",
            remedy=f"record at least {_SHORTEST_S:g} s: drift shows over minutes",
        )
    return stream


NOISE_ABOVE_HZ = 1.0
"""Faster than this is called noise, slower drift [Hz]."""

_SEGMENT_S = 10.24
"""Of Welch's method: 0.1 Hz apart, and 35 overlapping segments in three minutes."""


@dataclass(frozen=True, slots=True)
class NoiseSpectrum:
    """One-sided power spectral density.

    Attributes:
        frequency_hz: Between zero and half the rate, shape (F,).
        density: [counts^2/Hz], shape (F, 19).
    """

    frequency_hz: Floats
    density: Floats

    def noise_sd(self) -> Floats:
        """Standard deviation of what is faster than 1 Hz [counts], shape (19,)."""
        fast = self.frequency_hz >= NOISE_ABOVE_HZ
        step = self.frequency_hz[1] - self.frequency_hz[0]
        return np.asarray(np.sqrt(self.density[fast].sum(axis=0) * step))


@dataclass(frozen=True, slots=True)
class ElectrodeDrift:
    """Slow change from the first mean on.

    Attributes:
        time_s: Middle of each mean [s] from the start of the stream, shape (M,).
        change: Mean counts minus those of the first mean [counts], shape (M, 19).
    """

    time_s: Floats
    change: Floats

    def per_minute(self) -> Floats:
        """Slope of a line through the change [counts/min], shape (19,)."""
        minutes = self.time_s / 60
        return np.asarray(np.polyfit(minutes, self.change, 1)[0])

    def common_share(self) -> float:
        """Share of all change, in squares, that the electrodes' one common course explains."""
        centred = self.change - self.change.mean(axis=0)
        power = np.linalg.svd(centred, compute_uv=False) ** 2
        return float(power[0] / power.sum()) if power.sum() > 0 else float("nan")


def spectrum(counts: Floats, rate_hz: float) -> NoiseSpectrum:
    """Welch's power spectral density of each electrode, from untouched counts, shape (T, 19).

    Hann windows that overlap by half; a line is taken out of each, so that drift does not leak
    into the noise.

    Raises:
        DatasetError: The stream is shorter than two windows, or its rate too low for noise.
    """
    length = round(_SEGMENT_S * rate_hz)
    # The fastest but one that such windows resolve: the last one is left out below.
    if (length // 2 - 1) * rate_hz < NOISE_ABOVE_HZ * length:
        raise DatasetError(
            f"untouched electrodes at {rate_hz:g} Hz show nothing faster than {NOISE_ABOVE_HZ:g} "
            "Hz, which is called noise",
            remedy="record them at the sensor's own rate",
        )
    if len(counts) < 2 * length:
        raise DatasetError(
            f"{len(counts)} samples at {rate_hz:g} Hz are too few for windows of {_SEGMENT_S:g} s",
            remedy=f"give at least {2 * _SEGMENT_S:g} s of untouched electrodes",
        )
    mlab = require("matplotlib.mlab", extra="training")
    densities = []
    frequency: Floats = np.empty(0)
    for column in np.asarray(counts, np.float64).T:
        density, frequency = mlab.psd(
            column, NFFT=length, Fs=rate_hz, noverlap=length // 2, detrend="linear"
        )
        densities.append(density)
    # The first holds what is left of the removed line, and is no place on a logarithmic axis; the
    # last one's density is halved where the window is even.
    return NoiseSpectrum(frequency[1:-1], np.stack(densities, axis=1)[1:-1])


def drift(counts: Floats, rate_hz: float) -> ElectrodeDrift:
    """Means over a second each of untouched counts, shape (T, 19), from the first one on.

    Raises:
        DatasetError: The stream is shorter than two means.
    """
    length = round(rate_hz)
    means = len(counts) // max(length, 1)
    if length < 1 or means < 2:
        raise DatasetError(
            f"{len(counts)} samples at {rate_hz:g} Hz hold no two means of 1 s",
            remedy="give a longer stream of untouched electrodes",
        )
    whole = np.asarray(counts[: means * length], np.float64)
    level: Floats = whole.reshape(means, length, -1).mean(axis=1)
    middle = np.asarray((np.arange(means) + 0.5) * length / rate_hz, np.float64)
    return ElectrodeDrift(middle, level - level[0])


def draw_noise(path: Path, streams: Sequence[IdleStream]) -> str:
    """Draw spectra and drift of the twin beside those of real sensors.

    Raises:
        DatasetError: A stream is too short, or the disk refused.
    """
    text = (
        "Lines: median of the 19 electrodes; bands: from the lowest to the highest. Left: Welch's"
        " power spectral density of untouched electrodes. Right: their means over 1 s, from the"
        " first on." + _about_real([stream for stream in streams if stream.real])
    )
    figure = new_figure(11.5, 4.7)
    left, right = figure.subplots(1, 2)
    real = twin = 0
    for stream in streams:
        if stream.real:
            colour, real = REAL_COLOURS[real % len(REAL_COLOURS)], real + 1
        else:
            colour, twin = unit_colour(twin), twin + 1
        density = spectrum(stream.counts, stream.rate_hz)
        change = drift(stream.counts, stream.rate_hz)
        _band(left, density.frequency_hz, density.density, colour, stream.name)
        _band(right, change.time_s / 60, change.change, colour, stream.name)
    left.set(xscale="log", yscale="log")
    label(left, "frequency [Hz]", "power spectral density [counts²/Hz]", "noise")
    label(right, "time [min]", "change [counts]", "drift")
    for axes in (left, right):
        grid(axes)
    handles, names = left.get_legend_handles_labels()
    figure.legend(
        handles, names, loc="outside right upper", frameon=False, fontsize=9, labelcolor=INK
    )
    return finish(figure, path, "Untouched electrodes", text)


def _about_real(streams: Sequence[IdleStream]) -> str:
    """The caption's sentence on the real sensors; empty where there are none."""
    if not streams:
        return ""
    repeats = [(np.diff(stream.counts, axis=0) == 0).all(axis=1).mean() for stream in streams]
    return (
        " The real sensors rest beside a pressed one and are still warming up; their rate is about"
        f" {streams[0].rate_hz:g} Hz and {100 * np.mean(repeats):.0f} % of their samples repeat the"
        " one before."
    )


def _band(axes: Any, across: Floats, values: Floats, colour: str, name: str) -> None:
    axes.fill_between(
        across, values.min(axis=1), values.max(axis=1), color=colour, alpha=0.15, lw=0
    )
    axes.plot(across, np.median(values, axis=1), color=colour, lw=1.3, label=name)
