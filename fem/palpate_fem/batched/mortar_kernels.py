# mypy: ignore-errors
"""Kernels of mortar corrections for many copies of one fingertip; see ``mortar`` for the equations.

Node k of slot s is at ``s * nodes + k``, and so on.
"""

from __future__ import annotations

import warp as wp

from palpate_fem.batched.dense_tiles import THREADS
from palpate_fem.indenter.kernels import indenter_distance
from palpate_fem.mechanics.contact_kernels import CELL, at_point, core_distance, grid_cell

wp.set_module_options({"enable_backward": False})


@wp.kernel
def near_indenter(
    slots: wp.array(dtype=wp.int32),
    surface: wp.array(dtype=wp.int32),
    nodes: int,
    primitives: wp.array3d(dtype=wp.float64),
    kind: wp.array(dtype=wp.int32),
    tip: wp.array(dtype=wp.vec3d),
    rotation: wp.array(dtype=wp.mat33d),
    margin: wp.float64,
    position_in: wp.array(dtype=wp.vec3d),
    gap_out: wp.array(dtype=wp.float64),
    normal_out: wp.array(dtype=wp.vec3d),
    mean_out: wp.array(dtype=wp.float64),
):
    """Gaps of a surface's nodes, and normals where they are below the margin; clear the means."""
    i, k = wp.tid()
    slot = slots[i]
    at = slot * nodes + surface[k]
    local = wp.transpose(rotation[slot]) * (position_in[at] - tip[slot])
    near = indenter_distance(primitives[kind[slot]], local, margin)
    gap_out[at] = near.gap
    normal_out[at] = rotation[slot] * near.normal
    mean_out[at] = wp.float64(0.0)


@wp.kernel
def near_core(
    slots: wp.array(dtype=wp.int32),
    surface: wp.array(dtype=wp.int32),
    nodes: int,
    coefficients: wp.array3d(dtype=wp.float64),
    origin: wp.vec3d,
    spacing: wp.float64,
    margin: wp.float64,
    position_in: wp.array(dtype=wp.vec3d),
    gap_out: wp.array(dtype=wp.float64),
    normal_out: wp.array(dtype=wp.vec3d),
    mean_out: wp.array(dtype=wp.float64),
):
    """`near_indenter` for the core; far from it the gap is the coefficient of its cell."""
    i, k = wp.tid()
    slot = slots[i]
    at = slot * nodes + surface[k]
    x = position_in[at]
    cell = grid_cell(coefficients, origin, spacing, x)
    gap_out[at] = coefficients[cell[0], cell[1], cell[2]]
    normal_out[at] = wp.vec3d()
    mean_out[at] = wp.float64(0.0)
    if gap_out[at] < margin + CELL * spacing:
        near = core_distance(coefficients, origin, spacing, x)
        gap_out[at] = near.gap
        normal_out[at] = near.normal


@wp.func
def touchable(
    faces: wp.array2d(dtype=wp.int32),
    gap: wp.array(dtype=wp.float64),
    margin: wp.float64,
    s: int,
    begin: int,
) -> bool:
    """Whether a node of a face may touch."""
    for a in range(faces.shape[1]):
        if gap[begin + faces[s, a]] < margin:
            return True
    return False


@wp.func
def add_to_means(
    faces: wp.array2d(dtype=wp.int32),
    weight: wp.array3d(dtype=wp.float64),
    gap: wp.float64,
    s: int,
    q: int,
    begin: int,
    mean_out: wp.array(dtype=wp.float64),
):
    """Share the gap of a quadrature point out to the means of its face's nodes."""
    for a in range(faces.shape[1]):
        wp.atomic_add(mean_out, begin + faces[s, a], weight[s, q, a] * gap)


@wp.kernel(launch_bounds=(THREADS, 3))
def mean_gaps_to_indenter(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    weight: wp.array3d(dtype=wp.float64),
    primitives: wp.array3d(dtype=wp.float64),
    kind: wp.array(dtype=wp.int32),
    tip: wp.array(dtype=wp.vec3d),
    rotation: wp.array(dtype=wp.mat33d),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    margin: wp.float64,
    hanging: wp.array(dtype=wp.float64),
    position_in: wp.array(dtype=wp.vec3d),
    gap_in: wp.array(dtype=wp.float64),
    outward_out: wp.array2d(dtype=wp.vec3d),
    held_out: wp.array2d(dtype=wp.vec3d),
    mean_out: wp.array(dtype=wp.float64),
):
    """Means of the gaps over the faces, and directions at the quadrature points.

    ``hanging`` is the gap of each kind of indenter from which on a direction is held.
    """
    item, q = wp.tid()
    f = items[item]
    s = f % faces.shape[0]
    slot = f // faces.shape[0]
    begin = slot * nodes
    near = touchable(faces, gap_in, margin, s, begin)
    outward_out[f, q] = wp.vec3d()
    held_out[f, q] = wp.vec3d()
    if near:
        x = at_point(faces, shape, position_in, s, q, begin)
        local = wp.transpose(rotation[slot]) * (x - tip[slot])
        found = indenter_distance(primitives[kind[slot]], local, wp.float64(1.0e300))
        outward_out[f, q] = rotation[slot] * found.normal
        if found.gap >= hanging[kind[slot]]:
            held_out[f, q] = outward_out[f, q]
        add_to_means(faces, weight, found.gap, s, q, begin, mean_out)


@wp.kernel
def mean_gaps_to_core(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    weight: wp.array3d(dtype=wp.float64),
    coefficients: wp.array3d(dtype=wp.float64),
    origin: wp.vec3d,
    spacing: wp.float64,
    nodes: int,
    items: wp.array(dtype=wp.int32),
    margin: wp.float64,
    position_in: wp.array(dtype=wp.vec3d),
    gap_in: wp.array(dtype=wp.float64),
    outward_out: wp.array2d(dtype=wp.vec3d),
    mean_out: wp.array(dtype=wp.float64),
):
    """`mean_gaps_to_indenter` for the core."""
    item, q = wp.tid()
    f = items[item]
    s = f % faces.shape[0]
    begin = (f // faces.shape[0]) * nodes
    near = touchable(faces, gap_in, margin, s, begin)
    outward_out[f, q] = wp.vec3d()
    if near:
        x = at_point(faces, shape, position_in, s, q, begin)
        found = core_distance(coefficients, origin, spacing, x)
        outward_out[f, q] = found.normal
        add_to_means(faces, weight, found.gap, s, q, begin, mean_out)


@wp.kernel
def gap_offsets(
    faces: wp.array2d(dtype=wp.int32),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    margin: wp.float64,
    area: wp.array(dtype=wp.float64),
    gap_in: wp.array(dtype=wp.float64),
    mean_in: wp.array(dtype=wp.float64),
    offset_out: wp.array2d(dtype=wp.float64),
):
    """What the mean gap of each corner's node adds to its own gap."""
    f = items[wp.tid()]
    s = f % faces.shape[0]
    begin = (f // faces.shape[0]) * nodes
    for a in range(faces.shape[1]):
        node = faces[s, a]
        offset_out[f, a] = wp.float64(0.0)
        if gap_in[begin + node] < margin:
            offset_out[f, a] = mean_in[begin + node] / area[node] - gap_in[begin + node]


@wp.kernel
def spread_load(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    weight: wp.array3d(dtype=wp.float64),
    corner_area: wp.array2d(dtype=wp.float64),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    margin: wp.float64,
    gap_in: wp.array(dtype=wp.float64),
    normal_in: wp.array(dtype=wp.vec3d),
    outward_in: wp.array2d(dtype=wp.vec3d),
    slope_in: wp.array2d(dtype=wp.vec3d),
    status_in: wp.array2d(dtype=wp.int32),
    wanted_in: wp.array2d(dtype=wp.float64),
    pressure_in: wp.array2d(dtype=wp.float64),
    change_in: wp.array(dtype=wp.vec3d),
    by_change: int,
    force_out: wp.array(dtype=wp.vec3d),
):
    """Mortar's loads at neighbours (`MortarCorrection.load`): by a change of the nodes, or lacking.

    With ``by_change`` the pressures are the slopes times the change; without, minus what touching
    points' wanted pressures exceed their pressures by.
    """
    f = items[wp.tid()]
    s = f % faces.shape[0]
    begin = (f // faces.shape[0]) * nodes
    if touchable(faces, gap_in, margin, s, begin):
        for a in range(faces.shape[1]):
            p = wp.float64(0.0)
            node = begin + faces[s, a]
            if by_change != 0:
                p = wp.dot(slope_in[f, a], change_in[node])
            elif status_in[f, a] > 0:
                p = pressure_in[f, a] - wanted_in[f, a]
            if p != wp.float64(0.0):
                for q in range(shape.shape[0]):
                    load = (p * weight[s, q, a]) * outward_in[f, q]
                    for b in range(faces.shape[1]):
                        wp.atomic_add(force_out, begin + faces[s, b], shape[q, b] * load)
                wp.atomic_add(force_out, node, (-p * corner_area[s, a]) * normal_in[node])


@wp.kernel
def offset_changes(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    weight: wp.array3d(dtype=wp.float64),
    corner_area: wp.array2d(dtype=wp.float64),
    area: wp.array(dtype=wp.float64),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    margin: wp.float64,
    gap_in: wp.array(dtype=wp.float64),
    normal_in: wp.array(dtype=wp.vec3d),
    outward_in: wp.array2d(dtype=wp.vec3d),
    change_in: wp.array(dtype=wp.vec3d),
    offset_out: wp.array2d(dtype=wp.float64),
):
    """Add how a change of the nodes changes the offsets of their gaps; `gap_offsets`, derived."""
    f = items[wp.tid()]
    s = f % faces.shape[0]
    slot = f // faces.shape[0]
    begin = slot * nodes
    if touchable(faces, gap_in, margin, s, begin):
        for a in range(faces.shape[1]):
            node = faces[s, a]
            own = wp.dot(normal_in[begin + node], change_in[begin + node])
            total = -corner_area[s, a] * own
            for q in range(shape.shape[0]):
                moved = at_point(faces, shape, change_in, s, q, begin)
                total += weight[s, q, a] * wp.dot(outward_in[f, q], moved)
            wp.atomic_add(offset_out, slot, node, total / area[node])


@wp.kernel
def offset_load(
    faces: wp.array2d(dtype=wp.int32),
    area: wp.array2d(dtype=wp.float64),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    slope_in: wp.array2d(dtype=wp.vec3d),
    offset_in: wp.array2d(dtype=wp.float64),
    force_out: wp.array(dtype=wp.vec3d),
):
    """Add the forces by which touching points resist changes of their offsets."""
    f = items[wp.tid()]
    s = f % faces.shape[0]
    slot = f // faces.shape[0]
    for a in range(faces.shape[1]):
        node = faces[s, a]
        size = area[s, a] * offset_in[slot, node]
        if size != wp.float64(0.0) and wp.length(slope_in[f, a]) > wp.float64(0.0):
            wp.atomic_add(force_out, slot * nodes + node, size * slope_in[f, a])


@wp.kernel
def move_along_normals(
    faces: wp.array2d(dtype=wp.int32),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    slope_in: wp.array2d(dtype=wp.vec3d),
    offset_in: wp.array2d(dtype=wp.float64),
    change_in: wp.array(dtype=wp.vec3d),
    change_out: wp.array(dtype=wp.vec3d),
):
    """Add changes of offsets, along the normals, to a change of the nodes that touch.

    Corners of several faces are one node, with one normal, and write the same.
    """
    f = items[wp.tid()]
    s = f % faces.shape[0]
    slot = f // faces.shape[0]
    for a in range(faces.shape[1]):
        size = wp.length(slope_in[f, a])
        if size > wp.float64(0.0):
            node = faces[s, a]
            at = slot * nodes + node
            change_out[at] = change_in[at] + (offset_in[slot, node] / size) * slope_in[f, a]


@wp.kernel
def place_anchors(
    items: wp.array(dtype=wp.int32),
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    nodes: int,
    softness: wp.float64,
    tip: wp.array(dtype=wp.vec3d),
    rotation: wp.array(dtype=wp.mat33d),
    position_in: wp.array(dtype=wp.vec3d),
    traction_in: wp.array2d(dtype=wp.vec3d),
    anchor_out: wp.array2d(dtype=wp.vec3d),
):
    """Anchors whose springs carry the tractions, in the indenter's frame."""
    f = items[wp.tid()]
    s = f % faces.shape[0]
    slot = f // faces.shape[0]
    for q in range(shape.shape[0]):
        x = at_point(faces, shape, position_in, s, q, slot * nodes)
        away = x - softness * traction_in[f, q] - tip[slot]
        anchor_out[f, q] = wp.transpose(rotation[slot]) * away
