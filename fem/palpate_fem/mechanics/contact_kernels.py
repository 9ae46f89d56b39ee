# mypy: ignore-errors
"""Kernels of contact: the outer faces with the indenter, and what all contact shares."""

from __future__ import annotations

import warp as wp

from palpate_fem.indenter.kernels import indenter_distance
from palpate_fem.mechanics.contact_laws import Law, friction_law, normal_law

wp.set_module_options({"enable_backward": False})


@wp.kernel
def indenter_contact(
    # Model:
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    area: wp.array2d(dtype=wp.float64),
    primitives: wp.array2d(dtype=wp.float64),
    law: Law,
    margin: wp.float64,
    # State in:
    tip: wp.vec3d,
    rotation: wp.mat33d,
    position_in: wp.array(dtype=wp.vec3d),
    pressure_in: wp.array2d(dtype=wp.float64),
    traction_in: wp.array2d(dtype=wp.vec3d),
    anchor_in: wp.array2d(dtype=wp.vec3d),
    # Out:
    status_out: wp.array2d(dtype=wp.int32),
    gap_out: wp.array2d(dtype=wp.float64),
    wanted_out: wp.array2d(dtype=wp.float64),
    slope_out: wp.array2d(dtype=wp.vec3d),
    misfit_out: wp.array2d(dtype=wp.vec3d),
    tangent_out: wp.array2d(dtype=wp.mat33d),
    wanted_traction_out: wp.array2d(dtype=wp.vec3d),
    traction_slope_out: wp.array2d(dtype=wp.mat33d),
    coupled_out: wp.array2d(dtype=wp.vec3d),
    rest_out: wp.array2d(dtype=wp.mat33d),
    force_out: wp.array(dtype=wp.vec3d),
):
    """Frictional contact of the outer faces with the indenter.

    Anchors are in the indenter's frame. Adds minus the contact force to ``force_out``. A symmetric
    approximation of the tangent goes to ``tangent_out``, what it lacks to ``rest_out``: mostly the
    growth of the sliding friction with pressure. That term must not be symmetrised: its mirror
    image would make the matrix indefinite, by the square of half the friction coefficient.
    """
    f = wp.tid()
    k = faces.shape[1]
    for q in range(shape.shape[0]):
        x = wp.vec3d()
        for a in range(k):
            x += shape[q, a] * position_in[faces[f, a]]
        local = wp.transpose(rotation) * (x - tip)
        near = indenter_distance(primitives, local, margin)
        gap_out[f, q] = near.gap
        status_out[f, q] = 0
        wanted_out[f, q] = wp.float64(0.0)
        slope_out[f, q] = wp.vec3d()
        misfit_out[f, q] = wp.vec3d()
        wanted_traction_out[f, q] = wp.vec3d()
        traction_slope_out[f, q] = wp.mat33d()
        coupled_out[f, q] = wp.vec3d()
        rest_out[f, q] = wp.mat33d()
        p = pressure_in[f, q]
        # Far points have none of these: their pressure was taken away when they left.
        if near.gap < margin:
            normal = rotation * near.normal
            answer = normal_law(law, p, near.gap)
            if answer[1] > wp.float64(0.0):
                status_out[f, q] = 1
                w = area[f, q]
                curvature = rotation * near.hessian * wp.transpose(rotation)
                slope = answer[1] * normal
                wanted_out[f, q] = answer[0]
                slope_out[f, q] = slope
                residual = p * normal
                misfit = (answer[0] - p) * normal
                d = wp.outer(slope, normal) - p * curvature
                rest = wp.mat33d()
                if law.friction > wp.float64(0.0):
                    t = traction_in[f, q]
                    arm = x - (tip + rotation * anchor_in[f, q])
                    rub = friction_law(law, p, t, normal, curvature, arm)
                    status_out[f, q] = 1 + rub.status
                    grown = (answer[0] - p) * rub.by_pressure
                    wanted_traction_out[f, q] = rub.wanted + grown
                    coupled_out[f, q] = -w * grown
                    coupled = wp.outer(rub.by_pressure, slope)
                    traction_slope_out[f, q] = rub.by_position - coupled
                    residual -= t
                    misfit -= rub.wanted - t
                    symmetric = wp.float64(0.5) * (rub.by_position + wp.transpose(rub.by_position))
                    d += symmetric
                    rest = rub.by_position - symmetric - coupled
                misfit_out[f, q] = w * misfit
                for a in range(k):
                    wp.atomic_sub(force_out, faces[f, a], (w * shape[q, a]) * residual)
                rest_out[f, q] = w * rest
                tangent_out[f, q] = w * d


@wp.kernel
def point_tangent(
    # Model:
    shape: wp.array2d(dtype=wp.float64),
    pair: wp.array3d(dtype=wp.int32),
    # State in:
    status_in: wp.array2d(dtype=wp.int32),
    tangent_in: wp.array2d(dtype=wp.mat33d),
    # Out:
    block_out: wp.array(dtype=wp.mat33d),
):
    """Add the tangents of the points that touch to the upper node-pair blocks."""
    f = wp.tid()
    for q in range(shape.shape[0]):
        if status_in[f, q] > 0:
            for a in range(shape.shape[1]):
                for b in range(shape.shape[1]):
                    weight = shape[q, a] * shape[q, b]
                    if weight != wp.float64(0.0) and pair[f, a, b] >= 0:
                        wp.atomic_add(block_out, pair[f, a, b], weight * tangent_in[f, q])


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


@wp.kernel
def misfit_force(
    # Model:
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    # State in:
    misfit_in: wp.array2d(dtype=wp.vec3d),
    # Out:
    force_out: wp.array(dtype=wp.vec3d),
):
    """Add the load (a residual) that condensing the contact pressures puts on the nodes."""
    f = wp.tid()
    for q in range(shape.shape[0]):
        m = misfit_in[f, q]
        if wp.length_sq(m) > wp.float64(0.0):
            for a in range(faces.shape[1]):
                wp.atomic_sub(force_out, faces[f, a], shape[q, a] * m)


@wp.kernel
def pressure_update(
    # Model:
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    # State in:
    status_in: wp.array2d(dtype=wp.int32),
    wanted_in: wp.array2d(dtype=wp.float64),
    slope_in: wp.array2d(dtype=wp.vec3d),
    wanted_traction_in: wp.array2d(dtype=wp.vec3d),
    traction_slope_in: wp.array2d(dtype=wp.mat33d),
    change_in: wp.array(dtype=wp.vec3d),
    # Out:
    pressure_out: wp.array2d(dtype=wp.float64),
    traction_out: wp.array2d(dtype=wp.vec3d),
):
    """Pressures, none negative, and tractions that go with a change of the nodes, to first order.

    The slopes are those of the factorised tangent.
    """
    f = wp.tid()
    for q in range(shape.shape[0]):
        p = wp.float64(0.0)
        t = wp.vec3d()
        if status_in[f, q] > 0:
            moved = wp.vec3d()
            for a in range(faces.shape[1]):
                moved += shape[q, a] * change_in[faces[f, a]]
            p = wp.max(wanted_in[f, q] - wp.dot(slope_in[f, q], moved), wp.float64(0.0))
            if p > wp.float64(0.0):
                t = wanted_traction_in[f, q] + traction_slope_in[f, q] * moved
        pressure_out[f, q] = p
        traction_out[f, q] = t
