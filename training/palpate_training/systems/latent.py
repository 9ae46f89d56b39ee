"""Narang 2021: latent spaces of the electrodes and of the skin, with projections between them.

Each side has a variational autoencoder that is trained without the other; then a network between
the two latent spaces is trained on pairs. The article's mesh encoder convolves over the mesh; here
it is fully connected and sees the coefficients of the skin's modes, which lose 5 um. The electrode
side is as the ACROSS framework has it (19-256-128-64 and 8 latent values).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate_training.learning.fit import FitConfig, fit
from palpate_training.learning.networks import predict

FloatArray = npt.NDArray[np.float32]

SIGNAL_WIDTHS, SIGNAL_LATENT, SIGNAL_BETA = (256, 128, 64), 8, 0.005
MESH_WIDTHS, MESH_LATENT, MESH_BETA = (256, 256), 32, 0.005
SIGNAL_TO_MESH = (512, 128, 256, 256)
MESH_TO_SIGNAL = (256, 256, 128)

LATENT_CONFIG = FitConfig(
    epochs=80, patience=80, batch_rows=256, learning_rate=1e-3, weight_decay=0.0
)


def _layers(widths: tuple[int, ...], outputs: int, activation: type[nn.Module]) -> nn.Sequential:
    made: list[nn.Module] = []
    for before, after in pairwise(widths):
        made += [nn.Linear(before, after), activation()]
    return nn.Sequential(*made, nn.Linear(widths[-1], outputs))


class VariationalAutoencoder(nn.Module):
    """Standardised values (N, I) -> few latent values -> the same values.

    In training the latent values are drawn; the output is the reconstruction with, behind it, the
    divergence of each row's latent distribution from the unit one.
    """

    def __init__(self, inputs: int, widths: tuple[int, ...], latent: int) -> None:
        super().__init__()
        self.latent = latent
        self.encoder = _layers((inputs, *widths), 2 * latent, nn.ReLU)
        self.decoder = _layers((latent, *widths[::-1]), inputs, nn.ReLU)

    def encode(self, values: Tensor) -> Tensor:
        """Mean of the latent values, (N, latent)."""
        mean: Tensor = self.encoder(values)[:, : self.latent]
        return mean

    def forward(self, values: Tensor) -> Tensor:
        """Reconstruction and divergence, (N, I + 1)."""
        mean, log_variance = self.encoder(values).chunk(2, dim=1)
        drawn = mean
        if self.training:
            drawn = mean + torch.exp(0.5 * log_variance) * torch.randn_like(mean)
        divergence = 0.5 * (mean**2 + torch.exp(log_variance) - 1.0 - log_variance).mean(dim=1)
        return torch.cat([self.decoder(drawn), divergence[:, None]], dim=1)


@dataclass(frozen=True, slots=True)
class LatentProjection:
    """From one side's values to the other's, through both latent spaces.

    Attributes:
        source: Autoencoder of the given side.
        target: Autoencoder of the wanted side.
        projection: From latent to latent.
    """

    source: VariationalAutoencoder
    target: VariationalAutoencoder
    projection: nn.Module

    def apply(self, values: FloatArray) -> FloatArray:
        """Standardised values (N, I) of the given side -> those of the wanted side (N, O)."""
        chain = nn.Sequential(_Encoder(self.source), self.projection, self.target.decoder)
        return predict(chain, values)


class _Encoder(nn.Module):
    def __init__(self, autoencoder: VariationalAutoencoder) -> None:
        super().__init__()
        self.autoencoder = autoencoder

    def forward(self, values: Tensor) -> Tensor:
        return self.autoencoder.encode(values)


def fit_latents(
    counts: FloatArray, coefficients: FloatArray, *, to_mesh: bool, seed: int
) -> LatentProjection:
    """Train both autoencoders and one projection, on standardised rows (N, 19) and (N, K)."""
    torch.manual_seed(seed)
    signal = VariationalAutoencoder(counts.shape[1], SIGNAL_WIDTHS, SIGNAL_LATENT)
    mesh = VariationalAutoencoder(coefficients.shape[1], MESH_WIDTHS, MESH_LATENT)
    for net, values, beta in (
        (signal, counts, SIGNAL_BETA),
        (mesh, coefficients, MESH_BETA),
    ):
        _fit_autoencoder(net, values, beta)
    latent = predict(_Encoder(signal), counts), predict(_Encoder(mesh), coefficients)
    source, target = latent if to_mesh else latent[::-1]
    widths = SIGNAL_TO_MESH if to_mesh else MESH_TO_SIGNAL
    projection = _layers((source.shape[1], *widths), target.shape[1], nn.ELU)
    fit(
        projection,
        source,
        target,
        loss_of=lambda estimate, wanted: torch.square(estimate - wanted).mean(),
        score_of=None,
        config=LATENT_CONFIG,
    )
    return LatentProjection(*((signal, mesh) if to_mesh else (mesh, signal)), projection=projection)


def _fit_autoencoder(net: VariationalAutoencoder, values: FloatArray, beta: float) -> None:
    def loss_of(estimate: Tensor, wanted: Tensor) -> Tensor:
        squares = torch.square(estimate[:, :-1] - wanted).mean()
        return squares + beta * estimate[:, -1].mean()

    fit(net, values, values, loss_of=loss_of, score_of=None, config=LATENT_CONFIG)
