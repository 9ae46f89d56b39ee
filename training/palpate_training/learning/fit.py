"""The training loop of every network: read it from top to bottom.

Adam, a learning rate that falls along a cosine, the weights of the epoch with the best validation
score are kept. What differs from task to task is passed in: the loss, the score, and what is done
to a batch before the network sees it.
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
from torch.optim.lr_scheduler import CosineAnnealingLR

from palpate.messages import COUNTS_MAX
from palpate_training.learning.networks import (
    PAPER_WIDTHS,
    Activation,
    Mlp,
    Standardised,
    predict,
)

_log = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float32]
OnEpoch = Callable[[], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class FitConfig:
    """Settings of the loop.

    Attributes:
        widths: Hidden layers.
        epochs: Passes over the training rows at most.
        patience: Stop after so many epochs without a better validation score.
        batch_rows: Rows in one step.
        learning_rate: At the start.
        learning_rate_end: At the end of the cosine.
        weight_decay: L2 penalty of Adam.
        threads: Threads of torch; small networks are fastest with one.
    """

    widths: Sequence[int] = PAPER_WIDTHS
    epochs: int = 50
    patience: int = 50
    batch_rows: int = 256
    learning_rate: float = 3e-3
    learning_rate_end: float = 1e-5
    weight_decay: float = 1e-5
    threads: int = 1


def fit(
    net: nn.Module,
    inputs: FloatArray,
    targets: FloatArray,
    *,
    loss_of: Callable[[Tensor, Tensor], Tensor],
    score_of: Callable[[nn.Module], float] | None,
    config: FitConfig,
    augment: Callable[[Tensor, Tensor], Tensor] = lambda batch, rows: batch,
    on_epoch: OnEpoch | None = None,
) -> None:
    """Train a network in place, on torch's default device, and leave it there.

    The caller seeds torch before it makes the network: weights, order of rows and augmentation all
    come from torch's one generator, so the same seed gives the same weights.

    Args:
        net: With its constants set from the training rows.
        inputs: Training rows, shape ``(N, I)``.
        targets: Their truth, shape ``(N, O)``.
        loss_of: Estimates ``(B, O)`` and truth ``(B, O)`` -> loss, by tensors alone: on a GPU it is
            recorded.
        score_of: Validation score of the network, smaller is better; None = all epochs are run and
            the last weights are kept.
        config: Settings.
        augment: Inputs of a batch and the numbers of its rows -> inputs that the network sees.
        on_epoch: Called after each epoch, for a progress bar.
    """
    torch.set_num_threads(config.threads)
    device = torch.get_default_device()
    net.to(device)
    x, y = torch.from_numpy(inputs).to(device), torch.from_numpy(targets).to(device)
    steps = config.epochs * math.ceil(len(x) / config.batch_rows)
    on_gpu = device.type == "cuda"
    # A recorded step reads the rate where it lies.
    rate = torch.tensor(config.learning_rate) if on_gpu else config.learning_rate
    optimiser = torch.optim.Adam(
        net.parameters(),
        lr=rate,
        weight_decay=config.weight_decay,
        capturable=on_gpu,
        fused=on_gpu or None,
    )
    schedule: CosineRate | CosineAnnealingLR
    if isinstance(rate, Tensor):
        schedule = CosineRate(rate, steps, config.learning_rate_end)
    else:
        schedule = CosineAnnealingLR(optimiser, T_max=steps, eta_min=config.learning_rate_end)

    def step(rows: Tensor) -> None:
        loss = loss_of(net(augment(x[rows], rows)), y[rows])
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()

    take = recorded(step, min(config.batch_rows, len(x))) if on_gpu else step
    best_score, best_epoch, weights = math.inf, 0, copy.deepcopy(net.state_dict())
    for epoch in range(1, config.epochs + 1):
        net.train()
        # Dealt on the CPU, so that the order is the same on every device.
        order = torch.randperm(len(x), device="cpu").to(device)
        for rows in torch.split(order, config.batch_rows):
            take(rows)
            schedule.step()
        if on_epoch is not None:
            on_epoch()
        if score_of is None:
            continue
        net.eval()
        score = score_of(net)
        if score < best_score:
            best_score, best_epoch, weights = score, epoch, copy.deepcopy(net.state_dict())
        if epoch - best_epoch >= config.patience:
            break
    net.eval()
    if score_of is not None:
        net.load_state_dict(weights)
        _log.debug("best epoch %d of %d, score %.4g", best_epoch, epoch, best_score)


@dataclass(frozen=True, slots=True, kw_only=True)
class FeaturesFitConfig(FitConfig):
    """Settings of a training of one quantity from tared counts.

    Attributes:
        activation: After each hidden layer.
        huber_beta: Where smooth-L1 turns from square to straight, in standard deviations.
        drift_sd: Standard deviation of the common factor that multiplies all impedances of a
            training row, as warming of the fluid does; 0 = none.
    """

    activation: Activation = "silu"
    huber_beta: float = 0.1
    drift_sd: float = 0.0


def fit_quantity(
    inputs: FloatArray,
    targets: FloatArray,
    validation: tuple[FloatArray, FloatArray] | None = None,
    *,
    baseline: FloatArray | None = None,
    config: FeaturesFitConfig | None = None,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> Mlp:
    """Fit the paper's network to one quantity: smooth-L1 on standardised targets.

    The validation score is the median of the error's norm.

    Args:
        inputs: Tared counts [counts], shape ``(N, 19)``.
        targets: The quantity, shape ``(N, 3)``.
        validation: Rows to stop on, ``(M, 19)`` and ``(M, 3)``; None = all epochs are run and the
            last weights kept.
        baseline: Untouched counts of the training rows [counts], shape ``(N, 19)``; needed where
            ``config.drift_sd`` is not 0.
        config: Settings.
        seed: Seed of the first weights, the order of the rows and the drift.
        on_epoch: Called after each epoch, for a progress bar.
    """
    config = config or FeaturesFitConfig()
    if config.drift_sd > 0 and baseline is None:
        raise ValueError("drift_sd needs the baseline of the training rows")
    torch.manual_seed(seed)
    net = Mlp(config.widths, inputs.shape[1], config.activation)
    rest = torch.from_numpy(baseline) if baseline is not None and config.drift_sd > 0 else None

    def warm(batch: Tensor, rows: Tensor) -> Tensor:
        return batch if rest is None else drift(batch, rest[rows], config.drift_sd)

    fit_standardised(net, (inputs, targets), validation, config, augment=warm, on_epoch=on_epoch)
    return net


def fit_standardised(
    net: Standardised,
    train: tuple[FloatArray, FloatArray],
    validation: tuple[FloatArray, FloatArray] | None,
    config: FeaturesFitConfig,
    *,
    augment: Callable[[Tensor, Tensor], Tensor] = lambda batch, rows: batch,
    on_epoch: OnEpoch | None = None,
) -> None:
    """Train a network in place: smooth-L1 on standardised targets, stopped by the median distance.

    Args:
        net: With fresh weights; its constants are set from the training rows.
        train: Inputs ``(N, I)`` and targets ``(N, O)``.
        validation: The same of the rows to stop on; None = all epochs are run.
        config: Settings.
        augment: As in ``fit``.
        on_epoch: Called after each epoch, for a progress bar.
    """
    net.normalise_from(*train)
    smooth_l1 = nn.SmoothL1Loss(beta=config.huber_beta)

    def loss_of(estimate: Tensor, truth: Tensor) -> Tensor:
        # Both in standard deviations of the target, so that beta means the same for N and m.
        loss: Tensor = smooth_l1(estimate / net.output_sd, truth / net.output_sd)
        return loss

    def median_error(net: nn.Module) -> float:
        assert validation is not None
        residual = predict(net, validation[0]) - validation[1]
        return float(np.median(np.linalg.norm(residual, axis=1)))

    fit(
        net,
        *train,
        loss_of=loss_of,
        score_of=None if validation is None else median_error,
        config=config,
        augment=augment,
        on_epoch=on_epoch,
    )


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


# On a GPU a step is recorded once and then launched as a whole: a step of a small network is some
# ninety kernels of a few microseconds, about as long as it takes to launch one. What a training
# takes is in training/LOG.md.

_WARM_UP_STEPS = 3
"""Steps before the recording, as torch asks: they make what is made once."""


def recorded(step: Callable[[Tensor], None], batch_rows: int) -> Callable[[Tensor], None]:
    """A step that is launched as one; batches of another size are taken kernel by kernel.

    Args:
        step: Trains on the rows of these numbers; must not read anything back from the GPU.
        batch_rows: Rows in all batches but the last.
    """
    picked = torch.zeros(batch_rows, dtype=torch.int64)
    beside = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    graph = torch.cuda.CUDAGraph()
    taken = 0

    def take(rows: Tensor) -> None:
        nonlocal taken
        if len(rows) != batch_rows:
            step(rows)
            return
        picked.copy_(rows)
        taken += 1
        if taken <= _WARM_UP_STEPS:
            beside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(beside):
                step(picked)
            torch.cuda.current_stream().wait_stream(beside)
            return
        if taken == _WARM_UP_STEPS + 1:
            with torch.cuda.graph(graph):
                step(picked)
        graph.replay()

    return take


class CosineRate:
    """What ``CosineAnnealingLR`` does to a learning rate that lies on the GPU, in one launch.

    Args:
        rate: The learning rate, shape (); starts with the value that it has.
        steps: In which it falls.
        end: Value after them.
    """

    def __init__(self, rate: Tensor, steps: int, end: float) -> None:
        self._rate = rate
        self._start, self._end, self._steps = float(rate), end, steps
        self._taken = 0

    def step(self) -> None:
        """Lower it, once after each training step."""
        self._taken += 1
        share = 0.5 * (1.0 + math.cos(math.pi * self._taken / self._steps))
        self._rate.fill_(self._end + (self._start - self._end) * share)
