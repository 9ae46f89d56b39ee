"""Training on a GPU: a step that is launched as one does what the same step does on the CPU."""

import numpy as np
import pytest
import torch

from palpate_training.learning.features_net import (
    FeaturesNetConfig,
    FeaturesRows,
    fit_features_net,
    score_of,
)
from palpate_training.learning.fit import FeaturesFitConfig, fit_quantity
from palpate_training.learning.networks import predict

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")

ROWS = 1000  # not a whole number of batches, so that both kinds of steps are taken


@pytest.fixture(scope="module")
def rows() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    counts = rng.normal(0, 100, (ROWS, 19)).astype(np.float32)
    return counts, np.tanh(counts @ rng.normal(0, 0.01, (19, 3))).astype(np.float32)


def trained(rows: tuple[np.ndarray, np.ndarray], device: str, epochs: int) -> np.ndarray:
    config = FeaturesFitConfig(epochs=epochs, batch_rows=128)
    with torch.device(device):
        net = fit_quantity(*rows, config=config)
    return predict(net, rows[0])


def test_learns_as_on_the_cpu(rows: tuple[np.ndarray, np.ndarray]) -> None:
    left = {
        device: np.linalg.norm(trained(rows, device, epochs=40) - rows[1], axis=1).mean()
        for device in ("cpu", "cuda")
    }
    assert left["cuda"] == pytest.approx(left["cpu"], rel=0.2)
    assert left["cuda"] < 0.2 * np.linalg.norm(rows[1], axis=1).mean()


def test_a_recorded_step_is_the_step_itself(
    rows: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = trained(rows, "cuda", epochs=5)
    monkeypatch.setattr("palpate_training.learning.fit.recorded", lambda step, batch_rows: step)
    one_by_one = trained(rows, "cuda", epochs=5)
    np.testing.assert_allclose(recorded, one_by_one, atol=1e-3 * np.abs(one_by_one).max())


def test_the_network_that_ships_learns_as_on_the_cpu(rows: tuple[np.ndarray, np.ndarray]) -> None:
    known = FeaturesRows(*rows)
    config = FeaturesNetConfig(epochs=20, members=2, batch_rows=128)
    scores = {}
    for device in ("cpu", "cuda"):
        with torch.device(device):
            net = fit_features_net(
                known, known, np.full(19, 3000, np.float32), symmetric=True, config=config
            )
        scores[device] = score_of(net.cpu(), known)
    assert scores["cuda"] == pytest.approx(scores["cpu"], rel=0.2)
