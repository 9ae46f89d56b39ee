"""Studies: rows that compare with the row before, and a field carried from mesh to mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from palpate_fem import study
from palpate_fem.plot.validation import plot_study
from palpate_fem.result import IndentationOutcome


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
        patch.setattr(study, "DEPTH_M", 0.3e-3)
        patch.setattr(study, "PRESSES", {"sphere_medium": (0.0, 0.0, 1.0)})
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


def test_a_study_is_drawn(rows: list[study.StudyRow], tmp_path: Path) -> None:
    plot_study(rows, tmp_path / "study.png")
    assert (tmp_path / "study.png").read_bytes().startswith(b"\x89PNG")
