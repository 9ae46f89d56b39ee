"""Signed distance to an indenter with two derivatives; NumPy twin: ``tests/fem/numpy_indenter.py``.

A rounded primitive is a sharp one K grown by rho. With c(x) the point of K closest to x and
L = |x - c|::

    gap = L - rho,   normal = (x - c) / L,   hessian = (I - n n^T - dc/dx) / L

For a box dc/dx is diagonal, 1 where a coordinate is within. For a solid of revolution the same
holds in the half plane (r, t) of distance from and position along the axis, and the circumference
adds (d gap / d r) / r. Inside K, where L = 0, the nearest face of K replaces c, so that the sign is
right.

The distance to the union is the smallest of its parts': exact outside; inside, where parts overlap,
it has the right sign and is at least the exact one. At kinks (medial axes) one of the candidates is
chosen, always the same one, and all values are finite.

``primitives`` are the rows of `Indenter.packed`: kind, axis, centre (3), sizes (4), rounding.
"""

# Warp's types describe calls from Python, not the language inside kernels.
# mypy: ignore-errors

from __future__ import annotations

import warp as wp

from palpate_fem.indenter.shape import PrimitiveKind

wp.set_module_options({"enable_backward": False})

# [m]; closer to its axis a solid of revolution has no radial direction: far below any length that
# matters, far above what rounds to zero.
ON_AXIS = 1e-12
BOX = wp.constant(wp.float64(float(PrimitiveKind.BOX)))
NEAR_AXIS = wp.constant(wp.float64(ON_AXIS))


@wp.struct
class IndenterGap:
    """Gap [m], its gradient, and its second derivative [1/m]; indenter frame."""

    gap: wp.float64
    normal: wp.vec3d
    hessian: wp.mat33d


@wp.func
def top_of(primitives: wp.array2d(dtype=wp.float64), p: int) -> wp.float64:
    """Highest z of primitive p [m]."""
    height = primitives[p, 7]  # of a box
    if primitives[p, 0] != BOX:
        height = primitives[p, 6]  # radius of a solid whose axis lies
        if primitives[p, 1] == wp.float64(2.0):
            height = primitives[p, 8]
    return primitives[p, 4] + height + primitives[p, 9]


@wp.func
def around(axis: int, away: wp.vec3d) -> wp.vec3d:
    """Components of a vector across the axis, first and second, and along it."""
    if axis == 2:
        return away
    if axis == 0:
        return wp.vec3d(away[1], away[2], away[0])
    return wp.vec3d(away[2], away[0], away[1])


@wp.func
def gap_of(primitives: wp.array2d(dtype=wp.float64), p: int, x: wp.vec3d) -> wp.float64:
    """Signed distance to primitive p [m]."""
    zero = wp.float64(0.0)
    away = x - wp.vec3d(primitives[p, 2], primitives[p, 3], primitives[p, 4])
    if primitives[p, 0] == BOX:
        bx = wp.abs(away[0]) - primitives[p, 5]
        by = wp.abs(away[1]) - primitives[p, 6]
        bz = wp.abs(away[2]) - primitives[p, 7]
        ox = wp.max(bx, zero)
        oy = wp.max(by, zero)
        oz = wp.max(bz, zero)
        far = wp.sqrt(ox * ox + oy * oy + oz * oz)
        if far == zero:
            far = wp.max(bx, wp.max(by, bz))
        return far - primitives[p, 9]
    c = around(int(primitives[p, 1]), away)
    inner = primitives[p, 5]
    outer = primitives[p, 6]
    low = primitives[p, 7]
    high = primitives[p, 8]
    radius = wp.sqrt(c[0] * c[0] + c[1] * c[1])
    if radius < NEAR_AXIS:
        radius = zero
    out_r = radius - wp.clamp(radius, inner, outer)
    out_t = c[2] - wp.clamp(c[2], low, high)
    length = wp.sqrt(out_r * out_r + out_t * out_t)
    if length == zero:
        length = wp.max(wp.max(c[2] - high, low - c[2]), radius - outer)
        if inner > zero:
            length = wp.max(length, inner - radius)
    return length - primitives[p, 9]


@wp.func
def box_derivatives(primitives: wp.array2d(dtype=wp.float64), p: int, x: wp.vec3d) -> IndenterGap:
    """Normal and hessian of a box."""
    zero = wp.float64(0.0)
    near = IndenterGap()
    away = x - wp.vec3d(primitives[p, 2], primitives[p, 3], primitives[p, 4])
    side = wp.vec3d(wp.float64(1.0), wp.float64(1.0), wp.float64(1.0))
    out = wp.vec3d()
    face = wp.int32(0)
    largest = wp.abs(away[0]) - primitives[p, 5]
    for i in range(3):
        if away[i] < zero:
            side[i] = wp.float64(-1.0)
        beyond = wp.abs(away[i]) - primitives[p, 5 + i]
        out[i] = wp.max(beyond, zero)
        if beyond > largest:
            largest = beyond
            face = i
    length = wp.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    if length == zero:
        near.normal[face] = side[face]
        return near
    normal = wp.cw_mul(side, out) / length
    hessian = -wp.outer(normal, normal) / length
    for i in range(3):
        if out[i] > zero:
            hessian[i, i] = hessian[i, i] + wp.float64(1.0) / length
    near.normal = normal
    near.hessian = hessian
    return near


@wp.func
def revolved_derivatives(
    primitives: wp.array2d(dtype=wp.float64), p: int, x: wp.vec3d
) -> IndenterGap:
    """Normal and hessian of a solid of revolution."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    near = IndenterGap()
    axis = int(primitives[p, 1])
    away = x - wp.vec3d(primitives[p, 2], primitives[p, 3], primitives[p, 4])
    c = around(axis, away)
    inner = primitives[p, 5]
    outer = primitives[p, 6]
    low = primitives[p, 7]
    high = primitives[p, 8]

    first = (axis + 1) % 3
    second = (axis + 2) % 3
    along = wp.vec3d()
    along[axis] = one
    outward = wp.vec3d()
    radius = wp.sqrt(c[0] * c[0] + c[1] * c[1])
    if radius < NEAR_AXIS:
        radius = zero
        outward[second] = one
    else:
        outward[first] = c[0] / radius
        outward[second] = c[1] / radius

    out_r = radius - wp.clamp(radius, inner, outer)
    out_t = c[2] - wp.clamp(c[2], low, high)
    length = wp.sqrt(out_r * out_r + out_t * out_t)
    n_r = zero
    n_t = zero
    h_rr = zero
    h_tt = zero
    h_rt = zero
    h_ss = zero
    if length == zero:
        n_t = one
        largest = c[2] - high
        if low - c[2] > largest:
            largest = low - c[2]
            n_t = -one
        if radius - outer > largest:
            largest = radius - outer
            n_t = zero
            n_r = one
        if inner > zero and inner - radius > largest:
            n_t = zero
            n_r = -one
    else:
        n_r = out_r / length
        n_t = out_t / length
        h_rr = -n_r * n_r / length
        h_tt = -n_t * n_t / length
        h_rt = -n_r * n_t / length
        # On the axis of a line (outer = 0) it curves as beside it: (d gap / d r) / r -> 1 / L.
        if out_r != zero or (radius == zero and outer == zero):
            h_rr += one / length
        if out_t != zero:
            h_tt += one / length
        if radius == zero and outer == zero:
            h_ss = one / length
    if radius > zero:
        h_ss = n_r / radius
    sideways = wp.cross(along, outward)
    near.normal = n_r * outward + n_t * along
    near.hessian = (
        h_rr * wp.outer(outward, outward)
        + h_tt * wp.outer(along, along)
        + h_rt * (wp.outer(outward, along) + wp.outer(along, outward))
        + h_ss * wp.outer(sideways, sideways)
    )
    return near


@wp.func
def indenter_distance(
    primitives: wp.array2d(dtype=wp.float64), x: wp.vec3d, margin: wp.float64
) -> IndenterGap:
    """Gap, normal and hessian where the gap is below ``margin``.

    Elsewhere, which is most of the skin, the result is cheap: normal and hessian are zero, and the
    gap is a lower bound of the true one that is at least ``margin``.

    Args:
        primitives: Rows of `Indenter.packed`, shape (P, 10).
        x: Position [m], indenter frame.
        margin: Gap beyond which a lower bound suffices [m].
    """
    near = IndenterGap()
    nearest = wp.int32(-1)
    below = margin
    skipped = wp.float64(1e300)
    for p in range(primitives.shape[0]):
        bound = x[2] - top_of(primitives, p)
        if bound < below:
            gap = gap_of(primitives, p, x)
            if gap < below:
                below = gap
                nearest = p
            else:
                skipped = wp.min(skipped, gap)
        else:
            skipped = wp.min(skipped, bound)
    if nearest < 0:
        near.gap = skipped
        return near
    if primitives[nearest, 0] == BOX:
        near = box_derivatives(primitives, nearest, x)
    else:
        near = revolved_derivatives(primitives, nearest, x)
    near.gap = below
    return near
