"""Trajectories that tell the parameters apart: light ones and one into the pinch."""

from __future__ import annotations

import math
from typing import NamedTuple

from palpate_fem.calibration.recover import Planned
from palpate_fem.indenter.approach import OuterSurface
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.trajectory import angled_direction, pad_point, press_path


class _Press(NamedTuple):
    indenter: str
    x_m: float
    depth_m: float
    angle_deg: float
    azimuth_deg: float


# Below some 6 N thickness and modulus act alike; a pinch on the core to 10 N and more tells them
# apart. Friction shows where an indenter moves sideways.
PRESSES = {
    "pinch": _Press("cylinder_long", -4e-3, 4.2e-3, 0.0, 0.0),
    "normal": _Press("sphere_medium", -4e-3, 3.0e-3, 0.0, 0.0),
    "distal": _Press("sphere_medium", -4e-3, 2.5e-3, 30.0, 0.0),
    "lateral": _Press("sphere_large", -6e-3, 2.5e-3, 30.0, 90.0),
    "proximal": _Press("cube", -4e-3, 2.0e-3, 30.0, 180.0),
}

CLEARANCE_M = 1e-3
"""Paths begin so far from the skin [m]: the calibration tries thicker ones, too."""


def plan_recovery(tip: Fingertip, *, steps: int = 20) -> list[Planned]:
    """Poses for the presses, from first contact with this finger's pad on."""
    surface = OuterSurface(tip.nodes, tip.geometry.mesh.outer_faces)
    planned = []
    for name, press in PRESSES.items():
        target, normal = pad_point(surface, press.x_m, 0.0)
        direction = angled_direction(
            normal, math.radians(press.angle_deg), math.radians(press.azimuth_deg)
        )
        indenter = make_indenter(press.indenter)
        path = press_path(
            indenter,
            target,
            direction,
            surface,
            depth_m=press.depth_m,
            steps=steps,
            clearance_m=CLEARANCE_M,
        )
        planned.append(Planned(name, press.indenter, path))
    return planned
