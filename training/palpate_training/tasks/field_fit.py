"""Train the two small networks on coefficients and pooled values, never on whole fields.

Adam, learning rate 3e-3 down to 1e-5 along a cosine, the weights of the epoch with the best
validation loss are kept. The loss of a row is the root mean square of what it is wrong by: over the
nodes in mm (modes are orthonormal, so that is the norm of the coefficients' error over the root of
the number of nodes), over the electrodes in counts.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from palpate.messages import COUNTS_MAX
from palpate_training.datasets.experiment import MixedDataset
from palpate_training.datasets.features import ELECTRODES
from palpate_training.learning.field_code import FieldCode, Pooling, fit_code, pooling
from palpate_training.learning.networks import FilmNet, Mlp, predict
from palpate_training.learning.splits import Held, Rows

FloatArray = npt.NDArray[np.float32]
OnEpoch = Callable[[], None]


@dataclass(frozen=True, slots=True)
class FitConfig:
    """Settings of one training.

    Attributes:
        widths: Hidden layers, SiLU after each.
        epochs: Passes over the training rows at most.
        patience: Stop after so many epochs without a better validation loss.
        batch_rows: Rows in one step.
        learning_rate: At the start.
        learning_rate_end: At the end of the cosine.
        weight_decay: L2 penalty of Adam.
        rest_share: Untouched rows added to the training rows, as a share of them. The data set
            starts at 0.5 N; without them an untouched finger would be an extrapolation.
        rest_noise_counts: Standard deviation of the electrodes of such a row [counts].
        threads: Threads of torch; small networks are fastest with one.
    """

    widths: tuple[int, ...] = (256, 256, 128)
    epochs: int = 150
    patience: int = 30
    batch_rows: int = 256
    learning_rate: float = 3e-3
    learning_rate_end: float = 1e-5
    weight_decay: float = 1e-5
    rest_share: float = 0.05
    rest_noise_counts: float = 3.0
    threads: int = 1


@dataclass(frozen=True, slots=True)
class FieldModel:
    """Electrodes -> field.

    Attributes:
        net: Tared counts (N, 19) -> coefficients (N, K) [m].
        code: What they are coefficients of.
    """

    net: Mlp
    code: FieldCode

    def coefficients(self, tared_counts: FloatArray) -> FloatArray:
        """Coefficients [m], shape (N, K), of tared counts (N, 19)."""
        return predict(self.net, tared_counts)


@dataclass(frozen=True, slots=True)
class SynthesisModel:
    """Field -> electrodes.

    Attributes:
        net: Coefficients and pooled film (N, K + P) -> tared counts (N, 19).
        code: What they are coefficients of.
        pooling: How the film is pooled.
    """

    net: FilmNet
    code: FieldCode
    pooling: Pooling

    def counts(self, features: FloatArray) -> FloatArray:
        """Tared counts (N, 19) of features (N, K + P) from ``synthesis_features``."""
        return predict(self.net, features)


def tared_counts(data: MixedDataset) -> FloatArray:
    """Tared electrodes of all rows [counts], shape (N, 19)."""
    return np.asarray(data.experiment.tared * np.float32(COUNTS_MAX), np.float32)


def synthesis_features(data: MixedDataset, code: FieldCode, film: Pooling) -> FloatArray:
    """What the shipped graph computes from the field of every row, without making the fields.

    Projection and pooling are linear in the field and the field is linear in the data set's
    coefficients, so two small matrices do.

    Args:
        data: Rows with the coefficients of their fields.
        code: Modes to project on.
        film: How the film is pooled.

    Returns:
        Coefficients and pooled change of the film [m], shape (N, K + P).
    """
    modes, mean = data.basis.modes, data.basis.mean[None]
    lead = _features(np.concatenate([modes + mean, mean]), code, film)
    return np.asarray(data.coefficients @ (lead[:-1] - lead[-1]) + lead[-1], np.float32)


def _features(displacement: FloatArray, code: FieldCode, film: Pooling) -> FloatArray:
    flat = displacement.reshape(len(displacement), -1)
    return np.hstack([code.project(flat), film.pool(displacement)])


def fit_field(
    data: MixedDataset,
    held: Held,
    *,
    code: FieldCode | None = None,
    config: FitConfig | None = None,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> FieldModel:
    """Train electrodes -> field on the training rows of some units.

    Args:
        data: The mixed data set.
        held: Rows to train and to stop on.
        code: Modes to use; None = those of the training rows.
        config: Settings.
        seed: Seed of weights, order of rows and noise of the untouched rows.
        on_epoch: Called after each epoch.
    """
    config = config or FitConfig()
    split = held.split
    code = code or fit_code(data, split.train, split.validation)
    x, y = tared_counts(data), code.encode(data.coefficients)
    zero = code.project(np.zeros((1, len(code.mean)), np.float32))

    torch.manual_seed(seed)
    net = Mlp(config.widths, ELECTRODES, outputs=code.size)
    net.normalise_from(x[split.train], y[split.train])
    rest = _rest_rows(split.train, config)
    noise = np.random.default_rng(seed).normal(0, config.rest_noise_counts, (rest, ELECTRODES))
    _fit(
        net,
        np.vstack([x[split.train], noise.astype(np.float32)]),
        np.vstack([y[split.train], np.repeat(zero, rest, axis=0)]),
        (x[split.validation], y[split.validation]),
        scale=1e3 / math.sqrt(code.nodes),
        floor=0.01,
        config=config,
        on_epoch=on_epoch,
    )
    return FieldModel(net, code)


def fit_synthesis(
    data: MixedDataset,
    held: Held,
    *,
    code: FieldCode | None = None,
    config: FitConfig | None = None,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> SynthesisModel:
    """Train field -> electrodes; the arguments are those of ``fit_field``."""
    config = config or FitConfig()
    split = held.split
    code = code or fit_code(data, split.train, split.validation)
    film = pooling(data.mesh)
    x, y = synthesis_features(data, code, film), tared_counts(data)
    zero = _features(np.zeros((1, *data.mesh.nodes.shape), np.float32), code, film)

    torch.manual_seed(seed)
    width = code.size + 2 * len(film.rest_m)
    net = FilmNet(Mlp(config.widths, width, outputs=ELECTRODES), code.size, film.rest_m)
    net.normalise_from(x[split.train], y[split.train])
    rest = _rest_rows(split.train, config)
    _fit(
        net,
        np.vstack([x[split.train], np.repeat(zero, rest, axis=0)]),
        np.vstack([y[split.train], np.zeros((rest, ELECTRODES), np.float32)]),
        (x[split.validation], y[split.validation]),
        scale=1.0 / math.sqrt(ELECTRODES),
        floor=1.0,
        config=config,
        on_epoch=on_epoch,
    )
    return SynthesisModel(net, code, film)


def _rest_rows(train: Rows, config: FitConfig) -> int:
    return math.ceil(config.rest_share * len(train))


def _fit(
    net: nn.Module,
    inputs: FloatArray,
    targets: FloatArray,
    validation: tuple[FloatArray, FloatArray],
    *,
    scale: float,
    floor: float,
    config: FitConfig,
    on_epoch: OnEpoch | None,
) -> None:
    """Train in place.

    The loss of a row is ``sqrt((scale |error|)^2 + floor^2)``: an L2 norm, smooth at zero.
    """
    torch.set_num_threads(config.threads)
    x, y = torch.from_numpy(inputs), torch.from_numpy(targets)
    seen, truth = (torch.from_numpy(part) for part in validation)
    optimiser = torch.optim.Adam(
        net.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
    )
    steps = config.epochs * math.ceil(len(x) / config.batch_rows)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimiser, T_max=steps, eta_min=config.learning_rate_end
    )

    def loss_of(estimate: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
        squares = torch.sum(torch.square(scale * (estimate - wanted)), dim=1)
        return torch.sqrt(squares + floor**2).mean()

    best, best_epoch, weights = math.inf, 0, copy.deepcopy(net.state_dict())
    for epoch in range(1, config.epochs + 1):
        net.train()
        for rows in torch.split(torch.randperm(len(x)), config.batch_rows):
            loss = loss_of(net(x[rows]), y[rows])
            optimiser.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
        net.eval()
        with torch.inference_mode():
            score = float(loss_of(net(seen), truth))
        if score < best:
            best, best_epoch, weights = score, epoch, copy.deepcopy(net.state_dict())
        if on_epoch is not None:
            on_epoch()
        if epoch - best_epoch >= config.patience:
            break
    net.load_state_dict(weights)
    net.eval()
