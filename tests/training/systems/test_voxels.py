"""The voxel networks, and the published weights of one of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.training.systems.conftest import MakeSamples, assert_exports

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate_training.systems import voxels
from palpate_training.systems.samples import error_of


def test_every_electrode_has_a_voxel_of_its_own() -> None:
    found = voxels.voxel_of(ELECTRODE_POSITIONS)
    assert len({tuple(voxel) for voxel in found}) == 19
    assert found.min(axis=0).tolist() == [0, 0, 0]
    assert found.max(axis=0).tolist() == [15, 15, 7]
    grid = voxels.ElectrodeGrid()(torch.arange(1.0, 20.0)[None])
    assert grid.shape == (1, 1, 16, 16, 8)
    assert np.count_nonzero(grid) == 19
    for number, voxel in enumerate(found):
        assert grid[(0, 0, *voxel)] == number + 1


@pytest.fixture
def oracle(shared_data: Path) -> Path:
    folder = shared_data / "force_net_oracle"
    if not folder.is_dir():
        pytest.skip("the published weights are not beside the project")
    return folder


@pytest.mark.parametrize("name", ["icra19", "ll4ma_lab"])
def test_published_weights_give_the_published_forces(oracle: Path, name: str) -> None:
    golden = np.load(oracle / "golden_vectors_and_geometry.npz")
    net = voxels.ProjectionNet()
    net.load_published(dict(np.load(oracle / f"{name}_weights.npz")))
    with torch.inference_mode():
        force = net(torch.from_numpy(golden["electrodes_tared_counts"])).numpy()
    np.testing.assert_allclose(force, golden[f"{name}_tensorflow_force"], atol=1e-5, rtol=1e-5)


def test_voxels_are_those_of_the_original(oracle: Path) -> None:
    golden = np.load(oracle / "golden_vectors_and_geometry.npz")
    found = voxels.voxel_of(ELECTRODE_POSITIONS)
    np.testing.assert_array_equal(found, golden["electrode_voxel_index"])


def test_the_loss_of_a_press_along_the_normal_counts_most() -> None:
    net = voxels.ProjectionNet()
    counts = torch.zeros(2, 19)
    counts[:, 16] = -100.0  # E17, in the middle of the pad: the normal is along z
    truth = torch.tensor([[0.0, 0.0, 2.0], [2.0, 0.0, 0.0]])
    assert torch.allclose(net.inward(counts), torch.tensor([[0.0, 0.0, 1.0]] * 2), atol=1e-5)
    along, across = (
        voxels.projection_loss(net, truth[i : i + 1] * 1.1, truth[i : i + 1], counts[i : i + 1])
        for i in range(2)
    )
    assert float(along / across) == pytest.approx(2.0 ** (voxels.SHARPNESS / 4), rel=1e-2)


@pytest.mark.parametrize("make", [voxels.ProjectionNet, voxels.PaperVoxelNet])
def test_exports_with_standard_operators(make: type) -> None:
    torch.manual_seed(0)
    assert_exports(make(), 100.0 * torch.randn(5, 19))


@pytest.mark.slow
def test_both_learn(make_samples: MakeSamples, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, epochs in (("VOXEL_CONFIG", 6), ("PROJECTION_CONFIG", 30)):
        quick = replace(getattr(voxels, name), epochs=epochs, patience=epochs, batch_rows=32)
        monkeypatch.setattr(voxels, name, quick)
    train, test = make_samples(300, seed=1), make_samples(200, seed=2)
    mean = np.repeat(train.force.mean(axis=0)[None], len(test), axis=0)
    for system in voxels.VOXELS:
        estimate = system.fit("force", train, test, 0)
        assert error_of(estimate(test), test.force) < 0.8 * error_of(mean, test.force)
