"""Cuts and outlines are where geometry says; pictures are written, and refused with a reason."""

from __future__ import annotations

import errno
import importlib
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import ConfigError, DatasetError
from palpate_fem.plot.section import cut_sides, cut_solid, cut_surface, outline
from palpate_fem.plot.step import plot_step, von_mises
from palpate_fem.plot.trajectories import plot_overview, travel_m
from palpate_fem.result import IndentationOutcome, IndentationResult
from palpate_fem.store.content import Outline, StoredFingertip, TrajectorySummary

sample: Any = importlib.import_module("stored_sample")
INNER_M: float = sample.INNER_M
OUTER_M: float = sample.OUTER_M
indenter_outline: Callable[[str], Outline] = sample.indenter_outline
sample_fingertip: Callable[..., StoredFingertip] = sample.sample_fingertip
sample_trajectory: Callable[..., IndentationResult] = sample.sample_trajectory
sphere_outline: Callable[..., Outline] = sample.sphere_outline

FACETS = 0.03
"""A ball of 24 facets around has 1.1 % less section than a round one, off its centre up to 3 %."""

ROUNDING = 1e-12
"""Metres of a fingertip in float64."""


@pytest.fixture(scope="module")
def tip() -> StoredFingertip:
    return sample_fingertip(divisions=6)


@pytest.fixture(scope="module")
def press(tip: StoredFingertip) -> IndentationResult:
    return sample_trajectory(tip, steps=6, angle=0.2)


def _wedges(elements: np.ndarray) -> np.ndarray:
    """Each hexahedron as two wedges."""
    return np.concatenate([elements[:, [0, 1, 2, 4, 5, 6]], elements[:, [0, 2, 3, 4, 6, 7]]])


@pytest.mark.parametrize("wedges", [False, True])
@pytest.mark.parametrize(("axis", "at_m"), [(1, 0.0), (1, 1.3e-3), (0, -2e-3), (2, 4e-3)])
def test_section_of_a_shell(tip: StoredFingertip, wedges: bool, axis: int, at_m: float) -> None:
    nodes = tip.mesh.nodes
    elements = _wedges(tip.mesh.elements) if wedges else tip.mesh.elements
    cut = cut_solid(nodes, elements, axis=axis, at_m=at_m)
    points = cut.at(nodes)
    np.testing.assert_allclose(points[:, axis], at_m, atol=1e-10 + ROUNDING)
    corners = points[cut.triangles]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    assert 0.5 * area.sum() == pytest.approx(np.pi * (OUTER_M**2 - INNER_M**2), rel=FACETS)
    # A linear field is the same on both sides of interpolation.
    field = nodes @ [1.0, -2.0, 3.0] + 0.5
    np.testing.assert_allclose(cut.at(field), points @ [1.0, -2.0, 3.0] + 0.5, atol=ROUNDING)
    # Each triangle lies in the element that it says it is cut from.
    boxes = nodes[elements[cut.elements]]
    middle = corners.mean(axis=1)
    assert (middle >= boxes.min(axis=1) - ROUNDING).all()
    assert (middle <= boxes.max(axis=1) + ROUNDING).all()


def test_sides_are_the_lines_between_elements(tip: StoredFingertip) -> None:
    lines = cut_sides(tip.mesh.nodes, tip.mesh.elements, axis=1, at_m=1.0e-3)
    np.testing.assert_allclose(lines[:, :, 1], 1.0e-3, atol=ROUNDING)
    whole = np.linalg.norm(lines[:, 0] - lines[:, 1], axis=1).sum()
    round_ = sum(2 * np.pi * np.sqrt(r**2 - 1e-6) for r in np.linspace(INNER_M, OUTER_M, 3))
    # Three circles and the spokes between, 24 or a few more of them, 1.5 mm each.
    assert round_ * (1 - FACETS) < whole < round_ + 30 * 1.6e-3


def test_surface_is_cut_into_one_closed_loop() -> None:
    vertices, triangles = sphere_outline(5e-3, 6)
    for at_m in (0.0, 2e-3):
        (loop,) = cut_surface(np.asarray(vertices), triangles, axis=1, at_m=at_m)
        np.testing.assert_array_equal(loop[0], loop[-1])
        x, z = loop[:, 0], loop[:, 2]
        area = 0.5 * abs(np.sum(x[:-1] * z[1:] - x[1:] * z[:-1]))
        assert area == pytest.approx(np.pi * (25e-6 - at_m**2), rel=FACETS)
    assert cut_surface(np.asarray(vertices), triangles, axis=1, at_m=6e-3) == []


def test_open_surface_is_cut_into_one_open_line() -> None:
    vertices = np.array([[x, y, 0.0] for x in range(4) for y in (0.0, 1.0)])
    triangles = np.array(
        [[2 * a + b, 2 * a + 1 + b, 2 * a + 2 + b] for a in range(3) for b in (0, 1)]
    )
    (line,) = cut_surface(vertices, triangles[[3, 0, 5, 1, 4, 2]], axis=1, at_m=0.5)
    assert sorted([line[0, 0], line[-1, 0]]) == [0.0, 3.0]
    assert np.abs(np.diff(line[:, 0])).sum() == pytest.approx(3.0)


def test_outline_of_a_patch() -> None:
    faces = np.array([[0, 1, 4, 3], [1, 2, 5, 4]])
    edges = {tuple(sorted(edge)) for edge in outline(faces).tolist()}
    assert edges == {(0, 1), (1, 2), (2, 5), (4, 5), (3, 4), (0, 3)}
    assert len(outline(np.array([[0, 1, 2], [2, 1, 3]]))) == 4


def test_von_mises_of_simple_states() -> None:
    tension, shear, pressure = np.eye(6)[0], np.eye(6)[3], np.array([1.0, 1, 1, 0, 0, 0])
    np.testing.assert_allclose(von_mises(np.stack([5 * tension, 5 * shear, 5 * pressure])),
                               [5.0, 5 * np.sqrt(3), 0.0], atol=ROUNDING)  # fmt: skip


def test_travel_follows_the_path() -> None:
    path = np.zeros((3, 7))
    path[1, :3], path[2, :3] = (0, 0, 2e-3), (1.5e-3, 0, 0)
    np.testing.assert_allclose(travel_m(path, path[1:]), [2e-3, 4.5e-3])
    np.testing.assert_allclose(travel_m(path, path), [0, 2e-3, 4.5e-3])
    assert travel_m(path, path[:0]).shape == (0,)
    assert travel_m(path[:0], path[:0]).shape == (0,)


def _is_picture(path: Path) -> bool:
    return path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and path.stat().st_size > 20_000


@pytest.mark.parametrize("quantity", ["displacement", "von_mises"])
def test_step_is_drawn(
    tip: StoredFingertip, press: IndentationResult, tmp_path: Path, quantity: str
) -> None:
    path = tmp_path / "new" / "step.png"
    body = indenter_outline("sphere_medium") if quantity == "displacement" else None
    plot_step(tip, press, path, quantity=quantity, indenter=body, step=3)  # type: ignore[arg-type]
    assert _is_picture(path)


def test_wedges_and_no_contact_are_drawn(tip: StoredFingertip, tmp_path: Path) -> None:
    mesh = tip.mesh
    outer, inner = (np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
                    for faces in (mesh.outer_faces, mesh.inner_faces))  # fmt: skip
    thin = replace(
        tip,
        mesh=replace(mesh, elements=_wedges(mesh.elements), outer_faces=outer, inner_faces=inner),
    )
    path = tmp_path / "step.png"
    plot_step(thin, sample_trajectory(tip, steps=2, depth_m=-1e-4), path, y_m=1e-3)
    assert _is_picture(path)


def test_what_cannot_be_drawn_is_refused(
    tip: StoredFingertip, press: IndentationResult, tmp_path: Path
) -> None:
    path = tmp_path / "step.png"
    with pytest.raises(ConfigError, match="no step 6"):
        plot_step(tip, press, path, step=6)
    bare = replace(
        press, steps=tuple(replace(step, stress=np.zeros((0, 6))) for step in press.steps)
    )
    with pytest.raises(ConfigError, match="trajectory was not kept"):
        plot_step(tip, bare, path, quantity="von_mises")
    with pytest.raises(DatasetError, match="no trajectory"):
        plot_overview([], path)
    path.mkdir()
    with pytest.raises(DatasetError, match="cannot write"):
        plot_step(tip, press, path)


def test_a_full_disk_leaves_the_picture_that_was_there(
    tip: StoredFingertip, press: IndentationResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "step.png"
    plot_step(tip, press, path)
    before = path.read_bytes()

    def half(_: Any, file: Path, **__: Any) -> None:
        Path(file).write_bytes(before[: len(before) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", half)
    with pytest.raises(DatasetError, match="No space left"):
        plot_step(tip, press, path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_overview_counts_outcomes(press: IndentationResult, tmp_path: Path) -> None:
    outcomes = [IndentationOutcome.COMPLETE] * 5 + [
        IndentationOutcome.FORCE_LIMIT,
        IndentationOutcome.DIVERGED,
    ]
    summaries = [
        TrajectorySummary(
            id=f"{at}", indenter=("cube", "ring", "sphere")[at % 3], sensor="", outcome=outcome,
            reason="", complete=outcome is IndentationOutcome.COMPLETE, travel_m=1e-3, seconds=8.0,
            path=press.path, pose=press.path[1:], force=press.forces, fluid_pressure_pa=np.zeros(6),
        )
        for at, outcome in enumerate(outcomes)
    ]  # fmt: skip
    path = tmp_path / "overview.png"
    assert plot_overview(summaries, path, title="sweep") == Counter(outcomes)
    assert _is_picture(path)
    measured = [replace(item, seconds=float("nan")) for item in summaries]
    measured.append(replace(measured[0], pose=np.zeros((0, 7)), force=np.zeros((0, 3))))
    assert plot_overview(measured, path)[IndentationOutcome.COMPLETE] == 6
