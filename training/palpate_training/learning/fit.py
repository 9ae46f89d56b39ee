"""Train one network for one quantity: a plain loop, read from top to bottom.

Adam, learning rate 3e-3 down to 1e-5 along a cosine, smooth-L1 on standardised targets, the weights
of the epoch with the best validation median are kept.
"""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.messages import COUNTS_MAX
from palpate_training.learning.networks import PAPER_WIDTHS, Activation, Mlp, predict

logger = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float32]
Progress = Callable[[], None]


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """Settings of one training.

    Attributes:
        widths: Hidden layers.
        activation: After each hidden layer.
        epochs: Passes over the training rows at most.
        patience: Stop after so many epochs without a better validation median.
        batch_rows: Rows in one step.
        learning_rate: At the start.
        learning_rate_end: At the end of the cosine.
        weight_decay: L2 penalty of Adam.
        huber_beta: Where smooth-L1 turns from square to straight, in standard deviations.
        drift_sd: Standard deviation of the common factor that multiplies all impedances of a
            training row, as warming of the fluid does; 0 = none.
        threads: Threads of torch; small networks are fastest with one.
    """

    widths: Sequence[int] = PAPER_WIDTHS
    activation: Activation = "silu"
    epochs: int = 50
    patience: int = 50
    batch_rows: int = 256
    learning_rate: float = 3e-3
    learning_rate_end: float = 1e-5
    weight_decay: float = 1e-5
    huber_beta: float = 0.1
    drift_sd: float = 0.0
    threads: int = 1


@dataclass(frozen=True, slots=True)
class Trained:
    """A trained network.

    Attributes:
        net: The weights of the best epoch.
        best_epoch: Which one that was, from 1.
        epochs: How many were run.
        validation_median: Median norm of the validation error at the best epoch, in the unit of
            the target; NaN without validation rows.
    """

    net: Mlp
    best_epoch: int
    epochs: int
    validation_median: float


def train(
    inputs: FloatArray,
    targets: FloatArray,
    validation_inputs: FloatArray | None = None,
    validation_targets: FloatArray | None = None,
    *,
    baseline: FloatArray | None = None,
    config: TrainConfig | None = None,
    seed: int = 0,
    on_epoch: Progress | None = None,
) -> Trained:
    """Fit the network; what it is standardised by comes from the training rows alone.

    Args:
        inputs: Tared counts [counts], shape ``(N, 19)``.
        targets: The quantity, shape ``(N, 3)``.
        validation_inputs: Rows to stop on, shape ``(M, 19)``; None = all epochs are run and the
            last weights kept.
        validation_targets: Their truth, shape ``(M, 3)``.
        baseline: Untouched counts of the training rows [counts], shape ``(N, 19)``; needed where
            ``config.drift_sd`` is not 0.
        config: Settings.
        seed: Seed of the first weights, the order of the rows and the drift.
        on_epoch: Called after each epoch, for a progress bar.
    """
    config = config or TrainConfig()
    torch.set_num_threads(config.threads)
    torch.manual_seed(seed)

    net = Mlp(config.widths, inputs.shape[1], config.activation)
    net.normalise_from(inputs, targets)
    x, y = torch.from_numpy(inputs), torch.from_numpy(targets)
    if config.drift_sd > 0 and baseline is None:
        raise ValueError("drift_sd needs the baseline of the training rows")
    rest = torch.from_numpy(baseline) if baseline is not None and config.drift_sd > 0 else None
    loss_of = nn.SmoothL1Loss(beta=config.huber_beta)
    optimiser = torch.optim.Adam(
        net.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
    )
    steps_per_epoch = math.ceil(len(x) / config.batch_rows)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimiser, T_max=config.epochs * steps_per_epoch, eta_min=config.learning_rate_end
    )

    best = Trained(net, 0, 0, math.inf)
    weights = copy.deepcopy(net.state_dict())
    epoch = 0
    for epoch in range(1, config.epochs + 1):
        net.train()
        for rows in torch.split(torch.randperm(len(x)), config.batch_rows):
            batch = x[rows]  # (B, 19)
            if rest is not None:
                batch = drift(batch, rest[rows], config.drift_sd)
            # Both in standard deviations of the target, so that beta means the same for N and m.
            loss = loss_of(net(batch) / net.output_sd, y[rows] / net.output_sd)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            schedule.step()
        if on_epoch is not None:
            on_epoch()
        if validation_inputs is None or validation_targets is None:
            continue
        residual = predict(net, validation_inputs) - validation_targets
        median = float(np.median(np.linalg.norm(residual, axis=1)))
        if median < best.validation_median:
            best = Trained(net, epoch, epoch, median)
            weights = copy.deepcopy(net.state_dict())
        if epoch - best.best_epoch >= config.patience:
            break
    net.eval()
    if validation_inputs is None:
        return Trained(net, epoch, epoch, math.nan)
    net.load_state_dict(weights)
    logger.debug("best epoch %d of %d, median %.4g", best.best_epoch, epoch, best.validation_median)
    return Trained(net, best.best_epoch, epoch, best.validation_median)


def drift(tared: Tensor, baseline: Tensor, sd: float) -> Tensor:
    """Tared counts as they would be, had the fluid's conductivity changed since the tare.

    Counts are ``4095 R / (R + Z)``, so ``Z / R = 4095 / counts - 1``; a change of temperature
    multiplies the impedance Z of all electrodes by the same factor (measured on a real BioTac:
    0.940 +- 0.007 over ten minutes). One log-normal factor is drawn for each row.

    Args:
        tared: Tared counts [counts], shape ``(B, 19)``.
        baseline: Untouched counts [counts], shape ``(B, 19)``.
        sd: Standard deviation of the factor's logarithm.
    """
    counts = (tared + baseline).clamp(1.0, COUNTS_MAX - 1.0)
    factor = torch.exp(sd * torch.randn(len(tared), 1))  # (B, 1)
    return COUNTS_MAX / (1.0 + (COUNTS_MAX / counts - 1.0) * factor) - baseline
