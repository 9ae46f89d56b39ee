"""The parametric BioTac: dimensions, symmetry, quality, and what it refuses."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.fem.mesh_measures import solid_volume

from palpate.errors import ConfigError
from palpate_fem.config import FingertipParameters
from palpate_fem.mesh.check import check_mesh, scaled_jacobians
from palpate_fem.mesh.parametric import GRID_M, NAIL_X_M, NAIL_Y_M, biotac
from palpate_fem.mesh.shape import CavityShape, CoreShape
from palpate_fem.mesh.solid import FingertipGeometry
from palpate_fem.mesh.surface import enclosed_volume, face_vectors, node_normals
from palpate_fem.population.responses import geometry_of
from palpate_fem.store.content import StoredFingertip

Floats = NDArray[np.float64]

# Of the public mesh (docs: finite-element anchors): what the parametric one stands for.
CAVITY_M3, SKIN_M3, FILM_M3 = 1765e-9, 1631e-9, 366e-9
# The parametric core keeps clear of the skin dorsally (220 mm^2 of 0.15 mm) and at the proximal
# end, where the public core touches or cuts it: 45 mm^3 of 366.
CLEARED = 0.14


@pytest.fixture(scope="module")
def tip() -> FingertipGeometry:
    return biotac()


def test_the_default_mesh_is_as_fine_as_asked(tip: FingertipGeometry) -> None:
    mesh = tip.mesh
    assert mesh.elements.shape[1] == 8
    assert len(mesh.outer_nodes) + len(mesh.inner_nodes) > 4000
    assert 30_000 <= 3 * (len(mesh.nodes) - len(mesh.fixed)) <= 34_500
    places = mesh.nodes[mesh.inner_faces]
    edge = np.linalg.norm(places - np.roll(places, 1, axis=1), axis=2)
    middle = places.mean(axis=1)
    pad = (middle[:, 2] < 0) & (middle[:, 0] > -14e-3)
    assert 0.40e-3 < edge[pad].mean() < 0.46e-3
    assert edge[pad].max() < 0.75e-3


def test_volumes_and_extent_are_those_of_the_public_part(tip: FingertipGeometry) -> None:
    mesh = tip.mesh
    cavity = enclosed_volume(mesh.nodes, mesh.inner_faces)
    assert cavity == pytest.approx(CAVITY_M3, rel=0.005)
    assert solid_volume(mesh) == pytest.approx(SKIN_M3, rel=0.01)
    assert cavity - tip.core.volume_m3 == pytest.approx(FILM_M3, rel=CLEARED)
    low, high = mesh.nodes.min(axis=0) * 1e3, mesh.nodes.max(axis=0) * 1e3
    np.testing.assert_allclose(low, [-20.61, -7.11, -8.31], atol=0.03)
    np.testing.assert_allclose(high, [7.35, 7.11, 5.33], atol=0.03)


def test_the_mesh_is_its_own_mirror_image_bit_by_bit(tip: FingertipGeometry) -> None:
    mesh = tip.mesh
    np.testing.assert_array_equal(mesh.nodes[mesh.mirror] * [1, -1, 1], mesh.nodes)
    np.testing.assert_array_equal(np.sort(mesh.mirror[mesh.fixed]), mesh.fixed)
    for faces in (mesh.outer_faces, mesh.inner_faces):
        ours = np.unique(np.sort(faces, axis=1), axis=0)
        np.testing.assert_array_equal(np.unique(np.sort(mesh.mirror[faces], axis=1), axis=0), ours)
    grid = tip.core.grid
    np.testing.assert_allclose(grid.coefficients, grid.coefficients[:, ::-1], rtol=0, atol=1e-16)


def test_the_core_starts_free_of_the_skin(tip: FingertipGeometry) -> None:
    mesh = tip.mesh
    inner = mesh.nodes[mesh.inner_faces]
    between = (inner + np.roll(inner, 1, axis=1)) / 2
    points = np.concatenate([inner.reshape(-1, 3), between.reshape(-1, 3), inner.mean(axis=1)])
    gap, _, _ = tip.core.grid.evaluate(points)
    assert gap.min() > 0.05e-3
    facing = node_normals(mesh.nodes, mesh.inner_faces)[mesh.inner_nodes]
    gap, _, _ = tip.core.grid.evaluate(mesh.nodes[mesh.inner_nodes])
    assert 1.1e-3 < np.median(gap[facing[:, 2] < -0.7]) < 1.5e-3  # under the pad
    assert 0.1e-3 < np.median(gap[facing[:, 2] > 0.7]) < 0.3e-3


def test_nail_and_clamp_hold_what_they_touch(tip: FingertipGeometry) -> None:
    mesh = tip.mesh
    held = np.isin(mesh.outer_faces, mesh.fixed).all(axis=1)
    area = np.linalg.norm(face_vectors(mesh.nodes, mesh.outer_faces), axis=1)
    middle = mesh.nodes[mesh.outer_faces].mean(axis=1)
    clamp = middle[:, 0] < -19e-3
    assert area[held & ~clamp].sum() == pytest.approx(120e-6, rel=0.05)
    assert area[held & clamp].sum() == pytest.approx(59e-6, rel=0.05)
    nail = middle[held & ~clamp]
    np.testing.assert_allclose(nail[:, 2], 3.48e-3, atol=0.1e-3)  # the hump begins there
    # The grid has lines where the slab ends.
    corners = mesh.nodes[mesh.outer_faces[held & ~clamp]].reshape(-1, 3)
    assert np.abs(corners[:, 0].min() - NAIL_X_M[0]) < 0.3e-3
    inner = mesh.nodes[mesh.outer_faces[held & ~clamp].ravel() - 2]
    assert np.abs(inner[:, 1]).max() == pytest.approx(NAIL_Y_M, abs=1e-5)


def test_the_facet_is_where_the_electrode_table_says(tip: FingertipGeometry, root: Path) -> None:
    page = (root / "docs" / "conventions.md").read_text()
    rows = re.findall(r"^\| E(\d+) \|((?: -?\d+\.\d+ \|){6})$", page, flags=re.MULTILINE)
    table = np.array([[float(word) for word in row.split("|")[:6]] for _, row in rows])
    gap, gradient, _ = tip.core.grid.evaluate(table[:, :3] * 1e-3)
    np.testing.assert_allclose(gap[7:10], 0, atol=2e-6)  # E8 E9 E10
    # A spline rings a little up to 1 mm from an edge.
    np.testing.assert_allclose(gradient[7:10], table[7:10, 3:], atol=0.01)
    # The others lie below the surface, as on the public core, by the same 0.25 mm.
    np.testing.assert_allclose(gap[np.r_[0:6, 10:19]], -0.25e-3, atol=0.03e-3)


def test_the_tabulated_core_is_the_core(tip: FingertipGeometry) -> None:
    shape = CoreShape(CavityShape())
    grid = tip.core.grid
    on_surface, _, _ = grid.evaluate(tip.core.vertices)
    assert np.sqrt((on_surface**2).mean()) < 1e-6
    assert np.abs(on_surface).max() < 20e-6
    _, exact = shape(tip.core.vertices)
    exact /= np.linalg.norm(exact, axis=1)[:, None]
    _, gradient, _ = grid.evaluate(tip.core.vertices)
    assert np.sqrt(((gradient - exact) ** 2).sum(axis=1).mean()) < 0.02


@pytest.mark.parametrize("body", [CavityShape(), CoreShape(CavityShape())])
def test_the_gradient_of_a_shape_is_exact(body: CavityShape | CoreShape) -> None:
    low, high = np.array([-20e-3, -6e-3, -7e-3]), np.array([6.5e-3, 6e-3, 4e-3])
    points = np.random.default_rng(4).uniform(low, high, (2000, 3))
    points = points[np.abs(body(points)[0]) < 1.5e-3]
    _, gradient = body(points)
    step = 1e-9
    numeric = np.stack(
        [(body(points + d)[0] - body(points - d)[0]) / (2 * step) for d in step * np.eye(3)], 1
    )
    off = np.linalg.norm(gradient - numeric, axis=1)
    # A point may have a kink of the slope within a step.
    assert np.quantile(off, 0.995) < 1e-5


def test_thickness_moves_nodes_along_straight_lines_and_changes_nothing_else() -> None:
    thin, middle, thick = (biotac(thickness_m=t, edge_m=1e-3).mesh for t in (1e-3, 1.5e-3, 2e-3))
    np.testing.assert_allclose(thin.nodes + thick.nodes, 2 * middle.nodes, rtol=0, atol=2 * GRID_M)
    np.testing.assert_array_equal(thin.elements, thick.elements)
    np.testing.assert_array_equal(thin.fixed, thick.fixed)
    assert len({mesh.sha256 for mesh in (thin, middle, thick)}) == 3


def test_equal_builds_have_equal_hashes() -> None:
    from palpate_fem.mesh import parametric

    first = biotac(edge_m=1e-3).mesh.sha256
    parametric._surface.cache_clear()
    assert biotac(edge_m=1e-3).mesh.sha256 == first


@pytest.mark.parametrize("edge_mm", [0.35, 0.45, 0.7, 1.0])
@pytest.mark.parametrize("thickness_mm", [1.0, 2.0])
@pytest.mark.parametrize("layers", [1, 3])
def test_elements_are_good_over_the_whole_range(
    edge_mm: float, thickness_mm: float, layers: int
) -> None:
    tip = biotac(edge_m=edge_mm * 1e-3, thickness_m=thickness_mm * 1e-3, layers=layers)
    mesh = tip.mesh
    check_mesh(mesh)
    corner = mesh.nodes[mesh.inner_faces]
    middles = np.concatenate(
        [corner.mean(axis=1), ((corner + np.roll(corner, 1, 1)) / 2).reshape(-1, 3)]
    )
    assert tip.core.grid.evaluate(middles)[0].min() > 5e-6  # facets do not cut into the core
    assert scaled_jacobians(mesh.nodes, mesh.elements).min() > 0.5


@pytest.mark.parametrize(
    "wrong",
    [
        {"thickness_m": 1.57},
        {"thickness_m": float("nan")},
        {"edge_m": 0.0},
        {"edge_m": float("inf")},
        {"layers": 0},
    ],
)
def test_what_is_out_of_range_is_refused_by_name(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        biotac(**wrong)  # type: ignore[arg-type]


def test_the_edge_is_in_whole_micrometres_as_the_name_holds_it() -> None:
    """Else a store's mesh could not be built again for its electrodes."""
    with pytest.raises(ConfigError, match="whole micrometres") as refused:
        biotac(edge_m=1.2346e-3)
    assert refused.value.remedy == "give 0.001235, or as an option 1.235 mm"
    geometry = biotac(edge_m=1.235e-3)
    stored = SimpleNamespace(mesh=geometry.mesh, parameters=FingertipParameters())
    again = geometry_of(cast("StoredFingertip", stored))
    assert again.mesh.sha256 == geometry.mesh.sha256


def test_the_mesh_has_the_same_bits_on_other_processors() -> None:
    """NumPy without the newer instructions gives sines and roots another last bit."""
    program = (
        "from palpate_fem.mesh.parametric import biotac;"
        "print(biotac(edge_m=0.6e-3).mesh.sha256.hex())"
    )
    plain = {"NPY_DISABLE_CPU_FEATURES": "X86_V3,X86_V4"}
    digests = {
        subprocess.run(
            [sys.executable, "-c", program],
            env={**os.environ, **features},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for features in ({}, plain)
    }
    assert digests == {biotac(edge_m=0.6e-3).mesh.sha256.hex() + "\n"}
