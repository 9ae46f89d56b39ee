# mypy: ignore-errors
"""Kernel of frictionless contact with the core, whose distance is a tabulated cubic B-spline."""

from __future__ import annotations

import warp as wp

from palpate_fem.mechanics.contact_laws import Law, normal_law

wp.set_module_options({"enable_backward": False})


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
    return wp.vec4d(
        s, wp.float64(3.0) * t - wp.float64(2.0), wp.float64(3.0) * s - wp.float64(2.0), t
    )


@wp.kernel
def core_contact(
    # Model:
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    area: wp.array2d(dtype=wp.float64),
    coefficients: wp.array3d(dtype=wp.float64),
    origin: wp.vec3d,
    spacing: wp.float64,
    law: Law,
    margin: wp.float64,
    # State in:
    position_in: wp.array(dtype=wp.vec3d),
    pressure_in: wp.array2d(dtype=wp.float64),
    # Out:
    status_out: wp.array2d(dtype=wp.int32),
    gap_out: wp.array2d(dtype=wp.float64),
    wanted_out: wp.array2d(dtype=wp.float64),
    slope_out: wp.array2d(dtype=wp.vec3d),
    misfit_out: wp.array2d(dtype=wp.vec3d),
    tangent_out: wp.array2d(dtype=wp.mat33d),
    force_out: wp.array(dtype=wp.vec3d),
):
    """Frictionless contact of the inner faces with the core, a tabulated distance.

    Adds minus the contact force (a residual) to ``force_out``. Points whose sample is farther
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
        m = wp.clamp(int(wp.floor(u[2])), 1, coefficients.shape[2] - 3)
        gap_out[f, q] = coefficients[i, j, m]
        status_out[f, q] = 0
        wanted_out[f, q] = wp.float64(0.0)
        slope_out[f, q] = wp.vec3d()
        misfit_out[f, q] = wp.vec3d()
        p = pressure_in[f, q]
        if coefficients[i, j, m] < margin or p > wp.float64(0.0):
            tx = u[0] - wp.float64(i)
            ty = u[1] - wp.float64(j)
            tz = u[2] - wp.float64(m)
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
                        c = coefficients[i + r - 1, j + s - 1, m + t - 1]
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
            answer = normal_law(law, p, value)
            if answer[1] > wp.float64(0.0):
                status_out[f, q] = 1
                wanted_out[f, q] = answer[0]
                w = area[f, q]
                slope_out[f, q] = answer[1] * normal
                misfit_out[f, q] = (w * (answer[0] - p)) * normal
                for a in range(k):
                    wp.atomic_sub(force_out, faces[f, a], (w * shape[q, a] * p) * normal)
                curvature = wp.mat33d(
                    hxx, hxy, hxz, hxy, hyy, hyz, hxz, hyz, hzz
                ) / (spacing * spacing)  # fmt: skip
                tangent_out[f, q] = w * (answer[1] * wp.outer(normal, normal) - p * curvature)
