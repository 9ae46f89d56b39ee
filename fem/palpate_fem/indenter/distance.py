"""Signed distance of many points to an indenter, by the function that contact uses."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
import warp as wp

from palpate_fem.arrays import Floats
from palpate_fem.device import launch, mat33s, scalars, vec3s
from palpate_fem.indenter.kernels import indenter_distance
from palpate_fem.indenter.shape import Indenter

wp.set_module_options({"enable_backward": False})


@wp.kernel
@no_type_check  # Warp's annotations are not types
def distances(
    primitives: wp.array2d(dtype=wp.float64),
    point_in: wp.array(dtype=wp.vec3d),
    gap_out: wp.array(dtype=wp.float64),
    normal_out: wp.array(dtype=wp.vec3d),
    hessian_out: wp.array(dtype=wp.mat33d),
) -> None:
    """`indenter_distance` at each point; no derivatives where their arrays are empty."""
    i = wp.tid()
    near = indenter_distance(primitives, point_in[i], wp.float64(1.0e300))  # no margin
    gap_out[i] = near.gap
    if normal_out.shape[0] > 0:
        normal_out[i] = near.normal
        hessian_out[i] = near.hessian


def _evaluate(indenter: Indenter, points: Floats, sloped: int) -> tuple[Floats, Floats, Floats]:
    points = np.ascontiguousarray(points, np.float64)
    gap, normal, hessian = np.empty(len(points)), np.empty((sloped, 3)), np.empty((sloped, 3, 3))
    launch(
        distances,
        len(points),
        [scalars(indenter.packed()), vec3s(points)],
        [scalars(gap), vec3s(normal), mat33s(hessian)],
    )
    return gap, normal, hessian


def signed_distance(indenter: Indenter, points: Floats) -> Floats:
    """Gap alone [m], shape (N,), positive outside; see `distance`."""
    return _evaluate(indenter, points, 0)[0]


def distance(indenter: Indenter, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Gap, normal and hessian.

    Args:
        indenter: The indenter.
        points: Positions [m], shape (N, 3), indenter frame.

    Returns:
        Gap [m], shape (N,), positive outside; its gradient, a unit vector away from the indenter,
        shape (N, 3); and its second derivative [1/m], shape (N, 3, 3). All in the indenter frame.
    """
    return _evaluate(indenter, points, len(points))
