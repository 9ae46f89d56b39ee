"""NumPy twin of the kernels of the indenter's distance; for tests."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from palpate_fem.arrays import Floats
from palpate_fem.indenter.kernels import ON_AXIS
from palpate_fem.indenter.shape import Indenter, Primitive, PrimitiveKind


def signed_distance(indenter: Indenter, points: Floats) -> Floats:
    """Gap alone [m] without fillet, shape (N,), positive outside; faster than `distance`.

    Args:
        indenter: The indenter.
        points: Positions [m], shape (N, 3), indenter frame.
    """
    return _nearest(indenter, np.asarray(points, np.float64))[0]


def distance(indenter: Indenter, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Gap, normal and hessian.

    Args:
        indenter: The indenter.
        points: Positions [m], shape (N, 3), indenter frame.

    Returns:
        Gap [m], shape (N,), positive outside; its gradient, a unit vector away from the indenter,
        shape (N, 3); and its second derivative [1/m], shape (N, 3, 3). All in the indenter frame.
    """
    points = np.asarray(points, np.float64)
    gap, nearest = _nearest(indenter, points)
    normal, hessian = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
    for index, primitive in enumerate(indenter.primitives):
        chosen = nearest == index
        if chosen.any():
            _, normal[chosen], hessian[chosen] = _of_primitive(primitive, points[chosen])
    if indenter.fillet_m > 0.0:
        inside = np.flatnonzero(gap < indenter.fillet_m)
        sharp = gap[inside], normal[inside], hessian[inside]
        gap[inside], normal[inside], hessian[inside] = _filleted(indenter, points[inside], *sharp)
    return gap, normal, hessian


def _of_primitive(primitive: Primitive, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Gap, normal and hessian of one primitive."""
    box = primitive.kind == PrimitiveKind.BOX
    gap = (_box_gap if box else _revolved_gap)(primitive, points)
    return gap, *(_box if box else _revolved)(primitive, points)


def _filleted(
    indenter: Indenter, points: Floats, gap: Floats, normal: Floats, hessian: Floats
) -> tuple[Floats, Floats, Floats]:
    """Fillets by the definition, among all pairs and triples of primitives.

    Of all points that have the gap r to one, two or three, and to none a smaller one, the closest.
    """
    radius, parts = indenter.fillet_m, indenter.primitives
    depth = radius - gap
    start = points + depth[:, None] * normal
    clear = _nearest(indenter, start)[0] >= radius - 1e-12
    best = np.where(clear, depth, depth + radius)
    out = np.where(clear, gap, gap - radius), normal.copy(), hessian.copy()
    gaps = np.stack([_of_primitive(part, points)[0] for part in parts])
    candidate = (gaps < radius + best) & ~clear
    for count in (2, 3):
        for chosen in combinations(range(len(parts)), count):
            rows = np.flatnonzero(candidate[list(chosen)].all(axis=0))
            if not len(rows):
                continue
            centre, follow = _centre(
                [parts[index] for index in chosen], radius, points[rows], start[rows]
            )
            away = centre - points[rows]
            size = np.linalg.norm(away, axis=1)
            valid = (size < best[rows]) & (size > 0.0)
            valid[valid] = _nearest(indenter, centre[valid])[0] >= radius - 1e-10
            rows, size, n = rows[valid], size[valid], away[valid] / size[valid, None]
            best[rows] = size
            out[0][rows], out[1][rows] = radius - size, n
            change = follow[valid] - np.eye(3)
            across = np.eye(3) - n[:, :, None] * n[:, None, :]
            out[2][rows] = across @ change / size[:, None, None]
    return out


def _centre(
    parts: list[Primitive], radius: float, points: Floats, start: Floats
) -> tuple[Floats, Floats]:
    """Closest points with the gap ``radius`` to all of the parts, by Newton's method.

    Infinite where there is none, (N, 3); and their derivative, (N, 3, 3).
    """
    centre, count = start.copy(), len(parts)
    share = np.zeros((len(points), count))
    matrix = np.zeros((len(points), 3 + count, 3 + count))
    error = np.full(len(points), np.inf)
    for _ in range(30):
        values = [_of_primitive(part, centre) for part in parts]
        gaps = np.stack([value[0] for value in values], axis=1)
        normals = np.stack([value[1] for value in values], axis=2)
        bend = sum(share[:, [k], None] * value[2] for k, value in enumerate(values))
        matrix[:, :3, :3] = np.eye(3) - bend
        matrix[:, :3, 3:], matrix[:, 3:, :3] = -normals, normals.transpose(0, 2, 1)
        right = np.concatenate([points - centre, radius - gaps], axis=1)
        inverse = np.linalg.pinv(matrix, rcond=1e-9)
        change = np.einsum("nij,nj->ni", inverse, right)
        error = np.abs(change[:, :3]).max(axis=1) + np.abs(gaps - radius).max(axis=1)
        centre += change[:, :3] * np.minimum(1.0, 0.5e-3 / np.maximum(error, 1e-30))[:, None]
        share = change[:, 3:]
    centre[error > 1e-12] = np.inf
    return centre, np.asarray(inverse[:, :3, :3], np.float64)


def top(primitive: Primitive) -> float:
    """Highest z of a primitive [m], indenter frame: x_z - top is a lower bound of its gap."""
    if primitive.kind == PrimitiveKind.BOX:
        height = primitive.sizes[2]
    else:
        height = primitive.sizes[3 if primitive.axis == 2 else 1]
    return primitive.centre[2] + height + primitive.rounding


def _nearest(indenter: Indenter, points: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Smallest gap and the primitive that it belongs to; the first of equals."""
    best: Floats = np.full(len(points), np.inf)
    nearest = np.zeros(len(points), np.intp)
    for index, primitive in enumerate(indenter.primitives):
        if index and len(points) and (points[:, 2] - top(primitive) >= best).all():
            continue
        value = _box_gap if primitive.kind == PrimitiveKind.BOX else _revolved_gap
        gap = value(primitive, points)
        closer = gap < best
        best[closer], nearest[closer] = gap[closer], index
    return best, nearest


def _length(a: Floats, b: Floats) -> Floats:
    """Euclidean, by the same operations as the kernel."""
    return np.asarray(np.sqrt(a * a + b * b))


def _box_gap(box: Primitive, points: Floats) -> Floats:
    beyond = np.abs(points - box.centre) - box.sizes[:3]
    out = np.maximum(beyond, 0.0)
    length = np.sqrt(out[:, 0] * out[:, 0] + out[:, 1] * out[:, 1] + out[:, 2] * out[:, 2])
    gap: Floats = np.where(length > 0.0, length, beyond.max(axis=1)) - box.rounding
    return gap


def _box(box: Primitive, points: Floats) -> tuple[Floats, Floats]:
    away = points - box.centre
    side = np.where(away < 0.0, -1.0, 1.0)
    beyond = np.abs(away) - box.sizes[:3]
    out = np.maximum(beyond, 0.0)
    length = np.sqrt(out[:, 0] * out[:, 0] + out[:, 1] * out[:, 1] + out[:, 2] * out[:, 2])
    inside = length == 0.0
    safe = np.where(inside, 1.0, length)
    normal = side * out / safe[:, None]
    hessian = np.einsum("ni,ij->nij", np.where(beyond > 0.0, 1.0, 0.0), np.eye(3))
    hessian = (hessian - normal[:, :, None] * normal[:, None, :]) / safe[:, None, None]
    face = beyond.argmax(axis=1)
    flat = np.zeros_like(normal)
    rows = np.arange(len(points))
    flat[rows, face] = side[rows, face]
    return (
        np.where(inside[:, None], flat, normal),
        np.where(inside[:, None, None], 0.0, hessian),
    )


def _half_plane(solid: Primitive, points: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Distance from the axis, position along it, and the unit vectors outwards (N, 3) and along."""
    first, second = (solid.axis + 1) % 3, (solid.axis + 2) % 3
    away = points - solid.centre
    radius = _length(away[:, first], away[:, second])
    on_axis = radius < ON_AXIS
    radius = np.where(on_axis, 0.0, radius)
    outward = np.zeros_like(away)
    safe = np.where(on_axis, 1.0, radius)
    outward[:, first] = np.where(on_axis, 0.0, away[:, first] / safe)
    outward[:, second] = np.where(on_axis, 1.0, away[:, second] / safe)
    along = np.zeros(3)
    along[solid.axis] = 1.0
    return radius, away[:, solid.axis], outward, along


def _faces(solid: Primitive, radius: Floats, position: Floats) -> Floats:
    """Signed distances to the four faces of the profile, (4, N): along up, down, outer, bore."""
    inner, outer, low, high = solid.sizes
    bore = inner - radius if inner > 0.0 else np.full_like(radius, -np.inf)
    return np.stack([position - high, low - position, radius - outer, bore])


def _revolved_gap(solid: Primitive, points: Floats) -> Floats:
    first, second = (solid.axis + 1) % 3, (solid.axis + 2) % 3
    inner, outer, low, high = solid.sizes
    away = points - solid.centre
    radius = _length(away[:, first], away[:, second])
    radius = np.where(radius < ON_AXIS, 0.0, radius)
    position = away[:, solid.axis]
    length = _length(
        radius - np.clip(radius, inner, outer), position - np.clip(position, low, high)
    )
    inside = length == 0.0
    if inside.any():
        length[inside] = _faces(solid, radius[inside], position[inside]).max(axis=0)
    return length - solid.rounding


def _revolved(solid: Primitive, points: Floats) -> tuple[Floats, Floats]:
    inner, outer, low, high = solid.sizes
    radius, position, outward, along = _half_plane(solid, points)
    out_r = radius - np.clip(radius, inner, outer)
    out_t = position - np.clip(position, low, high)
    length = _length(out_r, out_t)
    inside = length == 0.0
    safe = np.where(inside, 1.0, length)
    n_r, n_t = out_r / safe, out_t / safe
    h_rr = (np.where(out_r != 0.0, 1.0, 0.0) - n_r * n_r) / safe
    h_tt = (np.where(out_t != 0.0, 1.0, 0.0) - n_t * n_t) / safe
    h_rt = -n_r * n_t / safe
    # A line on the axis (outer = 0) curves there as everywhere: (d gap/d r) / r -> 1 / L.
    axis_value = np.where(inside | (outer > 0.0), 0.0, 1.0 / safe)

    face = _faces(solid, radius, position).argmax(axis=0)
    n_r = np.where(inside, np.array([0.0, 0.0, 1.0, -1.0])[face], n_r)
    n_t = np.where(inside, np.array([1.0, -1.0, 0.0, 0.0])[face], n_t)
    h_rr, h_tt, h_rt = (np.where(inside, 0.0, value) for value in (h_rr, h_tt, h_rt))
    h_rr = np.where((radius == 0.0) & (outer == 0.0) & ~inside, axis_value, h_rr)
    round_about = np.where(radius > 0.0, n_r / np.where(radius > 0.0, radius, 1.0), axis_value)

    normal = n_r[:, None] * outward + n_t[:, None] * along
    sideways = np.cross(along, outward)
    hessian = (
        h_rr[:, None, None] * outward[:, :, None] * outward[:, None, :]
        + h_tt[:, None, None] * along[:, None] * along
        + h_rt[:, None, None] * (outward[:, :, None] * along + along[:, None] * outward[:, None, :])
        + round_about[:, None, None] * sideways[:, :, None] * sideways[:, None, :]
    )
    return normal, hessian
