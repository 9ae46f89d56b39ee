"""The reader of the public BioTac: what it builds, and which files it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from tests.fem.mesh_measures import node_areas, solid_volume

from palpate.errors import ConfigError
from palpate_fem.mesh.check import scaled_jacobians
from palpate_fem.mesh.core import signed_distance
from palpate_fem.mesh.nvlabs import (
    PARTS,
    SKIN,
    boundary,
    read_nvlabs,
    read_obj,
    read_tet,
    to_sensor_frame,
)
from palpate_fem.mesh.parametric import biotac
from palpate_fem.mesh.solid import FingertipGeometry
from palpate_fem.mesh.surface import components, enclosed_volume, node_normals


@pytest.fixture(scope="module")
def folder(shared_data: Path) -> Path:
    return shared_data / "nvlabs_biotac_mesh"


@pytest.fixture(scope="module")
def public(folder: Path) -> FingertipGeometry:
    return read_nvlabs(folder)


def test_the_skin_has_the_public_volumes(public: FingertipGeometry) -> None:
    mesh = public.mesh
    assert mesh.elements.shape == (2 * 3168, 6)
    assert len(mesh.nodes) == 3 * 1586
    assert enclosed_volume(mesh.nodes, mesh.inner_faces) * 1e9 == pytest.approx(1764.7, abs=0.1)
    assert solid_volume(mesh) * 1e9 == pytest.approx(1631, rel=0.01)
    assert scaled_jacobians(mesh.nodes, mesh.elements).min() > 0.2
    low, high = mesh.nodes.min(axis=0) * 1e3, mesh.nodes.max(axis=0) * 1e3
    np.testing.assert_allclose(low, [-20.61, -7.11, -8.31], atol=0.06)
    np.testing.assert_allclose(high, [7.35, 7.11, 5.33], atol=0.06)


def test_the_core_starts_free_of_the_skin(public: FingertipGeometry) -> None:
    mesh, core = public.mesh, public.core
    corner = mesh.nodes[mesh.inner_faces]
    points = np.concatenate([corner.reshape(-1, 3), corner.mean(axis=1)])
    gap, _, _ = core.grid.evaluate(points)
    assert gap.min() > 5e-6
    assert core.volume_m3 * 1e9 == pytest.approx(1398.5, rel=0.01)  # less what is cut back


SLABS = {"nail": (2, -1.0, 114.1e-6), "clamp": (0, 1.0, 53.4e-6)}  # axis, side, area [m^2]


@pytest.mark.parametrize("name", SLABS)
def test_nail_and_clamp_hold_what_lies_on_them(
    public: FingertipGeometry, folder: Path, name: str
) -> None:
    # Their outlines are round: a box around them reaches 1 mm farther at its corners.
    axis, side, area = SLABS[name]
    vertices, faces = read_obj(folder / PARTS)
    vertices = to_sensor_frame(vertices)
    label = components(faces, len(vertices))
    parts = [vertices[np.unique(faces[label == i])] for i in np.unique(label)]
    slab = max((p for p in parts if len(p) < 100), key=lambda p: -side * p[:, axis].mean())
    planes = ConvexHull(slab).equations  # both are convex
    facing = planes[:, axis] * side > 0.99
    mesh = public.mesh
    outer = mesh.nodes[mesh.outer_nodes]
    beyond = (outer @ planes[~facing, :3].T + planes[~facing, 3]).max(axis=1)
    gap = (outer @ planes[facing, :3].T + planes[facing, 3]).max(axis=1)
    held = np.isin(mesh.outer_nodes, mesh.fixed) & (np.abs(gap) < 0.15e-3)
    grown_off_m = 0.1e-3
    assert beyond[held].max() < grown_off_m
    assert held[(beyond < -grown_off_m) & (np.abs(gap) < grown_off_m)].all()
    share = node_areas(mesh.nodes, mesh.outer_faces)[mesh.outer_nodes]
    assert share[held].sum() == pytest.approx(area, rel=0.03)


def test_nothing_else_is_held_whatever_the_thickness(
    public: FingertipGeometry, folder: Path
) -> None:
    mesh = public.mesh
    clamp = np.abs(mesh.nodes[mesh.fixed, 0] + 20.61e-3) < 0.1e-3
    nail = np.abs(mesh.nodes[mesh.fixed, 2] - 3.48e-3) < 0.1e-3
    assert (clamp ^ nail).all()
    thin = read_nvlabs(folder, thickness_m=1.2e-3, layers=1).mesh
    np.testing.assert_array_equal(thin.fixed // 2, mesh.fixed // 3)


def test_slabs_away_from_the_skin_are_refused(folder: Path, tmp_path: Path) -> None:
    vertices, faces = read_obj(folder / PARTS)
    label = components(faces, len(vertices))
    core = np.argmax(np.bincount(label))
    vertices[np.unique(faces[label != core])] += [0.0, 0.1e-3, 0.0]  # lifts the nail
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces.tolist()]
    with pytest.raises(ConfigError, match="do not touch"):
        read_nvlabs(copy(folder, tmp_path, obj="\n".join(lines)))


def test_the_parametric_skin_lies_on_the_public_one(
    public: FingertipGeometry, folder: Path
) -> None:
    # Inner surfaces: those of the files, not what was grown from them.
    theirs, ours = public.mesh, biotac().mesh
    points = ours.nodes[ours.inner_nodes]
    facing = node_normals(ours.nodes, ours.inner_faces)[ours.inner_nodes]
    distance, _ = signed_distance(points, theirs.nodes, theirs.inner_faces)
    touched = (facing[:, 2] < 0.3) & (points[:, 0] > -18.5e-3)  # ventral and lateral
    assert np.abs(distance[touched]).mean() < 0.04e-3
    assert np.abs(distance[touched]).max() < 0.12e-3
    # Outer surface of the files.
    vertices, tets = read_tet(folder / SKIN)
    vertices = to_sensor_frame(vertices)
    points = ours.nodes[ours.outer_nodes]
    distance, _ = signed_distance(points, vertices, boundary(tets, vertices))
    outside = distance[(points[:, 2] < 1e-3) & (points[:, 0] > -19e-3)]
    assert np.abs(outside).mean() < 0.04e-3
    assert np.abs(outside).max() < 0.15e-3


def copy(folder: Path, to: Path, **changes: str) -> Path:
    for path in (SKIN, PARTS):
        (to / path).parent.mkdir(parents=True, exist_ok=True)
        text = changes.get(path.suffix[1:], (folder / path).read_text())
        (to / path).write_text(text)
    return to


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"int_ext_skin_combined_ftw\.tet"):
        read_nvlabs(tmp_path)


def test_an_open_skin_is_refused(folder: Path, tmp_path: Path) -> None:
    # Without the tetrahedra at the tip the cavity is open to the outside.
    vertices, tets = read_tet(folder / SKIN)
    kept = tets[vertices[tets].mean(axis=1)[:, 0] > -20e-3]
    lines = [f"v {x!r} {y!r} {z!r} 0" for x, y, z in vertices.tolist()]
    lines += [f"t {a} {b} {c} {d}" for a, b, c, d in kept.tolist()]
    with pytest.raises(ConfigError, match=r"open at \d+ edges|cavities"):
        read_nvlabs(copy(folder, tmp_path, tet="\n".join(lines)))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds no mesh"),
        ("v 0 0 0 0\nt 0 1 2 3\n", "names vertex 3 of 1"),
        ("v 0 0 0 0\nt 0 0 0 -2\n", "names vertex -2 of 1"),
        ("v 0 0 zero 0\n", "line 1"),
        ("v 0 0 0 0\nt 0 1 2\n", "line 2"),
        ("v 0 0\nv 0 0 0\nt 0 0 0 0\n", "different lengths"),
        ("v 0 0 nan 0\nt 0 0 0 0\n", "not finite"),
    ],
)
def test_a_damaged_file_is_refused_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "skin.tet"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said):
        read_tet(path)


def test_a_core_that_is_not_three_parts_is_refused(folder: Path, tmp_path: Path) -> None:
    vertices, faces = read_obj(folder / PARTS)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces[1:].tolist()]
    with pytest.raises(ConfigError, match="closed nail, clamp and core"):
        read_nvlabs(copy(folder, tmp_path, obj="\n".join(lines)))


def test_a_thickness_in_millimetres_is_refused(folder: Path) -> None:
    with pytest.raises(ConfigError, match="thickness_m"):
        read_nvlabs(folder, thickness_m=1.57)
