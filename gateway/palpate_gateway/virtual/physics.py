"""A simple physical stand-in for a BioTac: indentation to force, pressure and electrode counts.

It is honest about what it is: closed formulas with the right signs, orders of magnitude and
couplings, so that every room can be built and tested without hardware. It is no model of skin
mechanics; the finite-element twin replaces it. Choices, and what they were tuned to:

* normal force: Hertz on a compliant fluid-backed skin, stiffened as skin nears core; 1.2 N at
  1 mm and 15 N at 3 mm for the 14 mm sphere (published forces reach 23-32 N);
* friction: grows with tangential travel and saturates at Coulomb's limit;
* film over an electrode: rest gap minus a Gaussian footprint, plus the bulge of the displaced
  fluid, plus the skin that friction drags along over the whole pad (or shear could not be told from
  a footprint that lies elsewhere), closing on a residual film that pressure squeezes out;
* electrode: ``counts = 4095 R_L / (R_L + Z)`` with ``Z / R_L = (a + b / film) / conductivity``.
  b = 0.07 mm meets the published fall by closing gaps: film 0.3 mm -0.07, 0.1 mm -0.22 of full
  scale; lateral electrodes rise by up to +0.05 (learning reference 4.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate.messages import COUNTS_MAX
from palpate_gateway.virtual.geometry import (
    INNER_RADIUS_M,
    OUTER_RADIUS_M,
    REST_GAPS_M,
    SKIN_NORMALS,
    SKIN_POINTS_M,
    Array,
)
from palpate_gateway.virtual.trajectory import Episode

INDENTER_RADII_M = {"sphere_3-5mm": 1.75e-3, "sphere_7mm": 3.5e-3, "sphere_14mm": 7.0e-3}
"""Spheres of the published indenter set, named by diameter [m]."""

_MODULUS_PA = 0.30e6
_STIFFENING_M = 1.5e-3
_FRICTION = 0.6
_STICK_M = 0.6e-3
"""Tangential travel at which friction nears its limit [m]."""
_SKIN_M = OUTER_RADIUS_M - INNER_RADIUS_M
_SPREAD_M = 2.5e-3
"""The skin spreads even a point load over this radius [m]."""
_BULGE_AREA_M2 = 700e-6
"""Skin that takes the displaced fluid [m^2]; the outer area is 1242 mm^2, half of it clamped."""
_DRAG_M = 0.5e-3
"""Most that friction displaces the skin tangentially [m]."""
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


@dataclass(frozen=True, slots=True)
class Unit:
    """What differs between two virtual fingers: electrics, not mechanics.

    Attributes:
        spreading: Resistance of a thick film over the load resistor, shape ``(19,)``.
        conductivity: Of the fluid, relative to nominal.
        pdc_rest: PDC at rest [counts].
    """

    spreading: Array
    conductivity: float
    pdc_rest: float

    @staticmethod
    def number(unit: int) -> Unit:
        """The finger with this number; 3 % between electrodes, 10 % between fingers."""
        random = np.random.default_rng([unit, 3])
        return Unit(
            spreading=_SPREADING * np.exp(random.normal(0.0, 0.03, len(REST_GAPS_M))),
            conductivity=float(np.exp(random.normal(0.0, 0.10))),
            pdc_rest=float(random.uniform(1800.0, 2400.0)),
        )


@dataclass(frozen=True, slots=True)
class Contact:
    """State of one episode at N times.

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


def contact(episode: Episode, time_s: Array, indenter_radius_m: float) -> Contact:
    """Force, pressure and place of the indenter at times from the episode's start [s]."""
    travel = episode.depth(time_s)
    shear = episode.shear(time_s)
    depth = np.maximum(travel, 0.0)
    normal = episode.place.normal
    relative = _relative_radius(indenter_radius_m)
    normal_force = (
        (4.0 / 3.0)
        * _MODULUS_PA
        * np.sqrt(relative)
        * depth**1.5
        * (1.0 + (depth / _STIFFENING_M) ** 1.5)
    )
    traction = _FRICTION * np.tanh(shear / _STICK_M)
    # The reaction pushes the finger along the inward normal and drags it along with the indenter.
    force = -normal_force[:, None] * normal + (normal_force * traction)[:, None] * episode.direction
    tip = episode.place.position - travel[:, None] * normal + shear[:, None] * episode.direction
    pressure = _PRESSURE_SCALE_PA * (1.0 - np.exp(-normal_force / _PRESSURE_FORCE_N))
    return Contact(depth, tip, normal_force, traction, force, pressure)


def films(episode: Episode, state: Contact, indenter_radius_m: float) -> Array:
    """Fluid film over each electrode [m], shape ``(N, 19)``."""
    normal = episode.place.normal
    depth = state.depth[:, None]
    relative = _relative_radius(indenter_radius_m)
    width2 = _SPREAD_M**2 + 0.5 * relative * depth
    # The footprint on the inner skin travels with the tip, one skin thickness further in.
    footprint = state.tip - (_SKIN_M - state.depth)[:, None] * normal
    offset = SKIN_POINTS_M - footprint[:, None, :]
    distance2 = np.einsum("nij,nij->ni", offset, offset)
    share = np.exp(-distance2 / (2.0 * width2))
    facing = np.maximum(SKIN_NORMALS @ normal, 0.0)
    bulge = 2.0 * np.pi * width2 * depth / _BULGE_AREA_M2
    # Friction drags the skin along, far beyond the footprint: off the core where it faces that way,
    # onto it on the far side, and under it fluid is pushed from ahead to behind.
    friction = state.normal_force * state.traction
    drag = _DRAG_M * np.tanh(friction / _DRAG_FORCE_N)[:, None]
    reach = np.exp(-distance2 / (2.0 * _DRAG_REACH_M**2))
    ahead = (offset @ episode.direction) / _DRAG_REACH_M
    dragged = drag * reach * (SKIN_NORMALS @ episode.direction - ahead * facing)
    gap = REST_GAPS_M + bulge * (1.0 - share) - depth * share * facing + dragged

    patch = np.pi * (relative * depth + 4e-6)
    load = state.normal_force[:, None] * share / patch
    residual = _FILM_FLOOR_M + _ASPERITY_M / (1.0 + load / _FILM_PRESSURE_PA)
    closed: Array = residual + _SOFTNESS_M * np.logaddexp(0.0, (gap - residual) / _SOFTNESS_M)
    return closed


def electrode_counts(film: Array, unit: Unit, drift: Array) -> Array:
    """Noise-free counts, shape ``(N, 19)``.

    Args:
        film: Film over each electrode [m], shape ``(N, 19)``.
        unit: The finger's electrics.
        drift: Relative conductivity of the warming fluid, shape ``(N,)``.
    """
    impedance = (unit.spreading + _FILM_M / film) / (unit.conductivity * drift[:, None])
    counts: Array = COUNTS_MAX / (1.0 + impedance)
    return counts


def _relative_radius(indenter_radius_m: float) -> float:
    """Hertz's relative radius of sphere and finger [m]."""
    return 1.0 / (1.0 / indenter_radius_m + 1.0 / OUTER_RADIUS_M)
