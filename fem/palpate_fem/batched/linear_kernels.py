# mypy: ignore-errors
"""Kernels on vectors of many slots: sums over the unknowns, and what the border adds.

Vectors have the shape (slots, lanes, n). A block of threads works on a stretch of one vector.
"""

from __future__ import annotations

import warp as wp

STRETCH = 512
"""Entries of a vector that one block of threads adds up."""

wp.set_module_options({"enable_backward": False})


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
    change_out: wp.array(dtype=wp.float64),
):
    """Pressure by which the change of the skin has the volume that is missing."""
    slot = listed[wp.tid()]
    change_out[slot] = (missing_in[slot] - moved_in[slot]) / stiffness_in[slot]
