"""The table, the film's mesh with its discs, the gap above it with gradients, the residual film."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.fem.mesh_measures import node_areas

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate.errors import ConfigError, SimulationError
from palpate_fem.electrodes import film
from palpate_fem.electrodes.film import FilmMesh, film_mesh, onto
from palpate_fem.electrodes.gap import CLAMP_X_M, GapFinder, gap_adjustment, thickness
from palpate_fem.electrodes.specimen import (
    DISC_DIAMETER_M,
    DISC_TERMINAL,
    TERMINALS,
    SpecimenParameters,
)
from palpate_fem.mesh.core import RigidCore
from palpate_fem.mesh.parametric import biotac
from palpate_fem.mesh.solid import FingertipGeometry, SolidMesh
from palpate_fem.mesh.surface import open_edges

Floats = NDArray[np.float64]
Shell = Callable[..., SolidMesh]


@cache
def finger() -> FingertipGeometry:
    return biotac(edge_m=0.9e-3, layers=1)


def test_the_four_excitation_electrodes_are_one_terminal() -> None:
    assert np.bincount(DISC_TERMINAL).tolist() == [4] + [1] * 19


def check_one_patch(mesh: FilmMesh) -> None:
    """A disc in the sense of topology: no holes, no triangles upon one another."""
    pairs = np.sort(np.concatenate([mesh.faces[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    edges, times = np.unique(pairs, axis=0, return_counts=True)
    assert times.max() == 2
    assert len(mesh.nodes) - len(edges) + len(mesh.faces) == 1
    border = open_edges(mesh.faces)
    assert len(border) == (times == 1).sum()
    follow = dict(border.tolist())
    assert len(follow) == len(border)
    at, seen = border[0, 0], 0
    while seen == 0 or at != border[0, 0]:
        at, seen = follow[at], seen + 1
    assert seen == len(border)  # one loop


@pytest.mark.parametrize("edge", [0.4e-3, 0.55e-3, 0.8e-3])
@pytest.mark.parametrize("recess", [0.0, 0.25e-3])
def test_film_mesh_is_one_sound_patch_on_the_core(edge: float, recess: float) -> None:
    core = finger().core
    mesh = film_mesh(core, edge_m=edge, recess_m=recess)
    distance, gradient, _ = core.grid.evaluate(mesh.nodes)
    np.testing.assert_allclose(distance, -recess, atol=1e-9)
    assert np.einsum("ni,ni->n", gradient, mesh.normals).min() > 0.9
    corner = mesh.nodes[mesh.faces]
    outwards = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    middle = mesh.normals[mesh.faces].mean(axis=1)
    assert (np.einsum("fi,fi->f", outwards, middle) > 0).all()
    check_one_patch(mesh)
    area = 441e-6 if recess == 0 else 412e-6  # section 4.3 has 441 mm^2 on another core
    assert mesh.areas.sum() == pytest.approx(area, rel=0.03)


def test_discs_have_their_area_and_grow_smoothly() -> None:
    core = finger().core
    diameters = np.linspace(2.4e-3, 2.6e-3, 5)
    areas = []
    for diameter in diameters:
        mesh = film_mesh(core, disc_diameter_m=float(diameter))
        check_one_patch(mesh)
        areas.append([mesh.areas[mesh.terminal == i].sum() for i in range(TERMINALS)])
    wanted = np.pi / 4 * diameters[:, None] ** 2 * np.array([4] + [1] * 19)
    np.testing.assert_allclose(areas, wanted, rtol=0.02)
    bend = np.diff(np.log(areas), 2, axis=0) - np.diff(np.log(wanted), 2, axis=0)
    assert np.abs(bend).max() < 1e-3


def test_rings_of_nodes_stand_about_each_disc() -> None:
    """The current leaves at the rim: 71 nodes within it, a disc's own triangles between them."""
    core = finger().core
    mesh = film_mesh(core)
    assert np.bincount(mesh.terminal + 1)[1:].tolist() == [4 * 116] + [116] * 19
    radius = DISC_DIAMETER_M / 2
    for electrode, centre in enumerate(onto(core, ELECTRODE_POSITIONS)[0], start=1):
        (terminal,) = np.unique(DISC_TERMINAL[electrode - 1])
        own = np.unique(mesh.faces[mesh.terminal == terminal])
        distance = np.sort(np.linalg.norm(mesh.nodes[own] - centre, axis=1)) / radius
        shares = np.repeat([0.0, 0.4, 0.7, 0.88, 1.0], [1, 8, 14, 24, 24])
        # On the curved core a disc is stretched by up to 7 % to keep its area.
        np.testing.assert_allclose(distance, shares, rtol=0.08, atol=1e-9)


@pytest.mark.parametrize(
    ("recess_m", "edge_m", "nodes", "area_mm2", "back_mm"),
    [(0.0, 0.55e-3, 3430, 445.707, -6.10), (0.0, 0.8e-3, 3001, 445.228, -6.05),
     (0.25e-3, 0.55e-3, 3366, 412.713, -6.12)],
)  # fmt: skip
def test_film_mesh_is_the_one_that_results_were_made_on(
    recess_m: float, edge_m: float, nodes: int, area_mm2: float, back_mm: float
) -> None:
    mesh = film_mesh(finger().core, recess_m=recess_m, edge_m=edge_m)
    assert len(mesh.nodes) == nodes
    assert mesh.areas.sum() * 1e6 == pytest.approx(area_mm2, abs=2e-3)
    middle_m = mesh.nodes.mean(axis=0)
    assert middle_m[0] * 1e3 == pytest.approx(back_mm, abs=6e-3)
    assert abs(middle_m[1]) < 1e-12, "symmetric"


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_edges_are_flipped_until_opposite_angles_are_small(tilt: float) -> None:
    """A rhombus: cut along its long diagonal, and then along the short one. In space, too."""
    corners = np.array([[-2.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, -1.0, tilt], [0.0, 1.0, tilt]])
    long_cut = np.array([[0, 1, 3], [1, 0, 2]], np.int32)
    short_cut = np.array([[2, 3, 0], [3, 2, 1]], np.int32)
    for faces in (long_cut, short_cut):
        found = {frozenset(face) for face in film._flipped(1e-3 * corners, faces).tolist()}
        assert found == {frozenset({0, 2, 3}), frozenset({1, 2, 3})}


@pytest.mark.parametrize("key", ["edge_m", "disc_diameter_m", "recess_m"])
def test_film_mesh_refuses_slips_of_units(key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        film_mesh(finger().core, **{key: 2.5})


def test_electrodes_must_fit_the_core(ball: Callable[..., RigidCore]) -> None:
    with pytest.raises(ConfigError, match="disc"):
        film_mesh(ball(2.5e-3))


def sphere_film(shell: Shell, radius: float) -> FilmMesh:
    skin = shell(10, 1, radius, radius + 1e-3)
    used, faces = np.unique(skin.inner_faces, return_inverse=True)
    quads = faces.reshape(-1, 4)
    points = skin.nodes[used]
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)
    normals = points / np.linalg.norm(points, axis=1)[:, None]
    return FilmMesh(points, normals, triangles, np.zeros(len(triangles), np.int32))


def test_gap_between_spheres(shell: Shell) -> None:
    film, skin = sphere_film(shell, 2.5e-3), shell(24, 1, 3e-3, 4e-3)
    finder = GapFinder(film, skin)
    sagitta = 4.5e-6  # of triangles with edges up to 0.33 mm on 3 mm
    np.testing.assert_allclose(finder.measure(skin.nodes).gap, 0.5e-3, atol=sagitta)
    # Moved as a whole, far enough that every normal meets other triangles.
    shift = np.array([0.1e-3, -0.35e-3, 0.2e-3])
    along = film.normals @ shift
    exact = along + np.sqrt(along**2 + (3e-3) ** 2 - shift @ shift) - 2.5e-3
    np.testing.assert_allclose(finder.measure(skin.nodes + shift).gap, exact, atol=2 * sagitta)


def test_pressure_is_that_of_the_nodal_forces(shell: Shell) -> None:
    film, skin = sphere_film(shell, 2.5e-3), shell(24, 1, 3e-3, 4e-3)
    finder = GapFinder(film, skin)
    areas = node_areas(skin.nodes, finder.faces)
    out = skin.nodes / np.linalg.norm(skin.nodes, axis=1)[:, None]
    gap = finder.measure(skin.nodes, 20e3 * areas[:, None] * out)
    np.testing.assert_allclose(gap.pressure, 20e3, rtol=5e-3)
    assert not finder.measure(skin.nodes, -20e3 * areas[:, None] * out).pressure.any()  # no pull


def test_gap_gradient_is_that_of_differences() -> None:
    geometry = finger()
    finder = GapFinder(film_mesh(geometry.core), geometry.mesh)
    rng = np.random.default_rng(3)
    # Off the symmetric state, whose normals meet edges, where the gap has a kink.
    position = geometry.mesh.nodes + 1e-5 * rng.normal(size=geometry.mesh.nodes.shape)
    gap = finder.measure(position)
    way = rng.normal(size=position.shape)
    step = 1e-10
    ahead, behind = (finder.measure(position + sign * step * way).gap for sign in (1, -1))
    moved = np.einsum("nk,nki->ni", gap.weights, way[gap.nodes])
    answer = np.einsum("ni,ni->n", moved, gap.slope)
    np.testing.assert_allclose(answer, (ahead - behind) / (2 * step), atol=1e-6)
    weight = rng.normal(size=len(answer))
    assert (gap.to_skin(weight, len(position)) * way).sum() == pytest.approx(weight @ answer)


def test_a_skin_that_is_not_there_is_refused(shell: Shell) -> None:
    film = sphere_film(shell, 2.5e-3)
    skin = shell(6, 1, 30e-3, 40e-3)
    with pytest.raises(SimulationError, match="miss the skin"):
        GapFinder(film, skin)


@settings(max_examples=60)
@given(
    gap=st.floats(-5e-6, 2e-3),
    pressure=st.floats(0, 2e6),
    exponent=st.floats(0.3, 2.0),
)
def test_residual_film_falls_to_its_floor(gap: float, pressure: float, exponent: float) -> None:
    specimen = SpecimenParameters(squeeze_exponent=exponent)
    h, by_gap, by_pressure = thickness(np.array(gap), np.array(pressure), specimen)
    assert specimen.floor_m < h <= max(gap, 0) + specimen.asperity_m + 1e-6
    assert 0 <= by_gap <= 1
    assert by_pressure <= 0
    step = 1e-4 * (1e3 + pressure)
    harder = thickness(np.array(gap), np.array(pressure + step), specimen)[0]
    slope = (harder - thickness(np.array(gap), np.array(max(pressure - step, 0)), specimen)[0]) / (
        step + min(step, pressure)
    )
    assert slope == pytest.approx(float(by_pressure), rel=2e-3, abs=1e-16)


def test_clamp_closes_the_film_behind_its_edge() -> None:
    specimen = SpecimenParameters(clamp_closing=0.8, core_offset_m=(0.0, 0.0, -0.2e-3))
    points = np.array([[CLAMP_X_M + dx, 0.0, 0.0] for dx in (-4e-3, 0.0, 4e-3)])
    below = np.tile([0.0, 0.0, -1.0], (3, 1))
    share, nearer = gap_adjustment(points, below, specimen)
    np.testing.assert_allclose(share, [0.2, 0.6, 1.0], atol=3e-3)
    np.testing.assert_allclose(nearer, 0.2e-3 * share)  # held there, core and skin move together
    open_behind = replace(specimen, clamp_closing=0.0)
    np.testing.assert_array_equal(gap_adjustment(points, below, open_behind)[0], 1.0)


def test_sides_stand_nearer_and_the_pad_does_not() -> None:
    specimen = SpecimenParameters(side_closing_m=0.4e-3)
    angle = np.radians([0.0, 44.0, 60.0, 77.0, 95.0])
    normals = np.stack([0 * angle, np.sin(angle), -np.cos(angle)], axis=1)
    points = 5e-3 * (normals - [1.0, 0.0, 0.0])
    share, nearer = gap_adjustment(points, normals, specimen)
    np.testing.assert_allclose(nearer[[0, 1, 3, 4]], [0.0, 0.0, 0.4e-3, 0.4e-3], atol=1e-9)
    assert 0.05e-3 < nearer[2] < 0.35e-3
    mirror = np.array([1, -1, 1])
    mirrored = gap_adjustment(points * mirror, normals * mirror, specimen)[1]
    np.testing.assert_array_equal(nearer, mirrored)
    gap = share * np.full(5, 1e-3) - nearer
    np.testing.assert_allclose(gap, 1e-3 - nearer, rtol=1e-4)  # the clamp is not quite gone
