# mypy: ignore-errors
"""Kernel of the sealed fluid: the volume that a closed surface encloses, and its derivatives."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def cavity_volume(
    # Model:
    faces: wp.array2d(dtype=wp.int32),
    form: wp.array3d(dtype=wp.float64),
    # State in:
    position_in: wp.array(dtype=wp.vec3d),
    # Out:
    volume_out: wp.array(dtype=wp.float64),
    gradient_out: wp.array(dtype=wp.vec3d),
):
    """Volume under each face and, added to the nodes, its gradient (``volume_form``)."""
    f = wp.tid()
    k = faces.shape[1]
    volume = wp.float64(0.0)
    for a in range(k):
        g = wp.vec3d()
        for b in range(k):
            for c in range(k):
                if c > b:
                    area = wp.cross(position_in[faces[f, b]], position_in[faces[f, c]])
                    g += (wp.float64(2.0) * form[a, b, c]) * area
        volume += wp.dot(position_in[faces[f, a]], g)
        wp.atomic_add(gradient_out, faces[f, a], wp.float64(3.0) * g)
    volume_out[f] = volume


@wp.kernel
def cavity_tangent(
    # Model:
    faces: wp.array2d(dtype=wp.int32),
    form: wp.array3d(dtype=wp.float64),
    pair: wp.array3d(dtype=wp.int32),
    # State in:
    factor: wp.float64,
    position_in: wp.array(dtype=wp.vec3d),
    # Out:
    block_out: wp.array(dtype=wp.mat33d),
):
    """Add ``factor`` times the second derivative of the volume to the upper node-pair blocks."""
    f = wp.tid()
    k = faces.shape[1]
    for a in range(k):
        for b in range(k):
            block = pair[f, a, b]
            if block >= 0:
                arm = wp.vec3d()
                for c in range(k):
                    arm += form[a, b, c] * position_in[faces[f, c]]
                # d/dx_b of 6 C_abc x_b x x_c = -6 C_abc skew(x_c)
                wp.atomic_add(block_out, block, (wp.float64(-6.0) * factor) * wp.skew(arm))
