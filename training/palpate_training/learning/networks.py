"""The paper's fully connected network, with its normalisation inside."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.errors import ConfigError
from palpate_training.datasets.features import ELECTRODES

PAPER_WIDTHS = (256, 128, 128)
"""Hidden layers of the paper's MLP."""

Activation = Literal["silu", "relu", "tanh"]
"""The paper does not state its activation. SiLU won on validation blocks (training/LOG.md)."""

_SMALLEST_SD = 1e-6
"""Keeps a channel that never moves (a dead electrode) from dividing by zero."""


_ACTIVATIONS: dict[Activation, type[nn.Module]] = {
    "silu": nn.SiLU,
    "relu": nn.ReLU,
    "tanh": nn.Tanh,
}


class Standardised(nn.Module):
    """Inputs ``(N, I)`` -> one quantity ``(N, O)``, each in its own unit, by some layers.

    Standardisation of the inputs and of the outputs are constants of the graph, so that
    it runs without any knowledge of the training data.
    """

    input_mean: Tensor
    input_sd: Tensor
    output_mean: Tensor
    output_sd: Tensor

    def __init__(self, layers: nn.Module, inputs: int = ELECTRODES, outputs: int = 3) -> None:
        super().__init__()
        self.layers = layers
        self.register_buffer("input_mean", torch.zeros(inputs))
        self.register_buffer("input_sd", torch.ones(inputs))
        self.register_buffer("output_mean", torch.zeros(outputs))
        self.register_buffer("output_sd", torch.ones(outputs))

    def forward(self, inputs: Tensor) -> Tensor:
        """Estimate of the quantity, shape ``(N, O)``."""
        scaled = (inputs - self.input_mean) / self.input_sd
        estimate: Tensor = self.layers(scaled) * self.output_sd + self.output_mean
        return estimate

    def normalise_from(
        self, inputs: npt.NDArray[np.float32], targets: npt.NDArray[np.float32]
    ) -> None:
        """Set the constants from training rows: inputs ``(N, I)`` and targets ``(N, O)``."""
        for values, mean, sd in (
            (inputs, self.input_mean, self.input_sd),
            (targets, self.output_mean, self.output_sd),
        ):
            mean.copy_(torch.from_numpy(values.mean(axis=0, dtype=np.float64)))
            spread = np.maximum(values.std(axis=0, dtype=np.float64), _SMALLEST_SD)
            sd.copy_(torch.from_numpy(spread))


class Mlp(Standardised):
    """Tared counts ``(N, 19)`` -> one quantity, by default ``(N, 3)``, fully connected."""

    def __init__(
        self,
        widths: Sequence[int] = PAPER_WIDTHS,
        inputs: int = ELECTRODES,
        activation: Activation = "silu",
        outputs: int = 3,
    ) -> None:
        layers: list[nn.Module] = []
        for before, after in zip((inputs, *widths[:-1]), widths, strict=True):
            layers += [nn.Linear(before, after), _ACTIVATIONS[activation]()]
        super().__init__(nn.Sequential(*layers, nn.Linear(widths[-1], outputs)), inputs, outputs)


def round_to_half(net: nn.Module) -> None:
    """Round the weights of all layers to half precision, in place, as bundles store them."""
    with torch.no_grad():
        for layer in net.modules():
            if isinstance(layer, nn.Linear):
                layer.weight.copy_(layer.weight.half())


def predict(
    net: nn.Module, inputs: npt.NDArray[np.float32], *, batch_rows: int = 8192
) -> npt.NDArray[np.float32]:
    """Run a network over rows, where it lies: ``(N, I)`` -> ``(N, O)``."""
    net.eval()
    device = device_of(net)
    with torch.inference_mode():
        parts = [
            net(part.to(device)).cpu().numpy()
            for part in torch.split(torch.from_numpy(inputs), batch_rows)
        ]
    return np.concatenate(parts)


def training_device(wanted: str) -> str:
    """Where networks are trained: ``cpu``, ``cuda``, or for ``auto`` a GPU if there is one.

    Raises:
        ConfigError: It is none of these, or there is no GPU.
    """
    if wanted not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"no device {wanted!r}", remedy="choose auto, cpu or cuda")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise ConfigError("torch sees no GPU", remedy="give --device cpu, or auto")
    return "cuda" if wanted != "cpu" and torch.cuda.is_available() else "cpu"


def device_of(net: nn.Module) -> torch.device:
    """Where the weights of a network lie."""
    return next(net.parameters()).device
