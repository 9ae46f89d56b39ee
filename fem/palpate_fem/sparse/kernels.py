# mypy: ignore-errors
"""Kernel that adds a child's share to its parent's front."""

from __future__ import annotations

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def extend_add(
    # Child: its square of ``size`` columns, one after the other, and their places in the front.
    size: int,
    share: wp.array(dtype=Any),
    place: wp.array(dtype=wp.int32),
    # Parent: unknowns it eliminates, unknowns of its border.
    own: int,
    border: int,
    # Out, all column after column; only lower triangles are read and written:
    lower_out: wp.array(dtype=Any),
    below_out: wp.array(dtype=Any),
    share_out: wp.array(dtype=Any),
):
    """Add one column."""
    j = wp.tid()
    q = place[j]
    for i in range(j, size):
        p = place[i]
        value = share[j * size + i]
        if q < own:
            if p < own:
                lower_out[q * own + p] = lower_out[q * own + p] + value
            else:
                k = q * border + p - own
                below_out[k] = below_out[k] + value
        else:
            k = (q - own) * border + p - own
            share_out[k] = share_out[k] + value


for _kind in (wp.float32, wp.float64):
    wp.overload(
        extend_add,
        {
            "share": wp.array(dtype=_kind),
            "lower_out": wp.array(dtype=_kind),
            "below_out": wp.array(dtype=_kind),
            "share_out": wp.array(dtype=_kind),
        },
    )
