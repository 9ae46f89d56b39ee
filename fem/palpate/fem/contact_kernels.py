"""Kernels of contact, at the quadrature points of the surface faces.

Normal law, with gap g, multiplier lambda, stiffness e and softness d (all per *reference* area, so
that frictionless contact has an energy)::

    p(g) = e d log(1 + exp((lambda / e - g) / d))

an augmented Lagrangian whose corner is rounded within d, which stops the cycling of a hard active set.
Friction: return mapping. A point sticks to an anchor on the indenter by a spring of stiffness k; the
spring's traction is capped at mu p, and what is beyond moves the anchor at the end of the increment.

NumPy twins: ``contact.py``.
"""

from __future__ import annotations

import warp as wp

from palpate.fem.indenter.kernels import indenter_distance

wp.set_module_options({"enable_backward": False})


@wp.struct
class Law:
    """Constants of the contact laws; SI."""

    stiffness: wp.float64
    softness: wp.float64
    friction: wp.float64
    tangential_stiffness: wp.float64


@wp.func
def normal_law(law: Law, multiplier: wp.float64, gap: wp.float64) -> wp.vec2d:
    """Pressure p [Pa] and -dp/dg [Pa/m]."""
    z = (multiplier / law.stiffness - gap) / law.softness
    if z > wp.float64(30.0):
        return wp.vec2d(law.stiffness * law.softness * z, law.stiffness)
    if z < wp.float64(-40.0):
        return wp.vec2d(wp.float64(0.0), wp.float64(0.0))
    grown = wp.exp(z)
    pressure = law.stiffness * law.softness * wp.log(wp.float64(1.0) + grown)
    return wp.vec2d(pressure, law.stiffness * grown / (wp.float64(1.0) + grown))


@wp.func
def bspline(t: wp.float64, order: int) -> wp.vec4d:
    """Weights of four cubic B-spline coefficients at 0 <= t < 1, or their derivative in t."""
    one = wp.float64(1.0)
    s = one - t
    if order == 0:
        return wp.vec4d(
            s * s * s / wp.float64(6.0),
            (wp.float64(3.0) * t * t * t - wp.float64(6.0) * t * t + wp.float64(4.0))
            / wp.float64(6.0),
            (wp.float64(3.0) * s * s * s - wp.float64(6.0) * s * s + wp.float64(4.0))
            / wp.float64(6.0),
            t * t * t / wp.float64(6.0),
        )
    half = wp.float64(0.5)
    if order == 1:
        return wp.vec4d(
            -half * s * s,
            (wp.float64(1.5) * t - wp.float64(2.0)) * t,
            -(wp.float64(1.5) * s - wp.float64(2.0)) * s,
            half * t * t,
        )
    return wp.vec4d(s, wp.float64(3.0) * t - wp.float64(2.0), wp.float64(3.0) * s - wp.float64(2.0), t)


@wp.kernel
def core_contact(
    # Model:
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    area: wp.array2d(dtype=wp.float64),
    pair: wp.array3d(dtype=wp.int32),
    coefficients: wp.array3d(dtype=wp.float64),
    origin: wp.vec3d,
    spacing: wp.float64,
    law: Law,
    margin: wp.float64,
    # State in:
    position_in: wp.array(dtype=wp.vec3d),
    multiplier_in: wp.array2d(dtype=wp.float64),
    with_tangent: int,
    # Out:
    gap_out: wp.array2d(dtype=wp.float64),
    pressure_out: wp.array2d(dtype=wp.float64),
    force_out: wp.array(dtype=wp.vec3d),
    block_out: wp.array(dtype=wp.mat33d),
):
    """Frictionless contact of the inner faces with the core, a tabulated distance.

    Adds minus the contact force (a residual) to ``force_out``. Points whose nearest sample is farther
    than ``margin`` are left out.
    """
    f = wp.tid()
    k = faces.shape[1]
    for q in range(shape.shape[0]):
        x = wp.vec3d()
        for a in range(k):
            x += shape[q, a] * position_in[faces[f, a]]
        u = (x - origin) / spacing
        i = wp.clamp(int(wp.floor(u[0])), 1, coefficients.shape[0] - 3)
        j = wp.clamp(int(wp.floor(u[1])), 1, coefficients.shape[1] - 3)
        l = wp.clamp(int(wp.floor(u[2])), 1, coefficients.shape[2] - 3)
        gap_out[f, q] = coefficients[i, j, l]
        pressure_out[f, q] = wp.float64(0.0)
        if coefficients[i, j, l] < margin:
            tx = u[0] - wp.float64(i)
            ty = u[1] - wp.float64(j)
            tz = u[2] - wp.float64(l)
            x0 = bspline(tx, 0)
            x1 = bspline(tx, 1)
            x2 = bspline(tx, 2)
            y0 = bspline(ty, 0)
            y1 = bspline(ty, 1)
            y2 = bspline(ty, 2)
            z0 = bspline(tz, 0)
            z1 = bspline(tz, 1)
            z2 = bspline(tz, 2)
            value = wp.float64(0.0)
            gx = wp.float64(0.0)
            gy = wp.float64(0.0)
            gz = wp.float64(0.0)
            hxx = wp.float64(0.0)
            hyy = wp.float64(0.0)
            hzz = wp.float64(0.0)
            hyz = wp.float64(0.0)
            hxz = wp.float64(0.0)
            hxy = wp.float64(0.0)
            for r in range(4):
                for s in range(4):
                    row0 = wp.float64(0.0)
                    row1 = wp.float64(0.0)
                    row2 = wp.float64(0.0)
                    for t in range(4):
                        c = coefficients[i + r - 1, j + s - 1, l + t - 1]
                        row0 += c * z0[t]
                        row1 += c * z1[t]
                        row2 += c * z2[t]
                    value += x0[r] * y0[s] * row0
                    gx += x1[r] * y0[s] * row0
                    gy += x0[r] * y1[s] * row0
                    gz += x0[r] * y0[s] * row1
                    hxx += x2[r] * y0[s] * row0
                    hyy += x0[r] * y2[s] * row0
                    hzz += x0[r] * y0[s] * row2
                    hyz += x0[r] * y1[s] * row1
                    hxz += x1[r] * y0[s] * row1
                    hxy += x1[r] * y1[s] * row0
            normal = wp.vec3d(gx, gy, gz) / spacing
            gap_out[f, q] = value
            answer = normal_law(law, multiplier_in[f, q], value)
            pressure_out[f, q] = answer[0]
            if answer[0] > wp.float64(0.0):
                w = area[f, q]
                for a in range(k):
                    wp.atomic_sub(force_out, faces[f, a], (w * shape[q, a] * answer[0]) * normal)
                if with_tangent == 1:
                    curvature = wp.mat33d(
                        hxx, hxy, hxz, hxy, hyy, hyz, hxz, hyz, hzz
                    ) / (spacing * spacing)  # fmt: skip
                    d = w * (answer[1] * wp.outer(normal, normal) - answer[0] * curvature)
                    for a in range(k):
                        for b in range(k):
                            if pair[f, a, b] >= 0:
                                wp.atomic_add(
                                    block_out, pair[f, a, b], (shape[q, a] * shape[q, b]) * d
                                )


@wp.kernel
def indenter_contact(
    # Model:
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    area: wp.array2d(dtype=wp.float64),
    pair: wp.array3d(dtype=wp.int32),
    primitives: wp.array2d(dtype=wp.float64),
    law: Law,
    margin: wp.float64,
    # State in:
    tip: wp.vec3d,
    rotation: wp.mat33d,
    position_in: wp.array(dtype=wp.vec3d),
    multiplier_in: wp.array2d(dtype=wp.float64),
    anchor_in: wp.array2d(dtype=wp.vec3d),
    with_tangent: int,
    # Out:
    gap_out: wp.array2d(dtype=wp.float64),
    pressure_out: wp.array2d(dtype=wp.float64),
    normal_out: wp.array2d(dtype=wp.vec3d),
    friction_out: wp.array2d(dtype=wp.vec3d),
    rest_out: wp.array2d(dtype=wp.mat33d),
    force_out: wp.array(dtype=wp.vec3d),
    block_out: wp.array(dtype=wp.mat33d),
):
    """Frictional contact of the outer faces with the indenter.

    Anchors are in the indenter's frame. Adds minus the contact force to ``force_out``, a symmetric
    approximation of the tangent to the blocks, and what it lacks to ``rest_out``: mostly the growth
    of the sliding friction with pressure. That term must not be symmetrised: its mirror image
    would make the matrix indefinite, by the square of half the friction coefficient.
    """
    f = wp.tid()
    k = faces.shape[1]
    for q in range(shape.shape[0]):
        x = wp.vec3d()
        for a in range(k):
            x += shape[q, a] * position_in[faces[f, a]]
        local = wp.transpose(rotation) * (x - tip)
        near = indenter_distance(primitives, local, margin)
        gap = near.gap
        gap_out[f, q] = gap
        pressure_out[f, q] = wp.float64(0.0)
        friction_out[f, q] = wp.vec3d()
        if with_tangent == 1:
            rest_out[f, q] = wp.mat33d()
        if gap < margin:
            normal = rotation * near.normal
            normal_out[f, q] = normal
            answer = normal_law(law, multiplier_in[f, q], gap)
            p = answer[0]
            pressure_out[f, q] = p
            if p > wp.float64(0.0):
                w = area[f, q]
                curvature = rotation * near.hessian * wp.transpose(rotation)
                arm = x - (tip + rotation * anchor_in[f, q])
                along = wp.dot(normal, arm)
                trial = law.tangential_stiffness * (arm - along * normal)
                size = wp.length(trial)
                limit = law.friction * p
                slips = size > limit
                friction = trial
                if slips:
                    friction = (limit / size) * trial
                friction_out[f, q] = friction
                for a in range(k):
                    wp.atomic_sub(
                        force_out, faces[f, a], (w * shape[q, a]) * (p * normal - friction)
                    )
                if with_tangent == 1:
                    d = answer[1] * wp.outer(normal, normal) - p * curvature
                    rest = wp.mat33d()
                    if law.friction > wp.float64(0.0):
                        # d trial / d x, from trial = k P(n) arm and d n / d x = curvature
                        turn = law.tangential_stiffness * (
                            wp.identity(n=3, dtype=wp.float64)
                            - wp.outer(normal, normal)
                            - along * curvature
                            - wp.outer(normal, curvature * arm)
                        )
                        if slips:
                            t = trial / size
                            turn = (limit / size) * (turn - wp.outer(t, wp.transpose(turn) * t))
                            rest = wp.outer((-law.friction * answer[1]) * t, normal)
                        symmetric = wp.float64(0.5) * (turn + wp.transpose(turn))
                        rest += turn - symmetric
                        d += symmetric
                    rest_out[f, q] = w * rest
                    d = w * d
                    for a in range(k):
                        for b in range(k):
                            if pair[f, a, b] >= 0:
                                wp.atomic_add(
                                    block_out, pair[f, a, b], (shape[q, a] * shape[q, b]) * d
                                )


@wp.kernel
def rest_product(
    # Model:
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    # State in:
    sliding_in: wp.array(dtype=wp.int32),
    rest_in: wp.array2d(dtype=wp.mat33d),
    vector_in: wp.array(dtype=wp.vec3d),
    # Out:
    product_out: wp.array(dtype=wp.vec3d),
):
    """Add (tangent - its symmetric approximation) times a nodal vector, over the listed faces."""
    f = sliding_in[wp.tid()]
    k = faces.shape[1]
    for q in range(shape.shape[0]):
        v = wp.vec3d()
        for a in range(k):
            v += shape[q, a] * vector_in[faces[f, a]]
        moved = rest_in[f, q] * v
        for a in range(k):
            wp.atomic_add(product_out, faces[f, a], shape[q, a] * moved)
