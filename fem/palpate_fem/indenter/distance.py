"""Signed distance of many points to an indenter as contact sees it, and first touch.

A gap shrinks by no more than the indenter moves (sphere tracing). So the indenter may always move
by the gap of a point.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
import warp as wp

from palpate_fem.arrays import Floats
from palpate_fem.device import launch, mat33s, scalars, vec3s
from palpate_fem.indenter.kernels import indenter_distance
from palpate_fem.indenter.shape import Indenter

wp.set_module_options({"enable_backward": False})

TOUCH_M = 1e-9
"""A smaller gap counts as contact [m]."""

_TOUCH = wp.constant(wp.float64(TOUCH_M))
_MOVES = wp.constant(2000)  # contact at a glancing angle is approached slowly


@wp.kernel
@no_type_check  # Warp's annotations are not types
def distances(
    primitives: wp.array2d(dtype=wp.float64),
    point_in: wp.array(dtype=wp.vec3d),
    margin: wp.float64,
    gap_out: wp.array(dtype=wp.float64),
    normal_out: wp.array(dtype=wp.vec3d),
    hessian_out: wp.array(dtype=wp.mat33d),
) -> None:
    """`indenter_distance` at each point; no derivatives where their arrays are empty."""
    i = wp.tid()
    near = indenter_distance(primitives, point_in[i], margin)
    gap_out[i] = near.gap
    if normal_out.shape[0] > 0:
        normal_out[i] = near.normal
        hessian_out[i] = near.hessian


@wp.kernel
@no_type_check
def first_touches(
    primitives: wp.array2d(dtype=wp.float64),
    point_in: wp.array(dtype=wp.vec3d),
    move: wp.vec3d,
    start: wp.float64,
    limit: wp.float64,
    travel_out: wp.array(dtype=wp.float64),
) -> None:
    """Travel from ``start`` on at which each point is touched; ``limit`` if it is not before."""
    i = wp.tid()
    travel = start
    for _ in range(_MOVES):
        near = indenter_distance(primitives, point_in[i] - travel * move, limit - travel)
        if near.gap >= limit - travel:
            travel = limit
        if travel >= limit or near.gap <= _TOUCH:
            break
        travel += near.gap
    travel_out[i] = travel


def first_touch(
    indenter: Indenter, points: Floats, move: Floats, start: float, limit: float
) -> float:
    """Travel at which a moving indenter touches the first of some points [m].

    Args:
        indenter: The indenter.
        points: Positions before it moves [m], shape (N, 3), indenter frame.
        move: Its direction, a unit vector of the same frame, shape (3,).
        start: Travel from which on it is clear of all of them [m].
        limit: Travel at which it ends [m]; returned if it touches none before.
    """
    points = np.ascontiguousarray(points, np.float64)
    travel = np.full(len(points), limit)
    inputs = [scalars(indenter.packed()), vec3s(points), wp.vec3d(*move), start, limit]
    launch(first_touches, len(points), inputs, [scalars(travel)])
    return float(travel.min(initial=limit))


def _evaluate(
    indenter: Indenter, points: Floats, sloped: int, margin_m: float = np.inf
) -> tuple[Floats, Floats, Floats]:
    points = np.ascontiguousarray(points, np.float64)
    gap, normal, hessian = np.empty(len(points)), np.empty((sloped, 3)), np.empty((sloped, 3, 3))
    launch(
        distances,
        len(points),
        [scalars(indenter.packed()), vec3s(points), margin_m],
        [scalars(gap), vec3s(normal), mat33s(hessian)],
    )
    return gap, normal, hessian


def signed_distance(indenter: Indenter, points: Floats, margin_m: float = np.inf) -> Floats:
    """Gap alone [m], shape (N,), positive outside; see `distance`.

    Where it is above the margin, it may be any smaller value that is above the margin, too.
    """
    return _evaluate(indenter, points, 0, margin_m)[0]


def distance(
    indenter: Indenter, points: Floats, margin_m: float = np.inf
) -> tuple[Floats, Floats, Floats]:
    """Gap, normal and hessian.

    Args:
        indenter: The indenter.
        points: Positions [m], shape (N, 3), indenter frame.
        margin_m: Gap above which any value above it will do, with derivatives of zero [m].

    Returns:
        Gap [m], shape (N,), positive outside; its gradient, a unit vector away from the indenter,
        shape (N, 3); and its second derivative [1/m], shape (N, 3, 3). All in the indenter frame.
    """
    return _evaluate(indenter, points, len(points), margin_m)
