"""Train, validation, test: whole blocks, groups, trajectories or sensors, not single rows.

Neighbouring rows of a recording are nearly copies of one another, so a split by rows flatters
every model (the idle drift of an untouched sensor alone correlates with force). The only function
here that makes one is ``rows_at_random``, which shows how much: what a model could gain at most.
Its results are never called results.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from palpate.errors import ConfigError, DatasetError
from palpate_training.datasets.basis import subset
from palpate_training.datasets.experiment import ExperimentDataset
from palpate_training.datasets.trials import press_kind

Rows = npt.NDArray[np.int64]
Labels = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]

GUARD_S = 1.0
"""Rows of a recording that are within this time of another side's are left out [s]."""


@dataclass(frozen=True, slots=True)
class RowSplit:
    """Row numbers of each side; ``guard`` rows are on none.

    Attributes:
        train: Rows to fit on.
        validation: Rows to choose on (early stop, settings).
        test: Rows to report on.
        guard: Rows left out because they lie next to another side.
    """

    train: Rows
    validation: Rows
    test: Rows
    guard: Rows


def contiguous_folds(
    block: Labels, recording: Labels, *, folds: int = 5, guard_rows: int = 100
) -> list[RowSplit]:
    """Hold out whole blocks; every block is tested in exactly one fold.

    In each recording the blocks are counted in order of time: fold ``k`` tests those with
    ``i % folds == k`` and validates on those with ``i % (2 * folds) == (k + 2) % (2 * folds)``.

    Args:
        block: Block of every row, shape ``(N,)``.
        recording: Recording of every row, shape ``(N,)``; rows in order of time.
        folds: Number of folds, at least 3.
        guard_rows: Rows left out on either side of a border between two sides.

    Returns:
        One split for each fold.
    """
    if folds < 3:
        raise ValueError(f"folds must be at least 3, not {folds}")
    position = np.empty(len(block), dtype=np.int64)
    for one in np.unique(recording):
        rows = np.flatnonzero(recording == one)
        starts, inverse = np.unique(block[rows], return_inverse=True)
        if len(starts) < 2 * folds:
            raise DatasetError(
                f"recording {one} has {len(starts)} blocks, {folds} folds need {2 * folds}",
                remedy="cut the recording into more blocks, or use fewer folds",
            )
        first_row = np.array([rows[inverse == i][0] for i in range(len(starts))])
        position[rows] = np.argsort(np.argsort(first_row))[inverse]
    splits = []
    for fold in range(folds):
        test = position % folds == fold
        validation = position % (2 * folds) == (fold + 2) % (2 * folds)
        split = _guarded(validation, test, recording, guard_rows)
        if not (len(split.train) and len(split.validation)):
            raise DatasetError(
                f"fold {fold}: a guard of {guard_rows} rows leaves nothing to train or validate on",
                remedy="cut the recordings into fewer, longer blocks",
            )
        splits.append(split)
    return splits


def last_part(
    recording: Labels, *, share: float = 0.2, validation_share: float = 0.1, guard_rows: int = 100
) -> RowSplit:
    """Test the end of each recording; the part before it validates.

    Args:
        recording: Recording of every row, shape ``(N,)``; rows in order of time.
        share: Of each recording that is tested.
        validation_share: Of each recording that validates.
        guard_rows: Rows left out on either side of a border between two sides.
    """
    test, validation = np.zeros(len(recording), bool), np.zeros(len(recording), bool)
    for one in np.unique(recording):
        rows = np.flatnonzero(recording == one)
        end, middle = (
            round(len(rows) * (1.0 - part)) for part in (share, share + validation_share)
        )
        test[rows[end:]] = True
        validation[rows[middle:end]] = True
    return _guarded(validation, test, recording, guard_rows)


def unseen_sensor(
    sensor: Labels, block: Labels, *, test_sensor: int, guard_rows: int = 100
) -> RowSplit:
    """Train on the other sensors, test on all rows of one that was never seen.

    Sensor and block are those of every row, shape ``(N,)``. Each tenth block of the others
    validates; rows beside it are left out.

    Raises:
        DatasetError: It is no sensor or the only one, or the others leave nothing to train on.
    """
    test = sensor == test_sensor
    if not test.any() or test.all():
        raise DatasetError(
            f"sensor {test_sensor} cannot be held out: it has {test.sum()} of {len(test)} rows",
            remedy="use a data set with at least two sensors",
        )
    seen = np.unique(block[~test])
    validation = np.isin(block, seen[2::10] if len(seen) > 2 else seen[-1:]) & ~test
    split = _guarded(validation, test, sensor, guard_rows)
    if not (len(split.train) and len(split.validation)):
        raise DatasetError(
            f"the other sensors have {len(seen)} blocks, of which a guard of {guard_rows} rows"
            " leaves nothing to train or validate on",
            remedy="cut their recordings into more blocks, or use longer recordings",
        )
    return split


HELD_OUT_MOST = 1000
"""Groups that are enough to measure an error by: its 95 % interval is a few per cent wide."""


def by_group(
    group: Labels,
    *,
    test_share: float = 0.2,
    validation_share: float = 0.1,
    seed: int = 0,
    recording: Labels | None = None,
    guard_rows: int = 0,
) -> RowSplit:
    """Deal whole groups (presses, trajectories) to test, validation and train.

    Test and validation get their shares, but ``HELD_OUT_MOST`` groups each at most.

    Args:
        group: Group of every row, shape ``(N,)``.
        test_share: Of the groups.
        validation_share: Of the groups.
        seed: Deals the groups.
        recording: Recording of every row, shape ``(N,)``, rows in order of time, where groups may
            be pieces of one; None = no group goes on where another one ends.
        guard_rows: Rows left out on either side of a border between two sides in a recording.

    Raises:
        DatasetError: There are fewer than three groups, or the guard leaves a side empty.
    """
    groups = np.unique(group)
    if len(groups) < 3:
        raise DatasetError(
            f"{len(groups)} groups cannot be dealt to train, validation and test",
            remedy="record more presses: at least three, better a hundred",
        )
    dealt = np.random.default_rng(seed).permutation(groups)
    tests, validations = (
        min(HELD_OUT_MOST, max(1, round(share * len(groups))))
        for share in (test_share, validation_share)
    )
    test = np.isin(group, dealt[:tests])
    validation = np.isin(group, dealt[tests : tests + validations])
    if recording is None:
        # No guard: a group starts and ends without contact, so neighbours across it share nothing.
        return _guarded(validation, test, group, guard_rows=0)
    split = _guarded(validation, test, recording, guard_rows)
    if not (len(split.train) and len(split.validation)):
        raise DatasetError(
            f"a guard of {guard_rows} rows around blocks of a recording leaves nothing to train or"
            " validate on",
            remedy="record longer, or say which rows are one press: group",
        )
    return split


def _guarded(validation: Mask, test: Mask, recording: Labels, guard_rows: int) -> RowSplit:
    near_test = _near(test, recording, guard_rows)
    near_validation = _near(validation, recording, guard_rows)
    train = ~test & ~validation & ~near_test & ~near_validation
    validation = validation & ~near_test
    guard = ~train & ~validation & ~test
    return RowSplit(*(np.flatnonzero(side) for side in (train, validation, test, guard)))


def _near(mask: Mask, recording: Labels, distance: int) -> Mask:
    """Rows within ``distance`` rows of a marked row of the same recording."""
    near = mask.copy()
    if distance == 0:
        return near
    # Recordings may be as many as presses: they are sorted, not searched for one after the other.
    order = np.argsort(recording, kind="stable")
    _, first, rows = np.unique(recording[order], return_index=True, return_counts=True)
    start, end = np.repeat(first, rows), np.repeat(first + rows, rows)
    marked = np.concatenate([[0], np.cumsum(mask[order])])
    index = np.arange(len(order))
    low = np.maximum(index - distance, start)
    high = np.minimum(index + distance + 1, end)
    near[order] = marked[high] > marked[low]
    return near


def by_trajectory(data: ExperimentDataset, *, seed: int = 0) -> RowSplit:
    """Deal 70, 20 and 10 % of the unique trajectories to train, test and validation.

    The paper keeps a trajectory's rows together (section "Contiguity"); here every execution of
    it, on whatever unit, is also on the same side, so that no network has seen the same trajectory
    on another specimen.

    Raises:
        DatasetError: There are fewer than three trajectories.
    """
    return by_group(data.row_trajectory, test_share=0.2, validation_share=0.1, seed=seed)


def of_units(data: ExperimentDataset, split: RowSplit, units: Sequence[str]) -> RowSplit:
    """The rows of a split that belong to some units.

    Raises:
        DatasetError: A unit is not in the data set, or one side of the split has no row of them.
    """
    unknown = [unit for unit in units if unit not in data.unit_names]
    if unknown or not units:
        raise DatasetError(
            f"the data set has no unit {', '.join(unknown) or '(none was given)'}",
            remedy=f"choose from {', '.join(data.unit_names)}",
        )
    wanted = _of(data, units)

    sides = {
        name: rows[wanted[rows]]
        for name, rows in (
            ("train", split.train),
            ("validation", split.validation),
            ("test", split.test),
            ("guard", split.guard),
        )
    }
    for side in ("train", "validation", "test"):
        if not sides[side].size:
            raise DatasetError(
                f"no {side} row of {', '.join(units)} is left after holding trajectories out",
                remedy="use a data set with more trajectories of these units, or another seed",
            )
    return RowSplit(**sides)


def unit_sets(data: ExperimentDataset) -> list[tuple[str, ...]]:
    """Each specimen that has rows, alone; then all of them together if there are several."""
    present = [name for i, name in enumerate(data.unit_names) if bool(np.any(data.row_unit == i))]
    each = [(name,) for name in present]
    return each + ([tuple(present)] if len(present) > 1 else [])


SplitName = Literal[
    "trajectory", "execution", "point", "indenter", "block", "tail", "touch", "log", "unit",
    "neighbour",
]  # fmt: skip
"""What is held out: a unique trajectory on every unit; one execution of it; a point of an indenter
with all its trajectories; an indenter; of long recordings a block, the end, one touch of many, or a
log that was recorded at another time; a unit. ``neighbour`` holds out rows at random."""

SPLITS: tuple[SplitName, ...] = get_args(SplitName)

ALL_UNITS = "all units"


@dataclass(frozen=True, slots=True, eq=False)
class Fold:
    """One training and its test.

    Attributes:
        split: What is held out.
        test: On what is tested, as tables call it: a unit, "all units", "biotac-1 to biotac-2".
        part: The indenter, or the number of the blocks, that is held out; empty in the other
            splits. Rows of all parts of a test are put together.
        rows: Rows of each side.
    """

    split: SplitName
    test: str
    part: str
    rows: RowSplit


def folds_of(data: ExperimentDataset, split: SplitName, *, seed: int = 0) -> list[Fold]:
    """All trainings of a split.

    ``execution`` differs from ``trajectory`` only where several units are trained on together.

    Raises:
        DatasetError: The data set has too few trajectories, points, indenters or units, or does not
            say which points it has.
    """
    folds = list(_folds(data, split, seed))
    if not folds:
        raise DatasetError(
            f"the data set cannot be split by {split}",
            remedy="it needs two units, or two indenters on a unit",
        )
    return folds


def rows_of_part(data: ExperimentDataset, part: str) -> Mask:
    """Which rows of a joined data set are of a part, shape (N,).

    Raises:
        ConfigError: There is no such part, or it is the only one.
    """
    of = np.array([name.partition("/")[0] for name in data.trajectories])
    found = of == part
    if not found.any() or found.all():
        raise ConfigError(
            f"{part} is no part of a joined data set: its trajectories' names begin with"
            f" {', '.join(np.unique(of)[:20])}",
            remedy="join data sets (palpate data join), and name one by its file without .h5",
        )
    return np.asarray(found[data.row_trajectory])


PART_SPLITS: tuple[SplitName, ...] = ("trajectory", "execution", "unit")
"""Splits of a part of a joined data set: points and indenters that are held out in one part may
have been met in another."""


def folds_of_part(
    data: ExperimentDataset, part: str, split: SplitName, *, seed: int = 0
) -> list[Fold]:
    """Trainings of one part of a joined data set, whose other parts are learned from, too.

    The part's rows are dealt as if it were alone. All rows of the other parts join the training
    rows, as far as they are of the same units.

    Args:
        data: Joined data sets; names of trajectories begin with the part's.
        part: Its name.
        split: One of ``PART_SPLITS``.
        seed: Deals the part's trajectories to the sides.

    Raises:
        ConfigError: As in ``rows_of_part``, or rows of the part are in another one, too.
        DatasetError: As in ``folds_of``.
    """
    assert split in PART_SPLITS
    of_part = rows_of_part(data, part)
    mine, others = np.flatnonzero(of_part), np.flatnonzero(~of_part)
    twice = int(np.isin(_as_bytes(data.tared[mine]), _as_bytes(data.tared[others])).sum())
    if twice:
        raise ConfigError(
            f"{twice} of {len(mine)} rows of {part} are in another part, too: they would be"
            " learned from and tested",
            remedy="join data sets of different presses",
        )
    alone = subset(data, np.unique(data.trial[mine]).tolist())
    folds = []
    for fold in folds_of(alone, split, seed=seed):
        sides = {
            side: mine[getattr(fold.rows, side)]
            for side in ("train", "validation", "test", "guard")
        }
        units = np.unique(data.row_unit[sides["train"]])
        more = others[np.isin(data.row_unit[others], units)]
        sides["train"] = np.concatenate([sides["train"], more])
        folds.append(replace(fold, rows=RowSplit(**sides)))
    return folds


def _as_bytes(rows: npt.NDArray[np.float32]) -> npt.NDArray[np.void]:
    """Each row as one value, to be looked for among others."""
    rows = np.ascontiguousarray(rows)
    return rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1])))[:, 0]


def _folds(data: ExperimentDataset, split: SplitName, seed: int) -> Iterator[Fold]:
    sets = unit_sets(data)
    if split == "unit":
        yield from _unseen_units(data, seed)
        return
    if split == "indenter":
        yield from _unseen_indenters(data, seed)
        return
    if split == "neighbour":
        dealt = rows_at_random(len(data), seed=seed)
    else:
        dealt = by_group(_groups(data, split), seed=seed)
    for units in sets[-1:] if split == "execution" else sets:
        yield Fold(split, name_of_units(units), "", of_units(data, dealt, units))


def _groups(data: ExperimentDataset, split: SplitName) -> Labels:
    if split == "execution":
        return data.trial
    if split == "trajectory":
        return data.row_trajectory
    if unknown := [name for name in data.trajectories if not press_kind(name)]:
        raise DatasetError(
            f"the data set cannot be split by point: the name of {unknown[0]} does not say at which"
            f" it is ({len(unknown)} of {len(data.trajectories)} trajectories)",
            remedy="split it by trajectory; the files that the paper published do not tell points",
        )
    points = [name.rpartition("/")[0] for name in data.trajectories]
    _, number = np.unique(points, return_inverse=True)
    return number.astype(np.int32)[data.row_trajectory]


def rows_at_random(count: int, *, seed: int = 0) -> RowSplit:
    """Rows dealt one by one, so that each test row has neighbours on the training side.

    What a model reaches here is no result: it shows the noise of single rows, which no model can
    learn away.
    """
    return by_group(np.arange(count, dtype=np.int32), seed=seed)


def _unseen_units(data: ExperimentDataset, seed: int) -> Iterator[Fold]:
    """Each unit from each other one, and from all others together; nothing is calibrated."""
    names = [units[0] for units in unit_sets(data) if len(units) == 1]
    inner = by_trajectory(data, seed=seed)
    validation = np.zeros(len(data), bool)
    validation[inner.validation] = True
    for test in names:
        others = [name for name in names if name != test]
        sets = [(name,) for name in others] + ([tuple(others)] if len(others) > 1 else [])
        for seen in sets:
            yield Fold(
                "unit",
                f"{' + '.join(seen)} to {test}",
                "",
                _sides(_of(data, seen), _of(data, (test,)), validation),
            )


def _unseen_indenters(data: ExperimentDataset, seed: int) -> Iterator[Fold]:
    """Each indenter from the others, on units that met all of them, alone and together."""
    indenter = np.array(data.indenters)[data.row_trajectory]
    every = np.unique(indenter)
    whole = [
        units[0]
        for units in unit_sets(data)
        if len(units) == 1 and len(np.unique(indenter[_of(data, units)])) == len(every)
    ]
    sets = [(name,) for name in whole] + ([tuple(whole)] if len(whole) > 1 else [])
    inner = by_trajectory(data, seed=seed)
    validation = np.zeros(len(data), bool)
    validation[inner.validation] = True
    for units, held in itertools.product(sets, every if len(every) > 1 else []):
        mine, its = _of(data, units), indenter == held
        yield Fold(
            "indenter",
            name_of_units(units, len(unit_sets(data)) - 1),
            str(held),
            _sides(mine & ~its, mine & its, validation),
        )


def _of(data: ExperimentDataset, units: Sequence[str]) -> Mask:
    """Rows of some units."""
    return np.isin(data.row_unit, [data.unit_names.index(unit) for unit in units])


def _sides(seen: Mask, test: Mask, validation: Mask) -> RowSplit:
    """Train and validate on the seen rows, test on others."""
    sides = (seen & ~validation, seen & validation, test, ~seen & ~test)
    return RowSplit(*(np.flatnonzero(side) for side in sides))


def name_of_units(units: Sequence[str], of: int | None = None) -> str:
    """How tables call a set of units; ``of`` is how many there are where these may be fewer."""
    if len(units) == 1:
        return units[0]
    return ALL_UNITS if of in (None, len(units)) else " + ".join(units)
