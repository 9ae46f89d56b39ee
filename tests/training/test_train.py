"""The paper's network, the loop that trains it, and the warming that it is shown."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest
import torch

from palpate_training.datasets.features import FeatureDataset
from palpate_training.learning.fit import FeaturesFitConfig, drift, fit_quantity
from palpate_training.learning.networks import Mlp, predict
from palpate_training.learning.splits import by_group

MakeData = Callable[..., FeatureDataset]
QUICK = FeaturesFitConfig(widths=(32, 32), epochs=30, batch_rows=64)


def test_the_papers_network_has_54915_parameters() -> None:
    assert sum(values.numel() for values in Mlp().parameters()) == 54_915


def test_normalisation_is_inside() -> None:
    net = Mlp()
    inputs = np.random.default_rng(0).normal(100, 50, (500, 19)).astype(np.float32)
    targets = np.random.default_rng(1).normal([0, 1, 5], [1, 2, 3], (500, 3)).astype(np.float32)
    inputs[:, 4] = 7.0  # a dead electrode
    net.normalise_from(inputs, targets)
    np.testing.assert_allclose(net.input_mean.numpy(), inputs.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(net.output_sd.numpy(), targets.std(axis=0), rtol=1e-5)
    assert np.isfinite(predict(net, inputs)).all()


def test_training_learns_repeats_and_uses_train_rows_only(press_data: MakeData) -> None:
    data = press_data()
    split = by_group(data.group)
    x, y = data.tared_counts, data.force

    def run(seed: int) -> Mlp:
        return fit_quantity(
            x[split.train],
            y[split.train],
            (x[split.validation], y[split.validation]),
            config=QUICK,
            seed=seed,
        )

    net = run(0)
    np.testing.assert_allclose(net.input_mean.numpy(), x[split.train].mean(axis=0), rtol=1e-4)
    error = np.linalg.norm(predict(net, x[split.test]) - y[split.test], axis=1)
    mean = y[split.train].mean(axis=0)
    assert np.median(error) < 0.2 * np.median(np.linalg.norm(y[split.test] - mean, axis=1))
    np.testing.assert_array_equal(predict(run(0), x), predict(net, x))
    assert not np.array_equal(predict(run(1), x), predict(net, x))


def test_patience_stops_and_the_best_weights_are_kept(
    press_data: MakeData, caplog: pytest.LogCaptureFixture
) -> None:
    data = press_data(presses=4)
    x, y = data.tared_counts, data.force
    shuffled = np.random.default_rng(0).permutation(y)  # nothing to learn
    config = FeaturesFitConfig(widths=(16,), epochs=60, patience=3, batch_rows=64)
    epochs: list[None] = []
    with caplog.at_level("DEBUG", "palpate_training.learning.fit"):
        net = fit_quantity(x, shuffled, (x, y), config=config, on_epoch=lambda: epochs.append(None))
    best, last, score = map(float, re.findall(r"[0-9][0-9.]*", caplog.messages[-1]))
    assert last == len(epochs) < 60
    assert best <= last - 3
    error = np.median(np.linalg.norm(predict(net, x) - y, axis=1))
    assert error == pytest.approx(score, rel=1e-3)


def test_drift_is_a_common_factor_of_the_impedances() -> None:
    torch.manual_seed(0)
    baseline = torch.full((4, 19), 2800.0)
    tared = torch.linspace(-500, 200, 19).expand(4, 19)
    drifted = drift(tared, baseline, 0.05) + baseline
    impedance = 4095 / (tared + baseline) - 1
    factor = (4095 / drifted - 1) / impedance
    for row in factor:
        torch.testing.assert_close(row, row[:1].expand(19), rtol=1e-4, atol=0)
    assert len({round(float(row[0]), 6) for row in factor}) == 4


def test_drift_needs_the_baseline(press_data: MakeData) -> None:
    data = press_data(presses=3)
    x, y = data.tared_counts, data.force
    with pytest.raises(ValueError, match="baseline"):
        fit_quantity(x, y, (x, y), config=FeaturesFitConfig(drift_sd=0.1))
