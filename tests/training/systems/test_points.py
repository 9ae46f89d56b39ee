"""Networks on points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.training.systems.conftest import MakeSamples, assert_exports

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate_training.systems import points
from palpate_training.systems.samples import error_of


def test_centres_are_far_from_one_another() -> None:
    line = np.column_stack([np.arange(9.0), np.zeros(9), np.zeros(9)])
    assert sorted(points.farthest_points(line, 3)) == [0, 4, 8]
    assert len(set(points.farthest_points(line, 32))) == 9  # no more than there are


def test_the_published_radius_sees_single_electrodes() -> None:
    """The nearest two are 2.8 mm apart: nothing is gathered by the first layer."""
    first, second = (
        points.SetAbstraction(ELECTRODE_POSITIONS, 1, layers[0])
        for layers in (points.PUBLISHED, points.FITTED)
    )
    assert first.offset.shape == (19, 1, 3)
    assert float(first.offset.abs().max()) == 0.0
    assert second.offset.shape[1] > 4


def test_a_layer_is_the_most_of_its_sets() -> None:
    """Against a plain loop over centres and their points."""
    torch.manual_seed(0)
    places = np.random.default_rng(0).uniform(-5e-3, 5e-3, (12, 3))
    size = points.Abstraction(5, 4e-3, (8, 6))
    layer = points.SetAbstraction(places, 2, size)
    features = torch.randn(3, 12, 2)
    found = layer(features)
    assert found.shape == (3, 5, 6)
    for number, centre in enumerate(layer.centres):
        near = np.flatnonzero(np.linalg.norm(places - centre, axis=1) <= size.radius_m)
        each = []
        for point in near:
            offset = torch.tensor((places[point] - centre) / 1e-3, dtype=torch.float32)
            joined = layer.of_point(features[:, point]) + layer.of_offset(offset)
            each.append(layer.rest(joined))
        wanted = torch.stack(each).amax(dim=0)
        assert torch.allclose(found[:, number], wanted, atol=1e-5)


def test_sizes_are_those_of_the_paper() -> None:
    net = points.PointNetPlus(ELECTRODE_POSITIONS, 1, 3)
    weights = sum(one.numel() for one in net.parameters())
    assert weights == pytest.approx(507_779, rel=0.01)  # learning notes, section 1.2 h


@pytest.mark.parametrize(
    "make",
    [
        lambda: (points.PointNetPlus(ELECTRODE_POSITIONS, 1, 3, points.FITTED), 19),
        lambda: (points.PointNetPlus(np.random.default_rng(0).uniform(size=(40, 3)), 3, 19), 120),
        lambda: (points.PointNet(np.random.default_rng(0).uniform(size=(40, 3)), 19), 120),
    ],
)
def test_exports_with_standard_operators(make: object) -> None:
    torch.manual_seed(0)
    net, inputs = make()  # type: ignore[operator]
    assert_exports(net, torch.randn(5, inputs))


@pytest.mark.slow
def test_it_learns(make_samples: MakeSamples, monkeypatch: pytest.MonkeyPatch) -> None:
    quick = replace(points.POINTS_CONFIG, epochs=30, patience=30, batch_rows=64)
    monkeypatch.setattr(points, "POINTS_CONFIG", quick)
    train, test = make_samples(300, seed=1), make_samples(200, seed=2)
    mean = np.repeat(train.force.mean(axis=0)[None], len(test), axis=0)
    estimate = points.fit_points(points.FITTED, "force", train, test, 0)
    assert error_of(estimate(test), test.force) < 0.5 * error_of(mean, test.force)
