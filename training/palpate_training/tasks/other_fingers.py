"""A ``features`` bundle for a finger that was never pressed, by what other fingers taught.

It is right as far as the finger is like the others, which nobody knows before it is pressed. So it
names no sensor: every estimate of it is flagged ``UNCALIBRATED``. Its errors and bounds are those
on fingers that were left out, and its bounds are for sensors that it was not made for.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from palpate.errors import DatasetError
from palpate.files.hdf5 import add_array
from palpate_training.datasets.features import FeatureDataset, of_sensor
from palpate_training.learning.export import refuse_existing
from palpate_training.learning.force_process import Floats, KnownRows
from palpate_training.learning.other_fingers import OtherFinger, OtherFingers
from palpate_training.tasks.finger import (
    FingerReport,
    HeldOutPresses,
    estimate_of,
    known_rows,
    write_finger,
)

UNPRESSED = "other fingers alone"


def fingers_in(data: FeatureDataset) -> list[OtherFinger]:
    """Every finger of a data set, with rows of its presses.

    Raises:
        DatasetError: One has too few presses.
    """
    found = []
    for number, name in enumerate(data.sensor_names):
        if not (data.sensor == number).any():
            continue
        one = of_sensor(data, name)
        rest = one.baseline.mean(axis=0, dtype=np.float64)
        rows, touched = known_rows(one)
        found.append(OtherFinger(name, rows, rest, touched))
    return found


def train_unpressed(
    others: Sequence[OtherFinger],
    rest: Floats,
    folder: Path,
    *,
    name: str,
    version: int = 1,
) -> FingerReport:
    """Fit to other fingers, measure on one that is left out, and write the bundle.

    Of a single other finger one half is estimated by the other: nothing is known then of how
    fingers differ, and the bounds are too close.

    Args:
        others: At least one.
        rest: Untouched counts of the finger that it is for, shape ``(19,)``.
        folder: Of the bundle; must not exist.
        name: Of the bundle.
        version: Of the bundle.

    Raises:
        DatasetError: No other finger is given.
        BundleError: The folder exists, or parity fails; nothing is left on disk.
    """
    refuse_existing(folder)
    if not others:
        raise DatasetError(
            "a finger that was never pressed can only be estimated by other fingers",
            remedy="give presses of at least one other finger, or press this one",
        )
    estimates, constants, rows = [], [], []
    first = 0
    left_out = _left_out(others)
    for known, tested in left_out:
        estimates.append(estimate_of(OtherFingers(known, tested.rest), tested.rows.tared))
        mean = np.vstack([one.rows.force for one in known]).mean(axis=0)
        constants.append(np.broadcast_to(mean, tested.rows.force.shape))
        _, press = np.unique(tested.rows.press, return_inverse=True)
        rows.append(replace(tested.rows, press=first + press))
        first += int(press.max()) + 1
    tested_rows = KnownRows(
        *(np.concatenate([getattr(one, name) for one in rows]) for name in KnownRows.__slots__)
    )
    touched = np.concatenate([tested.touched for _, tested in left_out])
    number = np.repeat(np.arange(len(rows)), [len(one) for one in rows])
    said = HeldOutPresses.of(
        np.vstack(estimates),
        tested_rows,
        touched,
        {"constant": np.vstack(constants)},
        finger=number if len(others) > 1 else None,
    )
    digest = hashlib.sha256()
    for one in others:
        add_array(digest, "tared", one.rows.tared)
        add_array(digest, "force", one.rows.force)
    names = ", ".join(one.name for one in others)
    written = write_finger(
        folder,
        OtherFingers(others, rest),
        tested_rows,
        said,
        estimator=UNPRESSED,
        source=f"{len(tested_rows)} rows of {names}",
        held_out_as="each finger left out in its turn"
        if len(others) > 1
        else "one half estimated by the other, so too close for another finger",
        data_sha256=digest.hexdigest(),
        foreign=True,
        name=name,
        version=version,
        trained_on=f"presses of {names}; of the finger itself none",
    )
    return FingerReport(written, UNPRESSED, said.metrics, 0, len(tested_rows))


def _left_out(others: Sequence[OtherFinger]) -> list[tuple[list[OtherFinger], OtherFinger]]:
    """What is learned from and what is tested: every finger, or each half of a single one."""
    if len(others) > 1:
        return [([two for two in others if two is not one], one) for one in others]
    (one,) = others
    presses = np.unique(one.rows.press)
    early = np.isin(one.rows.press, presses[: len(presses) // 2])
    halves = [
        replace(one, rows=one.rows.where(kept), touched=one.touched[kept])
        for kept in (early, ~early)
    ]
    return [([halves[1]], halves[0]), ([halves[0]], halves[1])]
