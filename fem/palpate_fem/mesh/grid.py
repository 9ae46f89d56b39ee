"""A grid of quads over a closed bag: a tube of rings with a rectangular patch at either end.

A ring has 2 (a + b) nodes; a and b are the quads along the sides of the patches: a ventrally and
dorsally, b on either flank. So all nodes have four quads, but the eight corners of the patches
three. Everything is symmetric to the plane of the midline.

`lay` places the nodes on a smooth body by rays from inside, graded by the wanted edge length, and
relaxes them; positions are mirror-symmetric to the bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, diags

from palpate_fem.arrays import Floats, Ints
from palpate_fem.mesh.shape import Field, cast, project
from palpate_fem.mesh.surface import edges


@dataclass(frozen=True)
class BagTopology:
    """Nodes and quads of the bag.

    Around a ring, node k = 0 is on the ventral midline and k = half on the dorsal one, k ascending
    towards +y first. On a patch, (i, j) counts from its right ventral corner (-y) towards +y
    and dorsally, and its rim is the ring that it closes.

    Attributes:
        rings: Node ids, shape (rings, around); ring 0 is the rim of the proximal patch, the last
            that of the patch at the tip.
        proximal: Node ids of the proximal patch, rim included, shape (a + 1, b + 1).
        tip: Same of the patch at the tip.
        faces: Quads, counter-clockwise seen from outside, shape (F, 4).
        mirror: Node at the mirror image of each node, shape (V,).
    """

    rings: Ints
    proximal: Ints
    tip: Ints
    faces: Ints
    mirror: Ints

    @property
    def left(self) -> Ints:
        """Nodes at y < 0: each is the mirror image of one on the right."""
        half = self.rings.shape[1] // 2
        middle = self.tip.shape[0] // 2
        sides = [self.rings[:, half + 1 :], self.tip[:middle], self.proximal[:middle]]
        return np.unique(np.concatenate([side.ravel() for side in sides]))


def rim(a: int, b: int) -> tuple[Ints, Ints]:
    """Patch position (i, j) of each ring node k, two arrays of shape (2 (a + b),); a is even."""
    half = a // 2
    first = [(i, 0) for i in range(half, a)]  # ventral, from the midline to +y
    up = [(a, j) for j in range(b)]
    over = [(i, b) for i in range(a, 0, -1)]
    down = [(0, j) for j in range(b, 0, -1)]
    last = [(i, 0) for i in range(half)]
    pairs = np.array(first + up + over + down + last, np.int32)
    return pairs[:, 0], pairs[:, 1]


def bag(rings: int, a: int, b: int) -> BagTopology:
    """Number the nodes of a bag from the proximal patch to the tip.

    Args:
        rings: Rings, the rims of both patches among them, at least 2.
        a: Quads across the ventral side of a patch, even.
        b: Quads along each of its flanks.
    """
    around = 2 * (a + b)
    on_i, on_j = rim(a, b)
    interior = (a - 1) * (b - 1)
    first = interior  # id of ring 0
    ring = first + np.arange(rings * around, dtype=np.int32).reshape(rings, around)
    proximal, tip = (np.empty((a + 1, b + 1), np.int32) for _ in range(2))
    for patch, start, edge in (
        (proximal, 0, ring[0]),
        (tip, first + rings * around, ring[-1]),
    ):
        patch[1:-1, 1:-1] = start + np.arange(interior, dtype=np.int32).reshape(a - 1, b - 1)
        patch[on_i, on_j] = edge
    mirror = np.empty(2 * interior + rings * around, np.int32)
    mirror[ring] = ring[:, -np.arange(around) % around]
    for patch in (proximal, tip):
        mirror[patch] = patch[::-1]
    ahead = np.roll(ring, -1, axis=1)
    tube = np.stack([ring[:-1], ahead[:-1], ahead[1:], ring[1:]], axis=-1).reshape(-1, 4)
    cap = np.stack([tip[:-1, :-1], tip[1:, :-1], tip[1:, 1:], tip[:-1, 1:]], -1).reshape(-1, 4)
    back = np.stack(
        [proximal[:-1, :-1], proximal[:-1, 1:], proximal[1:, 1:], proximal[1:, :-1]], -1
    ).reshape(-1, 4)
    faces = np.ascontiguousarray(np.concatenate([back, tube, cap]), np.int32)
    return BagTopology(ring, proximal, tip, faces, mirror)


REACH_M = 15e-3  # every ray leaves the body within
DENSE = 401  # samples of a curve
PATCH_SHARE = 0.26  # of half a ring along the dorsal half side of a patch, so that it is square
ROUNDS = 60  # of relaxation; nodes then move by less than 1 um
ANCHOR = 0.06  # weight of a node's first position; without it, rings slip over the dome


@dataclass(frozen=True, slots=True)
class RayOrigins:
    """Start points of the rays that lay a bag over a body [m], sensor frame.

    Attributes:
        axis_z_m: Height of the axis.
        tip_x_m: Rays of the dome start here on the axis ...
        tip_angle: ... and the patch at the tip begins at this angle from it [rad].
        end_x_m: The flat proximal end.
        end_radius_m: Radius of the patch there.
        back_x_m: Rays to the proximal end start here on the axis.
        mark_x_m: One ring lies in the section at this x, another along the proximal edge.
        mark_y_m: One dorsal node of each section has this y.
        section_x_m: Section in which the spacing around the body is made.
    """

    axis_z_m: float
    tip_x_m: float
    tip_angle: float
    end_x_m: float
    end_radius_m: float
    back_x_m: float
    mark_x_m: float
    mark_y_m: float
    section_x_m: float


Spacing = Callable[[Floats], Floats]  # positions (N, 3) -> wanted edge length [m], (N,)
# Nodes that keep one coordinate: ids, axis, value [m].
Line = tuple[Ints, int, float | Floats]


def _cut(curve: Floats, size: Spacing, parts: int) -> Floats:
    """Fractional sample indices that cut a curve (S, 3) into parts of equal length / size."""
    step = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    load = np.concatenate([[0.0], np.cumsum(step / size((curve[1:] + curve[:-1]) / 2))])
    wanted = np.linspace(0.0, load[-1], parts + 1)
    return np.asarray(np.interp(wanted, load, np.arange(len(curve), dtype=np.float64)))


def _count(curve: Floats, size: Spacing) -> float:
    """Length of a curve in wanted edges."""
    step = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    return float((step / size((curve[1:] + curve[:-1]) / 2)).sum())


def _angles(field: Field, frame: RayOrigins, size: Spacing) -> tuple[Floats, int]:
    """Angles of the nodes of half a ring from the ventral midline [rad]; which is at the mark."""
    theta = np.linspace(0.0, np.pi, DENSE)
    start = np.tile([frame.section_x_m, 0.0, frame.axis_z_m], (DENSE, 1))
    ray = np.stack([np.zeros(DENSE), np.sin(theta), -np.cos(theta)], axis=1)
    curve = cast(field, start, ray, reach=REACH_M)
    dorsal = curve[:, 2] > frame.axis_z_m
    # Index where the dorsal flat reaches the mark; y falls towards the midline there.
    mark = int(np.flatnonzero(dorsal & (curve[:, 1] >= frame.mark_y_m))[-1])
    share = (curve[mark, 1] - frame.mark_y_m) / (curve[mark, 1] - curve[mark + 1, 1])
    exact = mark + share
    below, above = curve[: mark + 2], curve[mark + 1 :]
    parts = max(4, round(_count(below, size)))
    first = _cut(below, size, parts) * exact / (mark + 1)
    flat = max(2, round(_count(above, size)))
    second = exact + np.arange(1, flat + 1) * (DENSE - 1 - exact) / flat
    index = np.concatenate([first, second])
    return np.asarray(np.interp(index, np.arange(DENSE), theta)), parts


def _rays(frame: RayOrigins, way: Floats, theta: Floats) -> tuple[Floats, Floats]:
    """Start and direction of the rays of one meridian.

    Args:
        frame: Where rays start.
        way: 0 at the proximal patch, 1 at the section of back_x_m, 2 at tip_x_m, 3 at the patch at
            the tip, shape (S,).
        theta: Angle of the meridian [rad], shape () or (S,).

    Returns:
        Start [m] and unit direction, shapes (S, 3).
    """
    behind, along, ahead = np.clip(way, 0, 1), np.clip(way - 1, 0, 1), np.clip(way - 2, 0, 1)
    steepest = np.arctan2(frame.end_radius_m, frame.back_x_m - frame.end_x_m)
    tilt = ahead * (np.pi / 2 - frame.tip_angle) - (1 - behind) * (np.pi / 2 - steepest)
    start = np.zeros((len(way), 3))
    start[:, 0] = frame.back_x_m + along * (frame.tip_x_m - frame.back_x_m)
    start[:, 2] = frame.axis_z_m
    across = np.cos(tilt)
    ray = np.stack([np.sin(tilt), across * np.sin(theta), -across * np.cos(theta)], axis=1)
    return start, ray


def _meridian(field: Field, frame: RayOrigins, theta: float) -> tuple[Floats, tuple[float, float]]:
    """Dense curve from patch to patch; fractional indices of the proximal edge and of the mark."""
    way = np.concatenate([np.linspace(0, 1, DENSE)[:-1], np.linspace(1, 3, 2 * DENSE)])
    start, ray = _rays(frame, way, np.full(len(way), theta))
    curve = cast(field, start, ray, reach=REACH_M)
    _, gradient = field(curve)
    backwards = -gradient[:, 0] / np.linalg.norm(gradient, axis=1) - np.sqrt(0.5)
    return curve, (_crossing(backwards), _crossing(frame.mark_x_m - curve[:, 0]))


def _crossing(values: Floats) -> float:
    """Fractional index where values first fall below zero."""
    after = int(np.flatnonzero(values < 0)[0])
    return after - 1 + float(values[after - 1] / (values[after - 1] - values[after]))


def _coons(edge: Floats, a: int, b: int) -> Floats:
    """Fill a rim, shape (2 (a + b), 2), with a patch, shape (a + 1, b + 1, 2) (Coons 1967)."""
    i, j = rim(a, b)
    patch = np.zeros((a + 1, b + 1, 2))
    patch[i, j] = edge
    u, v = np.linspace(0, 1, a + 1)[:, None, None], np.linspace(0, 1, b + 1)[None, :, None]
    low, high, left, right = patch[:, :1], patch[:, -1:], patch[:1], patch[-1:]
    corners = (
        (1 - u) * (1 - v) * patch[0, 0] + u * (1 - v) * patch[-1, 0]
        + (1 - u) * v * patch[0, -1] + u * v * patch[-1, -1]
    )  # fmt: skip
    full = (1 - v) * low + v * high + (1 - u) * left + u * right - corners
    patch[1:-1, 1:-1] = full[1:-1, 1:-1]
    return patch


def lay(field: Field, frame: RayOrigins, size: Spacing) -> tuple[BagTopology, Floats]:
    """Lay a bag over a body.

    Args:
        field: The body; rays of the frame leave it only once.
        frame: Where the rays start, and the lines that the grid keeps.
        size: Wanted edges.

    Returns:
        The bag and the places of its nodes on the body [m], shape (V, 3); y of a node and of its
        mirror image differ in sign only, bit by bit.
    """
    theta, rim_node = _angles(field, frame, size)
    half = len(theta) - 1
    a = 2 * max(2, round(PATCH_SHARE * half))
    flank, (edge, mark) = _meridian(field, frame, 0.25 * np.pi)
    parts = [
        max(least, round(_count(flank[int(i) : int(j) + 1], size)))
        for least, i, j in ((2, 0, edge), (3, edge, mark), (6, mark, len(flank) - 1))
    ]
    sheet = bag(sum(parts) + 1, a, half - a)
    places = np.zeros((len(sheet.mirror), 3))
    for k in range(half + 1):
        curve, (edge, mark) = _meridian(field, frame, float(theta[k]))
        places[sheet.rings[:, k]] = _along(curve, [0, edge, mark, len(curve) - 1], parts, size)
    turn = np.concatenate([theta, -theta[1:-1][::-1]])
    around = np.stack([np.sin(turn), -np.cos(turn)], axis=1)
    backwards = frame.back_x_m - frame.end_x_m
    for patch, x, way, radius in (
        (sheet.tip, frame.tip_x_m, 1.0, np.tan(frame.tip_angle)),
        (sheet.proximal, frame.back_x_m, -1.0, frame.end_radius_m / backwards),
    ):
        flat = _coons(radius * around, a, half - a)[1:-1, 1:-1].reshape(-1, 2)
        ray = np.concatenate([np.full((len(flat), 1), way), flat], axis=1)
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        start = np.tile([x, 0.0, frame.axis_z_m], (len(flat), 1))
        places[patch[1:-1, 1:-1].ravel()] = cast(field, start, ray, reach=REACH_M)
    at_edge, at_mark = sheet.rings[parts[0]], sheet.rings[parts[0] + parts[1]]
    on_flat = sheet.rings[parts[0] + parts[1] :, rim_node]
    on_flat = on_flat[np.abs(places[on_flat, 1] - frame.mark_y_m) < 0.02 * frame.mark_y_m]
    lines: tuple[Line, ...] = (
        *((at_edge, axis, places[at_edge, axis]) for axis in range(3)),
        (at_mark, 0, frame.mark_x_m),
        (on_flat, 1, frame.mark_y_m),
    )
    return sheet, relax(field, places, sheet, size, lines)


def _along(curve: Floats, ends: list[float], parts: list[int], size: Spacing) -> Floats:
    """Nodes of one meridian [m], shape (rings, 3); each piece between two ends is cut evenly."""
    sample = np.arange(len(curve), dtype=np.float64)

    def at(index: Floats) -> Floats:
        return np.stack([np.interp(index, sample, axis) for axis in curve.T], axis=1)

    index = [np.zeros(1)]
    for first, last, count in zip(ends[:-1], ends[1:], parts, strict=True):
        piece = np.linspace(first, last, DENSE)
        cuts = _cut(at(piece), size, count)[1:]
        index.append(first + cuts * (last - first) / (DENSE - 1))
    return at(np.concatenate(index))


def relax(
    field: Field, places: Floats, sheet: BagTopology, size: Spacing, lines: tuple[Line, ...]
) -> Floats:
    """Smooth the grid on the body, exactly symmetric.

    Each node moves towards the mean of its neighbours, weighted with 1 / wanted edge, and a little
    towards its first position, and is projected on the body again. Nodes of a line keep a
    coordinate.
    """
    pairs, _ = edges(sheet.faces)
    own, twin = np.arange(len(places)), sheet.mirror
    left = sheet.left
    middle = twin == own

    def held(points: Floats) -> Floats:
        for ids, axis, value in lines:
            points[ids, axis] = value
        points[left] = points[twin[left]] * np.array([1.0, -1.0, 1.0])
        points[middle, 1] = 0.0
        return points

    first = held(project(field, held(places.copy())))
    now = first
    for _ in range(ROUNDS):
        # Springs of stiffness 1 / wanted length: at rest, edges are as long as wanted.
        weight = 1 / size((now[pairs[:, 0]] + now[pairs[:, 1]]) / 2)
        pull = coo_matrix((weight, (pairs[:, 0], pairs[:, 1])), shape=(len(own), len(own))).tocsr()
        total = np.asarray(pull.sum(axis=1)).ravel()
        mean = diags(1 / total) @ (pull @ now)
        target = (mean + ANCHOR * first) / (1 + ANCHOR)
        now = held(project(field, held((now + target) / 2), steps=2))
    return held(project(field, now))
