"""Numbers of a data set, its boxes, and the map they are drawn beside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import hypothesis.extra.numpy as hnp
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.anatomy import CORE_RADIUS_M, core_normal
from palpate.errors import DatasetError
from palpate_training.datasets.experiment import ExperimentDataset, MixedDataset
from palpate_training.figures.boxes import box_of
from palpate_training.figures.outline import unwrap
from palpate_training.figures.page import group_table, size_table, unit_table
from palpate_training.figures.skin import final_rows, motion_share
from palpate_training.figures.statistics import (
    ELECTRODE_GROUPS,
    angled_share,
    dataset_statistics,
    shear_ratio,
)

MakeTrials = Callable[..., ExperimentDataset]
Floats = npt.NDArray[np.float64]


@pytest.fixture
def three_trials(trials_data: MakeTrials) -> ExperimentDataset:
    """Unit 1 executes the first trajectory (2 rows), unit 2 the first (1 row) and second (3)."""
    data = trials_data(units=2, rows=1)
    first = np.zeros((6, 19), np.float32)
    first[0, 4], first[1, 4], first[5, 18], first[3, 0] = -0.5, 0.25, -0.75, 0.125
    force = np.zeros((6, 3), np.float32)
    force[:, 2] = [1, 2, 4, 3, 5, 12]
    force[5, 0] = 5  # 13 N, and 5 / 13 of it tangential
    location = np.tile(np.array([-5e-3, 0, -7e-3], np.float32), (6, 1))
    return replace(
        data,
        trial_unit=np.array([0, 1, 1], np.int32),
        trial_trajectory=np.array([0, 0, 1], np.int32),
        trial_rest=data.trial_rest[:3],
        trial=np.array([0, 0, 1, 2, 2, 2], np.int32),
        travel_m=np.zeros(6, np.float32),
        tared=first,
        force=force,
        location=location,
    )


def test_statistics_of_three_trials(three_trials: ExperimentDataset) -> None:
    found = dataset_statistics(three_trials)
    assert (found.trajectories, found.trials, found.rows) == (2, 3, 6)
    assert found.angled_share == 0.5  # by unique trajectory
    one, two = found.units
    assert (one.name, one.trials, one.trajectories, one.rows) == ("biotac-1", 1, 1, 2)
    assert (two.name, two.trials, two.trajectories, two.rows) == ("biotac-2", 2, 2, 4)
    assert one.rows_per_trial == (2, 2.0, 2)
    assert two.rows_per_trial == (1, 2.0, 3)
    assert (one.tared_min, one.tared_max) == (-0.5, 0.25)
    assert (two.tared_min, two.tared_max) == (-0.75, 0.125)
    assert (one.force_max_n, one.force_median_n) == (2.0, 1.5)
    assert (two.force_max_n, two.force_median_n) == (13.0, 4.5)
    assert one.electrode_mean[4] == -0.125
    assert one.electrode_sd[4] == 0.375
    assert not one.electrode_sd[:4].any()
    assert (one.angled_share, two.angled_share) == (0.0, 0.5)
    assert (one.sheared_share, two.sheared_share) == (0.0, 0.5)


def test_unused_unit_is_left_out_and_final_rows_are_the_last(
    three_trials: ExperimentDataset,
) -> None:
    np.testing.assert_array_equal(final_rows(three_trials), [1, 2, 5])
    only_second = replace(three_trials, trial_unit=np.array([1, 1, 1], np.int32) * 0 + 1,
                          trial_trajectory=np.array([0, 1, 2], np.int32))  # fmt: skip
    assert [unit.name for unit in dataset_statistics(only_second).units] == ["biotac-2"]


def test_tables_put_the_paper_beside(three_trials: ExperimentDataset) -> None:
    found = dataset_statistics(three_trials)
    assert "| unique trajectories | 2 | 411 |" in size_table(found)
    table = unit_table(found.units, [0, None])
    assert "-0.500 to 0.250 (-0.65 to 0.13) | -0.750 to 0.125 |" in table
    assert "2.0 (23.4) | 13.0 |" in table
    assert "| trials planned angled | 0 % | 50 % |" in table


def test_angled_share_is_unknown_for_other_names() -> None:
    assert angled_share(["cube/00/normal", "cube/00/angled-3"]) == 0.5
    assert np.isnan(angled_share(["cube/00/normal", "trajectory_7"]))
    assert np.isnan(angled_share([]))


def test_groups_hold_every_electrode_once_and_know_their_target() -> None:
    assert sorted(i for group in ELECTRODE_GROUPS for i in group.electrodes) == list(range(19))
    tip = next(group for group in ELECTRODE_GROUPS if group.name == "E7-E10")
    sd = np.full(19, 0.5)
    sd[6:10] = 0.018
    assert tip.within(sd)
    assert not tip.within(sd + 0.003)
    assert not tip.within(sd - 0.003)


def test_group_table_marks_what_misses(three_trials: ExperimentDataset) -> None:
    (unit, _) = dataset_statistics(three_trials).units
    good = replace(unit, electrode_sd=np.array([0.05] * 6 + [0.018] * 4 + [0.05] * 4 + [0.03] * 5))
    bad = replace(good, electrode_sd=good.electrode_sd * 2)
    assert "outside" not in group_table([good])
    assert group_table([good, bad]).count("outside") == len(ELECTRODE_GROUPS)


def test_shear_is_counted_from_the_surface_not_from_the_vertical() -> None:
    location = np.array([[-5e-3, 0, -7e-3], [-5e-3, 7e-3, 0], [7e-3, 0, 0], [-5e-3, 7e-3, 0]])
    force = np.array([[0.0, 0, 3], [0, -2, 0], [-1, 0, 0], [0, 0, 2]])
    np.testing.assert_allclose(shear_ratio(force, location), [0, 0, 0, 1], atol=1e-12)
    tilted = np.array([[np.sin(np.pi / 6), 0, np.cos(np.pi / 6)]])
    np.testing.assert_allclose(shear_ratio(9 * tilted, location[:1]), [0.5])
    assert np.isnan(shear_ratio(np.zeros((1, 3)), location[:1])).all()


@given(
    hnp.arrays(np.float64, st.integers(1, 60), elements=st.floats(-1e3, 1e3, allow_subnormal=False))
)
def test_box_is_that_of_matplotlib(values: Floats) -> None:
    """Its fences reach the furthest value within 1.5 IQR, or the edge of the box."""
    cbook = pytest.importorskip("matplotlib.cbook", reason="matplotlib not installed")
    (theirs,) = cbook.boxplot_stats(values, whis=1.5)
    ours = box_of(values)
    names = ("whislo", "q1", "med", "mean", "q3", "whishi")
    got = (ours.low, ours.q1, ours.median, ours.mean, ours.q3, ours.high)
    np.testing.assert_allclose(got, [theirs[name] for name in names], rtol=1e-9, atol=1e-9)


def test_fence_stops_at_a_value_and_leaves_the_far_one() -> None:
    box = box_of(np.array([0.0, 1, 2, 3, 4, 6.9, 100]))
    assert (box.q1, box.median, box.q3) == (1.5, 3.0, 5.45)
    assert (box.low, box.high) == (0.0, 6.9)
    with pytest.raises(DatasetError, match="0 values"):
        box_of(np.empty(0))
    with pytest.raises(DatasetError, match="4 values, 3 of them not finite"):
        box_of(np.array([1.0, np.inf, -np.inf, np.nan]))


@given(st.floats(-15e-3, -1e-6), st.floats(-1.7, 1.7))
def test_cylinder_is_rolled_out_without_stretching(x: float, turn: float) -> None:
    point = [[x, CORE_RADIUS_M * np.sin(turn), -CORE_RADIUS_M * np.cos(turn)]]
    np.testing.assert_allclose(unwrap(np.array(point)), [[x, CORE_RADIUS_M * turn]], atol=1e-12)


@given(st.floats(-1.5, 1.5))
def test_tip_meets_the_cylinder_without_a_step(turn: float) -> None:
    y, z = CORE_RADIUS_M * np.sin(turn), -CORE_RADIUS_M * np.cos(turn)
    before, after = unwrap(np.array([[-1e-9, y, z], [1e-9, y, z]]))
    np.testing.assert_allclose(before, after, atol=1e-7)


def test_foremost_point_is_a_quarter_turn_away() -> None:
    tip, pole = unwrap(np.array([[CORE_RADIUS_M, 0, 0], [0, 0, -CORE_RADIUS_M]]))
    np.testing.assert_allclose(tip, [CORE_RADIUS_M * np.pi / 2, 0], atol=1e-12)
    np.testing.assert_allclose(pole, [0, 0], atol=1e-12)


def test_normal_is_from_the_axis_and_at_the_tip_from_the_centre() -> None:
    points = np.array([[-9e-3, 3e-3, -4e-3], [3e-3, 0, -4e-3]])
    np.testing.assert_allclose(core_normal(points), [[0, 0.6, -0.8], [0.6, 0, -0.8]])


@pytest.mark.parametrize("block_rows", [1, 7, 10_000])
def test_motion_counts_rows_beyond_the_threshold(
    fields_data: Callable[..., MixedDataset], block_rows: int
) -> None:
    mixed = fields_data(units=1, rows=6)
    whole = np.linalg.norm(mixed.displacement(slice(None)), axis=2)
    share = motion_share(mixed, block_rows=block_rows)
    np.testing.assert_allclose(share, (whole > 1e-4).mean(axis=0))
    assert share[0] == 0
    assert 0 < share[-1] < 1  # the first row of each trial does not move
    assert motion_share(mixed, threshold_m=10.0).max() == 0
