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
    Split,
    by_group,
    contiguous_folds,
    unseen_sensor,
)


def check(split: Split, rows: int) -> None:
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


def test_no_function_splits_rows_at_random() -> None:
    public = [name for name, _ in inspect.getmembers(splits, inspect.isfunction) if name[0] != "_"]
    assert sorted(public) == [
        "by_group",
        "by_trajectory",
        "contiguous_folds",
        "dataclass",
        "of_units",
        "unit_sets",
        "unseen_sensor",
    ]
