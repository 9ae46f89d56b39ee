# mypy: ignore-errors
"""Kernels of the skin (nearly incompressible rubber) and of the fluid that it encloses.

The element has linear displacements and one pressure (Q1-P0, mean dilatation; Simo, Taylor and
Pister 1985). Its energy, with v its volume and p its pressure::

    sum_q w_q mu/2 (m + stiffening/3 m^3 + barrier b^2)  +  p (v - v0)  -  v0 p^2 / (2 kappa)

with m = J^(-2/3) I1 - 3. The cubic is Yeoh's: rubber becomes stiffer where it is stretched to
several times its length, which neo-Hooke does not (ADR 0013); without it the law is neo-Hooke's.
b = max(0, |ln J| - 0.25) is the barrier of the volume. The pressure of an element keeps its
*mean* volume, but not the volume at each of its quadrature points. Where skin is pinched between a
hard indenter and the core, the points of one element may go to J = 0.3 beside J = 2, an hourglass
mode that Q1-P0 does not resist, and Newton's method finds no equilibrium. The barrier resists it;
for J within 0.78..1.28 it is exactly zero (ADR 0013).

The pressure is condensed: the tangent is as large as the displacements alone. But p is an unknown
of its own, updated by the linear solve, so the number of Newton iterations does not grow with
kappa. One pressure for each element avoids volumetric locking: only the *mean* volume is kept.

The fluid's volume is a third of the integral of x . n over the closed inner surface; its gradient
and second derivative are exact for bilinear faces (``reference_element.volume_form``).

One Warp thread handles one element or face of those that ``items`` lists. Two host threads may run
two lists at once, so each adds into arrays of its own. Arrays named ``_in`` hold the state, those
named ``_out`` take the results. NumPy twins: ``tests/fem/numpy_mechanics.py``.

The same kernels work on many copies of one mesh (``batched``). Item number i belongs to copy
``i // count``, with count the elements or faces of one mesh; state and results of the copies follow
one another, each with ``nodes`` nodes and ``blocks`` blocks, and what the mesh decides is stored
once.
"""

from __future__ import annotations

import warp as wp

VOLUME_BARRIER = 60.0
"""Stiffness of the barrier in shear moduli; ADR 0013 says how little it changes forces."""

BARRIER_FROM = 0.25
"""|ln J| at which the barrier begins."""

FROM = wp.constant(wp.float64(BARRIER_FROM))

Scales = wp.types.vector(length=5, dtype=wp.float64)
"""Of the tangent at a quadrature point; see `tangent_scales`."""

wp.set_module_options({"enable_backward": False})


@wp.func
def beyond(j: wp.float64):
    """Barrier of the volume at a point: b sign(ln J)."""
    logarithm = wp.log(wp.max(j, wp.float64(1.0e-3)))
    return wp.sign(logarithm) * wp.max(wp.abs(logarithm) - FROM, wp.float64(0.0))


@wp.func
def deformation(
    elements: wp.array2d(dtype=wp.int32),
    gradient: wp.array3d(dtype=wp.vec3d),
    position_in: wp.array(dtype=wp.vec3d),
    s: int,
    q: int,
    begin: int,
) -> wp.mat33d:
    """F = sum_a x_a (x) grad N_a at a quadrature point, by gradients on the undeformed element."""
    f = wp.mat33d()
    for a in range(elements.shape[1]):
        f += wp.outer(position_in[begin + elements[s, a]], gradient[s, q, a])
    return f


@wp.func
def nominal_stress(
    f: wp.mat33d,
    j: wp.float64,
    inverse_t: wp.mat33d,
    w: wp.float64,
    mu: wp.float64,
    barrier: wp.float64,
    stiffening: wp.float64,
    pressure: wp.float64,
) -> wp.mat33d:
    """Weighted: w P = scale (F - I1/3 F^-T) + w (p J + mu barrier b sign(ln J)) F^-T.

    scale = w mu J^(-2/3) (1 + stiffening m^2)
    """
    power = wp.pow(wp.abs(j), (wp.float64(-2.0) / wp.float64(3.0)))
    i1 = wp.ddot(f, f)
    m = power * i1 - wp.float64(3.0)
    scale = w * mu * power * (wp.float64(1.0) + stiffening * m * m)
    along = w * (pressure * j + mu * barrier * beyond(j)) - scale * i1 / wp.float64(3.0)
    return scale * f + along * inverse_t


@wp.kernel
def element_state(
    elements: wp.array2d(dtype=wp.int32),
    gradient: wp.array3d(dtype=wp.vec3d),
    weight: wp.array2d(dtype=wp.float64),
    mu: wp.float64,
    barrier: wp.float64,
    stiffening: wp.float64,
    nodes: int,
    items: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3d),
    pressure_in: wp.array(dtype=wp.float64),
    volume_out: wp.array(dtype=wp.float64),
    smallest_jacobian_out: wp.array(dtype=wp.float64),
    volume_gradient_out: wp.array2d(dtype=wp.vec3d),
    force_out: wp.array(dtype=wp.vec3d),
):
    """Add internal nodal forces; set element volumes, their gradients and the smallest J."""
    e = items[wp.tid()]
    s = e % elements.shape[0]
    begin = (e // elements.shape[0]) * nodes
    n = elements.shape[1]
    pressure = pressure_in[e]
    volume = wp.float64(0.0)
    smallest = wp.float64(1.0e30)
    for a in range(n):
        volume_gradient_out[e, a] = wp.vec3d()
    for q in range(weight.shape[1]):
        f = deformation(elements, gradient, position_in, s, q, begin)
        j = wp.determinant(f)
        smallest = wp.min(smallest, j)
        w = weight[s, q]
        volume += w * j
        inverse_t = wp.transpose(wp.inverse(f))
        stress = nominal_stress(f, j, inverse_t, w, mu, barrier, stiffening, pressure)
        for a in range(n):
            g = gradient[s, q, a]
            wp.atomic_add(force_out, begin + elements[s, a], stress * g)
            # dJ/dF = J F^-T
            volume_gradient_out[e, a] = volume_gradient_out[e, a] + (w * j) * (inverse_t * g)
    volume_out[e] = volume
    smallest_jacobian_out[e] = smallest


@wp.func
def tangent_scales(
    f: wp.mat33d,
    j: wp.float64,
    w: wp.float64,
    mu: wp.float64,
    barrier: wp.float64,
    stiffening: wp.float64,
    pressure: wp.float64,
) -> Scales:
    """Scales of the tangent at a quadrature point, see `point_state`.

    c, c I1 / 3 - w p J - w mu barrier b sign(ln J), s, 2/9 c I1, and 2/9 c I1 + w p J +
    w mu barrier [b > 0], with c = w mu J^(-2/3) (1 + stiffening m^2) and
    s = 9 w mu stiffening m (J^(-2/3) / c)^2.
    """
    power = wp.pow(wp.abs(j), (wp.float64(-2.0) / wp.float64(3.0)))
    i1 = wp.ddot(f, f)
    m = power * i1 - wp.float64(3.0)
    c = w * mu * power * (wp.float64(1.0) + stiffening * m * m)
    ci1 = c * i1
    b = beyond(j)
    wpj = w * (pressure * j + mu * barrier * b)
    isochoric = ci1 * wp.float64(2.0) / wp.float64(9.0)
    along = isochoric + w * pressure * j
    if b != wp.float64(0.0):
        along += w * mu * barrier
    growth = wp.float64(9.0) * w * mu * stiffening * m * (power / c) * (power / c)
    return Scales(c, ci1 / wp.float64(3.0) - wpj, growth, isochoric, along)


@wp.func
def left_of(scales: Scales, f: wp.mat33d, gradient: wp.vec3d) -> wp.vec3d:
    """-2/3 c F grad N."""
    return ((wp.float64(-2.0) / wp.float64(3.0)) * scales[0]) * (f * gradient)


@wp.kernel
def point_state(
    elements: wp.array2d(dtype=wp.int32),
    gradient: wp.array3d(dtype=wp.vec3d),
    weight: wp.array2d(dtype=wp.float64),
    mu: wp.float64,
    barrier: wp.float64,
    stiffening: wp.float64,
    nodes: int,
    items: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3d),
    pressure_in: wp.array(dtype=wp.float64),
    spatial_out: wp.array3d(dtype=wp.vec3d),
    left_out: wp.array3d(dtype=wp.vec3d),
    right_out: wp.array3d(dtype=wp.vec3d),
    scales_out: wp.array2d(dtype=Scales),
):
    """Vectors of which the tangent is made, for each element, quadrature point and node.

    With g = F^-T grad N and h = F grad N: spatial = g, left = -2/3 c h, right = left + (2/9 c I1 +
    w p J + w mu barrier [b > 0]) g; `tangent_scales`. By the growth of c the tangent has s d x d
    more, with d = left + 2/9 c I1 g. A thread for each point.
    """
    item, q = wp.tid()
    e = items[item]
    s = e % elements.shape[0]
    f = deformation(elements, gradient, position_in, s, q, (e // elements.shape[0]) * nodes)
    j = wp.determinant(f)
    inverse_t = wp.transpose(wp.inverse(f))
    scales = tangent_scales(f, j, weight[s, q], mu, barrier, stiffening, pressure_in[e])
    for a in range(elements.shape[1]):
        g = inverse_t * gradient[s, q, a]
        left = left_of(scales, f, gradient[s, q, a])
        spatial_out[e, q, a] = g
        left_out[e, q, a] = left
        right_out[e, q, a] = left + scales[4] * g
    scales_out[e, q] = scales


@wp.func
def tangent_at_point(
    scales: Scales,
    ga: wp.vec3d,
    gb: wp.vec3d,
    left_a: wp.vec3d,
    left_b: wp.vec3d,
    right_b: wp.vec3d,
) -> wp.mat33d:
    """Share of a quadrature point in the tangent of nodes a and b, but for the multiple of I.

    ga x right_b + left_a x gb + scale gb x ga + s da x db
    """
    k = wp.outer(ga, right_b) + wp.outer(left_a, gb) + wp.outer(scales[1] * gb, ga)
    if scales[2] != wp.float64(0.0):
        k += wp.outer(scales[2] * (left_a + scales[3] * ga), left_b + scales[3] * gb)
    return k


@wp.kernel
def element_tangent(
    pair: wp.array3d(dtype=wp.int32),
    gradient: wp.array3d(dtype=wp.vec3d),
    bulk_over_volume: wp.array(dtype=wp.float64),
    blocks: int,
    items: wp.array(dtype=wp.int32),
    spatial_in: wp.array3d(dtype=wp.vec3d),
    left_in: wp.array3d(dtype=wp.vec3d),
    right_in: wp.array3d(dtype=wp.vec3d),
    scales_in: wp.array2d(dtype=Scales),
    volume_gradient_in: wp.array2d(dtype=wp.vec3d),
    block_out: wp.array(dtype=wp.mat33d),
):
    """Add the condensed tangent to the upper node-pair blocks; a ``pair`` below 0 has none.

    K_ab = sum_q c (dNa . dNb) I + `tangent_at_point`, plus kappa/v0 dv dv.
    """
    e = items[wp.tid()]
    s = e % pair.shape[0]
    begin = (e // pair.shape[0]) * blocks
    for a in range(pair.shape[1]):
        for b in range(pair.shape[1]):
            block = pair[s, a, b]
            if block >= 0:
                # Condensation of p = kappa (v - v0) / v0: one rank-1 term for the whole element.
                k = wp.outer(
                    bulk_over_volume[s] * volume_gradient_in[e, a], volume_gradient_in[e, b]
                )
                diagonal = wp.float64(0.0)
                for q in range(spatial_in.shape[1]):
                    scales = scales_in[e, q]
                    diagonal += scales[0] * wp.dot(gradient[s, q, a], gradient[s, q, b])
                    k += tangent_at_point(
                        scales, spatial_in[e, q, a], spatial_in[e, q, b], left_in[e, q, a],
                        left_in[e, q, b], right_in[e, q, b],
                    )  # fmt: skip
                k += diagonal * wp.identity(n=3, dtype=wp.float64)
                wp.atomic_add(block_out, begin + block, k)


@wp.kernel
def pressure_update(
    elements: wp.array2d(dtype=wp.int32),
    rest_volume: wp.array(dtype=wp.float64),
    bulk_over_volume: wp.array(dtype=wp.float64),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    volume_in: wp.array(dtype=wp.float64),
    volume_gradient_in: wp.array2d(dtype=wp.vec3d),
    change_in: wp.array(dtype=wp.vec3d),
    pressure_out: wp.array(dtype=wp.float64),
):
    """Element pressures after a change of the nodal positions, to first order.

    The gradients are those of the factorised tangent, so that pressures and displacements solve one
    linear system: kappa would magnify any difference.
    """
    e = items[wp.tid()]
    s = e % elements.shape[0]
    begin = (e // elements.shape[0]) * nodes
    v = volume_in[e] - rest_volume[s]
    for a in range(elements.shape[1]):
        v += wp.dot(volume_gradient_in[e, a], change_in[begin + elements[s, a]])
    pressure_out[e] = bulk_over_volume[s] * v


@wp.kernel
def pressure_misfit(
    elements: wp.array2d(dtype=wp.int32),
    rest_volume: wp.array(dtype=wp.float64),
    bulk_over_volume: wp.array(dtype=wp.float64),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    volume_in: wp.array(dtype=wp.float64),
    volume_gradient_in: wp.array2d(dtype=wp.vec3d),
    pressure_in: wp.array(dtype=wp.float64),
    force_out: wp.array(dtype=wp.vec3d),
):
    """Add the load on the nodes by static condensation of the element pressures.

    A thread for each corner.
    """
    item, a = wp.tid()
    e = items[item]
    s = e % elements.shape[0]
    node = (e // elements.shape[0]) * nodes + elements[s, a]
    misfit = bulk_over_volume[s] * (volume_in[e] - rest_volume[s]) - pressure_in[e]
    wp.atomic_add(force_out, node, misfit * volume_gradient_in[e, a])


@wp.kernel
def element_stress(
    elements: wp.array2d(dtype=wp.int32),
    gradient: wp.array3d(dtype=wp.vec3d),
    weight: wp.array2d(dtype=wp.float64),
    mu: wp.float64,
    barrier: wp.float64,
    stiffening: wp.float64,
    nodes: int,
    items: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3d),
    pressure_in: wp.array(dtype=wp.float64),
    stress_out: wp.array(dtype=wp.mat33d),
):
    """Cauchy stress, mean over the current volume of each element."""
    e = items[wp.tid()]
    s = e % elements.shape[0]
    begin = (e // elements.shape[0]) * nodes
    total = wp.mat33d()
    volume = wp.float64(0.0)
    for q in range(weight.shape[1]):
        f = deformation(elements, gradient, position_in, s, q, begin)
        j = wp.determinant(f)
        b = f * wp.transpose(f)
        third = wp.trace(b) / wp.float64(3.0)
        deviator = b - third * wp.identity(n=3, dtype=wp.float64)
        power = wp.pow(wp.abs(j), wp.float64(-2.0) / wp.float64(3.0))
        m = power * wp.trace(b) - wp.float64(3.0)
        stiff = wp.float64(1.0) + stiffening * m * m
        total += (weight[s, q] * mu * power * stiff) * deviator
        # J times the barrier's mean stress; the weights are of the undeformed volume.
        total += (weight[s, q] * mu * barrier * beyond(j)) * wp.identity(n=3, dtype=wp.float64)
        volume += weight[s, q] * j
    stress_out[e] = total / volume + pressure_in[e] * wp.identity(n=3, dtype=wp.float64)


@wp.kernel
def cavity_volume(
    faces: wp.array2d(dtype=wp.int32),
    form: wp.array3d(dtype=wp.float64),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3d),
    volume_out: wp.array(dtype=wp.float64),
    gradient_out: wp.array(dtype=wp.vec3d),
):
    """Set the volume under each face; add its gradient to the nodes."""
    f = items[wp.tid()]
    s = f % faces.shape[0]
    begin = (f // faces.shape[0]) * nodes
    k = faces.shape[1]
    volume = wp.float64(0.0)
    for a in range(k):
        g = wp.vec3d()
        for b in range(k):
            for c in range(k):
                if c > b:
                    area = wp.cross(
                        position_in[begin + faces[s, b]], position_in[begin + faces[s, c]]
                    )
                    g += (wp.float64(2.0) * form[a, b, c]) * area
        volume += wp.dot(position_in[begin + faces[s, a]], g)
        wp.atomic_add(gradient_out, begin + faces[s, a], wp.float64(3.0) * g)
    volume_out[f] = volume


@wp.func
def fluid_arm(
    faces: wp.array2d(dtype=wp.int32),
    form: wp.array3d(dtype=wp.float64),
    position_in: wp.array(dtype=wp.vec3d),
    s: int,
    a: int,
    b: int,
    begin: int,
) -> wp.vec3d:
    """Sum over c of C_abc x_c, of which the tangent of corners a and b of face s is made."""
    arm = wp.vec3d()
    for c in range(faces.shape[1]):
        arm += form[a, b, c] * position_in[begin + faces[s, c]]
    return arm


@wp.kernel
def cavity_tangent(
    faces: wp.array2d(dtype=wp.int32),
    form: wp.array3d(dtype=wp.float64),
    pair: wp.array3d(dtype=wp.int32),
    nodes: int,
    blocks: int,
    items: wp.array(dtype=wp.int32),
    pressure_in: wp.array(dtype=wp.float64),
    position_in: wp.array(dtype=wp.vec3d),
    block_out: wp.array(dtype=wp.mat33d),
):
    """Add the tangent of the fluid's pressure, a follower load, to the upper node-pair blocks."""
    f = items[wp.tid()]
    s = f % faces.shape[0]
    copy = f // faces.shape[0]
    k = faces.shape[1]
    # Minus the pressure times the volume's: d/dx_b of 6 C_abc x_b x x_c = -6 C_abc skew(x_c).
    factor = wp.float64(6.0) * pressure_in[copy]
    for a in range(k):
        for b in range(k):
            block = pair[s, a, b]
            if block >= 0:
                arm = fluid_arm(faces, form, position_in, s, a, b, copy * nodes)
                wp.atomic_add(block_out, copy * blocks + block, factor * wp.skew(arm))
