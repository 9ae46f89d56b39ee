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

With a fillet r the union is *closed* by a ball: it also holds all that a ball of radius r outside
cannot reach, so a concave crease becomes an arc of radius r, whatever the angle. The ball's centres
are the set A of points with all gaps at least r, and where the union's gap g is below r::

    gap = r - |y - x|,   normal = (y - x) / |y - x|,   y the point of A closest to x

Beside creases y is straight above one primitive, and nothing changes. In a crease y is on two
surfaces of gap r, on three where three primitives meet, and Newton's method finds it. As |y - x| is
a distance, the gap is continuous and changes no faster than the point moves; the normal is
continuous where y is, which is so up to the kinks of A, a radius above the surface. Inside, where y
may be far, the gap is at least g - r, and jumps at few places deeper than 0.3 mm.

``primitives`` are the rows of `Indenter.packed`: kind, axis, centre (3), sizes (4), rounding,
fillet.
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
CLOSE = wp.constant(wp.float64(1e-12))  # [m]; lengths that do not matter in a fillet
FLATTEST = wp.constant(wp.float64(1e-6))  # sine of the angle below which two normals are parallel
STEPS = wp.constant(30)  # of Newton's method; it needs 3-5


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
def of_primitive(primitives: wp.array2d(dtype=wp.float64), p: int, x: wp.vec3d) -> IndenterGap:
    """Gap, normal and hessian of primitive p."""
    near = IndenterGap()
    if primitives[p, 0] == BOX:
        near = box_derivatives(primitives, p, x)
    else:
        near = revolved_derivatives(primitives, p, x)
    near.gap = gap_of(primitives, p, x)
    return near


@wp.struct
class Crease:
    """Centre of the ball that touches two or three primitives, and how it follows a point."""

    found: wp.bool
    centre: wp.vec3d  # [m]
    share: wp.vec3d  # centre - x in the basis of the normals [m]; negative: not held by that one
    along: wp.vec3d  # direction of the crease; zero in a corner of three
    follow: wp.float64  # movement of the centre along the crease, per movement of x


@wp.func
def crease_of(
    primitives: wp.array2d(dtype=wp.float64),
    a: int,
    b: int,
    c: int,
    x: wp.vec3d,
    start: wp.vec3d,
) -> Crease:
    """The point with gaps of a fillet to primitives a, b and c that is closest to x.

    Newton's method for: |y - x| least, gaps of y equal to the fillet. In a corner of three the gaps
    determine y; on a crease of two it also moves along the crease.

    Args:
        primitives: Rows of `Indenter.packed`.
        a: First primitive.
        b: Second primitive.
        c: Third primitive, or -1.
        x: Position [m].
        start: Where to begin [m].
    """
    one = wp.float64(1.0)
    fillet = primitives[0, 10]
    out = Crease()
    out.centre = start
    length = wp.float64(1e300)
    step = wp.int32(0)
    while length > CLOSE and step < STEPS:
        step += 1
        on_a = of_primitive(primitives, a, out.centre)
        on_b = of_primitive(primitives, b, out.centre)
        on_c = IndenterGap()
        third = wp.cross(on_a.normal, on_b.normal)
        if c >= 0:
            on_c = of_primitive(primitives, c, out.centre)
            third = on_c.normal
        else:
            third = third / wp.max(wp.length(third), FLATTEST)
        volume = wp.dot(on_a.normal, wp.cross(on_b.normal, third))
        if wp.abs(volume) <= FLATTEST:
            return out
        by_a = wp.cross(on_b.normal, third) / volume
        by_b = wp.cross(third, on_a.normal) / volume
        by_c = wp.cross(on_a.normal, on_b.normal) / volume
        move = (fillet - on_a.gap) * by_a + (fillet - on_b.gap) * by_b
        if c >= 0:
            move += (fillet - on_c.gap) * by_c
        else:
            bend = out.share[0] * on_a.hessian + out.share[1] * on_b.hessian
            left = wp.max(wp.abs(one - wp.dot(third, bend * third)), wp.float64(1e-3))
            move += (wp.dot(third, x - out.centre + bend * move) / left) * third
        length = wp.length(move)
        if length > fillet:
            move = (fillet / length) * move
        out.centre += move
        away = out.centre - x
        out.share = wp.vec3d(wp.dot(by_a, away), wp.dot(by_b, away), wp.dot(by_c, away))
        if c < 0:
            out.share[2] = wp.float64(0.0)
            bend = out.share[0] * on_a.hessian + out.share[1] * on_b.hessian
            out.along = third
            out.follow = one / wp.max(one - wp.dot(third, bend * third), wp.float64(1e-3))
    out.found = length <= CLOSE
    return out


@wp.func
def deepest_at(
    primitives: wp.array2d(dtype=wp.float64), a: int, b: int, c: int, centre: wp.vec3d
) -> int:
    """The primitive but a, b and c that a ball is deepest in; -1 = it is in none."""
    deepest = wp.int32(-1)
    least = primitives[0, 10] - CLOSE
    for p in range(primitives.shape[0]):
        if p != a and p != b and p != c and centre[2] - top_of(primitives, p) < least:
            gap = gap_of(primitives, p, centre)
            if gap < least:
                least = gap
                deepest = p
    return deepest


@wp.func
def closest_crease(
    primitives: wp.array2d(dtype=wp.float64), x: wp.vec3d, start: wp.vec3d, reach: wp.float64
) -> Crease:
    """The closest crease or corner among all pairs and triples of primitives within reach."""
    closest = Crease()
    least = reach
    count = primitives.shape[0]
    for a in range(count):
        if gap_of(primitives, a, x) < primitives[0, 10] + least:
            for b in range(a + 1, count):
                if gap_of(primitives, b, x) < primitives[0, 10] + least:
                    for c in range(b, count):
                        third = wp.where(c > b, c, -1)  # first the pair
                        if third < 0 or gap_of(primitives, c, x) < primitives[0, 10] + least:
                            ball = crease_of(primitives, a, b, third, x, start)
                            size = wp.length(ball.centre - x)
                            if ball.found and size < least:
                                if deepest_at(primitives, a, b, third, ball.centre) < 0:
                                    closest = ball
                                    least = size
    return closest


@wp.func
def filleted(
    primitives: wp.array2d(dtype=wp.float64), nearest: int, near: IndenterGap, x: wp.vec3d
) -> IndenterGap:
    """What a fillet makes of a gap below its radius.

    The ball above the nearest primitive is held by that alone, or also by the one that it is
    deepest in, or also by a third. Where this is not the answer, which is rare, all are tried.
    """
    depth = primitives[0, 10] - near.gap
    reach = depth + primitives[0, 10]
    start = x + depth * near.normal
    second = deepest_at(primitives, nearest, -1, -1, start)
    if second < 0:
        return near
    ball = crease_of(primitives, nearest, second, -1, x, start)
    third = wp.int32(-1)
    if ball.found:
        third = deepest_at(primitives, nearest, second, -1, ball.centre)
    if third >= 0:
        ball = crease_of(primitives, nearest, second, third, x, ball.centre)
        if ball.found and deepest_at(primitives, nearest, second, third, ball.centre) >= 0:
            ball.found = False
    if not ball.found or wp.min(ball.share) < wp.float64(0.0):
        ball = closest_crease(primitives, x, start, reach)
    out = IndenterGap()
    away = ball.centre - x
    size = wp.length(away)
    if not ball.found or size > reach:
        out.gap = near.gap - primitives[0, 10]
        out.normal = near.normal
        out.hessian = near.hessian
        return out
    if size < CLOSE:
        return near
    n = away / size
    along = ball.along - wp.dot(ball.along, n) * n
    flat = wp.identity(n=3, dtype=wp.float64) - wp.outer(n, n)
    out.gap = primitives[0, 10] - size
    out.normal = n
    out.hessian = (ball.follow * wp.outer(along, along) - flat) / size
    return out


@wp.func
def indenter_distance(
    primitives: wp.array2d(dtype=wp.float64), x: wp.vec3d, margin: wp.float64
) -> IndenterGap:
    """Gap, normal and hessian where the gap is below ``margin``.

    Elsewhere, which is most of the skin, the result is cheap: normal and hessian are zero, and the
    gap is a lower bound of the true one that is at least ``margin``.

    Args:
        primitives: Rows of `Indenter.packed`, shape (P, 11).
        x: Position [m], indenter frame.
        margin: Gap beyond which a lower bound suffices [m], positive.
    """
    near = IndenterGap()
    nearest = wp.int32(-1)
    fillet = primitives[0, 10]
    below = wp.max(margin, fillet)  # a fillet makes gaps smaller only where they are below it
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
    near = of_primitive(primitives, nearest, x)
    if near.gap < fillet and fillet > wp.float64(0.0):
        near = filleted(primitives, nearest, near, x)
    if near.gap >= margin:
        bound_only = IndenterGap()
        bound_only.gap = near.gap
        return bound_only
    return near
