"""Small structured solids for the verification."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate_fem.arrays import Floats, Ints
from palpate_fem.mesh.solid import SolidMesh, extrude

KINDS = {"hexahedra": False, "wedges": True}  # whether elements are wedges, by their name


def rectangle(x: Floats, y: Floats) -> tuple[Floats, Ints]:
    """Grid lines to points (C, 2) and quads (F, 4), counter-clockwise; x runs slowest."""
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    number = np.arange(len(points), dtype=np.int32).reshape(len(x), len(y))
    corners = (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:])
    return points, np.stack([c.ravel() for c in corners], axis=1)


def quarter_disc(radii: Floats, around: int) -> tuple[Floats, Ints]:
    """Quarter of a disc as quads: a rounded square in the middle, rings of nodes outside.

    Args:
        radii: Radii of the rings [m], ascending; the first bounds the middle.
        around: Quads on a ring, even.
    """
    half = around // 2
    share = np.linspace(0.0, 1.0, half + 1)
    square, faces = rectangle(share, share)
    # Rounded: the farther out, the more of the circle's direction and radius.
    size = square.max(axis=1, keepdims=True)
    turn = np.divide(square, size, out=np.zeros_like(square), where=size > 0) * (np.pi / 4)
    circle = size * np.sin(turn)
    points = [radii[0] * ((1 - size) * square * 0.8 + size * circle)]
    number = np.arange((half + 1) ** 2, dtype=np.int32).reshape(half + 1, half + 1)
    ring = np.concatenate([number[half, :], number[half - 1 :: -1, half]])
    angle = np.linspace(0.0, np.pi / 2, around + 1)
    quads = [faces]
    count = len(square)
    for radius in radii[1:]:
        points.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        after = np.arange(count, count + around + 1, dtype=np.int32)
        quads.append(np.stack([ring[:-1], after[:-1], after[1:], ring[1:]], axis=1))
        ring, count = after, count + around + 1
    every = np.concatenate(points)
    every[np.abs(every) < 1e-12 * radii[-1]] = 0.0
    return every, np.concatenate(quads).astype(np.int32)


def triangles(quads: Ints) -> Ints:
    """Each quad as two triangles."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def slab(points: Floats, faces: Ints, depths: Floats, *, name: str = "slab") -> SolidMesh:
    """A solid behind a flat contact surface, whose normal is -z, where indenters come from.

    Args:
        points: In the plane [m], shape (C, 2).
        faces: Counter-clockwise seen from +z, (F, 4) or (F, 3).
        depths: z of the layers [m], ascending from the contact surface's 0.
        name: For people.

    Returns:
        Nodes of a column are consecutive, the deepest first; without a cavity.
    """
    flat = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    deep = flat + np.array([0.0, 0.0, depths[-1]])
    mesh = extrude(deep, flat, faces[:, ::-1], layers=len(depths) - 1, name=name)
    nodes = mesh.nodes.copy()
    nodes[:, 2] = np.tile(depths[::-1], len(points))
    return solid(replace(mesh, nodes=nodes))


def solid(mesh: SolidMesh) -> SolidMesh:
    """The same mesh without a cavity."""
    none = np.empty((0, 3), np.int32)
    return replace(mesh, inner_faces=none, inner_elements=none[:, 0])


def graded(fine: float, even: float, end: float, growth: float) -> Floats:
    """Positions from 0: steps of ``fine`` up to ``even``, then growing ones up to ``end`` [m]."""
    places = list(np.linspace(0.0, even, max(1, round(even / fine)) + 1))
    step = fine
    while places[-1] < end:
        step *= growth
        places.append(places[-1] + step)
    places[-1] = end
    if places[-1] - places[-2] < 0.5 * step:
        del places[-2]
    return np.array(places)


def octant(
    edges: int, inner: float, outer: float, layers: int, *, wedges: bool = False
) -> SolidMesh:
    """An eighth of a hollow sphere: x, y, z >= 0; three patches on the faces of a cube, projected.

    ``edges`` are the quads along a side of each patch, ``layers`` the elements through the wall.
    """
    side = np.tan(np.linspace(0.0, np.pi / 4, edges + 1))
    flat, quads = rectangle(side, side)
    ones = np.ones((len(flat), 1))
    patch = np.concatenate([ones, flat], axis=1)
    points = np.concatenate([np.roll(patch, turn, axis=1) for turn in range(3)])
    faces = np.concatenate([quads + turn * len(flat) for turn in range(3)])
    points, faces = _merged(points, faces)
    return _ball(points, faces, inner, outer, layers, wedges)


def hollow_sphere(edges: int, inner: float, outer: float, layers: int) -> SolidMesh:
    """A whole hollow sphere of hexahedra, ``edges`` along a side of each of six patches."""
    side = np.tan(np.linspace(-np.pi / 4, np.pi / 4, edges + 1))
    flat, quads = rectangle(side, side)
    ones = np.ones((len(flat), 1))
    patch = np.concatenate([ones, flat], axis=1)
    points: list[Floats] = []
    faces: list[Ints] = []
    for turn in range(3):
        for sign in (1.0, -1.0):
            faces.append((quads if sign > 0 else quads[:, ::-1]) + len(points) * len(flat))
            points.append(np.roll(patch * [sign, 1.0, 1.0], turn, axis=1))
    return _ball(*_merged(np.concatenate(points), np.concatenate(faces)), inner, outer, layers)


def _ball(
    points: Floats, faces: Ints, inner: float, outer: float, layers: int, wedges: bool = False
) -> SolidMesh:
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    faces = triangles(faces) if wedges else faces
    return extrude(inner * unit, outer * unit, faces, layers=layers, name="sphere")


def _merged(points: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Merge coincident points."""
    _, first, number = np.unique(
        np.round(points, 9), axis=0, return_index=True, return_inverse=True
    )
    return points[first], number.reshape(-1)[faces].astype(np.int32)


def quarter_tube(around: int, inner: float, outer: float, layers: int) -> SolidMesh:
    """A quarter of a tube along z, one element long; columns run from inside out."""
    angle, quads = rectangle(
        np.linspace(0.0, np.pi / 2, around + 1), np.array([0.0, (outer - inner) / layers])
    )
    unit = np.stack([np.cos(angle[:, 0]), np.sin(angle[:, 0]), np.zeros(len(angle))], axis=1)
    unit[np.abs(unit) < 1e-12] = 0.0
    along = angle[:, 1:] * [0.0, 0.0, 1.0]
    mesh = extrude(inner * unit + along, outer * unit + along, quads, layers=layers, name="tube")
    return solid(mesh)


def cooks_membrane(edges: int) -> SolidMesh:
    """Cook's tapered panel, 48 wide, 44 high at the clamp, 16 at the free end, 1 thick."""
    square, quads = rectangle(np.linspace(0.0, 1.0, edges + 1), np.linspace(0.0, 1.0, edges + 1))
    s, t = square.T
    low, high = 44.0 * s, 44.0 + 16.0 * s
    points = np.stack([48.0 * s, low + t * (high - low)], axis=1)
    return slab(points, quads, np.array([0.0, 1.0]), name="Cook")


def distorted(mesh: SolidMesh, amount: float, seed: int) -> SolidMesh:
    """The same solid with its interior nodes moved at random by up to ``amount`` [m]."""
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    inside = ((mesh.nodes > low) & (mesh.nodes < high)).all(axis=1)
    nodes = mesh.nodes.copy()
    random = np.random.default_rng(seed)
    nodes[inside] += random.uniform(-amount, amount, (int(inside.sum()), 3))
    return replace(mesh, nodes=nodes)


def on_planes(mesh: SolidMesh) -> NDArray[np.bool_]:
    """Components held by symmetry to the planes x = 0, y = 0 and z = 0, shape (V, 3)."""
    return np.asarray(np.abs(mesh.nodes) < 1e-9 * np.abs(mesh.nodes).max())
