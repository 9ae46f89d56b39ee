"""Studies: rows that compare with the row before, a field carried over, and the work on paths."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate_fem import study
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.approach import OuterSurface
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.indenter.path import parse_segments, show_segments
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac
from palpate_fem.plot.validation import plot_study
from palpate_fem.result import IndentationOutcome
from palpate_fem.trajectory import pad_point, segment_path


def test_a_linear_field_is_carried_over() -> None:
    """From scattered points of a bent surface to others on it, to less than studies accept."""
    random = np.random.default_rng(0)

    def surface(count: int) -> np.ndarray:
        x, y = random.uniform(-3e-3, 3e-3, (2, count))
        return np.stack((x, y, 20.0 * (x**2 + y**2)), axis=1)

    nodes, points = surface(4000), surface(50) * 0.8
    points[:, 2] = 20.0 * (points[:, :2] ** 2).sum(axis=1)
    slope = np.array([[0.1, 0.02, 0.3], [0.0, 0.2, 0.1], [0.05, 0.1, -0.1]])
    field = study._SkinDisplacement(nodes, 1e-3 + nodes @ slope, 1.0)
    np.testing.assert_allclose(study._at(field, nodes[:40]), field.displacement[:40], atol=1e-9)
    carried = study._at(field, points)
    np.testing.assert_allclose(carried, 1e-3 + points @ slope, atol=3e-6)


@pytest.fixture(scope="module")
def rows() -> list[study.StudyRow]:
    """Two coarse meshes of the real finger, one step: quick, and far from converged."""
    with pytest.MonkeyPatch.context() as patch:
        ball = replace(study.PRESSES["sphere_medium"], depth_m=0.3e-3)
        patch.setattr(study, "PRESSES", {"sphere_medium": ball})
        return study.mesh_study(edges_m=(1.4e-3, 1.1e-3), steps=2)


def test_rows_tell_what_refinement_changed(rows: list[study.StudyRow]) -> None:
    coarse, fine = rows
    assert coarse.outcome == fine.outcome == str(IndentationOutcome.COMPLETE)
    assert coarse.unknowns < fine.unknowns
    assert np.isnan(coarse.force_change)
    assert not coarse.accepted
    assert fine.force_change == pytest.approx((fine.force_n - coarse.force_n) / fine.force_n)
    assert 0.0 < fine.displacement_change_m < fine.largest_change_m < 0.3e-3
    assert coarse.plain()["force_change"] is None


def test_on_the_same_mesh_nodes_are_compared_without_interpolation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ball = replace(study.PRESSES["sphere_medium"], depth_m=0.3e-3)
    monkeypatch.setattr(study, "PRESSES", {"sphere_medium": ball})
    first, again = study.step_study(edge_m=1.4e-3, steps=(2, 2))
    assert again.force_n == first.force_n
    assert again.largest_change_m == 0.0


def test_a_study_is_drawn(rows: list[study.StudyRow], tmp_path: Path) -> None:
    plot_study(rows, tmp_path / "study.png")
    assert (tmp_path / "study.png").read_bytes().startswith(b"\x89PNG")


@pytest.fixture(scope="module")
def tip() -> Fingertip:
    """Fine enough that the gap, a mean over faces, is open where a path begins and ends."""
    return Fingertip.pressurised(biotac(edge_m=0.7e-3))


@pytest.mark.parametrize(
    ("indenter", "words", "within"),
    [
        ("sphere_medium", "press 1 mm, slide 0.6 mm towards +y, twist 10 deg, unload", 0.15),
        # Its friction is less sure in so few steps: 0.34 off, 0.07 with five times as many.
        ("cylinder_long", "press 0.8 mm at 20 deg towards -y, roll 8 deg towards +y, unload", 0.4),
    ],
)
def test_friction_takes_what_the_indenter_gives_and_nothing_is_left(
    tip: Fingertip, indenter: str, words: str, within: float
) -> None:
    row = study.run_path(tip, indenter, (-6.0, 0.0), words)
    assert row.complete
    assert row.accepted
    assert row.undone_m < study.UNDONE_M
    # On a way that ends where it began, elastic energy gives back what it took.
    assert 1e-6 < row.friction_j
    assert row.friction_j == pytest.approx(row.work_j, rel=within)
    assert not tip.state.traction.any()  # the fingertip is as it was


def test_nothing_is_left_of_a_given_fill_either() -> None:
    """A fingertip that was filled to a volume rested 0.1 um from where each touch left it."""
    filled = replace(FingertipParameters(), fluid_volume_m3=0.6e-6)
    row = study.run_path(
        Fingertip.pressurised(biotac(edge_m=0.8e-3), filled),
        "sphere_large", (-6.0, 0.0), "press 0.5 mm, unload",
    )  # fmt: skip
    assert row.complete
    assert row.undone_m < study.UNDONE_M


def test_without_friction_none_is_taken(tip: Fingertip, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tip, "parameters", replace(tip.parameters, friction_coefficient=0.0))
    row = study.run_path(tip, "sphere_medium", (-6.0, 0.0), "press 1 mm, unload")
    assert row.friction_j == row.friction_least_j == 0.0
    assert abs(row.work_j) < 0.02 * row.force_n * 1e-3
    assert row.accepted


def test_random_paths_say_what_they_run_and_more_begin_alike(tip: Fingertip) -> None:
    paths = list(study.random_paths(tip, 40, 0))
    assert paths[:5] == list(study.random_paths(tip, 5, 0))
    assert paths[:5] != list(study.random_paths(tip, 5, 1))
    assert {indenter for indenter, *_ in paths} == set(indenter_names())
    kinds = [one.kind for *_, words in paths for one in parse_segments(words)]
    assert min(map(kinds.count, ("slide", "twist", "roll"))) > 5
    assert all(words.endswith(", unload") for *_, words in paths)
    for *_, words in paths:
        assert show_segments(parse_segments(words)) == words


def test_a_ledger_takes_back_what_load_stepping_takes_back(tip: Fingertip) -> None:
    surface = OuterSurface(tip.nodes, tip.geometry.mesh.outer_faces)
    target, normal = pad_point(surface, -6e-3, 0.0)
    ball = make_indenter("sphere_medium")
    path = segment_path(ball, target, normal, parse_segments("press 0.6 mm"), surface)
    run = tip.load_stepping(ball, path)
    ledger = study._WorkLedger(run)
    run.increment(path[1], 1.0)
    before = run.at
    run.increment(path[2], 1.0)
    once = list(ledger.work)
    run.at = before
    run.increment(path[2], 1.0)
    assert ledger.work == pytest.approx(once, rel=1e-5)  # the factor at hand is another one
    assert len(ledger.friction) == 2
