"""Displacement fields as few numbers: proper orthogonal decomposition of more than fits in memory.

A thousand trials are 1.5 GB of fields, so the fields come in blocks, several times over. The modes
come from a randomised range finder with one power iteration (Halko, Martinsson and Tropp, SIAM
Review 53, 2011), in float64 as squares of small modes would be lost in float32. The loss is then
measured, on every row and with the float32 numbers that are stored, not inferred from singular
values.

A few trials of a data set, as a data set: a sample small enough to ship.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    FieldBasis,
    FloatArray,
    MixedDataset,
    SimulatedContact,
)

Floats = npt.NDArray[np.float64]
Blocks = Callable[[], Iterable[FloatArray]]
"""Gives the same blocks of fields, each of shape (R, V, 3), each time."""

LOSS_MEAN_M = 1e-6
"""What the compressed form of displacements may lose on average [m]."""

_FIRST_MODES = 64
_OVERSAMPLING = 10
"""Directions beyond the modes wanted, which make the last of these accurate (Halko et al.)."""


def fit_basis(
    blocks: Blocks,
    *,
    loss_mean: float = LOSS_MEAN_M,
    count: int | None = None,
    seed: int = 0,
) -> FieldBasis:
    """Find the modes of many fields.

    Args:
        blocks: The fields, block by block; called once for each pass.
        loss_mean: The basis gets as many modes as it takes for the mean distance, over all nodes
            and rows, between fields and their compressed form to be below this [their unit].
        count: Number of modes, if not to be chosen by the loss.
        seed: Of the range finder.

    Returns:
        Mean, modes in order of their share, and the loss as measured.

    Raises:
        DatasetError: No rows, blocks of different meshes, values that are not finite, or a loss
            that float32 cannot reach.
    """
    mean, rows = _mean(blocks)
    flat = mean.reshape(-1)
    most = min(rows, flat.size)
    wanted = min(_FIRST_MODES if count is None else count, most)
    while True:
        modes = _modes(blocks, flat, min(wanted + _OVERSAMPLING, most), seed)[:wanted]
        shaped = modes.reshape(len(modes), *mean.shape).astype(np.float32)
        basis = _measured(blocks, FieldBasis(mean.astype(np.float32), shaped, 0.0, 0.0))
        if count is not None:
            return basis
        if basis.loss_mean < loss_mean:
            return _fewest(blocks, basis, loss_mean)
        if wanted == most:
            raise DatasetError(
                f"{wanted} modes lose {basis.loss_mean:.3g} on average, allowed are"
                f" {loss_mean:.3g}",
                remedy="allow more; float32 holds a field of 1 mm to about 1e-10 m",
            )
        wanted = min(2 * wanted, most)


def encode(basis: FieldBasis, fields: FloatArray) -> FloatArray:
    """Coefficients, shape (R, K), of fields, shape (R, V, 3)."""
    flat = fields.reshape(len(fields), -1).astype(np.float64) - basis.mean.reshape(-1)
    return np.asarray(flat @ basis.modes.reshape(len(basis.modes), -1).T, np.float32)


def loss(basis: FieldBasis, blocks: Blocks) -> tuple[float, float]:
    """Mean and largest distance of a node from its compressed form, over all rows."""
    total, nodes, largest = 0.0, 0, 0.0
    for block in blocks():
        rest = block - basis.decode(encode(basis, block))
        distance = np.linalg.norm(rest.astype(np.float64), axis=2)
        total += float(distance.sum())
        nodes += distance.size
        largest = max(largest, float(distance.max()))
    return total / nodes, largest


def _measured(blocks: Blocks, basis: FieldBasis) -> FieldBasis:
    mean, largest = loss(basis, blocks)
    return replace(basis, loss_mean=mean, loss_max=largest)


def _fewest(blocks: Blocks, enough: FieldBasis, loss_mean: float) -> FieldBasis:
    """The shortest beginning of the modes that is still good enough, by bisection."""
    too_few, best = 0, enough
    while len(best.modes) - too_few > 1:
        middle = (too_few + len(best.modes)) // 2
        tried = _measured(blocks, replace(enough, modes=enough.modes[:middle]))
        if tried.loss_mean < loss_mean:
            best = tried
        else:
            too_few = middle
    return best


def _mean(blocks: Blocks) -> tuple[Floats, int]:
    total, rows = None, 0
    for block in blocks():
        if block.ndim != 3 or (total is not None and block.shape[1:] != total.shape):
            raise DatasetError(
                f"a block of fields has shape {block.shape}, the first had"
                f" {None if total is None else total.shape} for each row",
                remedy="give blocks (rows, nodes, 3) of one mesh",
            )
        if not np.isfinite(block).all():
            raise DatasetError(
                f"a field is not finite in row {rows} or after",
                remedy="leave out what did not converge",
            )
        add = block.sum(axis=0, dtype=np.float64)
        total = add if total is None else total + add
        rows += len(block)
    if total is None or rows == 0:
        raise DatasetError("no fields", remedy="mix at least one trial")
    return total / rows, rows


def _modes(blocks: Blocks, mean: Floats, width: int, seed: int) -> Floats:
    """The first modes of the centred fields, shape (width, 3 V), most important first."""
    draw = np.random.default_rng(seed).standard_normal((mean.size, width))
    sketch = np.zeros_like(draw)
    for centred in _centred(blocks, mean):
        sketch += centred.T @ (centred @ draw)
    directions, _ = np.linalg.qr(sketch)
    inner = np.zeros((width, width))
    for centred in _centred(blocks, mean):
        seen = centred @ directions
        inner += seen.T @ seen
    _, turn = np.linalg.eigh(inner)
    modes = np.ascontiguousarray((directions @ turn[:, ::-1]).T)
    # A mode is known up to its sign; this one makes two runs, and two machines, agree.
    peak = np.abs(modes).argmax(axis=1)
    return np.asarray(modes * np.sign(modes[np.arange(width), peak])[:, None])


def _centred(blocks: Blocks, mean: Floats) -> Iterable[Floats]:
    for block in blocks():
        yield block.reshape(len(block), -1).astype(np.float64) - mean


Data = TypeVar("Data", ExperimentDataset, MixedDataset)


def subset(data: Data, trials: Sequence[int]) -> Data:
    """Keep some trials, by index, and only the units and trajectories that they are of.

    The order stays that of the data set.

    Raises:
        DatasetError: A trial does not exist, or none is given.
    """
    if isinstance(data, ExperimentDataset):
        return _experiment(data, trials)
    rows = _rows(data.experiment, trials)
    return replace(
        data,
        experiment=_experiment(data.experiment, trials),
        simulated_force=data.simulated_force[rows],
        coefficients=data.coefficients[rows],
        contact=None if data.contact is None else _contact(data.contact, rows),
    )


def _contact(
    contact: SimulatedContact, rows: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> SimulatedContact:
    return replace(
        contact,
        **{name: getattr(contact, name)[rows] for name in ("centre", "normal", "coefficients")},
    )


def _experiment(data: ExperimentDataset, trials: Sequence[int]) -> ExperimentDataset:
    rows = _rows(data, trials)
    chosen = np.unique(np.asarray(trials, np.int64))
    units, trial_unit = np.unique(data.trial_unit[chosen], return_inverse=True)
    trajectories, trial_trajectory = np.unique(data.trial_trajectory[chosen], return_inverse=True)
    return replace(
        data,
        unit_names=tuple(data.unit_names[i] for i in units),
        trajectories=tuple(data.trajectories[i] for i in trajectories),
        indenters=tuple(data.indenters[i] for i in trajectories),
        trial_unit=trial_unit.astype(np.int32),
        trial_trajectory=trial_trajectory.astype(np.int32),
        trial_rest=data.trial_rest[chosen],
        trial=np.searchsorted(chosen, data.trial[rows]).astype(np.int32),
        travel_m=data.travel_m[rows],
        tared=data.tared[rows],
        force=data.force[rows],
        location=data.location[rows],
    )


def _rows(
    data: ExperimentDataset, trials: Sequence[int]
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    outside = [trial for trial in trials if not 0 <= trial < data.trials]
    if outside or not len(trials):
        raise DatasetError(
            f"no trial {outside[0]}" if outside else "no trials are given",
            remedy=f"give some of 0..{data.trials - 1}",
        )
    return np.isin(data.trial, np.asarray(trials))
