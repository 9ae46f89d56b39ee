"""A real BioTac under a flat plate: what its electrodes do, from the LASA contact-normal logs.

Rules, ours: the sensor's untouched pressure is the count it shows most often (untouched it stays
within a count or two, in contact it spreads over hundreds); a sample within 10 counts of it is
untouched, one more than 30 counts (about 1 kPa) above it is touched. The plate is ventral when its
normal is within 20 degrees of the pad's.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.messages import COUNTS_MAX

Floats = npt.NDArray[np.float64]

CONTACT_NORMAL = Path("lasa_contact_normal") / "contact_normal_logs.npz"
"""Where the logs are, in the folder of public data."""

UNTOUCHED_COUNTS = 10
TOUCHED_COUNTS = 30
VENTRAL_COS = float(np.cos(np.radians(20.0)))
"""A press is ventral within so much of +z, the direction in which a plate pushes the finger."""

_UNTOUCHED_SAMPLES = 20
"""Fewer give no baseline; the log is left out."""


@dataclass(frozen=True, slots=True)
class PlateLog:
    """One log of a plate that is pressed on the pad.

    Attributes:
        pdc: Raw static pressure [counts], shape (T,).
        electrodes: Raw counts [counts], shape (T, 19).
        normal: Direction in which the plate pushes, sensor frame, unit, shape (T, 3); +z is
            ventral. The archive holds the last known one where nothing touches.
    """

    pdc: Floats
    electrodes: Floats
    normal: Floats


@dataclass(frozen=True, slots=True)
class PlateResponse:
    """What electrodes do under a ventral plate.

    Attributes:
        tared: Mean tared electrodes over full scale [1], shape (19,).
        samples: How many samples it is the mean of.
        logs: From how many logs they come.
    """

    tared: Floats
    samples: int
    logs: int


def read_plate_logs(folder: Path) -> tuple[PlateLog, ...]:
    """All logs, in order of name; empty where the archive is absent.

    Args:
        folder: Folder of public data.

    Raises:
        DatasetError: The archive is there but damaged or another one.
    """
    path = folder / CONTACT_NORMAL
    if not path.is_file():
        return ()
    remedy = "give the archive of the LASA contact-normal logs"
    try:
        with np.load(path, allow_pickle=False) as archive:
            names = sorted({key.partition("_")[0] for key in archive.files})
            return tuple(
                PlateLog(
                    *(
                        archive[f"{name}_{part}"].astype(np.float64)
                        for part in ("pdc_raw", "electrodes_raw", "contact_normal")
                    )
                )
                for name in names
            )
    except KeyError as error:
        raise DatasetError(f"{path}: {error.args[0]}", remedy=remedy) from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{path}: not a readable archive: {error}", remedy=remedy) from error


def plate_response(logs: Sequence[PlateLog]) -> PlateResponse | None:
    """Mean tared electrodes of all samples with a ventral plate on the pad.

    Args:
        logs: Each is tared by its own untouched samples; those without any, or never touched by a
            ventral plate, are left out.

    Returns:
        The response; None where no log is left.
    """
    touched = [part for log in logs if len(part := _ventral(log))]
    if not touched:
        return None
    rows = np.concatenate(touched)
    return PlateResponse(rows.mean(axis=0), len(rows), len(touched))


def _ventral(log: PlateLog) -> Floats:
    """Tared electrodes under a ventral plate, shape (S, 19)."""
    values, often = np.unique(log.pdc, return_counts=True)
    above = log.pdc - values[np.argmax(often)]
    untouched = np.abs(above) <= UNTOUCHED_COUNTS
    if np.count_nonzero(untouched) < _UNTOUCHED_SAMPLES:
        return np.empty((0, log.electrodes.shape[1]))
    rest = log.electrodes[untouched].mean(axis=0)
    ventral = (above > TOUCHED_COUNTS) & (log.normal[:, 2] > VENTRAL_COS)
    return np.asarray((log.electrodes[ventral] - rest) / COUNTS_MAX)
