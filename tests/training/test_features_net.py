"""The network of the shipped features: mirror images, unknown quantities, what decides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import torch

from palpate.anatomy import ELECTRODE_MIRROR
from palpate.messages import COUNTS_MAX
from palpate_training.learning import electrode_nets
from palpate_training.learning.electrode_nets import MIRROR_AXES, ResidualLayers
from palpate_training.learning.export import onnx_bytes, run_onnx
from palpate_training.learning.features_net import (
    FeaturesNet,
    FeaturesNetConfig,
    FeaturesRows,
    fit_features_net,
    score_of,
)
from palpate_training.learning.graphs import FeaturesGraph
from palpate_training.learning.networks import Standardised, predict

QUICK = FeaturesNetConfig(members=2, width=48, blocks=1, epochs=40, patience=40, batch_rows=64)
REST = np.linspace(2900, 3300, 19).astype(np.float32)


def rows_of(count: int, seed: int, *, contact: float = 1.0) -> FeaturesRows:
    """A finger that is its own mirror image; force, and a location of some rows."""
    rng = np.random.default_rng(seed)
    force = rng.normal(0.0, 2.0, (count, 3)).astype(np.float32)
    half = np.random.default_rng(0).normal(size=(3, 19))
    mix = half + (half * MIRROR_AXES[:, None])[:, ELECTRODE_MIRROR]
    tared = 20.0 * force @ mix
    location = (0.002 * force).astype(np.float32)
    location[rng.random(count) > contact] = np.nan
    return FeaturesRows(tared.astype(np.float32), np.hstack([force, location]))


def test_inputs_are_counts_and_the_fall_of_the_log_impedance() -> None:
    net = FeaturesNet([Standardised(ResidualLayers(38, 3, 8, 1), 38)], REST, symmetric=True)
    tared = np.random.default_rng(0).normal(0, 300, (5, 19)).astype(np.float32)
    inputs = net.inputs(torch.from_numpy(tared)).numpy()
    np.testing.assert_array_equal(inputs[:, :19], tared)

    def log_impedance(counts: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        return np.asarray(np.log(COUNTS_MAX / np.clip(counts, 1, COUNTS_MAX - 1) - 1))

    expected = log_impedance(REST) - log_impedance(REST + tared)
    np.testing.assert_allclose(inputs[:, 19:], expected, rtol=1e-4, atol=1e-5)
    at_the_ends = torch.tensor([[-1e6] * 19, [1e6] * 19])
    assert torch.isfinite(net(at_the_ends)).all()


def test_training_inputs_have_gains_of_their_own() -> None:
    """Another finger's electrodes are stronger or weaker: both inputs of an electrode alike."""
    read = electrode_nets.ElectrodeInputs(REST)
    tared = np.full((4000, 19), 300.0, np.float32)
    inputs = torch.from_numpy(read.of(tared))
    torch.manual_seed(0)
    counts, fall = (
        (read.noisy(inputs, gain_spread=0.1, drift_counts=0.0) / inputs)
        .numpy()
        .reshape(-1, 2, 19)
        .swapaxes(0, 1)
    )
    np.testing.assert_allclose(counts, fall, atol=0.05)
    gains = np.log(counts)
    np.testing.assert_allclose(gains.std(axis=0), 0.1, rtol=0.06)
    np.testing.assert_allclose(gains.mean(axis=0), 0.0, atol=0.02)
    assert np.abs(np.corrcoef(gains.T) - np.eye(19)).max() < 0.1
    # An untouched finger stays untouched, whatever its gains are.
    still = read.noisy(torch.zeros(500, 38), gain_spread=0.1, drift_counts=0.0)[:, :19]
    assert still.std() < 1.5 * electrode_nets.NOISE_COUNTS
    # A network for the fingers of its training gets no gains.
    own = read.noisy(inputs, gain_spread=0.0, drift_counts=0.0)[:, :19] - inputs[:, :19]
    assert own.std() < 1.5 * electrode_nets.NOISE_COUNTS


@pytest.mark.parametrize("symmetric", [True, False])
def test_it_learns_and_a_mirror_image_has_the_mirrored_estimate(*, symmetric: bool) -> None:
    train, test = rows_of(800, 1), rows_of(200, 2)
    even = (0.5 * (REST[ELECTRODE_MIRROR] + REST)).astype(np.float32)
    net = fit_features_net(train, test, even, symmetric=symmetric, config=QUICK)
    estimate = predict(net, test.tared)
    assert score_of(net, test) < 0.3
    assert np.linalg.norm(estimate - test.targets) < 0.3 * np.linalg.norm(test.targets)
    image = predict(net, np.ascontiguousarray(test.tared[:, ELECTRODE_MIRROR]))
    error = np.abs(image - estimate * np.tile(MIRROR_AXES, 2)).max()
    assert (error < 1e-4) == symmetric


def test_rows_without_a_contact_teach_the_force_alone() -> None:
    train, test = rows_of(800, 1, contact=0.6), rows_of(200, 2, contact=0.6)
    assert np.isnan(train.targets[:, 3]).any()
    net = fit_features_net(train, test, REST, symmetric=False, config=QUICK)
    assert np.isfinite(predict(net, test.tared)).all()
    assert score_of(net, test) < 0.4


def test_the_same_seed_gives_the_same_network() -> None:
    train, test = rows_of(200, 1), rows_of(50, 2)
    quick = FeaturesNetConfig(members=1, width=16, blocks=1, epochs=3, batch_rows=64)
    first, again, other = (
        predict(
            fit_features_net(train, test, REST, symmetric=True, config=quick, seed=seed),
            test.tared,
        )
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3


def test_a_common_drift_since_the_tare_is_hardly_a_force() -> None:
    train, test = rows_of(800, 1), rows_of(200, 2)
    one = replace(QUICK, members=1)
    drifted = np.array([[-20.0], [20.0]], np.float32).repeat(19, axis=1)

    def force_of_drift(config: FeaturesNetConfig) -> float:
        net = fit_features_net(train, test, REST, symmetric=False, config=config)
        return float(np.linalg.norm(predict(net, drifted)[:, :3], axis=1).mean())

    assert force_of_drift(one) < 0.5 * force_of_drift(replace(one, drift_counts=0.0))


def test_a_batch_has_the_bits_of_single_rows_in_onnx() -> None:
    """A service computes frames of several sensors together; none may change another's estimate."""
    torch.manual_seed(0)
    rows = np.random.default_rng(1).normal(0, 50, (400, 19)).astype(np.float32)
    member = Standardised(ResidualLayers(38, 3, 64, 2), 38)
    net = FeaturesNet([member], REST, symmetric=True).eval()
    inputs = net.inputs(torch.from_numpy(rows)).numpy()
    member.normalise_from(inputs, rows[:, :3])
    graph = FeaturesGraph(net, np.ones(3, np.float32))
    model = onnx_bytes(graph, "electrodes", torch.zeros(4, 19), ["force", "force_sd"])
    together, one_by_one = run_onnx(model, "electrodes", rows)
    assert together[0].tobytes() == one_by_one[0].tobytes()
