"""Ingest of the LASA force calibration: two real BioTacs pressed and sheared on a force sensor.

The file's authors publish the rows without a licence: measure, do not redistribute.

Axes. The authors' own table of electrodes (MiaoLi/syntouchcontact, ``SynTouchContact.cpp``) puts
E1 at (-7.5, 20.4, 0) mm, the tip E7 at y = 25.6 mm and the ventral E17 at z = +7.5 mm, so theirs is
x lateral, y distal, z ventral; ours is x distal, y lateral, z dorsal. Hence ``(x, y, z)_ours =
(y, x, -z)_theirs``, a proper rotation. Stored is the reaction on the BioTac: Fz < 0 there, Fz > 0
here, when the ventral side is pressed. That the force is stored in these same axes is not written
anywhere; the data agree (section "Axes" of training/LOG.md). No metric depends on it: a rotation
changes neither magnitudes nor angles.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.dataset import FeatureDataset, Provenance
from palpate_training.schema import palpate_version
from palpate_training.splits import cut_into_blocks

FINGERS = (1, 2)

BLOCKS_PER_RECORDING = 20
"""About 9 s each; the force's autocorrelation is below 0.3 after 5 s, below 0.1 after 4-11 s."""

ELECTRODE_LAG_ROWS = 2
"""The archive has no time stamps, and its electrodes come later than its force: a quadratic fit
explains the force 2-3 rows (20-30 ms) before a row of electrodes best, on both fingers. Pairing so
lowers the error on validation blocks (training/LOG.md); 0 takes the rows as stored."""

_NOTES = (
    "force rotated from the authors' axes (x lateral, y distal, z ventral) to the sensor frame:"
    " (x, y, z) = (y, x, -z); always in contact; no time stamps, about 100 Hz"
)


def ingest_lasa(
    path: Path,
    *,
    command: str = "",
    blocks_per_recording: int = BLOCKS_PER_RECORDING,
    lag_rows: int = ELECTRODE_LAG_ROWS,
) -> FeatureDataset:
    """Read ``force_calibration.npz``.

    Args:
        path: The archive.
        command: The command line, for provenance.
        blocks_per_recording: Contiguous pieces each recording is cut into.
        lag_rows: Electrodes of a row are paired with the force so many rows before.

    Returns:
        Both fingers, one recording (group) each, in order of time.

    Raises:
        DatasetError: The archive is missing, damaged, or not this one.
    """
    try:
        content = path.read_bytes()
        with np.load(path, allow_pickle=False) as archive:
            parts = [
                (
                    archive[f"finger{finger}_electrodes_raw"][lag_rows:],
                    archive[f"finger{finger}_baseline_mean"],
                    _without_last(archive[f"finger{finger}_force_N"], lag_rows),
                )
                for finger in FINGERS
            ]
    except KeyError as error:
        raise DatasetError(
            f"{path}: {error.args[0]}",
            remedy="give the archive force_calibration.npz of the LASA force calibration",
        ) from error
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{path}: not a readable NumPy archive: {error}",
            remedy="give the archive force_calibration.npz of the LASA force calibration",
        ) from error

    rows = [len(electrodes) for electrodes, _, _ in parts]
    force = np.concatenate([theirs for _, _, theirs in parts]).astype(np.float32)
    return FeatureDataset(
        electrodes=np.concatenate([electrodes for electrodes, _, _ in parts]).astype(np.uint16),
        baseline=np.concatenate(
            [np.tile(baseline, (n, 1)) for n, (_, baseline, _) in zip(rows, parts, strict=True)]
        ).astype(np.float32),
        force=force[:, [1, 0, 2]] * np.array([1, 1, -1], dtype=np.float32),
        group=np.repeat(np.arange(len(rows), dtype=np.int32), rows),
        block=np.concatenate(
            [
                cut_into_blocks(n, blocks_per_recording) + np.int32(i * blocks_per_recording)
                for i, n in enumerate(rows)
            ]
        ).astype(np.int32),
        sensor=np.repeat(np.arange(len(rows), dtype=np.int32), rows),
        sensor_names=tuple(f"lasa-finger{finger}" for finger in FINGERS),
        in_contact=np.ones(sum(rows), dtype=np.bool_),
        provenance=Provenance(
            source="LASA force calibration (MiaoLi/syntouchcontact), two real BioTacs",
            command=command,
            input_sha256=hashlib.sha256(content).hexdigest(),
            licence="none stated by the authors: measure, do not redistribute",
            palpate_version=palpate_version(),
            notes=f"{_NOTES}; electrodes paired with the force {lag_rows} rows before",
        ),
        name=str(path),
    )


def _without_last(rows: npt.NDArray[np.float32], count: int) -> npt.NDArray[np.float32]:
    return rows[: len(rows) - count]
