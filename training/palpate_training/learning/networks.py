"""The paper's fully connected network, with its normalisation inside.

The networks as they are shipped: the whole field in, or the whole field out.

The modes lie in the graph in half precision and are cast to single, so torch and ONNX Runtime
compute with the same numbers and the file is half as large.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.files.tasks import TASKS
from palpate.messages import TensorInfo
from palpate_training.datasets.features import ELECTRODES
from palpate_training.learning.field_code import FieldCode, FilmPooling

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


def device_of(net: nn.Module) -> torch.device:
    """Where the weights of a network lie."""
    return next(net.parameters()).device


FloatArray = npt.NDArray[np.float32]

THINNEST_FILM = 0.02
"""Relative thickness below which a film counts as closed; keeps the logarithm finite."""

SMALLEST_MODE = 0.1
"""Modes that vary less than this share of the first are not scaled to unit variance: they hold
little but the rounding and the peculiarities of single trajectories."""


def _register(module: nn.Module, **constants: npt.NDArray[Any]) -> None:
    """Make arrays constants of a graph, by name."""
    for name, values in constants.items():
        module.register_buffer(name, torch.from_numpy(values))


class FeaturesGraph(nn.Module):
    """The ``features`` task: estimates of one network, and constant standard deviations.

    Args:
        net: Tared counts ``(N, 19)`` -> force [N], then what only a contact has, ``(N, 3 Q)``.
        force_sd: Residual standard deviation per axis on validation rows [N], shape ``(3,)``.
        contact_sd: The same of what only a contact has, by the name of its output, in the order of
            the contract: ``contact_location`` and ``centre_of_pressure`` [m], one per axis;
            ``contact_normal``, that of its angle [rad], shape ``(1,)``. Normals are made unit
            vectors.
    """

    def __init__(
        self,
        net: nn.Module,
        force_sd: FloatArray,
        contact_sd: Mapping[str, FloatArray] | None = None,
    ) -> None:
        super().__init__()
        given = contact_sd or {}
        self.names = tuple(one.name for one in TASKS["features"].optional if one.name in given)
        if self.names != tuple(given):
            raise ValueError(f"{tuple(given)} are not in the order of the contract")
        self.net = net
        # Not named as the outputs are: ONNX wants every name once.
        _register(self, force_spread=force_sd.astype(np.float32))
        for name in self.names:
            _register(self, **{f"{name}_spread": given[name].astype(np.float32)})

    def forward(self, electrodes: Tensor) -> tuple[Tensor, ...]:
        """Tared counts ``(N, 19)`` -> the task's outputs in order."""
        rows = electrodes.shape[0]
        force, *contact = torch.split(self.net(electrodes), 3, dim=1)
        outputs = [force, self.get_buffer("force_spread").expand(rows, 3)]
        for name, estimate in zip(self.names, contact, strict=True):
            spread = self.get_buffer(f"{name}_spread")
            if name == "contact_normal":
                estimate = nn.functional.normalize(estimate, dim=1)
            outputs += [estimate, spread.expand(rows, len(spread))]
        return tuple(outputs)

    @property
    def outputs(self) -> tuple[TensorInfo, ...]:
        """What it gives, as the contract names it."""
        contract = TASKS["features"]
        given = {*self.names, *(f"{name}_sd" for name in self.names)}
        return contract.outputs + tuple(one for one in contract.optional if one.name in given)


class FieldGraph(nn.Module):
    """Tared counts ``(N, 19)`` -> nodal displacement ``(N, 3V)`` [m], its spread, coefficients.

    Args:
        net: Tared counts -> coefficients [m], shape ``(N, K)``.
        code: What they are coefficients of.
        node_sd: Root mean square length of the nodal error on validation rows [m], shape ``(V,)``.
    """

    modes: Tensor
    scale: Tensor
    mean: Tensor
    node_spread: Tensor

    def __init__(self, net: Mlp, code: FieldCode, node_sd: FloatArray) -> None:
        super().__init__()
        self.net = net
        _register(self, modes=code.modes, scale=code.scale, mean=code.mean)
        _register(self, node_spread=node_sd.astype(np.float32))

    def forward(self, electrodes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Displacement ``(N, 3V)``, standard deviation ``(N, V)``, coefficients ``(N, K)``, [m]."""
        coefficients = self.net(electrodes) * self.scale  # (N, K)
        field = coefficients @ self.modes.to(torch.float32) + self.mean  # (N, 3V)
        return field, self.node_spread.expand(electrodes.shape[0], -1), coefficients


class FilmNet(nn.Module):
    """Coefficients and pooled film change -> tared counts; adds the film's relative thickness.

    The impedance of an electrode under a thin film is nearly inverse in its thickness, so its
    logarithm is what the counts follow (learning notes, section 4.2).

    Args:
        mlp: ``(N, K + 2P)`` -> tared counts ``(N, 19)``.
        modes: K.
        rest_m: Pooled film of the untouched finger [m], shape ``(P,)``.
    """

    rest_m: Tensor

    def __init__(self, mlp: Mlp, modes: int, rest_m: FloatArray) -> None:
        super().__init__()
        self.mlp = mlp
        self.modes = modes
        self.register_buffer("rest_m", torch.from_numpy(rest_m))

    def widen(self, features: Tensor) -> Tensor:
        """Features ``(N, K + P)`` [m] with the logarithms behind them, ``(N, K + 2P)``."""
        thickness = 1.0 + features[:, self.modes :] / self.rest_m
        return torch.cat([features, torch.log(torch.clamp(thickness, min=THINNEST_FILM))], dim=1)

    def normalise_from(self, features: FloatArray, tared_counts: FloatArray) -> None:
        """Set the constants from training rows: ``(N, K + P)`` [m] and ``(N, 19)`` [counts]."""
        self.mlp.normalise_from(self.widen(torch.from_numpy(features)).numpy(), tared_counts)
        modes = self.mlp.input_sd[: self.modes]
        modes.clamp_(min=SMALLEST_MODE * float(modes.max()))

    def forward(self, features: Tensor) -> Tensor:
        """Tared counts ``(N, 19)`` of features ``(N, K + P)`` [m]."""
        counts: Tensor = self.mlp(self.widen(features))
        return counts


class SynthesisGraph(nn.Module):
    """Nodal displacement ``(N, 3V)`` [m] -> tared counts and their spread, each ``(N, 19)``.

    Args:
        net: Coefficients and pooled film change -> tared counts.
        code: Modes to project on.
        pooling: How the film near the electrodes is pooled.
        counts_sd: Root mean square residual on validation rows [counts], shape ``(19,)``.
    """

    modes: Tensor
    scale: Tensor
    mean: Tensor
    nodes: Tensor
    normals: Tensor
    weights: Tensor
    counts_spread: Tensor

    def __init__(
        self, net: FilmNet, code: FieldCode, pooling: FilmPooling, counts_sd: FloatArray
    ) -> None:
        super().__init__()
        self.net = net
        _register(self, modes=code.modes, scale=code.scale, mean=code.mean)
        _register(self, nodes=pooling.nodes, normals=pooling.normals, weights=pooling.weights)
        _register(self, counts_spread=counts_sd.astype(np.float32))

    def forward(self, displacement: Tensor) -> tuple[Tensor, Tensor]:
        """Tared counts and standard deviation, each ``(N, 19)`` [counts]."""
        modes = self.modes.to(torch.float32)
        coefficients = nn.functional.linear(displacement - self.mean, modes) * self.scale
        vectors = displacement.reshape(displacement.shape[0], -1, 3)
        near = torch.index_select(vectors, 1, self.nodes)  # (N, I, 3)
        pooled = (near * self.normals).sum(dim=2) @ self.weights  # (N, P)
        counts: Tensor = self.net(torch.cat([coefficients, pooled], dim=1))
        return counts, self.counts_spread.expand(displacement.shape[0], -1)
