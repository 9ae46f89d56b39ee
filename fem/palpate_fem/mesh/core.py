"""The rigid core as a tabulated signed distance, and the tabulation of triangle surfaces.

The distance is a tricubic B-spline, because Newton's method needs its second derivative to be
continuous. SciPy is imported where a table is made: every process that only holds a mesh, such as
a worker before its first job, would wait a third longer for its imports.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_fem.arrays import Floats, Ints
from palpate_fem.mesh.surface import face_vectors, node_normals


def _weights(t: Floats) -> tuple[Floats, Floats, Floats]:
    """Cubic B-spline weights of the four coefficients around a point, and two derivatives.

    Args:
        t: Position within the cell, 0..1, shape (...).

    Returns:
        Value, first and second derivative per cell, each of shape (..., 4).
    """
    s = 1 - t
    value = np.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3], -1) / 6
    slope = np.stack([-(s**2), 3 * t**2 - 4 * t, -(3 * s**2 - 4 * s), t**2], -1) / 2
    curvature = np.stack([s, 3 * t - 2, 3 * s - 2, t], -1)
    return value, slope, curvature


@dataclass(frozen=True)
class DistanceGrid:
    """A signed distance on a regular grid, between nodes a tricubic B-spline (C2).

    Coefficient (i, j, k) belongs to the point origin + spacing * (i, j, k). A point x is *inside*
    if u = (x - origin) / spacing lies in [1, n - 2] on each axis, so that the four coefficients
    floor(u) - 1 .. floor(u) + 2 exist (at u = n - 2 the cell below is used).

    Outside, the value is that of the nearest inside point plus the distance to it, with that
    point's gradient and a zero Hessian: enough to see that there is no contact, but not its
    derivative. Grids have a margin of several mm around the core, so the value there is far from
    zero.

    Attributes:
        origin: Position of coefficient (0, 0, 0) [m], shape (3,), sensor frame.
        spacing: Distance of neighbours on each axis [m].
        coefficients: B-spline coefficients [m], shape (nx, ny, nz), C order.
    """

    origin: Floats
    spacing: float
    coefficients: Floats

    @classmethod
    def sampled(cls, origin: Floats, spacing: float, values: Floats) -> DistanceGrid:
        """Interpolate values [m] given at the grid's nodes."""
        from scipy import ndimage

        coefficients = ndimage.spline_filter(values, order=3, output=np.float64, mode="mirror")
        return cls(np.asarray(origin, np.float64), spacing, np.ascontiguousarray(coefficients))

    def evaluate(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Signed distance with derivatives.

        Args:
            points: Positions [m], shape (N, 3), sensor frame.

        Returns:
            Distance [m], positive outside the core, shape (N,); gradient, shape (N, 3); Hessian
            [1/m], shape (N, 3, 3).
        """
        points = np.asarray(points, np.float64).reshape(-1, 3)
        grid = (points - self.origin) / self.spacing
        last = np.array(self.coefficients.shape) - 2.0
        inside = np.clip(grid, 1.0, last)
        cell = np.minimum(np.floor(inside), last - 1).astype(np.int64)
        weights = _weights(inside - cell)  # by order of the derivative, each (N, 3, 4)
        near = cell[:, :, None] + np.arange(-1, 3)
        block = self.coefficients[
            near[:, 0, :, None, None], near[:, 1, None, :, None], near[:, 2, None, None, :]
        ]

        def derivative(x: int, y: int, z: int) -> Floats:
            """Derivative of these orders along the axes, per cell."""
            along = weights[x][:, 0], weights[y][:, 1], weights[z][:, 2]
            return np.asarray(np.einsum("nijk,ni,nj,nk->n", block, *along, optimize=True))

        distance = derivative(0, 0, 0)
        axes = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
        gradient = np.stack([derivative(*axis) for axis in axes], axis=1) / self.spacing
        upper = {
            (i, j): derivative(*np.add(axes[i], axes[j])) for i in range(3) for j in range(i, 3)
        }
        second = [upper[min(i, j), max(i, j)] for i in range(3) for j in range(3)]
        hessian = np.stack(second, axis=1) / self.spacing**2
        # Outside the grid: extrapolated by the distance to it, see above.
        away = np.linalg.norm(grid - inside, axis=1) * self.spacing
        hessian[away > 0] = 0.0
        return distance + away, gradient, hessian.reshape(-1, 3, 3)


@dataclass(frozen=True)
class RigidCore:
    """The rigid core inside the skin.

    Attributes:
        grid: Signed distance: zero on the surface, positive outside.
        vertices: Surface for pictures [m], shape (P, 3), sensor frame.
        faces: Triangles, normals out of the core, shape (Q, 3).
        volume_m3: Volume inside the zero level of the grid [m^3].
        name: Shown to users.
    """

    grid: DistanceGrid
    vertices: Floats
    faces: Ints
    volume_m3: float
    name: str = ""


def volume_inside(values: Floats, spacing: float) -> float:
    """Volume where a sampled signed distance is negative [m^3].

    Each node stands for one cell, of which the share inside is 1/2 - d / spacing within half a cell
    of the surface; good to second order in the spacing.
    """
    share = np.clip(0.5 - values / spacing, 0.0, 1.0)
    return float(share.sum() * spacing**3)


CANDIDATES = 8  # nearest sample points whose triangles are tried; samples are SAMPLE_M apart
SAMPLE_M = 0.25e-3
CHUNK = 20_000  # points at once: about 100 MB


def _samples(points: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Sample points of the surface, at most SAMPLE_M apart, and the triangle of each."""
    corner = points[faces]
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    parts = np.maximum(1, np.ceil(longest / SAMPLE_M).astype(int))
    places, owners = [], []
    for n in np.unique(parts):
        ids = np.flatnonzero(parts == n)
        i, j = np.divmod(np.arange(n * n), n)
        keep = i + j < n
        a, b = (i[keep] + 1 / 3) / n, (j[keep] + 1 / 3) / n
        weights = np.stack([1 - a - b, a, b], axis=1)
        places.append(np.einsum("sk,fki->fsi", weights, corner[ids]).reshape(-1, 3))
        owners.append(np.repeat(ids, keep.sum()))
    return np.concatenate(places), np.concatenate(owners).astype(np.int32)


def _nearest_on_triangles(p: Floats, a: Floats, b: Floats, c: Floats) -> tuple[Floats, Floats]:
    """Nearest points of triangles: barycentric coordinates (..., 3) and squared distance (...)."""
    ab, ac, ap = b - a, c - a, p - a

    def dot(x: Floats, y: Floats) -> Floats:
        return np.asarray(np.einsum("...i,...i->...", x, y))

    aa, bb, mixed = dot(ab, ab), dot(ac, ac), dot(ab, ac)
    d1, d2 = dot(ab, ap), dot(ac, ap)
    determinant = np.maximum(aa * bb - mixed**2, 1e-300)
    v, w = (bb * d1 - mixed * d2) / determinant, (aa * d2 - mixed * d1) / determinant
    best = np.stack([1 - v - w, v, w], axis=-1)
    within = (best >= 0).all(axis=-1)
    gap = dot(ap, ap) - d1 * v - d2 * w
    square = np.where(within, np.maximum(gap, 0.0), np.inf)
    for i, j, start, along in ((0, 1, a, ab), (0, 2, a, ac), (1, 2, b, c - b)):
        t = np.clip(dot(p - start, along) / np.maximum(dot(along, along), 1e-300), 0.0, 1.0)
        off = p - start - t[..., None] * along
        here = dot(off, off)
        on_edge = np.zeros_like(best)
        on_edge[..., i], on_edge[..., j] = 1 - t, t
        better = here < square
        best = np.where(better[..., None], on_edge, best)
        square = np.where(better, here, square)
    return best, square


def signed_distance(points: Floats, vertices: Floats, faces: Ints) -> tuple[Floats, Floats]:
    """Signed distance of points to a closed surface, by its triangles.

    The sign follows from the angle-weighted pseudo-normal of the nearest face, edge or node, which
    is correct for each closed surface that does not intersect itself (Baerentzen, Aanaes 2005).

    Args:
        points: Positions [m], shape (N, 3).
        vertices: Of the surface [m], shape (P, 3).
        faces: Triangles, normals outwards, shape (Q, 3).

    Returns:
        Distance [m], positive outside, shape (N,); nearest points of the surface [m], shape (N, 3).
    """
    from scipy.spatial import cKDTree

    sample, owner = _samples(vertices, faces)
    tree = cKDTree(sample)
    normals = node_normals(vertices, faces)
    flat = face_vectors(vertices, faces)
    flat /= np.maximum(np.linalg.norm(flat, axis=1), 1e-300)[:, None]
    edge_normal = _edge_normals(faces, flat)
    distance, nearest = np.empty(len(points)), np.empty((len(points), 3))
    for start in range(0, len(points), CHUNK):
        p = points[start : start + CHUNK]
        _, near = tree.query(p, k=min(CANDIDATES, len(sample)))
        tried = owner[near.reshape(len(p), -1)]
        corner = vertices[faces[tried]]
        where, square = _nearest_on_triangles(
            p[:, None], corner[:, :, 0], corner[:, :, 1], corner[:, :, 2]
        )
        pick = square.argmin(axis=1)
        rows = np.arange(len(p))
        face, bary = tried[rows, pick], where[rows, pick]
        foot = np.einsum("nk,nki->ni", bary, corner[rows, pick])
        # One vanishing barycentric coordinate: the foot lies on an edge; two: in a node.
        zero = bary < 1e-9
        normal = flat[face].copy()
        on = np.flatnonzero(zero.sum(axis=1) == 1)
        normal[on] = edge_normal[face[on], zero[on].argmax(axis=1)]
        on = np.flatnonzero(zero.sum(axis=1) == 2)
        normal[on] = normals[faces[face[on], bary[on].argmax(axis=1)]]
        side = np.where(np.einsum("ni,ni->n", p - foot, normal) < 0, -1.0, 1.0)
        distance[start : start + CHUNK] = side * np.sqrt(square[rows, pick])
        nearest[start : start + CHUNK] = foot
    return distance, nearest


def _edge_normals(faces: Ints, flat: Floats) -> Floats:
    """Sum of the normals of the two faces at the edge opposite to each corner, shape (Q, 3, 3)."""
    ends = np.stack([np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=2)
    key = ends.min(axis=2).astype(np.int64) * (int(faces.max()) + 1) + ends.max(axis=2)
    _, index = np.unique(key.ravel(), return_inverse=True)
    total = np.zeros((int(index.max()) + 1, 3))
    np.add.at(total, index, np.repeat(flat, 3, axis=0))
    return np.asarray(total[index].reshape(len(faces), 3, 3))


def grid_points(origin: Floats, spacing: float, shape: tuple[int, int, int]) -> Floats:
    """Nodes of a grid, shape (nx, ny, nz, 3) [m]."""
    axes = [origin[i] + spacing * np.arange(shape[i]) for i in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def box_around(
    points: Floats, margin: float, spacing: float
) -> tuple[Floats, tuple[int, int, int]]:
    """Origin [m] and shape of a grid that holds all points with a margin, symmetric to y = 0."""
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    half = np.ceil(max(-low[1], high[1]) / spacing) * spacing
    low[1], high[1] = -half, half
    size = np.ceil((high - low) / spacing - 1e-6).astype(int) + 1
    return low, (int(size[0]), int(size[1]), int(size[2]))


def spread(at: Floats, near: NDArray[np.bool_], foot: Floats, sign: Floats) -> Floats:
    """Distance at all nodes of a grid from the nearest surface points of those in a band.

    A node outside the band uses the surface point of the nearest node in the band, with an error
    below 1 % of the spacing at a smooth surface (Danielsson's propagation).

    Args:
        at: Nodes of the grid [m], shape (nx, ny, nz, 3).
        near: Nodes of the band, shape (nx, ny, nz).
        foot: Their nearest surface points [m], shape (N, 3).
        sign: -1 inside, +1 outside, shape (nx, ny, nz).

    Returns:
        Signed distance [m], shape (nx, ny, nz).
    """
    from scipy import ndimage

    flat, inside_band = at.reshape(-1, 3), near.ravel()
    full = np.empty_like(flat)
    full[inside_band] = foot
    index = ndimage.distance_transform_edt(~near, return_distances=False, return_indices=True)
    donor = np.ravel_multi_index(tuple(index), near.shape).ravel()
    return np.asarray(sign * np.linalg.norm(flat - full[donor], axis=1).reshape(near.shape))


def tabulate(vertices: Floats, faces: Ints, at: Floats, *, band_m: float = 0.6e-3) -> Floats:
    """Signed distance to a closed triangle surface at the nodes of a grid.

    Args:
        vertices: Of the surface [m], shape (P, 3).
        faces: Triangles, normals outwards, shape (Q, 3).
        at: Nodes of a regular grid [m], shape (nx, ny, nz, 3); node [0, 0, 0] lies outside.
        band_m: Within, the distance is exact; must exceed twice the spacing of the grid, so that
            the band separates inside from outside.

    Returns:
        Signed distance [m], positive outside, shape (nx, ny, nz).
    """
    from scipy import ndimage
    from scipy.spatial import cKDTree

    sample, _ = _samples(vertices, faces)
    flat = at.reshape(-1, 3)
    rough, _ = cKDTree(sample).query(flat, distance_upper_bound=band_m)
    near = np.isfinite(rough).reshape(at.shape[:-1])
    distance, foot = signed_distance(flat[near.ravel()], vertices, faces)
    # Outside the band the sign is that of the connected region: node [0, 0, 0] lies outside.
    label, _ = ndimage.label(~near)
    sign = np.where(~near & (label != label[0, 0, 0]), -1.0, 1.0)
    sign[near] = np.where(distance < 0, -1.0, 1.0)
    return spread(at, near, foot, sign)
