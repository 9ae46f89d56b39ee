"""All trainings of a split: what is held out is nowhere on the training side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import ConfigError, DatasetError
from palpate_training.datasets.assembly import assemble_experiment
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import ExperimentDataset
from palpate_training.datasets.join import join_experiments
from palpate_training.datasets.trials import TrialRows
from palpate_training.learning.splits import (
    PART_SPLITS,
    SPLITS,
    Fold,
    SplitName,
    folds_of,
    folds_of_part,
)

UNITS = ("one", "two", "three")
INDENTERS = ("cube", "ring", "sphere")


@pytest.fixture
def data(make_rows: Callable[..., TrialRows], provenance: Provenance) -> ExperimentDataset:
    """Three units, the first of which met one indenter only; ten points, three presses each."""
    trials = [
        make_rows(unit, f"{indenter}/{point}/{press}")
        for unit in UNITS
        for indenter in (INDENTERS[2:] if unit == "one" else INDENTERS)
        for point in range(10)
        for press in ("normal", "angled-1", "angled-2")
    ]
    return assemble_experiment(trials, provenance, unit_names=UNITS)


def names(data: ExperimentDataset, rows: np.ndarray) -> set[str]:
    return {data.trajectories[k] for k in data.row_trajectory[rows]}


def units(data: ExperimentDataset, rows: np.ndarray) -> set[str]:
    return {data.unit_names[k] for k in data.row_unit[rows]}


@pytest.mark.parametrize("split", SPLITS)
def test_no_row_is_on_two_sides(data: ExperimentDataset, split: SplitName) -> None:
    for fold in folds_of(data, split):
        sides = (fold.rows.train, fold.rows.validation, fold.rows.test)
        assert all(len(side) for side in sides), fold.test
        together = np.concatenate(sides)
        assert len(np.unique(together)) == len(together)


def test_points_of_names_without_points_are_not_made_up(data: ExperimentDataset) -> None:
    """As published files are read: their names would be split by indenter."""
    published = replace(
        data, trajectories=tuple(f"{data.indenters[k]}/{k}" for k in range(len(data.trajectories)))
    )
    assert folds_of(published, "trajectory")
    with pytest.raises(DatasetError, match=r"name of \w+/0 does not say .* \(90 of 90"):
        folds_of(published, "point")


def held_out(folds: list[Fold]) -> list[str]:
    return sorted({fold.test for fold in folds})


def test_unseen_trajectories(data: ExperimentDataset) -> None:
    folds = folds_of(data, "trajectory")
    assert held_out(folds) == ["all units", "one", "three", "two"]
    for fold in folds:
        assert not names(data, fold.rows.train) & names(data, fold.rows.test)


def test_unseen_executions_may_be_seen_on_another_unit(data: ExperimentDataset) -> None:
    (fold,) = folds_of(data, "execution")
    assert names(data, fold.rows.train) & names(data, fold.rows.test)
    assert not set(data.trial[fold.rows.train]) & set(data.trial[fold.rows.test])


def test_unseen_points(data: ExperimentDataset) -> None:
    for fold in folds_of(data, "point"):
        seen, held = (
            {name.rpartition("/")[0] for name in names(data, rows)}
            for rows in (fold.rows.train, fold.rows.test)
        )
        assert not seen & held


def test_unseen_indenters(data: ExperimentDataset) -> None:
    folds = folds_of(data, "indenter")
    assert held_out(folds) == ["three", "two", "two + three"]
    for fold in folds:
        assert {name.partition("/")[0] for name in names(data, fold.rows.test)} == {fold.part}
        assert fold.part not in {name.partition("/")[0] for name in names(data, fold.rows.train)}
        assert "one" not in units(data, fold.rows.train)
    both = [fold for fold in folds if fold.test == "two + three"]
    rows = np.concatenate([fold.rows.test for fold in both])
    assert len(np.unique(rows)) == len(rows) == np.isin(data.row_unit, (1, 2)).sum()


def test_unseen_units(data: ExperimentDataset) -> None:
    folds = folds_of(data, "unit")
    assert len(folds) == 9
    assert {"one to two", "two + three to one"} <= set(held_out(folds))
    for fold in folds:
        seen, held = fold.test.split(" to ")
        assert units(data, fold.rows.train) == set(seen.split(" + "))
        assert units(data, fold.rows.test) == {held}
        assert len(fold.rows.test) == (data.row_unit == UNITS.index(held)).sum()


def test_neighbours_are_on_both_sides(data: ExperimentDataset) -> None:
    fold = folds_of(data, "neighbour")[-1]
    assert set(data.trial[fold.rows.test]) <= set(data.trial[fold.rows.train])


def test_one_unit_cannot_be_unseen(
    make_rows: Callable[..., TrialRows], provenance: Provenance
) -> None:
    rows = [make_rows("one", f"cube/{k}/normal") for k in range(6)]
    data = assemble_experiment(rows, provenance)
    for split in ("unit", "indenter"):
        with pytest.raises(DatasetError, match=f"cannot be split by {split}"):
            folds_of(data, split)


@pytest.fixture
def more(make_rows: Callable[..., TrialRows], provenance: Provenance) -> ExperimentDataset:
    """Other presses of two of the units."""
    trials = [make_rows(unit, f"random/{n}") for unit in UNITS[:2] for n in range(7)]
    return assemble_experiment(trials, provenance, unit_names=UNITS[:2])


@pytest.mark.parametrize("split", PART_SPLITS)
def test_other_parts_are_learned_from_and_never_tested(
    data: ExperimentDataset, more: ExperimentDataset, split: SplitName
) -> None:
    joined = join_experiments([data, more], ["twin", "more"], data.provenance)
    alone, within = folds_of(data, split), folds_of_part(joined, "twin", split)
    assert [fold.test for fold in within] == [fold.test for fold in alone]
    for before, now in zip(alone, within, strict=True):
        # The part comes first, so its rows have the numbers that they have alone.
        for side in ("validation", "test"):
            assert np.array_equal(getattr(now.rows, side), getattr(before.rows, side))
        added = now.rows.train[len(before.rows.train) :]
        assert np.array_equal(now.rows.train[: len(before.rows.train)], before.rows.train)
        assert units(joined, added) == units(data, before.rows.train) & set(UNITS[:2])
        assert all(name.startswith("more/") for name in names(joined, added))
    together = next(fold for fold in within if fold.test in ("all units", "two + three to one"))
    count = len(more) if split != "unit" else int((more.row_unit == 1).sum())
    assert int((together.rows.train >= len(data)).sum()) == count


def test_the_part_may_stand_anywhere(data: ExperimentDataset, more: ExperimentDataset) -> None:
    joined = join_experiments([more, data], ["more", "twin"], data.provenance)
    alone = folds_of(data, "trajectory")[0].rows.test
    assert np.array_equal(
        folds_of_part(joined, "twin", "trajectory")[0].rows.test, alone + len(more)
    )


def test_a_part_has_to_be_one_of_several_with_presses_of_its_own(
    data: ExperimentDataset, more: ExperimentDataset
) -> None:
    joined = join_experiments([data, more], ["twin", "more"], data.provenance)
    with pytest.raises(ConfigError, match=r"tw is no part .* more, twin"):
        folds_of_part(joined, "tw", "trajectory")
    with pytest.raises(ConfigError, match="twin is no part"):
        folds_of_part(join_experiments([data], ["twin"], data.provenance), "twin", "trajectory")
    again = join_experiments([data, more, data], ["twin", "more", "copy"], data.provenance)
    with pytest.raises(
        ConfigError, match=f"{len(data)} of {len(data)} rows of twin are in another"
    ):
        folds_of_part(again, "twin", "trajectory")
