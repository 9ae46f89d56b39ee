"""Rows of a finger that is pressed in a known way."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from palpate.anatomy import ELECTRODE_NORMALS, ELECTRODE_POSITIONS
from palpate_training.systems.samples import Samples

MakeSamples = Callable[..., Samples]


@pytest.fixture
def make_samples() -> MakeSamples:
    """Rows in which the skin is pressed at a point: electrodes near it fall with the force."""

    def make(
        rows: int = 400, *, trials: int = 40, seed: int = 0, known_rest: bool = True
    ) -> Samples:
        rng = np.random.default_rng(seed)
        trial = np.sort(rng.integers(trials, size=rows)).astype(np.int32)
        at = rng.uniform((-13e-3, -4e-3, -7e-3), (4e-3, 4e-3, -5e-3), (trials, 3))[trial]
        depth = np.linspace(0.2, 1.0, rows)[rng.permutation(rows)]
        near = np.exp(-np.sum((ELECTRODE_POSITIONS - at[:, None]) ** 2, axis=2) / (4e-3) ** 2)
        tared = -900.0 * depth[:, None] * near
        force = -5.0 * depth[:, None] * np.einsum("ne,ek->nk", near, ELECTRODE_NORMALS)
        rest = np.full((rows, 19), 3000.0 if known_rest else np.nan)
        return Samples(
            tared=tared.astype(np.float32),
            rest=rest.astype(np.float32),
            trial=trial,
            location=at.astype(np.float32),
            force=force.astype(np.float32),
            centre=at.astype(np.float32),
            normal=np.tile(np.array([0.0, 0.0, -1.0], np.float32), (rows, 1)),
        )

    return make


def assert_exports(net: Any, inputs: Any) -> None:
    """A network runs in ONNX Runtime as in torch, by standard operators alone."""
    torch = pytest.importorskip("torch")
    runtime = pytest.importorskip("onnxruntime")
    program = torch.onnx.export(
        net.eval(), (inputs,), input_names=["x"], opset_version=20, dynamo=True, verbose=False
    )
    proto = program.model_proto
    assert {node.domain for node in proto.graph.node} <= {"", "ai.onnx"}
    session = runtime.InferenceSession(proto.SerializeToString())
    (found,) = session.run(None, {"x": inputs.numpy()})
    np.testing.assert_allclose(found, net(inputs).detach().numpy(), atol=1e-5, rtol=1e-5)
