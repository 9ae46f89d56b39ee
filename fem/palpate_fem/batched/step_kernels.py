# mypy: ignore-errors
"""Kernels that make steps of solutions: stresses, contact area, centre of pressure, and sums."""

from __future__ import annotations

import warp as wp

from palpate_fem.batched.reductions import raise_to

wp.set_module_options({"enable_backward": False})

SUMS = 16
"""Numbers of a step that are no fields; places below."""

FORCE, TORQUE, MOMENT = 0, 3, 6  # three each; the last is the sum of pressure x area x point
AREA, WEIGHT, ON_INDENTER, ON_CORE = 9, 10, 11, 12  # the last two are the largest pressures


@wp.kernel
def clear_sums(slots: wp.array(dtype=wp.int32), sums_out: wp.array2d(dtype=wp.float64)):
    """Begin the sums of the listed slots."""
    i, k = wp.tid()
    sums_out[slots[i], k] = wp.float64(0.0)


@wp.kernel
def sum_forces(
    slots: wp.array(dtype=wp.int32),
    nodes: int,
    position_in: wp.array(dtype=wp.vec3d),
    force_in: wp.array(dtype=wp.vec3d),
    sums_out: wp.array2d(dtype=wp.float64),
):
    """Net force of the indenter on the skin, and its moment; minus the nodal forces of balance."""
    i, k = wp.tid()
    slot = slots[i]
    force = -force_in[slot * nodes + k]
    if wp.length_sq(force) > wp.float64(0.0):
        torque = wp.cross(position_in[slot * nodes + k], force)
        for c in range(3):
            wp.atomic_add(sums_out, slot, FORCE + c, force[c])
            wp.atomic_add(sums_out, slot, TORQUE + c, torque[c])


@wp.kernel
def largest_pressure(
    items: wp.array(dtype=wp.int32),
    each: int,
    pressure_in: wp.array2d(dtype=wp.float64),
    place: int,
    sums_out: wp.array2d(dtype=wp.float64),
):
    """Largest pressure on the listed faces."""
    f = items[wp.tid()]
    for q in range(pressure_in.shape[1]):
        raise_to(sums_out, f // each, place, pressure_in[f, q])


@wp.kernel
def sum_contact_area(
    faces: wp.array2d(dtype=wp.int32),
    shape: wp.array2d(dtype=wp.float64),
    gradient: wp.array3d(dtype=wp.float64),
    weight: wp.array(dtype=wp.float64),
    corner_area: wp.array2d(dtype=wp.float64),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    share: wp.float64,
    position_in: wp.array(dtype=wp.vec3d),
    pressure_in: wp.array2d(dtype=wp.float64),
    sums_out: wp.array2d(dtype=wp.float64),
):
    """Area of the corners that touch, and the moment of all pressures.

    A corner touches if its pressure is more than ``share`` of the largest one. Its area now is the
    integral of its shape function over the face; pressures act on ``corner_area``, that at rest.
    """
    f = items[wp.tid()]
    s = f % faces.shape[0]
    slot = f // faces.shape[0]
    touching = share * wp.max(sums_out[slot, ON_INDENTER], wp.float64(1.0))
    for a in range(faces.shape[1]):
        p = pressure_in[f, a]
        if p > wp.float64(0.0):
            load = p * corner_area[s, a]
            point = position_in[slot * nodes + faces[s, a]]
            wp.atomic_add(sums_out, slot, WEIGHT, load)
            for c in range(3):
                wp.atomic_add(sums_out, slot, MOMENT + c, load * point[c])
        if p > touching:
            area = wp.float64(0.0)
            for q in range(shape.shape[0]):
                along = wp.vec3d()
                across = wp.vec3d()
                for b in range(faces.shape[1]):
                    x = position_in[slot * nodes + faces[s, b]]
                    along += gradient[q, b, 0] * x
                    across += gradient[q, b, 1] * x
                area += shape[q, a] * weight[q] * wp.length(wp.cross(along, across))
            wp.atomic_add(sums_out, slot, AREA, area)


@wp.kernel
def pack(
    slots: wp.array(dtype=wp.int32),
    each: int,
    factor: wp.float64,
    source_in: wp.array(dtype=wp.float64),
    at: int,
    packed_out: wp.array2d(dtype=wp.float64),
):
    """``each`` numbers of every listed slot, times a factor, from column ``at`` of its row on."""
    i, k = wp.tid()
    packed_out[i, at + k] = factor * source_in[slots[i] * each + k]


@wp.kernel
def pack_stress(
    slots: wp.array(dtype=wp.int32),
    elements: int,
    stress_in: wp.array(dtype=wp.mat33d),
    at: int,
    packed_out: wp.array2d(dtype=wp.float64),
):
    """Stresses xx yy zz yz xz xy of every listed slot, likewise."""
    i, e = wp.tid()
    stress = stress_in[slots[i] * elements + e]
    for c in range(3):
        packed_out[i, at + 6 * e + c] = stress[c, c]
    packed_out[i, at + 6 * e + 3] = stress[1, 2]
    packed_out[i, at + 6 * e + 4] = stress[0, 2]
    packed_out[i, at + 6 * e + 5] = stress[0, 1]
