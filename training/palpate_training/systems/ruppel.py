"""Ruppel 2019: electrodes from the contact's position and force, by two networks.

The article sees the force now, ten samples before and ten after, of a sensor that moves. Rows here
are settled increments of a press, so before and after are the neighbouring rows of the trial; the
temperature is constant and left out.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from palpate_training.learning.fit import FitConfig
from palpate_training.learning.networks import Standardised
from palpate_training.systems.samples import FloatArray, Samples

CONFIG = FitConfig(epochs=80, patience=20, batch_rows=512, learning_rate=5e-4, weight_decay=0.0)
A_WIDTH, A_LAYERS = 1280, 5
"""The article says five layers and more than six million weights."""
PENALTY = 1e-3
"""L1 penalty on the biases of the force branch, which makes no force change nothing."""


def ruppel_inputs(samples: Samples) -> FloatArray:
    """Position [m], and force now, before and after [N], (N, 12); rows of a trial in order."""
    before, after = samples.force.copy(), samples.force.copy()
    same = samples.trial[1:] == samples.trial[:-1]
    before[1:][same] = samples.force[:-1][same]
    after[:-1][same] = samples.force[1:][same]
    return np.hstack([samples.location, samples.force, before, after]).astype(np.float32)


def network_a(outputs: int) -> Standardised:
    """Five wide layers."""
    layers: list[nn.Module] = []
    width = 12
    for _ in range(A_LAYERS):
        layers += [nn.Linear(width, A_WIDTH), nn.ReLU()]
        width = A_WIDTH
    return Standardised(nn.Sequential(*layers, nn.Linear(width, outputs)), 12, outputs)


class BranchedLayers(nn.Module):
    """Network B: what the position tells times what the force tells."""

    def __init__(self, outputs: int) -> None:
        super().__init__()

        def branch(inputs: int, width: int, result: int) -> nn.Sequential:
            return nn.Sequential(
                nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(),
                nn.Linear(width, width), nn.ReLU(), nn.Linear(width, result),
            )  # fmt: skip

        self.area, self.force = branch(3, 512, 64), branch(9, 256, 64)
        self.activity = nn.Sequential(
            nn.Linear(64, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, outputs)
        )

    def forward(self, inputs: Tensor) -> Tensor:
        """Standardised electrodes of standardised inputs (N, 12)."""
        both = self.area(inputs[:, :3]) * self.force(inputs[:, 3:])
        estimate: Tensor = self.activity(both)
        return estimate

    def penalty(self) -> Tensor:
        """L1 norm of the force branch's biases, times its factor."""
        biases = [layer.bias for layer in self.force if isinstance(layer, nn.Linear)]
        return PENALTY * torch.stack([bias.abs().mean() for bias in biases]).sum()


def network_b(outputs: int) -> Standardised:
    """Branches that are multiplied."""
    return Standardised(BranchedLayers(outputs), 12, outputs)
