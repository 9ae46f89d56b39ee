"""Streams of untouched electrodes: what drift and noise are read from.

The file of an idle twin is a NumPy archive with ``rate_hz``, one number, and for each unit an array
by its name: counts [counts], shape (T, 19).
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.dataset import ELECTRODES

Counts = npt.NDArray[np.float64]

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
"""Drift is told over minutes; a shorter stream says nothing about it."""


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
    counts: Counts
    real: bool


def read_idle_twin(path: Path) -> tuple[IdleStream, ...]:
    """Idle streams of the twin's units, from an archive (see the module).

    Raises:
        DatasetError: The file is missing, damaged, has no rate, or a stream has another shape or
            lasts less than a minute.
    """
    remedy = f"write {_RATE} and an array (T, {ELECTRODES}) for each unit with numpy.savez"
    arrays = _load(path, remedy=remedy)
    rate = arrays.pop(_RATE, None)
    if rate is None or rate.size != 1 or not float(rate.reshape(-1)[0]) > 0:
        raise DatasetError(f"{path}: {_RATE} is missing or not one positive number", remedy=remedy)
    if not arrays:
        raise DatasetError(f"{path}: there is no stream in it", remedy=remedy)
    hertz = float(rate.reshape(-1)[0])
    return tuple(
        _checked(path, name, IdleStream(name, hertz, counts, real=False))
        for name, counts in arrays.items()
    )


def read_idle_real(folder: Path) -> tuple[IdleStream, ...]:
    """The idle sensors beside the pressed ones, LASA force calibration; empty where absent.

    Args:
        folder: Folder of public data.

    Raises:
        DatasetError: The archive is there but damaged or another one.
    """
    path = folder / FORCE_CALIBRATION
    if not path.is_file():
        return ()
    arrays = _load(path, remedy="give the archive of the LASA force calibration", only=tuple(_REAL))
    return tuple(
        _checked(path, key, IdleStream(name, REAL_RATE_HZ, arrays[key], real=True))
        for key, name in _REAL.items()
    )


def _load(path: Path, *, remedy: str, only: tuple[str, ...] = ()) -> dict[str, Counts]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {key: archive[key].astype(np.float64) for key in only or archive.files}
    except KeyError as error:
        raise DatasetError(f"{path}: {error.args[0]}", remedy=remedy) from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{path}: not a readable archive: {error}", remedy=remedy) from error


def _checked(path: Path, key: str, stream: IdleStream) -> IdleStream:
    if stream.counts.ndim != 2 or stream.counts.shape[1] != ELECTRODES:
        raise DatasetError(
            f"{path}: {key} has shape {stream.counts.shape}",
            remedy=f"give counts of shape (T, {ELECTRODES})",
        )
    if len(stream.counts) < _SHORTEST_S * stream.rate_hz:
        raise DatasetError(
            f"{path}: {key} lasts {len(stream.counts) / stream.rate_hz:.3g} s",
            remedy=f"record at least {_SHORTEST_S:g} s: drift is told over minutes",
        )
    return stream
