# mypy: ignore-errors
"""Contact at points, as kernels see it: normal law and friction.

Points are the corners of the surface faces (Lobatto points).

Normal law, with gap g and stiffness e per *reference* area, so that frictionless contact has an
energy::

    p = e max(0, -g)

so stiff that nothing is deeper than a few micrometres. Coulomb friction by return mapping: a point
sticks to an anchor on the indenter by a spring of stiffness k; the spring's traction is capped at
mu p, and what is beyond moves the anchor at the end of the increment.

Pressures and tractions are states of their own, as in the elements: an iterate's values come from
the linear solve, not from gap and slip, because so stiff laws would turn each micrometre of
curvature into a megapascal. Whether a point touches, sticks or slides is decided from both
(primal-dual active set; Hueber and Wohlmuth 2005, Gitterle et al. 2010)::

    touches: g < 0 or p > 0            slides: |t + c (d - t / k)| > mu p

with d the tangential way from the anchor. Points lie in the corners, where the nodes are: as many
conditions as unknowns. With 2 x 2 inner points there are four times as many; they contradict one
another by the facet's sagitta, and the sets cycle (tried, not kept).

NumPy twins: ``contact.py``.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Law:
    """Constants of the contact laws; SI."""

    stiffness: wp.float64
    friction: wp.float64
    tangential_stiffness: wp.float64
    complement: wp.float64


@wp.struct
class Friction:
    """Linearised friction at a point: status 1 sticks, 2 slides; traction, and its derivatives."""

    status: int
    wanted: wp.vec3d
    by_position: wp.mat33d
    by_pressure: wp.vec3d


@wp.func
def normal_law(law: Law, pressure: wp.float64, gap: wp.float64) -> wp.vec2d:
    """Linearised law at a pressure and a gap: what p should be [Pa], and -dp/dg [Pa/m]."""
    if gap < wp.float64(0.0) or pressure > wp.float64(0.0):
        return wp.vec2d(-law.stiffness * gap, law.stiffness)
    return wp.vec2d(wp.float64(0.0), wp.float64(0.0))


@wp.func
def friction_law(
    law: Law,
    pressure: wp.float64,
    traction: wp.vec3d,
    normal: wp.vec3d,
    curvature: wp.mat33d,
    arm: wp.vec3d,
) -> Friction:
    """Linearised friction of a touching point whose way from its anchor is ``arm``."""
    answer = Friction()
    k = law.tangential_stiffness
    along = wp.dot(normal, arm)
    way = arm - along * normal
    # d way / d x, from way = P(n) arm and d n / d x = curvature
    turn = (
        wp.identity(n=3, dtype=wp.float64)
        - wp.outer(normal, normal)
        - along * curvature
        - wp.outer(normal, curvature * arm)
    )
    now = traction - wp.dot(normal, traction) * normal
    trial = now + law.complement * (way - now / k)
    size = wp.length(trial)
    limit = law.friction * pressure
    if size <= limit:
        answer.status = 1
        answer.wanted = k * way
        answer.by_position = k * turn
        return answer
    answer.status = 2
    t = trial / size
    share = limit / size
    across = now - wp.dot(t, now) * t
    left = wp.float64(1.0) - share * (wp.float64(1.0) - law.complement / k)
    answer.wanted = limit * t + across - across / left
    answer.by_position = (share * law.complement / left) * (
        turn - wp.outer(t, wp.transpose(turn) * t)
    )
    answer.by_pressure = law.friction * t
    return answer
