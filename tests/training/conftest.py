"""A small data set with a known law between electrodes and force."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from palpate.training.dataset import FeatureDataset, Provenance


@pytest.fixture
def provenance() -> Provenance:
    return Provenance("made by a test", "pytest", "", "free", "0.0.0")


@pytest.fixture
def press_data(provenance: Provenance) -> Callable[..., FeatureDataset]:
    """Presses of an invented finger: force and place follow smooth laws of the counts."""

    def make(presses: int = 12, rows: int = 60, seed: int = 0) -> FeatureDataset:
        rng = np.random.default_rng(seed)
        n = presses * rows
        group = np.repeat(np.arange(presses, dtype=np.int32), rows)
        depth = np.tile(np.clip(np.sin(np.linspace(-0.5, np.pi, rows)), 0, None), presses)
        place = np.repeat(rng.uniform(-1, 1, (presses, 3)), rows, axis=0)
        touching = depth > 0
        force = (depth[:, None] * (place + np.array([0, 0, 3]))).astype(np.float32)
        mix = rng.normal(size=(6, 19)) * 60
        signal = np.hstack([force, depth[:, None] * place]) @ mix + rng.normal(size=(n, 19))
        baseline = np.tile(rng.uniform(2500, 3000, 19), (n, 1)).astype(np.float32)
        electrodes = np.clip(np.round(baseline + signal), 0, 4095).astype(np.uint16)
        location = np.where(touching[:, None], 0.004 * place, np.nan).astype(np.float32)
        return FeatureDataset(
            electrodes=electrodes,
            baseline=baseline,
            force=force,
            group=group,
            block=group.copy(),
            sensor=np.zeros(n, dtype=np.int32),
            sensor_names=("finger",),
            provenance=provenance,
            contact_location=location,
            in_contact=touching,
            time_ns=np.arange(n, dtype=np.int64) * 10_000_000,
        )

    return make
