# mypy: ignore-errors
"""Kernels for many copies of one fingertip: lists, moves, and products of vectors.

Arrays of the copies follow one another: node k of slot s is at ``s * nodes + k``, and so on.
Vectors of the free unknowns have the shape (slots, lanes, n). The equations' own kernels
(``mechanics``) work on such arrays as they are.
"""

from __future__ import annotations

from typing import Any

import warp as wp

STRETCH = 512
"""Entries of a vector that one block of threads adds up."""

ENTRIES = 4
"""Entries that a thread clears, copies or compares, where it does nothing else."""


Entries = wp.types.vector(length=ENTRIES, dtype=wp.float64)
"""What a thread reads before it writes any of it, as it would wait for each otherwise."""


def threads_for(count: int) -> int:
    """Threads that clear or copy so many entries of a slot."""
    return -(-count // ENTRIES)


@wp.func
def place_of(thread: int, n: int, count: int) -> int:
    """Place of entry n of a thread; neighbouring threads have neighbours."""
    return thread + n * ((count + wp.static(ENTRIES - 1)) // wp.static(ENTRIES))


wp.set_module_options({"enable_backward": False})


@wp.kernel
def expand(slots: wp.array(dtype=wp.int32), count: int, items_out: wp.array(dtype=wp.int32)):
    """Numbers of all items of the listed slots, ``count`` each."""
    i, k = wp.tid()
    items_out[i * count + k] = slots[i] * count + k


@wp.kernel
def expand_across(slots: wp.array(dtype=wp.int32), count: int, items_out: wp.array(dtype=wp.int32)):
    """`expand`, with the first item of all slots first."""
    i, k = wp.tid()
    items_out[k * slots.shape[0] + i] = slots[i] * count + k


@wp.kernel
def clear_rows(
    slots: wp.array(dtype=wp.int32), count: int, numbers_out: wp.array(dtype=wp.float64)
):
    """Set ``count`` numbers of each listed slot to zero; for `threads_for` them."""
    i, thread = wp.tid()
    begin = slots[i] * count
    for n in range(wp.static(ENTRIES)):
        k = place_of(thread, n, count)
        if k < count:
            numbers_out[begin + k] = wp.float64(0.0)


@wp.kernel
def copy_rows(
    slots: wp.array(dtype=wp.int32),
    count: int,
    source_in: wp.array(dtype=wp.float64),
    copy_out: wp.array(dtype=wp.float64),
):
    """Copy ``count`` numbers of each listed slot; for `threads_for` them."""
    i, thread = wp.tid()
    begin = slots[i] * count
    held = Entries()
    for n in range(wp.static(ENTRIES)):
        k = place_of(thread, n, count)
        if k < count:
            held[n] = source_in[begin + k]
    for n in range(wp.static(ENTRIES)):
        k = place_of(thread, n, count)
        if k < count:
            copy_out[begin + k] = held[n]


@wp.kernel
def copy_integers(
    slots: wp.array(dtype=wp.int32),
    count: int,
    source_in: wp.array(dtype=wp.int32),
    copy_out: wp.array(dtype=wp.int32),
):
    """`copy_rows` of integers."""
    i, thread = wp.tid()
    begin = slots[i] * count
    for n in range(wp.static(ENTRIES)):
        k = place_of(thread, n, count)
        if k < count:
            copy_out[begin + k] = source_in[begin + k]


@wp.kernel
def extrapolate(
    slots: wp.array(dtype=wp.int32),
    count: int,
    ratio: wp.array(dtype=wp.float64),
    positive: int,
    now_in: wp.array(dtype=wp.float64),
    before_in: wp.array(dtype=wp.float64),
    trial_out: wp.array(dtype=wp.float64),
):
    """Now + ratio (now - before); not below zero where ``positive``. For `threads_for` them."""
    i, thread = wp.tid()
    slot = slots[i]
    held = Entries()
    for n in range(wp.static(ENTRIES)):
        k = place_of(thread, n, count)
        if k < count:
            held[n] = now_in[slot * count + k]
            if ratio[slot] != wp.float64(0.0):
                held[n] += ratio[slot] * (held[n] - before_in[slot * count + k])
            if positive != 0:
                held[n] = wp.max(held[n], wp.float64(0.0))
    for n in range(wp.static(ENTRIES)):
        k = place_of(thread, n, count)
        if k < count:
            trial_out[slot * count + k] = held[n]


@wp.kernel
def go_towards(
    slots: wp.array(dtype=wp.int32),
    count: int,
    fraction: wp.array(dtype=wp.float64),
    start_in: wp.array(dtype=wp.float64),
    target_in: wp.array(dtype=wp.float64),
    state_out: wp.array(dtype=wp.float64),
):
    """Start + fraction (target - start)."""
    i, k = wp.tid()
    slot = slots[i]
    at = slot * count + k
    state_out[at] = start_in[at] + fraction[slot] * (target_in[at] - start_in[at])


@wp.kernel
def move_contact(
    items: wp.array(dtype=wp.int32),
    each: int,
    fraction: wp.array(dtype=wp.float64),
    start_in: wp.array2d(dtype=wp.float64),
    target_in: wp.array2d(dtype=wp.float64),
    traction_start_in: wp.array2d(dtype=wp.vec3d),
    traction_target_in: wp.array2d(dtype=wp.vec3d),
    pressure_out: wp.array2d(dtype=wp.float64),
    traction_out: wp.array2d(dtype=wp.vec3d),
):
    """Contact pressures and tractions; a contact opens at once, however short the step."""
    f = items[wp.tid()]
    share = fraction[f // each]
    for q in range(target_in.shape[1]):
        pressure_out[f, q] = wp.float64(0.0)
        traction_out[f, q] = wp.vec3d()
        if target_in[f, q] > wp.float64(0.0):
            p = start_in[f, q]
            t = traction_start_in[f, q]
            pressure_out[f, q] = p + share * (target_in[f, q] - p)
            traction_out[f, q] = t + share * (traction_target_in[f, q] - t)


@wp.kernel
def spread_change(
    slots: wp.array(dtype=wp.int32),
    free: wp.array(dtype=wp.int32),
    nodes: int,
    vectors_in: wp.array3d(dtype=wp.float64),
    lane: int,
    field_out: wp.array2d(dtype=wp.float64),
):
    """Free unknowns to a nodal field, whose held components stay zero; (slots * nodes, 3)."""
    i, k = wp.tid()
    slot = slots[i]
    component = free[k]
    field_out[slot * nodes + component // 3, component % 3] = vectors_in[slot, lane, k]


@wp.kernel
def move_nodes(
    slots: wp.array(dtype=wp.int32),
    free: wp.array(dtype=wp.int32),
    nodes: int,
    fraction: wp.array(dtype=wp.float64),
    vectors_in: wp.array3d(dtype=wp.float64),
    lane: int,
    start_in: wp.array2d(dtype=wp.float64),
    position_out: wp.array2d(dtype=wp.float64),
):
    """Move the free unknowns by a share of their change."""
    i, k = wp.tid()
    slot = slots[i]
    node = slot * nodes + free[k] // 3
    component = free[k] % 3
    position_out[node, component] = (
        start_in[node, component] + fraction[slot] * vectors_in[slot, lane, k]
    )


@wp.kernel
def move_fluid(
    slots: wp.array(dtype=wp.int32),
    fraction: wp.array(dtype=wp.float64),
    start_in: wp.array(dtype=wp.float64),
    change_in: wp.array(dtype=wp.float64),
    pressure_out: wp.array(dtype=wp.float64),
):
    """Fluid pressures after a share of their change."""
    slot = slots[wp.tid()]
    pressure_out[slot] = start_in[slot] + fraction[slot] * change_in[slot]


@wp.kernel
def gather_load(
    slots: wp.array(dtype=wp.int32),
    free: wp.array(dtype=wp.int32),
    nodes: int,
    sign: wp.float64,
    field_in: wp.array2d(dtype=wp.float64),
    vectors_out: wp.array3d(dtype=wp.float64),
    lane: int,
):
    """A nodal field times ``sign`` at the free unknowns."""
    i, k = wp.tid()
    slot = slots[i]
    component = free[k]
    value = field_in[slot * nodes + component // 3, component % 3]
    vectors_out[slot, lane, k] = sign * value


@wp.kernel
def add_load(
    slots: wp.array(dtype=wp.int32),
    free: wp.array(dtype=wp.int32),
    nodes: int,
    sign: wp.float64,
    field_in: wp.array2d(dtype=wp.float64),
    vectors_out: wp.array3d(dtype=wp.float64),
    lane: int,
):
    """Add a nodal field times ``sign`` at the free unknowns."""
    i, k = wp.tid()
    slot = slots[i]
    component = free[k]
    value = field_in[slot * nodes + component // 3, component % 3]
    vectors_out[slot, lane, k] += sign * value


@wp.kernel
def sum_shares(
    slots: wp.array(dtype=wp.int32),
    begins: wp.array(dtype=wp.int32),
    shares: wp.array(dtype=wp.int32),
    each: int,
    share_in: wp.array2d(dtype=Any),
    sum_out: wp.array(dtype=wp.float64),
):
    """Set the node-pair blocks to the sums of what elements and faces give to them.

    ``shares`` lists those of a block, from ``begins`` of it up to that of the next one. A thread
    for each of nine numbers of a block.
    """
    i, k = wp.tid()
    slot = slots[i]
    block = k // 9
    total = wp.float64(0.0)
    for n in range(begins[block], begins[block + 1]):
        total += wp.float64(share_in[slot * each + shares[n], k % 9])
    sum_out[slot * 9 * (begins.shape[0] - 1) + k] = total


@wp.kernel
def gather_values(
    slots: wp.array(dtype=wp.int32),
    gather: wp.array(dtype=wp.int32),
    blocks: int,
    sum_in: wp.array(dtype=wp.float64),
    values_out: wp.array2d(dtype=Any),
):
    """Entries of the upper triangle from the node-pair blocks; for `threads_for` them."""
    i, thread = wp.tid()
    slot = slots[i]
    begin = slot * blocks * 9
    count = gather.shape[0]
    held = Entries()
    for n in range(wp.static(ENTRIES)):
        k = place_of(thread, n, count)
        if k < count:
            held[n] = sum_in[begin + gather[k]]
    for n in range(wp.static(ENTRIES)):
        k = place_of(thread, n, count)
        if k < count:
            values_out[slot, k] = values_out.dtype(held[n])


@wp.kernel
def add_viscosity(
    slots: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    node_viscosity: wp.array(dtype=wp.float64),
    viscosity: wp.array(dtype=wp.float64),
    values_out: wp.array2d(dtype=Any),
):
    """Add the pseudo-viscosity to the diagonal, with which each row begins."""
    i, k = wp.tid()
    slot = slots[i]
    values_out[slot, starts[k]] += values_out.dtype(viscosity[slot] * node_viscosity[k])


@wp.kernel
def add_products(
    listed: wp.array(dtype=wp.int32),
    first_in: wp.array3d(dtype=wp.float64),
    first_lane: int,
    second_in: wp.array3d(dtype=wp.float64),
    second_lane: int,
    sums_out: wp.array(dtype=wp.float64),
):
    """Add the scalar product of two vectors of each listed slot."""
    i, part = wp.tid()
    slot = listed[i]
    first = wp.tile_load(first_in[slot, first_lane], shape=STRETCH, offset=part * STRETCH)
    second = wp.tile_load(second_in[slot, second_lane], shape=STRETCH, offset=part * STRETCH)
    wp.tile_atomic_add(sums_out, wp.tile_sum(wp.tile_map(wp.mul, first, second)), offset=slot)


@wp.kernel
def copy_lane(
    listed: wp.array(dtype=wp.int32),
    vector_in: wp.array3d(dtype=wp.float64),
    lane_in: int,
    vector_out: wp.array3d(dtype=wp.float64),
    lane_out: int,
):
    """Copy one lane of the listed slots to a lane of another array."""
    i, k = wp.tid()
    slot = listed[i]
    vector_out[slot, lane_out, k] = vector_in[slot, lane_in, k]


@wp.kernel
def add_scaled_lane(
    listed: wp.array(dtype=wp.int32),
    vector_in: wp.array3d(dtype=wp.float64),
    lane_in: int,
    factor_in: wp.array(dtype=wp.float64),
    vector_out: wp.array3d(dtype=wp.float64),
    lane_out: int,
):
    """Add a lane, times the slot's factor, to a lane of another array."""
    i, k = wp.tid()
    slot = listed[i]
    vector_out[slot, lane_out, k] += factor_in[slot] * vector_in[slot, lane_in, k]


@wp.kernel
def fluid_pressure_change(
    listed: wp.array(dtype=wp.int32),
    missing_in: wp.array(dtype=wp.float64),
    moved_in: wp.array(dtype=wp.float64),
    stiffness_in: wp.array(dtype=wp.float64),
    further_out: wp.array(dtype=wp.float64),
    change_out: wp.array(dtype=wp.float64),
):
    """Further pressure by which the change of the skin has the volume that is missing."""
    slot = listed[wp.tid()]
    further_out[slot] = (missing_in[slot] - moved_in[slot]) / stiffness_in[slot]
    change_out[slot] += further_out[slot]


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
