"""Physics of the formula: a closed-form stand-in for a BioTac, from indentation to counts.

The formulas have the right signs, orders of magnitude and couplings, so that every room can be
built and tested without hardware. They are no model of skin mechanics: the digital twin
(``virtual.tape``) has the finite-element results. Choices, and the data that they were tuned to:

* shape: the skin's inner and outer surface are capsules, the simplest shape that meets the measured
  profile of the inflated skin within 0.2 mm on the ventral side and the flanks (learning reference
  5.1: ventral outer -8.31, inner -6.69, lateral 7.11 and 5.54, tip +6.65 mm), and within about
  0.8 mm at the tip's facet;
* normal force: Hertz contact on a compliant fluid-backed skin, which stiffens as the skin comes
  near the core; 1.2 N at 1 mm and 15 N at 3 mm for the 14 mm sphere (published forces reach
  23-32 N);
* friction: grows with tangential travel and saturates at Coulomb's limit;
* film over an electrode: rest gap minus a Gaussian footprint, plus the bulge of the displaced
  fluid, plus the skin that friction drags along over the whole pad (without it shear could not be
  told from a footprint at another place); it closes on a residual film that pressure squeezes out;
* electrode: ``counts = 4095 R_L / (R_L + Z)`` with ``Z / R_L = (a + b / film) / conductivity``.
  b = 0.07 mm meets the published fall as gaps close: film 0.3 mm -0.07, 0.1 mm -0.22 of full
  scale; lateral electrodes rise by up to +0.05 (learning reference 4.4).

Sensor frame: x to the fingertip, z dorsal, so the ventral side faces -z.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate.messages import COUNTS_MAX
from palpate_gateway.virtual.model import CLEARANCE_M, Array, ease

OUTER_RADIUS_M = 7.0e-3
INNER_RADIUS_M = 5.4e-3
AXIS_Z_M = -1.31e-3
"""The skin's axis lies this far ventral of the core's [m]."""
TIP_X_M = -0.35e-3
"""Centre of the spherical tip [m]."""

INDENTER_RADII_M = {"sphere_3-5mm": 1.75e-3, "sphere_7mm": 3.5e-3, "sphere_14mm": 7.0e-3}
"""Spheres of the published indenter set, named by diameter [m]."""

_MODULUS_PA = 0.30e6
_STIFFENING_M = 1.5e-3
_FRICTION = 0.6
_STICK_M = 0.6e-3
"""Tangential travel at which friction nears its limit [m]."""
_SKIN_M = OUTER_RADIUS_M - INNER_RADIUS_M
_SPREAD_M = 2.5e-3
"""Radius over which the skin spreads even a point load [m]."""
_BULGE_AREA_M2 = 700e-6
"""Skin that takes the displaced fluid [m^2]; the outer area is 1242 mm^2, half of it clamped."""
_DRAG_M = 0.5e-3
"""Largest tangential displacement of the skin by friction [m]."""
_DRAG_FORCE_N = 4.0
_DRAG_REACH_M = 8.0e-3
_ASPERITY_M = 80e-6
_FILM_FLOOR_M = 5e-6
_FILM_PRESSURE_PA = 30e3
_SOFTNESS_M = 50e-6
_SPREADING = 0.30
_FILM_M = 70e-6
_PRESSURE_SCALE_PA = 25e3
_PRESSURE_FORCE_N = 2.0
"""PDC saturates at about 2 N (hardware reference 1.9)."""

# The region over the electrodes, ventral side and tip, where the real sensor is sensitive.
_ARC_M = (-13.0e-3, 6.5e-3)
_ANGLE_RAD = (-0.95, 0.95)
_DEPTH_M = (0.5e-3, 3.0e-3)
_SHEAR_M = (0.2e-3, 1.2e-3)
_SHEARED_SHARE = 0.75
"""Share of the indentations that shear."""

_NEAREST_ON_AXIS = np.stack(
    [
        np.minimum(ELECTRODE_POSITIONS[:, 0], TIP_X_M),
        np.zeros(len(ELECTRODE_POSITIONS)),
        np.full(len(ELECTRODE_POSITIONS), AXIS_Z_M),
    ],
    axis=1,
)
_FROM_AXIS = ELECTRODE_POSITIONS - _NEAREST_ON_AXIS
_DISTANCE = np.linalg.norm(_FROM_AXIS, axis=1)

SKIN_NORMALS: Array = _FROM_AXIS / _DISTANCE[:, None]
"""Outward unit normal of the skin over each electrode, shape ``(19, 3)``."""

SKIN_POINTS_M: Array = _NEAREST_ON_AXIS + SKIN_NORMALS * INNER_RADIUS_M
"""Point of the inner skin over each electrode [m], shape ``(19, 3)``."""

REST_GAPS_M: Array = np.maximum(INNER_RADIUS_M - _DISTANCE, 0.15e-3)
"""Fluid film over each untouched electrode [m], shape ``(19,)``."""


@dataclass(frozen=True, slots=True)
class SkinPoint:
    """A point of the outer skin.

    Attributes:
        position: Position [m], shape ``(3,)``.
        normal: Outward unit normal, shape ``(3,)``.
        along: Unit tangent towards the tip, shape ``(3,)``.
        across: Unit tangent across the finger, shape ``(3,)``.
    """

    position: Array
    normal: Array
    along: Array
    across: Array


def skin_point(arc_m: float, angle_rad: float) -> SkinPoint:
    """A point of the outer skin by its coordinates along and around the finger.

    Args:
        arc_m: Along the ventral meridian from the tip's centre [m]; negative towards the hand,
            positive around the tip.
        angle_rad: Around the axis from ventral towards +y [rad].
    """
    bend = max(arc_m, 0.0) / OUTER_RADIUS_M
    radial = np.array([0.0, np.sin(angle_rad), -np.cos(angle_rad)])
    forward = np.array([1.0, 0.0, 0.0])
    normal = np.cos(bend) * radial + np.sin(bend) * forward
    along = np.cos(bend) * forward - np.sin(bend) * radial
    centre = np.array([TIP_X_M + min(arc_m, 0.0), 0.0, AXIS_Z_M])
    return SkinPoint(centre + normal * OUTER_RADIUS_M, normal, along, np.cross(normal, along))


@dataclass(frozen=True, slots=True)
class Touch:
    """One indentation with shear, or a pause; a function of time only, so blocks can have any size.

    Attributes:
        place: Where the indenter meets the skin.
        direction: Unit tangent in which it shears, shape ``(3,)``.
        depth_m: Greatest indentation depth [m]; negative = a pause at that distance.
        shear_m: Greatest tangential travel [m].
        times_s: Ends of approach, press, shear, hold and release [s] from its start; then idle.
        duration_s: Length [s].
    """

    place: SkinPoint
    direction: Array
    depth_m: float
    shear_m: float
    times_s: tuple[float, float, float, float, float]
    duration_s: float

    def depth(self, time_s: Array) -> Array:
        """Indentation depth [m] at times from the start [s]; negative = distance from the skin."""
        if self.depth_m < 0.0:
            return np.full_like(time_s, self.depth_m)
        approach, press, _, hold, release = self.times_s
        down = ease(time_s, 0.0, approach) - 1.0
        up = ease(time_s, release, self.duration_s)
        pressed = ease(time_s, approach, press) - ease(time_s, hold, release)
        return CLEARANCE_M * (down - up) + self.depth_m * pressed

    def shear(self, time_s: Array) -> Array:
        """Tangential travel along ``direction`` [m] at times from the start [s]."""
        _, press, shear, hold, release = self.times_s
        return self.shear_m * (ease(time_s, press, shear) - ease(time_s, hold, release))


def pause(duration_s: float) -> Touch:
    """A time in which nothing touches the finger."""
    place = skin_point(0.0, 0.0)
    return Touch(place, place.along, -CLEARANCE_M, 0.0, (0.0,) * 5, duration_s)


def random_touch(seed: int, number: int) -> Touch:
    """Indentation ``number`` of the finger with this seed."""
    random = np.random.default_rng([seed, 1, number])
    place = skin_point(random.uniform(*_ARC_M), random.uniform(*_ANGLE_RAD))
    towards = random.uniform(-np.pi, np.pi)
    sheared = random.uniform() < _SHEARED_SHARE
    spans = random.uniform((0.20, 0.4, 0.3, 0.1, 0.3), (0.30, 1.0, 0.7, 0.4, 0.6))
    ends = np.cumsum(spans).tolist()
    return Touch(
        place=place,
        direction=np.cos(towards) * place.along + np.sin(towards) * place.across,
        depth_m=random.uniform(*_DEPTH_M),
        shear_m=random.uniform(*_SHEAR_M) if sheared else 0.0,
        times_s=(ends[0], ends[1], ends[2], ends[3], ends[4]),
        duration_s=ends[4] + random.uniform(0.15, 0.4),
    )


@dataclass(frozen=True, slots=True)
class FormulaSpecimen:
    """One specimen of the formula: specimens differ in their electrics, not in their mechanics.

    Attributes:
        spreading: Resistance of a thick film over the load resistor, shape ``(19,)``.
        conductivity: Of the fluid, relative to nominal.
        pdc_rest: PDC at rest [counts].
    """

    spreading: Array
    conductivity: float
    pdc_rest: float

    @staticmethod
    def number(number: int) -> FormulaSpecimen:
        """The specimen with this number; 3 % between electrodes, 10 % between specimens."""
        random = np.random.default_rng([number, 3])
        return FormulaSpecimen(
            spreading=_SPREADING * np.exp(random.normal(0.0, 0.03, len(REST_GAPS_M))),
            conductivity=float(np.exp(random.normal(0.0, 0.10))),
            pdc_rest=float(random.uniform(1800.0, 2400.0)),
        )


class FormulaContact(NamedTuple):
    """State of one indentation at N times.

    Attributes:
        depth: Indentation depth [m], 0 without contact, shape ``(N,)``.
        tip: Tip of the indenter [m], shape ``(N, 3)``.
        normal_force: Magnitude along the inward normal [N], shape ``(N,)``.
        traction: Friction over normal force, signed along the shear direction, shape ``(N,)``.
        force: Force on the finger [N], shape ``(N, 3)``.
        pressure: Rise of the fluid pressure [Pa], shape ``(N,)``.
    """

    depth: Array
    tip: Array
    normal_force: Array
    traction: Array
    force: Array
    pressure: Array


def contact(touch: Touch, time_s: Array, indenter_radius_m: float) -> FormulaContact:
    """Force, pressure and place of the indenter at times from the start of the indentation [s]."""
    travel = touch.depth(time_s)
    shear = touch.shear(time_s)
    depth = np.maximum(travel, 0.0)
    normal = touch.place.normal
    relative = _relative_radius(indenter_radius_m)
    # Hertz, 4/3 E sqrt(R) d^1.5; the last factor stiffens the skin as it comes near the core.
    normal_force = (
        (4.0 / 3.0)
        * _MODULUS_PA
        * np.sqrt(relative)
        * depth**1.5
        * (1.0 + (depth / _STIFFENING_M) ** 1.5)
    )
    traction = _FRICTION * np.tanh(shear / _STICK_M)
    # The indenter pushes the finger along the inward normal and drags it in the shear direction.
    force = -normal_force[:, None] * normal + (normal_force * traction)[:, None] * touch.direction
    tip = touch.place.position - travel[:, None] * normal + shear[:, None] * touch.direction
    pressure = _PRESSURE_SCALE_PA * (1.0 - np.exp(-normal_force / _PRESSURE_FORCE_N))
    return FormulaContact(depth, tip, normal_force, traction, force, pressure)


def films(touch: Touch, state: FormulaContact, indenter_radius_m: float) -> Array:
    """Fluid film over each electrode [m], shape ``(N, 19)``."""
    normal = touch.place.normal
    depth = state.depth[:, None]
    relative = _relative_radius(indenter_radius_m)
    width2 = _SPREAD_M**2 + 0.5 * relative * depth
    # The footprint on the inner skin moves with the tip, one skin thickness further in.
    footprint = state.tip - (_SKIN_M - state.depth)[:, None] * normal
    offset = SKIN_POINTS_M - footprint[:, None, :]
    distance2 = np.einsum("nij,nij->ni", offset, offset)
    share = np.exp(-distance2 / (2.0 * width2))
    facing = np.maximum(SKIN_NORMALS @ normal, 0.0)
    bulge = 2.0 * np.pi * width2 * depth / _BULGE_AREA_M2
    # Friction drags the skin along, far beyond the footprint: away from the core where the skin
    # faces the shear direction, towards the core on the opposite side. Below the indenter the
    # dragged skin pushes fluid from ahead to behind.
    friction = state.normal_force * state.traction
    drag = _DRAG_M * np.tanh(friction / _DRAG_FORCE_N)[:, None]
    reach = np.exp(-distance2 / (2.0 * _DRAG_REACH_M**2))
    ahead = (offset @ touch.direction) / _DRAG_REACH_M
    dragged = drag * reach * (SKIN_NORMALS @ touch.direction - ahead * facing)
    gap = REST_GAPS_M + bulge * (1.0 - share) - depth * share * facing + dragged

    # Pressure on the closed film: the normal force over the area of the footprint.
    patch = np.pi * (relative * depth + 4e-6)
    load = state.normal_force[:, None] * share / patch
    residual = _FILM_FLOOR_M + _ASPERITY_M / (1.0 + load / _FILM_PRESSURE_PA)
    # A smooth maximum of gap and residual film: counts must not have a kink at closure.
    closed: Array = residual + _SOFTNESS_M * np.logaddexp(0.0, (gap - residual) / _SOFTNESS_M)
    return closed


def electrode_counts(film: Array, specimen: FormulaSpecimen, drift: Array) -> Array:
    """Noise-free counts, shape ``(N, 19)``.

    Args:
        film: Film over each electrode [m], shape ``(N, 19)``.
        specimen: Electrics of the finger.
        drift: Relative conductivity of the warming fluid, shape ``(N,)``.
    """
    impedance = (specimen.spreading + _FILM_M / film) / (specimen.conductivity * drift[:, None])
    counts: Array = COUNTS_MAX / (1.0 + impedance)
    return counts


def _relative_radius(indenter_radius_m: float) -> float:
    """Hertz's relative radius of sphere and finger [m]."""
    return 1.0 / (1.0 / indenter_radius_m + 1.0 / OUTER_RADIUS_M)
