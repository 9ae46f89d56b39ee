"""Training of a population's network: blocks of rows of one specimen, beside presses of it.

Each time that a block is learned from, it gets other presses: none of them, one, or up to ten, and
never the press that a row belongs to, nor another one at the same point. What is unlike from
specimen to specimen is drawn for a block as a whole, presses included, so that these tell it: gains
of its electrodes, how stiff its skin is, and whether it is mirrored. What passes is drawn for each
row, or each press: offsets and noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.messages import COUNTS_MAX
from palpate_training.datasets.features import ELECTRODES
from palpate_training.learning.electrode_nets import NOISE_COUNTS
from palpate_training.learning.fit import OnEpoch, fit
from palpate_training.learning.networks import predict
from palpate_training.learning.population_net import PopulationConfig, PopulationNet
from palpate_training.learning.press_set import INPUTS, CalibrationPresses

FloatArray = npt.NDArray[np.float32]
Numbers = npt.NDArray[np.integer]

FORCE_FLOOR_N = 0.5

TOUCHED_N = 0.5
"""Rows that are learned from as presses have at least this force."""

PRESSES_MOST = 10
"""Presses of a block at most; fewer are more likely, and none in 30 % of the draws."""

PRESS_ROWS = 3
"""Rows of a press that are read in training, drawn anew each time."""

BLOCK_ROWS = 32

_KEPT_ROWS = 16
"""Rows of a press that are drawn from."""

_SMALLEST_RAD = 1e-9
_SMOOTH = 1e-4  # of a normalised distance's square, so that its root has a slope at zero


@dataclass(frozen=True, slots=True)
class PopulationRows:
    """Rows to learn from.

    Attributes:
        inputs: As ``inputs_of`` gives them, shape ``(N, 19)``.
        noise_sd: Standard deviation of their noise, as ``noise_of`` gives it, shape ``(N, 19)``.
        targets: Force [N], then what only a contact has, shape ``(N, 3 Q)``; NaN where there is
            none.
        specimen: Number of each row's specimen, shape ``(N,)``.
        press: Number of each row's press, shape ``(N,)``.
        point: Number of its point of the skin, shape ``(N,)``; None = every press has its own.
    """

    inputs: FloatArray
    noise_sd: FloatArray
    targets: FloatArray
    specimen: Numbers
    press: Numbers
    point: Numbers | None = None

    @property
    def touched(self) -> npt.NDArray[np.bool_]:
        """Rows that have a force, shape ``(N,)``."""
        return np.asarray(np.linalg.norm(self.targets[:, :3], axis=1) >= TOUCHED_N)

    def where(self, kept: npt.NDArray[np.bool_]) -> PopulationRows:
        """Some of the rows."""
        known = {one.name: getattr(self, one.name) for one in fields(self)}
        some = {name: values[kept] for name, values in known.items() if values is not None}
        return PopulationRows(**some)

    def calibration(self, rows: Numbers) -> CalibrationPresses:
        """Some rows of one specimen, as presses whose forces are known."""
        return CalibrationPresses(self.inputs[rows], self.targets[rows, :3], self.press[rows])


def noise_of(counts: npt.NDArray[np.integer]) -> FloatArray:
    """Standard deviation of the noise of the logarithm of each impedance, shape of the counts."""
    share = counts / COUNTS_MAX
    slope = np.maximum(share * (1.0 - share), 1e-3)
    return np.asarray(NOISE_COUNTS / COUNTS_MAX / slope, np.float32)


@dataclass(frozen=True, slots=True)
class StopRows:
    """Rows of one specimen to stop on, and presses of it that may be known.

    Attributes:
        inputs: Of the rows, shape ``(N, 19)``.
        targets: Of the rows, shape ``(N, 3 Q)``.
        presses: None, some, or several sets of them; the scores count alike.
    """

    inputs: FloatArray
    targets: FloatArray
    presses: Sequence[CalibrationPresses]


def fit_population(
    train: PopulationRows,
    validation: Sequence[Sequence[StopRows]],
    quantities: Sequence[str],
    *,
    config: PopulationConfig,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> PopulationNet:
    """Train on torch's default device; the weights of the best epoch are kept.

    Args:
        train: Rows to learn from; their mirror images are learned from, too.
        validation: Sets of specimens to stop on; the mean of the sets' scores counts.
        quantities: Names of the targets, three values each.
        config: Settings.
        seed: Of the weights, the order of the rows, the presses and the noise.
        on_epoch: Called after each epoch, for a progress bar.
    """
    torch.manual_seed(seed)
    with torch.device("cpu"):
        net = PopulationNet(quantities, config)
        net.normalise_from(train.inputs, train.targets)
        sizes = sizes_of(train.targets)
        episodes = _Episodes(net, train, np.random.default_rng(seed))
    blocks, width = episodes.rows.shape[0], train.targets.shape[1]
    targets = train.targets[episodes.rows.numpy()].reshape(blocks, -1)

    def loss(estimate: Tensor, truth: Tensor) -> Tensor:
        parts = (values.reshape(-1, width) for values in (estimate, truth))
        return _loss(sizes, config.force_power, *parts)

    fit(
        episodes,
        np.arange(blocks, dtype=np.float32)[:, None],
        targets,
        loss_of=loss,
        score_of=lambda _: float(np.mean([_score(net, some) for some in validation])),
        config=replace(config, batch_rows=max(1, config.batch_rows // BLOCK_ROWS)),
        on_epoch=on_epoch,
    )
    return net.cpu().eval()


def _score(net: PopulationNet, specimens: Sequence[StopRows]) -> float:
    """Mean over how much is known; each over the rows of all specimens."""
    truth = np.vstack([one.targets for one in specimens])
    of_each = ([net.told(one.inputs, some) for some in one.presses] for one in specimens)
    told = zip(*of_each, strict=True)
    return float(np.mean([score_of(predict(net, np.vstack(rows)), truth) for rows in told]))


class _Episodes(nn.Module):
    """Numbers of blocks ``(G, 1)`` -> estimates of all their rows, ``(G, 32 O)``, to be trained.

    Args:
        net: What is trained.
        rows: All rows to learn from.
        rng: Deals rows to blocks.
    """

    rows: Tensor
    specimen: Tensor
    inputs: Tensor
    noise_sd: Tensor
    force: Tensor
    point: Tensor
    trial_rows: Tensor
    trials: Tensor
    trial_count: Tensor

    def __init__(self, net: PopulationNet, rows: PopulationRows, rng: np.random.Generator) -> None:
        super().__init__()
        self.net = net
        dealt, specimen = _blocks(rows.specimen, rng)
        kept, first, count = _trials(rows)
        point = rows.press if rows.point is None else rows.point
        for name, values in (
            ("rows", dealt), ("specimen", specimen), ("point", point),
            ("trial_rows", kept), ("trials", first), ("trial_count", count),
        ):  # fmt: skip
            self._keep(name, torch.from_numpy(np.asarray(values, np.int64)))
        self._keep("inputs", torch.from_numpy(rows.inputs))
        self._keep("noise_sd", torch.from_numpy(rows.noise_sd))
        self._keep("force", torch.from_numpy(np.ascontiguousarray(rows.targets[:, :3])))

    def _keep(self, name: str, values: Tensor) -> None:
        self.register_buffer(name, values, persistent=False)

    def forward(self, numbers: Tensor) -> Tensor:
        net, config = self.net, self.net.config
        block = numbers[:, 0].long()
        rows, specimen = self.rows[block], self.specimen[block]  # (G, B), (G,)
        known, used = self._presses(specimen)  # (G, K, R), (G, K)
        one = torch.ones(len(block), 1, 1, device=numbers.device)
        electrodes = one.expand(-1, 1, ELECTRODES)
        gain = torch.exp(config.gain_sd * (torch.randn_like(electrodes) + torch.randn_like(one)))
        mirrored = torch.rand_like(one) < 0.5
        # Forces of a specimen that was turned, and is stiffer.
        turn = _turns(config.turn_sd * torch.randn(len(block), 3, device=numbers.device))
        stiffness = torch.exp(config.stiffness_sd * torch.randn_like(one))

        def seen(rows: Tensor, offsets: Tensor) -> Tensor:
            inputs = self.inputs[rows]
            noise = self.noise_sd[rows] * torch.randn_like(inputs)
            noisy = gain * inputs + noise + offsets
            image = torch.index_select(noisy, -1, net.order[:INPUTS])
            return torch.where(mirrored, image, noisy)

        # Offsets last longer than a press.
        of_press = _offsets(used.shape, config, numbers.device)[:, :, None]
        of_press = of_press.expand(*known.shape, ELECTRODES).flatten(1, 2)
        presses = seen(known.flatten(1, 2), of_press)
        signs = torch.where(mirrored, net.signs[:3], 1.0)
        force = stiffness * (self.force[known].flatten(1, 2) @ turn.mT) * signs
        share = used[:, :, None].expand(known.shape).flatten(1)[..., None] / PRESS_ROWS
        code = net.code_of(torch.cat([presses, force, share], dim=-1))  # (G, C)
        own = (self.point[rows][..., None] == self.point[known[..., 0]][:, None]) & used[:, None]
        told = used.any(dim=1)[:, None, None] & ~own.any(dim=-1, keepdim=True)  # (G, B, 1)
        inputs = seen(rows, _offsets(rows.shape, config, numbers.device))
        inputs = torch.cat([inputs, torch.where(told, code[:, None], 0.0)], dim=-1)
        estimate = net.one_sided(inputs)
        estimate = torch.where(mirrored, estimate * net.signs, estimate)
        # What is estimated is such a force, what it is compared with is not.
        plain = torch.where(told, estimate[..., :3] @ turn / stiffness, estimate[..., :3])
        return torch.cat([plain, estimate[..., 3:]], dim=-1).flatten(1)

    def _presses(self, specimen: Tensor) -> tuple[Tensor, Tensor]:
        """Rows of presses of each specimen, ``(G, K, R)``; which are used, ``(G, K)``."""
        device, groups = specimen.device, len(specimen)
        draw = torch.rand(groups, PRESSES_MOST, device=device)
        count = self.trial_count[specimen][:, None]
        trial = self.trials[specimen][:, None] + (draw * count).long()
        which = torch.rand(groups, PRESSES_MOST, PRESS_ROWS, device=device) * _KEPT_ROWS
        rows = self.trial_rows[trial[..., None], which.long()]
        most = (PRESSES_MOST + 1) * torch.square(torch.rand(groups, 1, device=device))
        used = torch.arange(PRESSES_MOST, device=device) < most.floor()
        return rows, used & (count > 0)


def _offsets(shape: Sequence[int], config: PopulationConfig, device: torch.device) -> Tensor:
    """Offsets of all electrodes and of each, drawn for each of a shape, ``(*shape, 19)``."""
    each = torch.randn(*shape, ELECTRODES, device=device)
    return config.offset_sd * each + config.common_sd * torch.randn(*shape, 1, device=device)


def _turns(vectors: Tensor) -> Tensor:
    """Rotations by vectors ``(G, 3)`` [rad], ``(G, 3, 3)``, by Rodrigues' formula.

    A matrix exponential reads back from a GPU, which a recorded step must not.
    """
    angle = torch.linalg.vector_norm(vectors, dim=-1)[:, None, None] + _SMALLEST_RAD
    x, y, z = vectors.unbind(dim=-1)
    none = torch.zeros_like(x)
    rows = torch.stack([none, -z, y, z, none, -x, -y, x, none], dim=-1)
    cross = rows.reshape(-1, 3, 3) / angle
    eye = torch.eye(3, device=vectors.device)
    turns: Tensor = eye + torch.sin(angle) * cross + (1.0 - torch.cos(angle)) * (cross @ cross)
    return turns


def _blocks(specimen: Numbers, rng: np.random.Generator) -> tuple[Numbers, Numbers]:
    """Rows dealt to blocks of one specimen each, ``(N, 32)``, and these specimens, ``(N,)``.

    The last block of a specimen is filled up with rows that it has already.
    """
    rows: list[Numbers] = []
    for number in np.unique(specimen):
        own = rng.permutation(np.flatnonzero(specimen == number))
        rows.append(np.resize(own, (-(-len(own) // BLOCK_ROWS), BLOCK_ROWS)))
    dealt = np.concatenate(rows)
    return dealt, specimen[dealt[:, 0]]


def _trials(rows: PopulationRows) -> tuple[Numbers, Numbers, Numbers]:
    """Rows of each press of each specimen, evenly over it, ``(T, 16)``, specimen by specimen.

    Returns:
        They, and by a specimen's number its first press and how many it has.
    """
    touched = np.flatnonzero(rows.touched)
    order = touched[np.lexsort((touched, rows.press[touched], rows.specimen[touched]))]
    pairs = np.stack([rows.specimen[order], rows.press[order]])
    starts = np.flatnonzero((np.diff(pairs, prepend=-1) != 0).any(axis=0))
    ends = np.append(starts[1:], len(order))
    share = np.linspace(0.0, 1.0, _KEPT_ROWS)
    kept = order[(starts[:, None] + np.rint((ends - starts - 1)[:, None] * share)).astype(int)]
    count = np.bincount(rows.specimen[order[starts]], minlength=int(rows.specimen.max()) + 1)
    first = np.minimum(np.cumsum(count) - count, max(0, len(starts) - 1))
    return kept, first, count


def sizes_of(targets: FloatArray) -> list[float]:
    """Root mean square distance of each quantity from its mean."""
    parts = np.split(targets.astype(np.float64), targets.shape[1] // 3, axis=1)
    return [max(1e-9, float(np.sqrt(np.nansum(np.nanvar(part, axis=0))))) for part in parts]


def _loss(sizes: Sequence[float], power: float, estimate: Tensor, wanted: Tensor) -> Tensor:
    """Sum over the quantities of the mean distance: of a force over its magnitude, else spread."""
    total = torch.zeros((), device=estimate.device)
    parts = zip(torch.split(estimate, 3, dim=1), torch.split(wanted, 3, dim=1), strict=True)
    for number, (guess, truth) in enumerate(parts):
        known = ~torch.isnan(truth[:, 0])
        error = torch.where(known[:, None], guess - torch.nan_to_num(truth), 0.0)
        if number == 0:
            magnitude = torch.linalg.vector_norm(torch.nan_to_num(truth), dim=1, keepdim=True)
            error = error / (FORCE_FLOOR_N + magnitude) ** power
        else:
            error = error / sizes[number]
        distance = torch.sqrt(torch.square(error).sum(dim=1) + _SMOOTH)
        total = total + (distance * known).sum() / known.sum().clamp(min=1)
    return total


def score_of(estimate: FloatArray, targets: FloatArray) -> float:
    """Force: median error over floor and magnitude; of all others over their spread; summed."""
    total = 0.0
    for number, size in enumerate(sizes_of(targets)):
        part = slice(3 * number, 3 * number + 3)
        if np.isnan(targets[:, part]).all():
            continue
        distance = np.linalg.norm(estimate[:, part] - targets[:, part], axis=1)
        if number == 0:
            distance = distance / (FORCE_FLOOR_N + np.linalg.norm(targets[:, part], axis=1))
            size = 1.0
        total += float(np.nanmedian(distance)) / size
    return total
