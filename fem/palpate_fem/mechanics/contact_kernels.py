# mypy: ignore-errors
"""Contact laws and kernels: friction with the indenter, frictionless contact with the core.

Contact points are the corners of the surface faces (Lobatto points). Their gap is that of the node
and its mortar correction (``mortar``), which is kept while Newton's method solves.

**Normal law**, with gap g and stiffness e per *undeformed* area, so that frictionless contact has
an energy::

    p = e max(0, -g)

so stiff that the penetration stays below a few micrometres. **Coulomb friction** by return
mapping: a spring of stiffness k ties a sticking point to an anchor on the indenter; its traction is
capped at mu p, and what exceeds the cap moves the anchor at the end of the increment.

Pressures and tractions are unknowns of their own, as in the elements: their iterates come from the
linear solve, not from gap and slip, because laws so stiff would turn each micrometre of curvature
into a megapascal. Whether a point touches, sticks or slides is decided from both (primal-dual
active set; Hueber and Wohlmuth 2005, Gitterle et al. 2010)::

    touches: g < 0 or p > 0            slides: |t + c (d - t / k)| > mu p

with d the tangential displacement from the anchor. The points are the nodes of the surface, so
there are as many conditions as unknowns. Quadrature points inside the faces (2 x 2) would be four
times as many; their conditions contradict one another by the sagitta of the facet, and the sets
cycle (ADR 0013).

What evaluates contact has a thread for each point of the listed faces, all else one for each face.
A NumPy twin of each function is in ``tests/fem/numpy_mechanics.py``.
"""

from __future__ import annotations

import warp as wp

from palpate_fem.indenter.kernels import indenter_distance

wp.set_module_options({"enable_backward": False})

CELL = wp.constant(wp.float64(2.0))
"""Spacings by which the distance to the core at a point may differ from the coefficient of its
cell, whose node is up to sqrt(3) of them away."""


@wp.struct
class ContactLaw:
    """Constants of the contact laws; SI."""

    stiffness: wp.float64
    friction: wp.float64
    tangential_stiffness: wp.float64
    complement: wp.float64
    at_nodes: wp.float64  # share of the pressure's force that acts at the nodes: 0 with mortar


@wp.struct
class LinearisedFriction:
    """Linearised friction at a point: status 1 sticks, 2 slides; traction and its derivatives."""

    status: int
    wanted: wp.vec3d
    by_position: wp.mat33d
    by_pressure: wp.vec3d


@wp.func
def at_point(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    nodal: wp.array(dtype=wp.vec3d),
    s: int,
    q: int,
    begin: int,
) -> wp.vec3d:
    """A nodal field at point q of face s; its nodes are numbered from ``begin`` on."""
    value = wp.vec3d()
    for a in range(faces.shape[1]):
        value += shape[q, a] * nodal[begin + faces[s, a]]
    return value


@wp.func
def add_at_nodes(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    load: wp.vec3d,
    s: int,
    q: int,
    begin: int,
    force_out: wp.array(dtype=wp.vec3d),
):
    """Share a load at point q of face s out to its nodes."""
    for a in range(faces.shape[1]):
        wp.atomic_add(force_out, begin + faces[s, a], shape[q, a] * load)


@wp.func
def normal_law(law: ContactLaw, pressure: wp.float64, gap: wp.float64) -> wp.vec2d:
    """Linearised normal law: the pressure that it demands [Pa], and -dp/dg [Pa/m]."""
    if gap < wp.float64(0.0) or pressure > wp.float64(0.0):
        return wp.vec2d(-law.stiffness * gap, law.stiffness)
    return wp.vec2d(wp.float64(0.0), wp.float64(0.0))


@wp.func
def friction_law(
    law: ContactLaw,
    pressure: wp.float64,
    traction: wp.vec3d,
    normal: wp.vec3d,
    curvature: wp.mat33d,
    arm: wp.vec3d,
) -> LinearisedFriction:
    """Linearised friction of a touching point at ``arm`` from its anchor."""
    answer = LinearisedFriction()
    k = law.tangential_stiffness
    along = wp.dot(normal, arm)
    way = arm - along * normal
    # d way / d x, from way = P(n) arm and d n / d x = curvature
    turn = (
        wp.identity(n=3, dtype=wp.float64)
        - wp.outer(normal, normal)
        - along * curvature
        - wp.outer(normal, curvature * arm)
    )
    now = traction - wp.dot(normal, traction) * normal
    # The sign of |trial| - mu p tells sticking from sliding, in an iterate as in the solution.
    trial = now + law.complement * (way - now / k)
    size = wp.length(trial)
    limit = law.friction * pressure
    if size <= limit:
        answer.status = 1
        answer.wanted = k * way
        answer.by_position = k * turn
        return answer
    # Newton's step for t = mu p trial / |trial|, solved for t at the point (the inverse is known in
    # closed form); it converges to the return mapping.
    answer.status = 2
    t = trial / size
    share = limit / size
    across = now - wp.dot(t, now) * t
    left = wp.float64(1.0) - share * (wp.float64(1.0) - law.complement / k)
    answer.wanted = limit * t + across - across / left
    answer.by_position = (share * law.complement / left) * (
        turn - wp.outer(t, wp.transpose(turn) * t)
    )
    answer.by_pressure = law.friction * t
    return answer


@wp.kernel(launch_bounds=(256, 2))
def indenter_contact(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    area: wp.array2d(dtype=wp.float64),
    primitives: wp.array3d(dtype=wp.float64),
    kind: wp.array(dtype=wp.int32),
    law: ContactLaw,
    margin: wp.float64,
    tip_in: wp.array(dtype=wp.vec3d),
    rotation_in: wp.array(dtype=wp.mat33d),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3d),
    correction_in: wp.array2d(dtype=wp.float64),
    pressure_in: wp.array2d(dtype=wp.float64),
    traction_in: wp.array2d(dtype=wp.vec3d),
    anchor_in: wp.array2d(dtype=wp.vec3d),
    status_out: wp.array2d(dtype=wp.int32),
    gap_out: wp.array2d(dtype=wp.float64),
    wanted_out: wp.array2d(dtype=wp.float64),
    slope_out: wp.array2d(dtype=wp.vec3d),
    misfit_out: wp.array2d(dtype=wp.vec3d),
    tangent_out: wp.array2d(dtype=wp.mat33d),
    wanted_traction_out: wp.array2d(dtype=wp.vec3d),
    traction_slope_out: wp.array2d(dtype=wp.mat33d),
    coupled_out: wp.array2d(dtype=wp.vec3d),
    unsymmetric_out: wp.array2d(dtype=wp.mat33d),
    force_out: wp.array(dtype=wp.vec3d),
):
    """Frictional contact of the outer faces with the indenter.

    Anchors are in the indenter frame. Adds minus the contact force to ``force_out``. A symmetric
    approximation of the tangent goes to ``tangent_out`` and the difference to
    ``unsymmetric_out``: mostly the growth of sliding friction with pressure. That term must not be
    symmetrised: its transpose would make the matrix indefinite, by the square of half the friction
    coefficient.
    """
    item, q = wp.tid()
    f = items[item]
    s = f % faces.shape[0]
    copy = f // faces.shape[0]
    begin = copy * nodes
    tip = tip_in[copy]
    rotation = rotation_in[copy]
    shape_of = primitives[kind[copy]]
    x = at_point(faces, shape, position_in, s, q, begin)
    local = wp.transpose(rotation) * (x - tip)
    near = indenter_distance(shape_of, local, margin)
    gap = near.gap + correction_in[f, q]
    gap_out[f, q] = gap
    if status_out[f, q] != 0:  # else the results of a point that does not touch stand there
        status_out[f, q] = 0
        wanted_out[f, q] = wp.float64(0.0)
        slope_out[f, q] = wp.vec3d()
        misfit_out[f, q] = wp.vec3d()
        wanted_traction_out[f, q] = wp.vec3d()
        traction_slope_out[f, q] = wp.mat33d()
        coupled_out[f, q] = wp.vec3d()
        unsymmetric_out[f, q] = wp.mat33d()
    p = pressure_in[f, q]
    # Points beyond the margin have no pressure: it was set to zero when they separated.
    if near.gap < margin:
        normal = rotation * near.normal
        answer = normal_law(law, p, gap)
        if answer[1] > wp.float64(0.0):
            status_out[f, q] = 1
            w = area[s, q]
            curvature = rotation * near.hessian * wp.transpose(rotation)
            slope = answer[1] * normal
            wanted_out[f, q] = answer[0]
            slope_out[f, q] = slope
            residual = law.at_nodes * p * normal
            misfit = (answer[0] - p) * normal
            d = wp.outer(slope, normal) - law.at_nodes * p * curvature
            unsymmetric = wp.mat33d()
            if law.friction > wp.float64(0.0):
                t = traction_in[f, q]
                arm = x - (tip + rotation * anchor_in[f, q])
                rub = friction_law(law, p, t, normal, curvature, arm)
                status_out[f, q] = 1 + rub.status
                # Friction by the change of pressure. It is kept apart (``coupled``), as the
                # demanded pressure of a new point is far too large before the linear solve.
                grown = (answer[0] - p) * rub.by_pressure
                wanted_traction_out[f, q] = rub.wanted + grown
                coupled_out[f, q] = -w * grown
                coupled = wp.outer(rub.by_pressure, slope)
                traction_slope_out[f, q] = rub.by_position - coupled
                residual -= t
                misfit -= rub.wanted - t
                symmetric = wp.float64(0.5) * (rub.by_position + wp.transpose(rub.by_position))
                d += symmetric
                unsymmetric = rub.by_position - symmetric - coupled
            misfit_out[f, q] = w * misfit
            add_at_nodes(faces, shape, -w * residual, s, q, begin, force_out)
            unsymmetric_out[f, q] = w * unsymmetric
            tangent_out[f, q] = w * d


@wp.kernel
def point_tangent(
    shape: wp.array2d(dtype=wp.float64),
    pair: wp.array3d(dtype=wp.int32),
    blocks: int,
    items: wp.array(dtype=wp.int32),
    status_in: wp.array2d(dtype=wp.int32),
    tangent_in: wp.array2d(dtype=wp.mat33d),
    block_out: wp.array(dtype=wp.mat33d),
):
    """Add the tangents of the touching points to the upper node-pair blocks."""
    f = items[wp.tid()]
    s = f % pair.shape[0]
    begin = (f // pair.shape[0]) * blocks
    for q in range(shape.shape[0]):
        if status_in[f, q] > 0:
            for a in range(shape.shape[1]):
                for b in range(shape.shape[1]):
                    weight = shape[q, a] * shape[q, b]
                    if weight != wp.float64(0.0) and pair[s, a, b] >= 0:
                        wp.atomic_add(block_out, begin + pair[s, a, b], weight * tangent_in[f, q])


@wp.kernel
def unsymmetric_product(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    status_in: wp.array2d(dtype=wp.int32),
    unsymmetric_in: wp.array2d(dtype=wp.mat33d),
    vector_in: wp.array(dtype=wp.vec3d),
    product_out: wp.array(dtype=wp.vec3d),
):
    """Add (tangent - its symmetric approximation) times a nodal vector, over the listed faces."""
    f = items[wp.tid()]
    s = f % faces.shape[0]
    begin = (f // faces.shape[0]) * nodes
    for q in range(shape.shape[0]):
        if status_in[f, q] > 0:
            moved = unsymmetric_in[f, q] * at_point(faces, shape, vector_in, s, q, begin)
            add_at_nodes(faces, shape, moved, s, q, begin, product_out)


@wp.kernel
def subtract_load(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    load_in: wp.array2d(dtype=wp.vec3d),
    force_out: wp.array(dtype=wp.vec3d),
):
    """Subtract a load at the contact points from nodal forces."""
    f = items[wp.tid()]
    s = f % faces.shape[0]
    begin = (f // faces.shape[0]) * nodes
    for q in range(shape.shape[0]):
        m = load_in[f, q]
        if wp.length_sq(m) > wp.float64(0.0):
            add_at_nodes(faces, shape, -m, s, q, begin, force_out)


@wp.kernel
def pressure_update(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    status_in: wp.array2d(dtype=wp.int32),
    wanted_in: wp.array2d(dtype=wp.float64),
    slope_in: wp.array2d(dtype=wp.vec3d),
    wanted_traction_in: wp.array2d(dtype=wp.vec3d),
    traction_slope_in: wp.array2d(dtype=wp.mat33d),
    change_in: wp.array(dtype=wp.vec3d),
    pressure_out: wp.array2d(dtype=wp.float64),
    traction_out: wp.array2d(dtype=wp.vec3d),
):
    """Pressures, none negative, and tractions after a change of the nodes, to first order.

    The slopes are those of the factorised tangent, see `element_kernels.pressure_update`.
    """
    f = items[wp.tid()]
    s = f % faces.shape[0]
    begin = (f // faces.shape[0]) * nodes
    for q in range(shape.shape[0]):
        p = wp.float64(0.0)
        t = wp.vec3d()
        if status_in[f, q] > 0:
            moved = at_point(faces, shape, change_in, s, q, begin)
            p = wp.max(wanted_in[f, q] - wp.dot(slope_in[f, q], moved), wp.float64(0.0))
            if p > wp.float64(0.0):
                t = wanted_traction_in[f, q] + traction_slope_in[f, q] * moved
        pressure_out[f, q] = p
        traction_out[f, q] = t


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


@wp.struct
class CoreDistance:
    """Distance to the core at a point, its gradient and second derivative."""

    gap: wp.float64
    normal: wp.vec3d
    hessian: wp.mat33d


@wp.func
def grid_cell(
    coefficients: wp.array3d(dtype=wp.float64), origin: wp.vec3d, spacing: wp.float64, x: wp.vec3d
) -> wp.vec3i:
    """The cell of a point, clamped so that its 4 x 4 x 4 coefficients exist."""
    u = (x - origin) / spacing
    return wp.vec3i(
        wp.clamp(int(wp.floor(u[0])), 1, coefficients.shape[0] - 3),
        wp.clamp(int(wp.floor(u[1])), 1, coefficients.shape[1] - 3),
        wp.clamp(int(wp.floor(u[2])), 1, coefficients.shape[2] - 3),
    )


@wp.func
def core_distance(
    coefficients: wp.array3d(dtype=wp.float64), origin: wp.vec3d, spacing: wp.float64, x: wp.vec3d
) -> CoreDistance:
    """The tensor product of cubic B-splines at a point."""
    cell = grid_cell(coefficients, origin, spacing, x)
    u = (x - origin) / spacing
    tx = u[0] - wp.float64(cell[0])
    ty = u[1] - wp.float64(cell[1])
    tz = u[2] - wp.float64(cell[2])
    # Value, gradient and hessian of the tensor product: 0, 1, 2 are orders of derivative.
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
                c = coefficients[cell[0] + r - 1, cell[1] + s - 1, cell[2] + t - 1]
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
    answer = CoreDistance()
    answer.gap = value
    answer.normal = wp.vec3d(gx, gy, gz) / spacing
    answer.hessian = wp.mat33d(
        hxx, hxy, hxz, hxy, hyy, hyz, hxz, hyz, hzz
    ) / (spacing * spacing)  # fmt: skip
    return answer


@wp.kernel
def core_distances(
    coefficients: wp.array3d(dtype=wp.float64),
    origin: wp.vec3d,
    spacing: wp.float64,
    margin: wp.float64,
    point_in: wp.array(dtype=wp.vec3d),
    gap_out: wp.array(dtype=wp.float64),
    normal_out: wp.array(dtype=wp.vec3d),
):
    """`core_distance` at each point, but its second derivative.

    Where the coefficient of a point's cell shows that the gap is above the margin (`CELL`), it is
    taken for the gap.
    """
    i = wp.tid()
    cell = grid_cell(coefficients, origin, spacing, point_in[i])
    gap_out[i] = coefficients[cell[0], cell[1], cell[2]]
    normal_out[i] = wp.vec3d()
    if gap_out[i] < margin + CELL * spacing:
        near = core_distance(coefficients, origin, spacing, point_in[i])
        gap_out[i] = near.gap
        normal_out[i] = near.normal


@wp.kernel
def core_contact(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    area: wp.array2d(dtype=wp.float64),
    coefficients: wp.array3d(dtype=wp.float64),
    origin: wp.vec3d,
    spacing: wp.float64,
    nodes: int,
    items: wp.array(dtype=wp.int32),
    law: ContactLaw,
    position_in: wp.array(dtype=wp.vec3d),
    correction_in: wp.array2d(dtype=wp.float64),
    pressure_in: wp.array2d(dtype=wp.float64),
    status_out: wp.array2d(dtype=wp.int32),
    gap_out: wp.array2d(dtype=wp.float64),
    wanted_out: wp.array2d(dtype=wp.float64),
    slope_out: wp.array2d(dtype=wp.vec3d),
    misfit_out: wp.array2d(dtype=wp.vec3d),
    tangent_out: wp.array2d(dtype=wp.mat33d),
    force_out: wp.array(dtype=wp.vec3d),
):
    """Frictionless contact of the inner faces with the core, whose distance is a cubic B-spline.

    Adds minus the contact force to ``force_out``. Where the coefficient of a point's cell shows
    that the point cannot touch (`CELL`), it is taken for the gap.
    """
    item, q = wp.tid()
    f = items[item]
    s = f % faces.shape[0]
    begin = (f // faces.shape[0]) * nodes
    x = at_point(faces, shape, position_in, s, q, begin)
    cell = grid_cell(coefficients, origin, spacing, x)
    rough = coefficients[cell[0], cell[1], cell[2]]
    gap_out[f, q] = rough
    if status_out[f, q] != 0:
        status_out[f, q] = 0
        wanted_out[f, q] = wp.float64(0.0)
        slope_out[f, q] = wp.vec3d()
        misfit_out[f, q] = wp.vec3d()
    p = pressure_in[f, q]
    if rough + correction_in[f, q] < CELL * spacing or p > wp.float64(0.0):
        near = core_distance(coefficients, origin, spacing, x)
        gap = near.gap + correction_in[f, q]
        gap_out[f, q] = gap
        answer = normal_law(law, p, gap)
        if answer[1] > wp.float64(0.0):
            status_out[f, q] = 1
            wanted_out[f, q] = answer[0]
            w = area[s, q]
            slope_out[f, q] = answer[1] * near.normal
            misfit_out[f, q] = (w * (answer[0] - p)) * near.normal
            load = (law.at_nodes * w * p) * near.normal
            add_at_nodes(faces, shape, -load, s, q, begin, force_out)
            # -d(p n)/dx: stiffness along the normal, and the turn of the normal under p.
            tangent_out[f, q] = w * (
                answer[1] * wp.outer(near.normal, near.normal) - law.at_nodes * p * near.hessian
            )


@wp.func
def load_at_point(
    f: int,
    s: int,
    q: int,
    weight: wp.array3d(dtype=wp.float64),
    pressure: wp.array2d(dtype=wp.float64),
) -> wp.float64:
    """Pressure at a quadrature point, by the dual shape functions, times its area [N]."""
    load = wp.float64(0.0)
    for a in range(weight.shape[2]):
        load += weight[s, q, a] * pressure[f, a]
    return load


@wp.kernel(launch_bounds=(256, 3))
def mortar_on_indenter(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    weight: wp.array3d(dtype=wp.float64),
    primitives: wp.array3d(dtype=wp.float64),
    kind: wp.array(dtype=wp.int32),
    tip_in: wp.array(dtype=wp.vec3d),
    rotation_in: wp.array(dtype=wp.mat33d),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3d),
    pressure_in: wp.array2d(dtype=wp.float64),
    held_in: wp.array2d(dtype=wp.vec3d),
    status_out: wp.array2d(dtype=wp.int32),
    tangent_out: wp.array2d(dtype=wp.mat33d),
    force_out: wp.array(dtype=wp.vec3d),
):
    """Pressure of the indenter at the quadrature points of the outer faces (``mortar``).

    Adds minus its forces to ``force_out``; the tangent is that at constant pressures. Where
    ``held_in`` is not zero, the pressure acts along it, and does not turn.
    """
    item, q = wp.tid()
    f = items[item]
    s = f % faces.shape[0]
    copy = f // faces.shape[0]
    begin = copy * nodes
    tip = tip_in[copy]
    rotation = rotation_in[copy]
    shape_of = primitives[kind[copy]]
    load = load_at_point(f, s, q, weight, pressure_in)
    status_out[f, q] = 0
    if load != wp.float64(0.0):
        normal = held_in[f, q]
        if normal == wp.vec3d():
            x = at_point(faces, shape, position_in, s, q, begin)
            local = wp.transpose(rotation) * (x - tip)
            near = indenter_distance(shape_of, local, wp.float64(1.0e300))
            normal = rotation * near.normal
            status_out[f, q] = 1
            tangent_out[f, q] = -load * (rotation * near.hessian * wp.transpose(rotation))
        add_at_nodes(faces, shape, -load * normal, s, q, begin, force_out)


@wp.kernel
def mortar_on_core(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    weight: wp.array3d(dtype=wp.float64),
    coefficients: wp.array3d(dtype=wp.float64),
    origin: wp.vec3d,
    spacing: wp.float64,
    nodes: int,
    items: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3d),
    pressure_in: wp.array2d(dtype=wp.float64),
    status_out: wp.array2d(dtype=wp.int32),
    tangent_out: wp.array2d(dtype=wp.mat33d),
    force_out: wp.array(dtype=wp.vec3d),
):
    """`mortar_on_indenter` for the core and the inner faces."""
    item, q = wp.tid()
    f = items[item]
    s = f % faces.shape[0]
    begin = (f // faces.shape[0]) * nodes
    load = load_at_point(f, s, q, weight, pressure_in)
    status_out[f, q] = 0
    if load != wp.float64(0.0):
        x = at_point(faces, shape, position_in, s, q, begin)
        near = core_distance(coefficients, origin, spacing, x)
        status_out[f, q] = 1
        tangent_out[f, q] = -load * near.hessian
        add_at_nodes(faces, shape, -load * near.normal, s, q, begin, force_out)
