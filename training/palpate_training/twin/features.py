"""The experiment's rows as rows of features, for ``palpate train features``."""

from __future__ import annotations

import numpy as np

from palpate.errors import DatasetError
from palpate.messages import COUNTS_MAX
from palpate_training.dataset import FeatureDataset, FloatArray
from palpate_training.twin.content import ExperimentDataset

UNTOUCHED_ROWS = 3
"""Rows without contact added to each trial, so that a network learns that nothing is nothing."""


def features(
    data: ExperimentDataset,
    *,
    untouched_rows: int = UNTOUCHED_ROWS,
    assumed_rest: int | None = None,
) -> FeatureDataset:
    """Turn tared values back into raw counts with their baseline.

    Rounding to counts moves a tared value by up to 0.5 counts (1.2e-4 of full scale).

    Args:
        data: Every row is at 0.5 N or more, so in contact.
        untouched_rows: Rows put before each trial at rest: baseline counts, zero force, no contact
            location.
        assumed_rest: Rest of every electrode [counts] in trials that do not tell theirs, such as
            published ones. Only differences count for the features; 3300 leaves room for the
            published ranges, -0.78 to 0.17 of full scale.

    Returns:
        Rows of one unique trajectory have one group, and are held out together over all units.

    Raises:
        DatasetError: The rest of a trial is not known, and none is to be assumed.
    """
    rest = data.trial_rest.copy()
    unknown = np.isnan(rest).any(axis=1)
    if unknown.any():
        if assumed_rest is None:
            raise DatasetError(
                f"rest of {data.trial_name(int(np.flatnonzero(unknown)[0]))} is not known"
                f" ({unknown.sum()} of {data.trials} trials)",
                remedy="say which rest to assume, e.g. 3300 counts",
            )
        rest[unknown] = assumed_rest
    # Where each row of the result comes from: a row of the data, or the rest of a trial (-1).
    starts = np.searchsorted(data.trial, np.arange(data.trials))
    source = np.insert(np.arange(len(data)), np.repeat(starts, untouched_rows), -1)
    trial = np.insert(
        data.trial,
        np.repeat(starts, untouched_rows),
        np.repeat(np.arange(data.trials), untouched_rows),
    )
    touching = source >= 0
    baseline = rest[trial]
    counts = np.rint(baseline + _where(touching, data.tared[source], 0.0) * COUNTS_MAX)
    group = data.trial_trajectory[trial]
    return FeatureDataset(
        electrodes=np.clip(counts, 0, COUNTS_MAX).astype(np.uint16),
        baseline=baseline,
        force=_where(touching, data.force[source], 0.0),
        group=group,
        block=group.copy(),
        sensor=data.trial_unit[trial],
        sensor_names=data.unit_names,
        provenance=data.provenance,
        contact_location=_where(touching, data.location[source], np.nan),
        in_contact=touching,
    )


def _where(
    touching: np.ndarray[tuple[int], np.dtype[np.bool_]], rows: FloatArray, else_: float
) -> FloatArray:
    return np.where(touching[:, None], rows, np.float32(else_)).astype(np.float32, copy=False)
