"""Displacement fields as few numbers: proper orthogonal decomposition of more than fits in memory.

A thousand trials are 1.5 GB of fields, so the fields come in blocks, several times over. The modes
come from a randomised range finder with one power iteration (Halko, Martinsson and Tropp, SIAM
Review 53, 2011), in float64 as squares of small modes would be lost in float32. The loss is then
measured, on every row and with the numbers that are stored, not inferred from singular values.

Stored coefficients are multiples of a step, a power of two so fine that it changes the loss by less
than one in a hundred: digits that say nothing about the field do not compress.

A few trials of a data set, as a data set: a sample small enough to ship.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.process import Closing
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

_LOSS_RATIO = 1.01
"""Mean loss with rounded coefficients over that with exact ones: at most."""

_ROUNDING = 0.02
"""Mean square of what the first step tried moves a node by, over the squared mean loss."""

_SOME_ROWS = 512
"""Rows that say how many modes are about enough."""

_ROWS = 400
"""Rows that a block read from disk has at least: products of few rows use half of a processor."""

_AT_ONCE = 100
"""Rows that are compressed at once: memory above 32 MB would be cleared anew each time."""


class FieldFile(Closing):
    """Blocks of fields on disk, for more of them than memory holds; read anew in each pass.

    The file has no name: nothing is left of it when it is closed or the process ends, in any way.
    """

    def __init__(self, folder: Path) -> None:
        """Make it.

        Args:
            folder: Whose disk holds it.

        Raises:
            DatasetError: The disk refuses.
        """
        self._folder = folder
        self._shapes: list[tuple[int, ...]] = []
        try:
            self._file = tempfile.TemporaryFile(dir=folder, buffering=0)
        except OSError as error:
            raise self._refused(error) from error

    def add(self, block: FloatArray) -> None:
        """Append a block, shape (R, V, 3).

        Raises:
            DatasetError: The disk refuses.
        """
        left = np.ascontiguousarray(block).reshape(-1).view(np.uint8).data
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError as error:
            raise self._refused(error) from error
        last = self._shapes[-1] if self._shapes else (_ROWS,)
        if last[0] < _ROWS and last[1:] == block.shape[1:]:
            self._shapes[-1] = (last[0] + len(block), *last[1:])
        else:
            self._shapes.append(block.shape)

    def __call__(self) -> Iterator[FloatArray]:
        """All rows, in order, blocks put together to some hundred rows; one pass at a time."""
        self._file.seek(0)
        for shape in self._shapes:
            yield np.fromfile(self._file, np.float32, math.prod(shape)).reshape(shape)

    def close(self) -> None:
        """Remove it."""
        self._file.close()

    def _refused(self, error: OSError) -> DatasetError:
        return DatasetError(
            f"{self._folder}: fields cannot be kept there: {error}",
            remedy="check the folder's rights and free space: it takes some gigabytes",
        )


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
    most = min(rows, mean.size)
    wanted = min(_FIRST_MODES if count is None else count, most)
    if count is not None:
        fitted = _fitted(blocks, mean, wanted, most, seed)
        return with_step(fitted.measured(fitted.basis), fitted.measured)
    which = np.unique(np.linspace(0, rows - 1, min(rows, _SOME_ROWS)).round().astype(int))
    some = _rows_of(blocks, which)
    # Where the modes of some rows alone do not do for these rows, those of all rows do not either.
    own = _own(some, mean)
    while wanted < min(most, len(some)) and not own.loss_of_first(wanted) < loss_mean:
        wanted = min(2 * wanted, most)
    while True:
        fitted = _fitted(blocks, mean, wanted, most, seed)
        on_some = _CompressedFields(lambda: [some], fitted.basis, fitted.coefficients[which])
        fewest = _fewest(fitted, on_some, loss_mean)
        if fewest.loss_mean < loss_mean:
            return with_step(fewest, fitted.measured, below=loss_mean)
        if wanted == most:
            raise DatasetError(
                f"{wanted} modes lose {fewest.loss_mean:.3g} on average, allowed are"
                f" {loss_mean:.3g}",
                remedy="allow more; float32 holds a field of 1 mm to about 1e-10 m",
            )
        wanted = min(2 * wanted, most)


def with_step(
    exact: FieldBasis, measure: Callable[[FieldBasis], FieldBasis], *, below: float = math.inf
) -> FieldBasis:
    """A basis with the coarsest step that leaves its mean loss as it is, but for a hundredth.

    Args:
        exact: Without a step; its loss is known.
        measure: Gives a basis with a step the loss that it has.
        below: What the loss has to stay below, too [unit of the fields].
    """
    if exact.loss_mean <= 0.0:
        return exact
    # Modes are orthonormal: errors of K coefficients, step / sqrt(12) each, spread over V nodes.
    spread = math.sqrt(12.0 * _ROUNDING * len(exact.mean) / len(exact.modes))
    step: float = 2.0 ** math.floor(math.log2(exact.loss_mean * spread))
    while True:
        tried = measure(replace(exact, step=step))
        if tried.loss_mean < below and tried.loss_mean <= _LOSS_RATIO * exact.loss_mean:
            return tried
        step /= 2.0  # small errors count for more where the loss is at few nodes


class FieldEncoder:
    """Fields to coefficients; made once for many fields, as it keeps the modes in float64."""

    def __init__(self, basis: FieldBasis) -> None:
        self.basis = basis
        self._mean = basis.mean.reshape(-1)
        self._modes = basis.modes.reshape(len(basis.modes), -1).astype(np.float64)

    def __call__(self, fields: FloatArray) -> FloatArray:
        """Coefficients as they are stored, shape (R, K), of fields (R, V, 3)."""
        return self.stored(self.exact(fields))

    def exact(self, fields: FloatArray) -> Floats:
        """Coefficients before they are rounded; linear in the fields, but for the mean."""
        return (fields.reshape(len(fields), -1).astype(np.float64) - self._mean) @ self._modes.T

    def stored(self, exact: Floats) -> FloatArray:
        """Coefficients as they are stored: multiples of the basis's step."""
        return rounded(exact, self.basis.step)

    def lost(self, fields: FloatArray, exact: Floats | None = None) -> FieldLoss:
        """What fields, shape (R, V, 3), lose when compressed; faster with their coefficients."""
        stored = self(fields) if exact is None else self.stored(exact)
        return lost(fields - self.basis.decode(stored))


@dataclass(frozen=True, slots=True)
class FieldLoss:
    """What fields lose when compressed: distances of nodes from their compressed form.

    Attributes:
        total: Sum over nodes and rows [unit of the fields].
        nodes: How many these are.
        largest: The largest of them [unit of the fields].
    """

    total: float
    nodes: int
    largest: float


def lost(rest: FloatArray) -> FieldLoss:
    """What is lost where fields differ from their compressed form by ``rest``, shape (R, V, 3)."""
    square = np.square(rest, dtype=np.float64)
    distance = np.sqrt(square[..., 0] + square[..., 1] + square[..., 2])
    return FieldLoss(float(distance.sum()), distance.size, float(distance.max()))


def mean_and_largest(losses: Iterable[FieldLoss]) -> tuple[float, float]:
    """Mean and largest distance over all fields; summed in the order given."""
    total, nodes, largest = 0.0, 0, 0.0
    for one in losses:
        total += one.total
        nodes += one.nodes
        largest = max(largest, one.largest)
    return total / nodes, largest


def rounded(coefficients: Floats | FloatArray, step: float) -> FloatArray:
    """Coefficients as they are stored: the nearest multiples of a step; 0 = as they are."""
    if step > 0.0:
        coefficients = np.rint(coefficients / step) * step + 0.0  # + 0.0: no negative zero
    return np.asarray(coefficients, np.float32)


def encode(basis: FieldBasis, fields: FloatArray) -> FloatArray:
    """Coefficients as they are stored, shape (R, K), of fields, shape (R, V, 3)."""
    return FieldEncoder(basis)(fields)


class _CompressedFields:
    """Fields with their coefficients: what fewer modes or a step lose takes half of the products.

    Modes are orthonormal, so the coefficients of the first ones do not depend on the others.

    Attributes:
        basis: All modes; their loss is not known.
        coefficients: Of all rows, not rounded, shape (R, K).
    """

    def __init__(self, blocks: Blocks, basis: FieldBasis, coefficients: Floats) -> None:
        self.basis = basis
        self.coefficients = coefficients
        self._blocks = blocks

    def measured(self, basis: FieldBasis) -> FieldBasis:
        """The basis, some of the first modes and perhaps a step, with its loss on these fields."""
        mean, largest = mean_and_largest(self._losses(basis))
        return replace(basis, loss_mean=mean, loss_max=largest)

    def loss_of_first(self, modes: int) -> float:
        """Mean loss of so many modes."""
        return self.measured(self.first(modes)).loss_mean

    def first(self, modes: int) -> FieldBasis:
        """The first modes alone."""
        return replace(self.basis, modes=self.basis.modes[:modes])

    def _losses(self, basis: FieldBasis) -> Iterator[FieldLoss]:
        row, modes = 0, len(basis.modes)
        for block in self._blocks():
            for fields in _pieces(block):
                those = self.coefficients[row : row + len(fields), :modes]
                yield lost(fields - basis.decode(rounded(those, basis.step)))
                row += len(fields)


def _fewest(fitted: _CompressedFields, on_some: _CompressedFields, loss_mean: float) -> FieldBasis:
    """The shortest beginning of the modes that is good enough, or nearly; all if none is.

    A pass over all rows takes long, so how many are enough is asked of some, by bisection, and of
    all of them only in the end; where those want more, a thirtieth is added at a time.
    """
    too_few, enough = 0, len(fitted.basis.modes)
    while enough - too_few > 1:
        middle = (too_few + enough) // 2
        if on_some.loss_of_first(middle) < loss_mean:
            enough = middle
        else:
            too_few = middle
    while True:
        found = fitted.measured(fitted.first(enough))
        if found.loss_mean < loss_mean or enough == len(fitted.basis.modes):
            return found
        enough = min(len(fitted.basis.modes), enough + max(1, enough // 30))


def _pieces(block: FloatArray) -> list[FloatArray]:
    return [block[k : k + _AT_ONCE] for k in range(0, len(block), _AT_ONCE)]


def _rows_of(blocks: Blocks, which: npt.NDArray[np.int64]) -> FloatArray:
    """Rows by their number, ascending."""
    found, first = [], 0
    for block in blocks():
        here = which[(which >= first) & (which < first + len(block))] - first
        found.append(block[here])
        first += len(block)
    return np.concatenate(found)


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


def _fitted(blocks: Blocks, mean: Floats, wanted: int, most: int, seed: int) -> _CompressedFields:
    """The first modes, most important first, of fields with a mean, shape (V, 3)."""
    width = min(wanted + _OVERSAMPLING, most)
    draw = np.random.default_rng(seed).standard_normal((mean.size, width))
    sketch, of_block = np.zeros_like(draw), np.empty_like(draw)
    for centred in _centred(blocks, mean):
        sketch += np.matmul(centred.T, centred @ draw, out=of_block)
    directions, _ = np.linalg.qr(sketch)
    seen = np.concatenate([centred @ directions for centred in _centred(blocks, mean)])
    _, turn = np.linalg.eigh(seen.T @ seen)
    return _turned(blocks, mean, directions, seen, turn[:, ::-1][:, :wanted])


def _own(some: FloatArray, mean: Floats) -> _CompressedFields:
    """All modes of few rows, about the mean of all."""
    (centred,) = _centred(lambda: [some], mean)
    directions, triangle = np.linalg.qr(centred.T)
    turn, _, _ = np.linalg.svd(triangle)
    return _turned(lambda: [some], mean, directions, triangle.T, turn)


def _turned(
    blocks: Blocks, mean: Floats, directions: Floats, seen: Floats, turn: Floats
) -> _CompressedFields:
    """Modes ``directions @ turn`` of fields, of which ``seen`` lies along the directions."""
    modes = (directions @ turn).T
    sign = _signs(modes)[:, None]
    # In the order in which a file holds them, or products would differ in their last digit.
    shaped = np.ascontiguousarray(sign * modes, np.float32).reshape(-1, *mean.shape)
    basis = FieldBasis(mean.astype(np.float32), shaped, 0.0, 0.0)
    return _CompressedFields(blocks, basis, seen @ turn * sign.T)


def with_signs(modes: Floats) -> Floats:
    """Modes (K, 3 V), which are known up to their signs, with those on which two machines agree."""
    return modes * _signs(modes)[:, None]


def _signs(modes: Floats) -> Floats:
    peak = np.abs(modes).argmax(axis=1)
    return np.asarray(np.sign(modes[np.arange(len(modes)), peak]))


def _centred(blocks: Blocks, mean: Floats) -> Iterable[Floats]:
    """Fields about their mean, shape (R, 3 V); each overwrites the one before."""
    held = np.empty((0, mean.size))
    for block in blocks():
        if len(block) > len(held):
            held = np.empty((len(block), mean.size))
        flat = block.reshape(len(block), -1)
        yield np.subtract(flat, mean.reshape(-1), out=held[: len(block)])


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
