"""Nobody is tested on a trajectory that any finger was trained on."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate_training.datasets.experiment import MixedDataset
from palpate_training.learning.splits import by_trajectory, of_units, unit_sets


@pytest.mark.parametrize("seed", range(4))
def test_a_trajectory_is_on_one_side_on_every_unit(mixed: MixedDataset, seed: int) -> None:
    data = mixed.experiment
    split = by_trajectory(data, seed=seed)
    sides = [set(data.row_trajectory[rows]) for rows in (split.train, split.validation, split.test)]
    assert [len(side) for side in sides] == [21, 3, 6]
    assert not sides[0] & sides[1] | sides[0] & sides[2] | sides[1] & sides[2]
    rows = np.concatenate([split.train, split.validation, split.test])
    assert sorted(rows) == list(range(len(data))), "every row is on a side"


def test_rows_of_a_unit_keep_their_side(mixed: MixedDataset) -> None:
    data = mixed.experiment
    split = by_trajectory(data)
    one = of_units(data, split, ["biotac-2"])
    assert set(one.test) <= set(split.test)
    assert set(data.row_unit[np.concatenate([one.train, one.validation, one.test])]) == {1}
    both = of_units(data, split, ["biotac-1", "biotac-2"])
    np.testing.assert_array_equal(both.train, split.train)
    assert unit_sets(data) == [("biotac-1",), ("biotac-2",), ("biotac-1", "biotac-2")]


def test_a_unit_without_rows_is_no_set(make_mixed: Callable[..., MixedDataset]) -> None:
    data = make_mixed(units=1, trajectories=6, steps=3).experiment
    named = replace(data, unit_names=("biotac-1", "biotac-9"))
    assert unit_sets(named) == [("biotac-1",)]
    with pytest.raises(DatasetError, match=r"no train row of biotac-9"):
        of_units(named, by_trajectory(named), ["biotac-9"])


@pytest.mark.parametrize(
    ("units", "named"), [(["biotac-7"], "no unit biotac-7"), ([], "no unit (none was given)")]
)
def test_unknown_units_are_named(mixed: MixedDataset, units: list[str], named: str) -> None:
    split = by_trajectory(mixed.experiment)
    with pytest.raises(DatasetError, match=re.escape(named)) as error:
        of_units(mixed.experiment, split, units)
    assert "biotac-1, biotac-2" in str(error.value)
