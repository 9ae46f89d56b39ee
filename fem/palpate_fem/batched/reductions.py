# mypy: ignore-errors
"""Sums and extremes over the nodes, elements and faces of each slot: numbers that the host reads.

A balance is evaluated in every iteration. There a thread has one node, element or face; the threads
of a warp find their sum or extreme together, and one of them adds it to the slot's. (With an atomic
operation of each thread, the thousands of a slot wait for each other.) So all threads of a warp
belong to one slot: launches have `padded` threads for each. Steps of the solution are rare: there
each thread adds its own.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

WARP = 32
"""Threads of a warp."""

NUMBERS = 16
"""Numbers of a slot that the host looks at; places below."""

UNBALANCED, INTERNAL, FLUID, INDENTER, CORE = 0, 1, 2, 3, 4  # sums of squares
VOLUME, STRAIN, GAP, TRACTION, LARGEST, JACOBIAN, CHANGED = 5, 6, 7, 8, 9, 10, 11
NET = 12  # and 13, 14

SUMS = 16
"""Numbers of a step that are no fields; places below."""

FORCE, TORQUE, MOMENT = 0, 3, 6  # three each; the last is the sum of pressure x area x point
AREA, WEIGHT, ON_INDENTER, ON_CORE = 9, 10, 11, 12  # the last two are the largest pressures


def padded(count: int) -> int:
    """Threads for ``count`` items of a slot: whole warps."""
    return -(-count // WARP) * WARP


_OVER_WARP = """
#ifdef __CUDA_ARCH__
    #pragma unroll
    for (int apart = 16; apart > 0; apart /= 2) {
        const double other = __shfl_xor_sync(~0u, value, apart);
        value = COMBINED;
    }
#endif
    return value;
"""


@wp.func_native(_OVER_WARP.replace("COMBINED", "value + other"))
def warp_sum(value: wp.float64) -> wp.float64:
    """Sum over the threads of a warp, all of which call it; on a CPU the value."""
    ...


@wp.func_native(_OVER_WARP.replace("COMBINED", "fmax(value, other)"))
def warp_max(value: wp.float64) -> wp.float64:
    """Largest value of the threads of a warp that is a number; likewise."""
    ...


@wp.func_native("""
#ifdef __CUDA_ARCH__
    return threadIdx.x % 32 == 0;
#else
    return true;
#endif
""")
def first_of_warp() -> bool:
    """Whether this thread is the first one of its warp; on a CPU each is."""
    ...


@wp.func
def add_sum(numbers: wp.array2d(dtype=wp.float64), slot: int, place: int, value: wp.float64):
    """Add the values of a warp's threads to a number of their slot."""
    total = warp_sum(value)
    if first_of_warp() and total != wp.float64(0.0):
        wp.atomic_add(numbers, slot, place, total)


@wp.func
def raise_to(numbers: wp.array2d(dtype=wp.float64), slot: int, place: int, value: wp.float64):
    """Raise a maximum; most values are below it, and need no atomic operation."""
    if value > numbers[slot, place]:
        wp.atomic_max(numbers, slot, place, value)


@wp.func
def raise_to_max(numbers: wp.array2d(dtype=wp.float64), slot: int, place: int, value: wp.float64):
    """Raise a maximum of a slot to the largest value of a warp's threads."""
    largest = warp_max(value)
    if first_of_warp():
        raise_to(numbers, slot, place, largest)


@wp.kernel
def clear_numbers(slots: wp.array(dtype=wp.int32), numbers_out: wp.array2d(dtype=wp.float64)):
    """Begin the `NUMBERS` of the listed slots."""
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
    unbalanced = wp.float64(0.0)
    internal = wp.float64(0.0)
    by_fluid = wp.float64(0.0)
    by_indenter = wp.float64(0.0)
    by_core = wp.float64(0.0)
    net = wp.vec3d()
    if k < nodes:
        at = slot * nodes + k
        of_skin = internal_in[at]
        net = indenter_in[at]
        of_core = core_in[at]
        fluid = fluid_pressure_in[slot] * gradient_in[at]
        total = of_skin + net + of_core - fluid
        for c in range(3):
            if held[3 * k + c] != 0:
                total[c] = wp.float64(0.0)
                internal += of_skin[c] * of_skin[c]
            else:
                unbalanced += total[c] * total[c]
                by_fluid += fluid[c] * fluid[c]
                by_indenter += net[c] * net[c]
                by_core += of_core[c] * of_core[c]
        unbalanced_out[at] = total
    add_sum(numbers_out, slot, UNBALANCED, unbalanced)
    add_sum(numbers_out, slot, INTERNAL, internal)
    add_sum(numbers_out, slot, FLUID, by_fluid)
    add_sum(numbers_out, slot, INDENTER, by_indenter)
    add_sum(numbers_out, slot, CORE, by_core)
    for c in range(3):
        add_sum(numbers_out, slot, NET + c, net[c])


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
    error = wp.float64(0.0)
    jacobian = wp.float64(1.0e30)
    if k < elements:
        at = slot * elements + k
        excess = volume_in[at] - rest_volume[k] - pressure_in[at] / bulk_over_volume[k]
        error = wp.abs(excess) / rest_volume[k]
        jacobian = jacobian_in[at]
    raise_to_max(numbers_out, slot, STRAIN, error)
    smallest = -warp_max(-jacobian)
    if first_of_warp() and smallest < numbers_out[slot, JACOBIAN]:
        wp.atomic_min(numbers_out, slot, JACOBIAN, smallest)


@wp.kernel
def sum_cavity(
    slots: wp.array(dtype=wp.int32),
    faces: int,
    volume_in: wp.array(dtype=wp.float64),
    numbers_out: wp.array2d(dtype=wp.float64),
):
    """Volume of the cavity."""
    i, k = wp.tid()
    volume = wp.float64(0.0)
    if k < faces:
        volume = volume_in[slots[i] * faces + k]
    add_sum(numbers_out, slots[i], VOLUME, volume)


@wp.kernel
def compare_contact(
    slots: wp.array(dtype=wp.int32),
    faces: int,
    wanted_in: wp.array2d(dtype=wp.float64),
    pressure_in: wp.array2d(dtype=wp.float64),
    wanted_traction_in: wp.array2d(dtype=wp.vec3d),
    traction_in: wp.array2d(dtype=wp.vec3d),
    status_in: wp.array2d(dtype=wp.int32),
    frozen_in: wp.array2d(dtype=wp.int32),
    numbers_out: wp.array2d(dtype=wp.float64),
):
    """Largest misfits of pressures and tractions [Pa], and whether the active set has changed."""
    i, k = wp.tid()
    slot = slots[i]
    misfit = wp.float64(0.0)
    apart = wp.float64(0.0)
    largest = wp.float64(0.0)
    if k < faces:
        f = slot * faces + k
        for q in range(wanted_in.shape[1]):
            misfit = wp.max(misfit, wp.abs(wanted_in[f, q] - pressure_in[f, q]))
            traction = traction_in[f, q]
            for c in range(3):
                apart = wp.max(apart, wp.abs(wanted_traction_in[f, q][c] - traction[c]))
                largest = wp.max(largest, wp.abs(traction[c]))
            if status_in[f, q] != frozen_in[f, q]:
                numbers_out[slot, CHANGED] = wp.float64(1.0)
    raise_to_max(numbers_out, slot, GAP, misfit)
    raise_to_max(numbers_out, slot, TRACTION, apart)
    raise_to_max(numbers_out, slot, LARGEST, largest)


@wp.kernel
def longest_moves(
    slots: wp.array(dtype=wp.int32),
    nodes: int,
    field_in: wp.array(dtype=wp.vec3d),
    longest_out: wp.array2d(dtype=wp.float64),
):
    """Square of the longest move of a node; 1e300 where a move is no number."""
    i, k = wp.tid()
    slot = slots[i]
    size = wp.float64(0.0)
    if k < nodes:
        size = wp.length_sq(field_in[slot * nodes + k])
        if not (size >= wp.float64(0.0)):
            size = wp.float64(1.0e300)
    raise_to_max(longest_out, slot, 0, size)


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
