"""Whole blocks, groups, sensors: nothing on two sides, nothing lost, no neighbour across."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.errors import DatasetError
from palpate_training.datasets.features import cut_into_blocks
from palpate_training.learning import splits
from palpate_training.learning.splits import (
    RowSplit,
    by_group,
    contiguous_folds,
    unseen_sensor,
)


def check(split: RowSplit, rows: int) -> None:
    """Disjoint and, with the guard, exhaustive."""
    parts = [split.train, split.validation, split.test, split.guard]
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(rows))


recordings = st.lists(st.integers(200, 500), min_size=1, max_size=3)


def labels(lengths: list[int], blocks: int) -> tuple[splits.Labels, splits.Labels]:
    block = [cut_into_blocks(n, blocks) + np.int32(i * blocks) for i, n in enumerate(lengths)]
    recording = np.repeat(np.arange(len(lengths), dtype=np.int32), lengths)
    return np.concatenate(block).astype(np.int32), recording


@given(recordings, st.integers(3, 5), st.integers(0, 12))
def test_contiguous_folds(lengths: list[int], folds: int, guard_rows: int) -> None:
    block, recording = labels(lengths, blocks=2 * folds)
    made = contiguous_folds(block, recording, folds=folds, guard_rows=guard_rows)
    for split in made:
        check(split, len(block))
        sides = {name: set(block[getattr(split, name)]) for name in ("train", "validation", "test")}
        assert not sides["train"] & sides["validation"]
        assert not sides["train"] & sides["test"]
        assert not sides["validation"] & sides["test"]
        assert len(split.train), "something to learn from"
        for one, other in (("train", "test"), ("train", "validation"), ("validation", "test")):
            for i in np.unique(recording):
                a = getattr(split, one)
                b = getattr(split, other)
                a, b = a[recording[a] == i], b[recording[b] == i]
                if len(a) and len(b):
                    assert np.min(np.abs(a[:, None] - b[None, :])) > guard_rows
    tested = np.concatenate([split.test for split in made])
    np.testing.assert_array_equal(np.sort(tested), np.arange(len(block)))


@given(st.integers(10, 1000), st.integers(1, 10))
def test_blocks_are_contiguous_and_even(rows: int, blocks: int) -> None:
    block = cut_into_blocks(rows, blocks)
    assert np.all(np.diff(block) >= 0)
    lengths = np.bincount(block)
    assert len(lengths) == blocks
    assert lengths.max() - lengths.min() <= 1


@given(st.integers(3, 40), st.integers(0, 5))
def test_by_group(groups: int, seed: int) -> None:
    group = np.repeat(np.arange(groups, dtype=np.int32), 7)
    split = by_group(group, seed=seed)
    check(split, len(group))
    sides = [set(group[rows]) for rows in (split.train, split.validation, split.test)]
    assert all(sides)
    assert sum(map(len, sides)) == groups, "each group on one side"


def test_unseen_sensor() -> None:
    block, sensor = labels([300, 200], blocks=10)
    split = unseen_sensor(sensor, block, test_sensor=1, guard_rows=4)
    check(split, len(block))
    np.testing.assert_array_equal(split.test, np.flatnonzero(sensor == 1))
    assert len(split.validation)


def by_block(split: RowSplit, block: splits.Labels) -> dict[str, list[int]]:
    """Blocks of each side; a block with rows in the guard is listed with its side, too."""
    sides = ("train", "validation", "test", "guard")
    return {side: np.unique(block[getattr(split, side)]).tolist() for side in sides}


def test_folds_follow_the_order_of_time() -> None:
    """Twelve blocks of ten rows whose numbers run backwards; every side is known."""
    block = np.repeat(np.arange(11, -1, -1, dtype=np.int32), 10)
    made = contiguous_folds(block, np.zeros(120, np.int32), folds=3, guard_rows=0)
    assert [by_block(split, 11 - block)["test"] for split in made] == [
        [0, 3, 6, 9],
        [1, 4, 7, 10],
        [2, 5, 8, 11],
    ]
    assert [by_block(split, 11 - block)["validation"] for split in made] == [
        [2, 8],
        [3, 9],
        [4, 10],
    ]


def test_guard_is_as_wide_as_it_says_on_either_side() -> None:
    block = np.repeat(np.arange(6, dtype=np.int32), 10)
    first, *_ = contiguous_folds(block, np.zeros(60, np.int32), folds=3, guard_rows=2)
    # Test: 0 to 9 and 30 to 39. Validation: 20 to 29, less what is near a test row.
    assert first.validation.tolist() == list(range(20, 28))
    assert first.train.tolist() == [*range(12, 18), *range(42, 60)]
    assert first.guard.tolist() == [10, 11, 18, 19, 28, 29, 40, 41]


def test_guard_after_a_block_of_a_single_row() -> None:
    block = np.repeat(np.arange(6, dtype=np.int32), [1, 10, 10, 10, 10, 10])
    first, *_ = contiguous_folds(block, np.zeros(51, np.int32), folds=3, guard_rows=2)
    assert first.test.tolist() == [0, *range(21, 31)]
    assert first.train.tolist() == [*range(3, 9), *range(33, 51)]


def test_without_being_asked_five_folds_a_hundred_rows_apart() -> None:
    block, recording = labels([4000], blocks=10)
    made = contiguous_folds(block, recording)
    assert len(made) == 5
    assert np.min(np.abs(made[0].train[:, None] - made[0].test)) == 101
    block, sensor = labels([4000, 400], blocks=10)
    split = unseen_sensor(sensor, block, test_sensor=1)
    assert np.min(np.abs(split.train[:, None] - split.validation)) == 101
    with pytest.raises(ValueError, match="at least 3"):
        contiguous_folds(block, sensor, folds=2)


@pytest.mark.parametrize(("blocks", "validated"), [(2, [1]), (3, [2]), (12, [2]), (13, [2, 12])])
def test_every_tenth_block_of_the_seen_sensors_validates(blocks: int, validated: list[int]) -> None:
    block, sensor = labels([blocks * 20, 20], blocks=blocks)
    split = unseen_sensor(sensor, block, test_sensor=1, guard_rows=0)
    assert by_block(split, block)["validation"] == validated


def test_groups_are_dealt_in_shares() -> None:
    group = np.repeat(np.arange(30, dtype=np.int32), 7)
    split = by_group(group)
    counts = {side: len(found) for side, found in by_block(split, group).items()}
    assert counts == {"train": 21, "validation": 3, "test": 6, "guard": 0}
    np.testing.assert_array_equal(split.test, by_group(group, seed=0).test)
    few = by_group(group[:35], test_share=0.01, validation_share=0.01)
    counts = {side: len(found) for side, found in by_block(few, group).items()}
    assert counts == {"train": 3, "validation": 1, "test": 1, "guard": 0}
    split = by_group(np.arange(20_000, dtype=np.int32))
    assert (len(split.train), len(split.validation), len(split.test)) == (18_000, 1000, 1000)


def test_groups_of_one_recording_are_kept_apart() -> None:
    group, recording = labels([400, 300], blocks=10)
    plain = by_group(group)
    split = by_group(group, recording=recording, guard_rows=5)
    check(split, len(group))
    np.testing.assert_array_equal(split.test, plain.test)

    def near(rows: splits.Rows, others: splits.Rows) -> splits.Mask:
        apart = np.abs(rows[:, None] - others)
        same = recording[rows][:, None] == recording[others]
        return np.asarray(((apart <= 5) & same).any(axis=1))

    assert (
        split.validation.tolist() == plain.validation[~near(plain.validation, plain.test)].tolist()
    )
    tested = np.concatenate([plain.validation, plain.test])
    assert split.train.tolist() == plain.train[~near(plain.train, tested)].tolist()
    assert len(split.guard)
    # A group that is a recording of its own borders on no other.
    whole = by_group(group, recording=group, guard_rows=5)
    assert not len(whole.guard)


def test_what_cannot_be_split_is_named() -> None:
    block, recording = labels([300], blocks=5)
    with pytest.raises(DatasetError, match="5 blocks, 5 folds need 10"):
        contiguous_folds(block, recording, folds=5)
    block, recording = labels([300], blocks=10)
    with pytest.raises(DatasetError, match="a guard of 100 rows leaves nothing"):
        contiguous_folds(block, recording, guard_rows=100)
    with pytest.raises(DatasetError, match="sensor 0 cannot be held out"):
        unseen_sensor(recording, block, test_sensor=0)
    with pytest.raises(DatasetError, match="2 groups"):
        by_group(np.array([0, 1], dtype=np.int32))
    with pytest.raises(DatasetError, match="a guard of 300 rows around blocks"):
        by_group(block, recording=recording, guard_rows=300)


def test_other_sensors_of_a_single_block_are_refused() -> None:
    """It would validate, and nothing would be left to train on."""
    sensor = np.repeat([0, 1], 50).astype(np.int32)
    with pytest.raises(DatasetError, match=r"sensors have 1 blocks, .* nothing to train"):
        unseen_sensor(sensor, sensor, test_sensor=1, guard_rows=5)


def test_a_single_function_splits_rows_at_random() -> None:
    """And its name says so; what it gives is called no result (``folds_of``, ``neighbour``)."""
    public = [name for name, _ in inspect.getmembers(splits, inspect.isfunction) if name[0] != "_"]
    assert sorted(public) == [
        "by_group",
        "by_trajectory",
        "contiguous_folds",
        "dataclass",
        "folds_of",
        "folds_of_part",
        "get_args",
        "last_part",
        "name_of_units",
        "of_units",
        "press_kind",
        "replace",
        "rows_at_random",
        "rows_of_part",
        "subset",
        "unit_sets",
        "unseen_sensor",
    ]
