"""Surfaces, extrusion and the check of a solid mesh, on spheres whose numbers are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.fem.mesh_measures import node_areas, solid_volume

from palpate.errors import SimulationError
from palpate_fem.mesh.check import check_mesh, scaled_jacobians
from palpate_fem.mesh.grid import bag
from palpate_fem.mesh.solid import SolidMesh, extrude
from palpate_fem.mesh.surface import (
    components,
    enclosed_volume,
    face_vectors,
    node_normals,
    open_edges,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

INNER, OUTER = 5.5e-3, 7.07e-3
BOX = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))


def cubed_sphere(n: int) -> tuple[Floats, Ints]:
    """Unit sphere of 6 n^2 quads."""
    corners = np.array(
        [[x, y, z] for z in (-1, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    )
    points: list[Floats] = []
    faces: list[Ints] = []
    t = np.linspace(0, 1, n + 1)
    for side in BOX:
        a, b, c, d = corners[list(side)].astype(float)
        u, v = (grid[..., None] for grid in np.meshgrid(t, t, indexing="ij"))
        patch = (1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d
        ids = len(points) * (n + 1) ** 2 + np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
        points.append(patch.reshape(-1, 3))
        quads = np.stack([ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]], axis=-1)
        faces.append(quads.reshape(-1, 4).astype(np.int32))
    stacked = np.concatenate(points)
    _, first, index = np.unique(
        np.round(stacked * 1e6).astype(int), axis=0, return_index=True, return_inverse=True
    )
    places = np.tan(stacked[first] * np.pi / 4)
    places /= np.linalg.norm(places, axis=1)[:, None]
    return places, index.reshape(-1)[np.concatenate(faces)].astype(np.int32)


def shell(
    n: int = 6, *, layers: int = 2, triangles: bool = False, outer: float = OUTER
) -> SolidMesh:
    unit, faces = cubed_sphere(n)
    if triangles:
        faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    return extrude(INNER * unit, outer * unit, faces, layers=layers, name="shell")


@pytest.mark.parametrize("triangles", [False, True])
def test_volume_area_and_normals_of_a_sphere_converge_with_order_2(triangles: bool) -> None:
    errors = []
    for n in (6, 12):
        points, faces = cubed_sphere(n)
        if triangles:
            faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
        area = np.linalg.norm(face_vectors(points, faces), axis=1).sum()
        assert node_areas(points, faces).sum() == pytest.approx(area)
        assert (np.linalg.norm(node_normals(points, faces) - points, axis=1) < 0.05).all()
        errors.append([4 / 3 * np.pi - enclosed_volume(points, faces), 4 * np.pi - area])
    assert (np.log2(np.array(errors[0]) / errors[1]) > 1.8).all()


def test_an_extrusion_numbers_columns_and_is_linear_in_thickness() -> None:
    thin, middle, thick = (shell(outer=outer) for outer in (6.5e-3, 7e-3, 7.5e-3))
    np.testing.assert_allclose(middle.nodes, (thin.nodes + thick.nodes) / 2, rtol=0, atol=1e-17)
    np.testing.assert_array_equal(thin.elements, thick.elements)
    column = np.linalg.norm(thin.nodes.reshape(-1, 3, 3), axis=2)
    np.testing.assert_allclose(column, np.tile([5.5e-3, 6e-3, 6.5e-3], (len(column), 1)))


@pytest.mark.parametrize("layers", [1, 2, 3])
@pytest.mark.parametrize("triangles", [False, True])
def test_an_extruded_shell_is_sound(layers: int, triangles: bool) -> None:
    mesh = shell(layers=layers, triangles=triangles)
    check_mesh(mesh)
    exact = 4 / 3 * np.pi * (OUTER**3 - INNER**3)
    assert solid_volume(mesh) == pytest.approx(exact, rel=0.04)
    assert scaled_jacobians(mesh.nodes, mesh.elements).min() > 0.5
    size = mesh.elements.shape[1] // 2
    for face, element in zip(mesh.outer_faces, mesh.outer_elements, strict=True):
        assert (mesh.elements[element, size:] == face).all()
    for face, element in zip(mesh.inner_faces, mesh.inner_elements, strict=True):
        assert (mesh.elements[element, :size] == face).all()


def test_quality_is_one_for_a_box_and_a_regular_wedge_and_sees_inversion() -> None:
    box = np.array([[x, y, z] for z in (0, 3.0) for x, y in ((0, 0), (2, 0), (2, 1), (0, 1))])
    hexahedron = np.arange(8, dtype=np.int32)[None]
    assert scaled_jacobians(box, hexahedron)[0] == pytest.approx(1)
    assert scaled_jacobians(box, hexahedron[:, [4, 5, 6, 7, 0, 1, 2, 3]])[0] == pytest.approx(-1)
    turn = 2 * np.pi * np.arange(3) / 3
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    prism = np.concatenate([np.insert(ring, 2, z, axis=1) for z in (0, 1)])
    wedge = np.arange(6, dtype=np.int32)[None]
    assert scaled_jacobians(prism, wedge)[0] == pytest.approx(1)
    flat = np.zeros((8, 3))
    assert scaled_jacobians(flat, hexahedron)[0] == -1


def spoil(what: str) -> SolidMesh:
    """A shell with one thing wrong."""
    mesh = shell()
    nodes, faces = mesh.nodes.copy(), mesh.outer_faces.copy()
    if what == "nan":
        nodes[17, 1] = np.nan
        return replace(mesh, nodes=nodes)
    if what == "id":
        elements = mesh.elements.copy()
        elements[3, 2] = len(nodes)
        return replace(mesh, elements=elements)
    if what == "negative":
        return replace(mesh, fixed=np.array([-1], np.int32))
    if what == "unused":
        return replace(mesh, nodes=np.concatenate([nodes, np.zeros((1, 3))]))
    if what == "inverted":
        nodes[2] = 0.5 * nodes[0]  # an outer node under its inner one
        return replace(mesh, nodes=nodes)
    if what == "inside out":
        return replace(mesh, elements=mesh.elements[:, [4, 5, 6, 7, 0, 1, 2, 3]])
    if what == "hole":
        return replace(mesh, outer_faces=faces[1:], outer_elements=mesh.outer_elements[1:])
    if what == "cavity hole":
        inner = mesh.inner_faces[1:]
        return replace(mesh, inner_faces=inner, inner_elements=mesh.inner_elements[1:])
    if what == "turned":
        return replace(mesh, inner_faces=mesh.inner_faces[:, ::-1])
    if what == "twice":
        faces[1] = faces[0]
        return replace(mesh, outer_faces=faces)
    if what == "missing element":
        return replace(mesh, elements=mesh.elements[1:])
    if what == "shape":
        return replace(mesh, elements=mesh.elements[:, :5])
    if what == "owner":
        return replace(mesh, outer_elements=mesh.outer_elements[1:])
    raise ValueError(what)


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("nan", "not finite, first 17"),
        ("id", "in elements, of only"),
        ("negative", "id -1 in fixed"),
        ("unused", "nodes of no element"),
        ("inverted", r"inverted or flat elements, worst element \d+ at \("),
        ("inside out", "inverted or flat"),
        ("hole", "open outer surface: 4 edges"),
        ("cavity hole", "open inner surface: 4 edges"),
        ("turned", "turned inside out"),
        ("twice", "open outer surface"),
        ("missing element", "range|in outer_elements|in inner_elements"),
        ("shape", "wrong shape"),
        ("owner", "wrong shape"),
    ],
)
def test_a_bad_mesh_is_refused_with_the_reason(what: str, said: str) -> None:
    with pytest.raises(SimulationError, match=said):
        check_mesh(spoil(what))


def test_a_solid_without_cavity_may_name_a_part_of_its_boundary() -> None:
    box = np.array([[x, y, z] for z in (0, 1.0) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])
    none = np.empty(0, np.int32)
    block = SolidMesh(
        nodes=box,
        elements=np.arange(8, dtype=np.int32)[None],
        outer_faces=np.array([[4, 5, 6, 7]], np.int32),
        outer_elements=np.zeros(1, np.int32),
        inner_faces=np.empty((0, 4), np.int32),
        inner_elements=none,
        fixed=np.arange(4, dtype=np.int32),
        mirror=none,
    )
    check_mesh(block)
    with pytest.raises(SimulationError, match="do not bound"):
        check_mesh(replace(block, outer_faces=block.outer_faces[:, ::-1]))


def test_the_hash_tells_meshes_apart_and_is_the_same_for_the_same() -> None:
    assert shell().sha256 == shell().sha256
    others = [
        shell(outer=7.0701e-3),
        shell(layers=3),
        replace(shell(), fixed=np.zeros(1, np.int32)),
    ]
    assert len({mesh.sha256 for mesh in [shell(), *others]}) == 4


@settings(max_examples=25)
@given(st.integers(2, 9), st.integers(1, 6), st.integers(1, 8))
def test_a_bag_is_closed_and_symmetric_for_all_sizes(rings: int, half: int, flank: int) -> None:
    sheet = bag(rings, 2 * half, flank)
    nodes = len(sheet.mirror)
    assert len(open_edges(sheet.faces)) == 0
    assert nodes - len(sheet.faces) == 2  # Euler: V - E + F with E = 2 F
    assert len(np.unique(components(sheet.faces, nodes))) == 1
    np.testing.assert_array_equal(np.unique(sheet.faces), np.arange(nodes))
    np.testing.assert_array_equal(sheet.mirror[sheet.mirror], np.arange(nodes))
    middle = int((sheet.mirror == np.arange(nodes)).sum())
    assert 2 * len(sheet.left) + middle == nodes
    assert len(np.intersect1d(sheet.left, sheet.mirror[sheet.left])) == 0
    mirrored = np.sort(sheet.mirror[sheet.faces], axis=1)
    ours = {tuple(face) for face in np.sort(sheet.faces, axis=1).tolist()}
    assert {tuple(face) for face in mirrored.tolist()} == ours
