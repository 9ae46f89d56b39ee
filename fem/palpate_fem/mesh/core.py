"""The rigid core: a tabulated signed distance that is twice continuously differentiable."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


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

    Outside, the value is that of the nearest inside point plus the way there, with that point's
    gradient and a zero Hessian: good to see that there is no contact, not to differentiate. The
    makers of grids leave a margin of several mm around the core, so the value is far from zero.

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
        value, slope, curvature = _weights(inside - cell)  # each (N, 3, 4)
        near = cell[:, :, None] + np.arange(-1, 3)
        block = self.coefficients[
            near[:, 0, :, None, None], near[:, 1, None, :, None], near[:, 2, None, None, :]
        ]

        def contract(x: Floats, y: Floats, z: Floats) -> Floats:
            return np.asarray(
                np.einsum("nijk,ni,nj,nk->n", block, x[:, 0], y[:, 1], z[:, 2], optimize=True)
            )

        distance = contract(value, value, value)
        gradient = (
            np.stack(
                [
                    contract(slope, value, value),
                    contract(value, slope, value),
                    contract(value, value, slope),
                ],
                axis=1,
            )
            / self.spacing
        )
        xx = contract(curvature, value, value)
        yy = contract(value, curvature, value)
        zz = contract(value, value, curvature)
        yz = contract(value, slope, slope)
        xz = contract(slope, value, slope)
        xy = contract(slope, slope, value)
        hessian = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1) / self.spacing**2
        away = np.linalg.norm(grid - inside, axis=1) * self.spacing
        hessian[away > 0] = 0.0
        return distance + away, gradient, hessian.reshape(-1, 3, 3)


@dataclass(frozen=True)
class Core:
    """The rigid core inside the skin.

    Attributes:
        grid: Signed distance: zero on the surface, positive outside.
        vertices: Surface for pictures [m], shape (P, 3), sensor frame.
        faces: Triangles, normals out of the core, shape (Q, 3).
        volume_m3: Volume inside the zero level of the grid [m^3].
        name: For people.
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
