"""Trajectories found in rows that name none: each sign of a beginning by itself, and matching."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate_training.datasets.published import (
    Floats,
    PublishedRun,
    Texts,
    find_runs,
    name_trajectories,
)


def _rows(force: list[float], z_mm: list[float], kinds: str) -> list[tuple[int, int]]:
    """Where runs begin and end, of forces along z, places along z and indenters by letter."""
    push = np.outer(force, [0.0, 0.0, 1.0])
    tip = np.outer(np.array(z_mm) * 1e-3, [0.0, 0.0, 1.0])
    indenter: Texts = np.array(list(kinds), dtype=object)
    return [(run.rows.start, run.rows.stop) for run in find_runs("file", push, tip, indenter)]


def test_the_force_falls_back_to_half_a_newton() -> None:
    near = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]
    assert _rows([0.5, 0.9, 1.4, 0.5, 1.0, 2.0], near, "aaaaaa") == [(0, 3), (3, 6)]
    # Rounded either way it is a beginning; a first row just above another is none.
    assert _rows([0.5, 0.9, 1.4, 0.50001, 1.0, 2.0], near, "aaaaaa") == [(0, 3), (3, 6)]
    assert _rows([0.5, 0.5005, 0.9, 1.4, 2.0, 1.2], near, "aaaaaa") == [(0, 6)]


def test_the_indenter_changes() -> None:
    near = [0.0, 0.1, 0.2, 0.3]
    assert _rows([0.5, 0.9, 1.0, 1.1], near, "aabb") == [(0, 2), (2, 4)]


def test_the_tip_jumps() -> None:
    assert _rows([0.6, 0.9, 1.0, 1.1], [0, 0.1, 2.1, 2.2], "aaaa") == [(0, 2), (2, 4)]
    assert _rows([0.6, 0.9, 1.0, 1.1], [0, 0.1, 0.5, 0.6], "aaaa") == [(0, 4)]


def test_rows_that_stand_alone_are_in_no_order() -> None:
    with pytest.raises(DatasetError, match="4 of 4 trajectories have a single row"):
        _rows([0.6, 0.9, 1.0, 1.1], [0, 3, 0, 3], "aaaa")
    assert _rows([0.5], [0.0], "a") == [(0, 1)], "a file of one row is no disorder"


def test_travel_is_along_the_path_and_never_runs_backward() -> None:
    way = np.array([0.6, 0.0, 0.8])
    tip = np.outer([0.0, 1e-4, 0.9e-4, 4e-4], way) + np.array([1e-3, 2e-3, 3e-3])
    force = np.outer([0.5, 1.0, 1.5, 2.0], way)
    (run,) = find_runs("file", force, tip, np.array(["a"] * 4, dtype=object))
    np.testing.assert_allclose(run.travel_m, [0, 1e-4, 1e-4, 4e-4], atol=1e-12)
    np.testing.assert_allclose(run.direction, way)
    np.testing.assert_allclose(run.start, [1e-3, 2e-3, 3e-3])


def _run(x_mm: float, angle_deg: float = 0.0, indenter: str = "a") -> PublishedRun:
    angle = np.radians(angle_deg)
    direction: Floats = np.array([np.sin(angle), 0.0, np.cos(angle)])
    return PublishedRun(
        slice(0, 2), indenter, np.array([x_mm * 1e-3, 0.0, 0.0]), direction, np.zeros(2)
    )


def test_the_same_place_and_direction_is_the_same_trajectory() -> None:
    assert name_trajectories([[_run(0), _run(5)], [_run(5.6, 4), _run(0.7, -5)]]) == [
        ["a/000", "a/001"],
        ["a/001", "a/000"],
    ]


@pytest.mark.parametrize(
    "other", [_run(2.0), _run(0.0, 30), _run(0.0, indenter="b")], ids=["place", "direction", "tip"]
)
def test_another_place_direction_or_indenter_is_another_trajectory(other: PublishedRun) -> None:
    (first,), (second,) = name_trajectories([[_run(0.0)], [other]])
    assert first != second


def test_matches_are_one_to_one_and_the_best_together() -> None:
    """Each of the two is nearest to the first; one to one, the second goes with the second."""
    names = name_trajectories([[_run(0.0), _run(1.3)], [_run(0.1), _run(0.5)]])
    assert names == [["a/000", "a/001"], ["a/000", "a/001"]]


def test_a_third_unit_meets_what_the_second_brought() -> None:
    names = name_trajectories([[_run(0.0)], [_run(5.0)], [_run(5.1), _run(0.1), _run(9.0)]])
    assert names == [["a/000"], ["a/001"], ["a/001", "a/000", "a/002"]]


def _short(x_mm: float) -> PublishedRun:
    tip = np.array([[x_mm * 1e-3, 0.0, 0.0], [x_mm * 1e-3, 0.0, 1e-4]])
    force = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.6]])
    (short,) = find_runs("file", force, tip, np.array(["a", "a"], dtype=object))
    return short


def test_a_path_too_short_for_a_direction_is_matched_by_its_place() -> None:
    assert name_trajectories([[_short(0)], [_run(0.2, 40)]]) == [["a/000"], ["a/000"]]
    assert name_trajectories([[_run(0.2, 40)], [_short(0)]]) == [["a/000"], ["a/000"]]
    assert name_trajectories([[_short(0)], [_short(2)]]) == [["a/000"], ["a/001"]]


def test_a_path_with_the_same_direction_is_preferred_to_a_short_one() -> None:
    assert name_trajectories([[_short(0), _run(0, 40)], [_run(0, 40)]])[1] == ["a/001"]


@pytest.mark.parametrize(("angle_deg", "same"), [(14, True), (16, False)])
def test_paths_of_one_trajectory_differ_by_half_of_what_plans_do(
    angle_deg: float, same: bool
) -> None:
    (first,), (second,) = name_trajectories([[_run(0)], [_run(0, angle_deg)]])
    assert (first == second) == same
