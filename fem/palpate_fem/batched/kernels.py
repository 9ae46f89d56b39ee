# mypy: ignore-errors
"""Kernels for many copies of one fingertip: lists, moves, reductions, and sums over vectors.

Arrays of the copies follow one another: node k of slot s is at ``s * nodes + k``, and so on.
Vectors of the free unknowns have the shape (slots, lanes, n). The equations' own kernels
(``mechanics``) work on such arrays as they are.
"""

from __future__ import annotations

import warp as wp

STRETCH = 512
"""Entries of a vector that one block of threads adds up."""

wp.set_module_options({"enable_backward": False})

NUMBERS = 16
"""Numbers of a slot that the host looks at; places below."""

UNBALANCED, INTERNAL, FLUID, INDENTER, CORE = 0, 1, 2, 3, 4  # sums of squares
VOLUME, STRAIN, GAP, TRACTION, LARGEST, JACOBIAN, CHANGED = 5, 6, 7, 8, 9, 10, 11
NET = 12  # and 13, 14


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
def clear_vectors(
    slots: wp.array(dtype=wp.int32), count: int, vectors_out: wp.array(dtype=wp.vec3d)
):
    """Set ``count`` vectors of each listed slot to zero."""
    i, k = wp.tid()
    vectors_out[slots[i] * count + k] = wp.vec3d()


@wp.kernel
def clear_matrices(
    slots: wp.array(dtype=wp.int32), count: int, matrices_out: wp.array(dtype=wp.mat33d)
):
    """Set ``count`` matrices of each listed slot to zero."""
    i, k = wp.tid()
    matrices_out[slots[i] * count + k] = wp.mat33d()


@wp.kernel
def copy_rows(
    slots: wp.array(dtype=wp.int32),
    count: int,
    source_in: wp.array(dtype=wp.float64),
    copy_out: wp.array(dtype=wp.float64),
):
    """Copy ``count`` numbers of each listed slot."""
    i, k = wp.tid()
    at = slots[i] * count + k
    copy_out[at] = source_in[at]


@wp.kernel
def copy_integers(
    slots: wp.array(dtype=wp.int32),
    count: int,
    source_in: wp.array(dtype=wp.int32),
    copy_out: wp.array(dtype=wp.int32),
):
    """`copy_rows` of integers."""
    i, k = wp.tid()
    at = slots[i] * count + k
    copy_out[at] = source_in[at]


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
    """Now + ratio (now - before); not below zero where ``positive``."""
    i, k = wp.tid()
    slot = slots[i]
    at = slot * count + k
    value = now_in[at]
    if ratio[slot] != wp.float64(0.0):
        value += ratio[slot] * (value - before_in[at])
    if positive != 0:
        value = wp.max(value, wp.float64(0.0))
    trial_out[at] = value


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
def gather_values(
    slots: wp.array(dtype=wp.int32),
    gather: wp.array(dtype=wp.int32),
    blocks: int,
    sum_in: wp.array(dtype=wp.float64),
    values_out: wp.array2d(dtype=wp.float64),
):
    """Entries of the upper triangle from the node-pair blocks."""
    i, k = wp.tid()
    slot = slots[i]
    values_out[slot, k] = sum_in[slot * blocks * 9 + gather[k]]


@wp.kernel
def add_viscosity(
    slots: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    node_viscosity: wp.array(dtype=wp.float64),
    viscosity: wp.array(dtype=wp.float64),
    values_out: wp.array2d(dtype=wp.float64),
):
    """Add the pseudo-viscosity to the diagonal, with which each row begins."""
    i, k = wp.tid()
    slot = slots[i]
    values_out[slot, starts[k]] += viscosity[slot] * node_viscosity[k]


@wp.func
def raise_to(numbers: wp.array2d(dtype=wp.float64), slot: int, place: int, value: wp.float64):
    """Raise a maximum; most values are below it, and need no atomic operation."""
    if value > numbers[slot, place]:
        wp.atomic_max(numbers, slot, place, value)


@wp.kernel
def clear_numbers(slots: wp.array(dtype=wp.int32), numbers_out: wp.array2d(dtype=wp.float64)):
    """Begin the sums and maxima of the listed slots."""
    i, k = wp.tid()
    numbers_out[slots[i], k] = wp.float64(0.0)
    if k == JACOBIAN:
        numbers_out[slots[i], k] = wp.float64(1.0e30)


@wp.kernel
def sum_nodes(
    slots: wp.array(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    nodes: int,
    internal_in: wp.array(dtype=wp.vec3d),
    indenter_in: wp.array(dtype=wp.vec3d),
    core_in: wp.array(dtype=wp.vec3d),
    gradient_in: wp.array(dtype=wp.vec3d),
    fluid_pressure_in: wp.array(dtype=wp.float64),
    unbalanced_out: wp.array(dtype=wp.vec3d),
    numbers_out: wp.array2d(dtype=wp.float64),
):
    """Unbalanced force of each node, and the sums of squares of all forces; see `ForceBalance`."""
    i, k = wp.tid()
    slot = slots[i]
    at = slot * nodes + k
    fluid = fluid_pressure_in[slot] * gradient_in[at]
    total = internal_in[at] + indenter_in[at] + core_in[at] - fluid
    unbalanced = wp.float64(0.0)
    internal = wp.float64(0.0)
    by_fluid = wp.float64(0.0)
    by_indenter = wp.float64(0.0)
    by_core = wp.float64(0.0)
    for c in range(3):
        if held[3 * k + c] != 0:
            total[c] = wp.float64(0.0)
            internal += internal_in[at][c] * internal_in[at][c]
        else:
            unbalanced += total[c] * total[c]
            by_fluid += fluid[c] * fluid[c]
            by_indenter += indenter_in[at][c] * indenter_in[at][c]
            by_core += core_in[at][c] * core_in[at][c]
    unbalanced_out[at] = total
    wp.atomic_add(numbers_out, slot, UNBALANCED, unbalanced)
    if internal != wp.float64(0.0):
        wp.atomic_add(numbers_out, slot, INTERNAL, internal)
    if by_fluid != wp.float64(0.0):
        wp.atomic_add(numbers_out, slot, FLUID, by_fluid)
    if by_indenter != wp.float64(0.0):
        wp.atomic_add(numbers_out, slot, INDENTER, by_indenter)
    if wp.length_sq(indenter_in[at]) > wp.float64(0.0):
        for c in range(3):
            wp.atomic_add(numbers_out, slot, NET + c, indenter_in[at][c])
    if by_core != wp.float64(0.0):
        wp.atomic_add(numbers_out, slot, CORE, by_core)


@wp.kernel
def sum_elements(
    slots: wp.array(dtype=wp.int32),
    elements: int,
    rest_volume: wp.array(dtype=wp.float64),
    bulk_over_volume: wp.array(dtype=wp.float64),
    volume_in: wp.array(dtype=wp.float64),
    jacobian_in: wp.array(dtype=wp.float64),
    pressure_in: wp.array(dtype=wp.float64),
    numbers_out: wp.array2d(dtype=wp.float64),
):
    """Largest error of an element's volume, and the smallest Jacobian."""
    i, k = wp.tid()
    slot = slots[i]
    at = slot * elements + k
    excess = volume_in[at] - rest_volume[k] - pressure_in[at] / bulk_over_volume[k]
    raise_to(numbers_out, slot, STRAIN, wp.abs(excess) / rest_volume[k])
    if jacobian_in[at] < numbers_out[slot, JACOBIAN]:
        wp.atomic_min(numbers_out, slot, JACOBIAN, jacobian_in[at])


@wp.kernel
def sum_cavity(
    slots: wp.array(dtype=wp.int32),
    faces: int,
    volume_in: wp.array(dtype=wp.float64),
    numbers_out: wp.array2d(dtype=wp.float64),
):
    """Volume of the cavity."""
    i, k = wp.tid()
    wp.atomic_add(numbers_out, slots[i], VOLUME, volume_in[slots[i] * faces + k])


@wp.kernel
def sum_contact(
    items: wp.array(dtype=wp.int32),
    each: int,
    wanted_in: wp.array2d(dtype=wp.float64),
    pressure_in: wp.array2d(dtype=wp.float64),
    wanted_traction_in: wp.array2d(dtype=wp.vec3d),
    traction_in: wp.array2d(dtype=wp.vec3d),
    status_in: wp.array2d(dtype=wp.int32),
    frozen_in: wp.array2d(dtype=wp.int32),
    numbers_out: wp.array2d(dtype=wp.float64),
):
    """Largest misfits of pressures and tractions [Pa], and whether the active set has changed."""
    f = items[wp.tid()]
    slot = f // each
    for q in range(wanted_in.shape[1]):
        raise_to(numbers_out, slot, GAP, wp.abs(wanted_in[f, q] - pressure_in[f, q]))
        for c in range(3):
            apart = wp.abs(wanted_traction_in[f, q][c] - traction_in[f, q][c])
            raise_to(numbers_out, slot, TRACTION, apart)
            raise_to(numbers_out, slot, LARGEST, wp.abs(traction_in[f, q][c]))
        if status_in[f, q] != frozen_in[f, q]:
            numbers_out[slot, CHANGED] = wp.float64(1.0)


@wp.kernel
def longest_moves(
    slots: wp.array(dtype=wp.int32),
    nodes: int,
    field_in: wp.array(dtype=wp.vec3d),
    longest_out: wp.array(dtype=wp.float64),
):
    """Square of the longest move of a node; not a number where a move is none."""
    i, k = wp.tid()
    slot = slots[i]
    size = wp.length_sq(field_in[slot * nodes + k])
    if size >= wp.float64(0.0):
        if size > longest_out[slot]:
            wp.atomic_max(longest_out, slot, size)
    else:
        wp.atomic_max(longest_out, slot, wp.float64(1.0e300))


@wp.kernel
def clear_sums(listed: wp.array(dtype=wp.int32), sums_out: wp.array(dtype=wp.float64)):
    """Set the sums of the listed slots to zero."""
    sums_out[listed[wp.tid()]] = wp.float64(0.0)


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
