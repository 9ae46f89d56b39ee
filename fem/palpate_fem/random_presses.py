"""Presses at random: any indenter at any point of the pad, tilted, turned, with or without a move.

The paper presses ten points of the pad along the normal and at one angle ("Experimental testing
procedure"). Networks that are to know other touches need others: here the point, the tilt, its
azimuth, the turn about the indenter's own axis and the depth are drawn, and some presses go on with
a slide or a twist.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from palpate.errors import ConfigError
from palpate_fem.arrays import Floats
from palpate_fem.indenter.approach import OuterSurface
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.indenter.path import PathSegment
from palpate_fem.trajectory import Region, angled_direction, sample_targets, segment_path

REGION = Region(x_from_m=-12e-3, x_to_m=3e-3, half_width_m=5e-3)
"""Where they aim: the pad to its sides and to the tip, more than the paper's points."""

TILT_MOST_RAD = math.radians(40.0)

DEPTH_LEAST_M = 1.0e-3
DEPTH_MOST_M = 3.8e-3
TILTED_DEPTH_MOST_M = 3.0e-3
"""Depth [m]: at most the one along the normal, and the other at the largest tilt."""

MOVED_SHARE = 0.15
"""Share of presses that slide when they have come to their depth, and share of those that twist."""

SLIDE_M = (0.5e-3, 2.0e-3)
TWIST_RAD = (math.radians(5.0), math.radians(30.0))


@dataclass(frozen=True)
class RandomPress:
    """One of them; a planned trajectory whose poses are made when they are asked for.

    Attributes:
        name: ``<indenter>/<number>/random``.
        indenter: Name of the indenter.
        target: Point of the skin that the tip goes through [m], shape (3,), sensor frame.
        normal: Outward unit normal there, shape (3,).
        segments: What it does.
        surface: The skin that is pressed.
    """

    name: str
    indenter: str
    target: Floats
    normal: Floats
    segments: tuple[PathSegment, ...]
    surface: OuterSurface

    @property
    def direction(self) -> Floats:
        """Where the tip moves at first, unit, shape (3,)."""
        first = self.segments[0]
        return angled_direction(self.normal, first.angle_rad, first.azimuth_rad)

    @cached_property
    def path(self) -> Floats:
        """Poses, the first clear of the skin, shape (K + 1, 7); takes some milliseconds.

        Raises:
            SimulationError: The indenter passes the skin.
        """
        indenter = make_indenter(self.indenter)
        return segment_path(indenter, self.target, self.normal, self.segments, self.surface)


def random_presses(
    surface: OuterSurface, count: int, *, seed: int, indenters: Sequence[str]
) -> Iterator[RandomPress]:
    """Draw presses, of all indenters in turn.

    Args:
        surface: Outer surface of the pressurised skin.
        count: How many; a larger count adds to a smaller one.
        seed: The same seed and surface give the same presses.
        indenters: Names, at least one.

    Raises:
        ConfigError: There is no indenter, or the surface has no pad.
    """
    if not indenters:
        raise ConfigError("no indenters", remedy="name at least one")
    targets, normals = sample_targets(surface, count, seed=seed, region=REGION)
    for number, (target, normal) in enumerate(zip(targets, normals, strict=True)):
        name = indenters[number % len(indenters)]
        segments = segments_of(seed, number)
        yield RandomPress(f"{name}/{number:05d}/random", name, target, normal, segments, surface)


def segments_of(seed: int, number: int) -> tuple[PathSegment, ...]:
    """What a press does, by the seed of the draw and its number in it."""
    return tuple(_segments(np.random.default_rng([seed, number])))


def _segments(random: np.random.Generator) -> Iterator[PathSegment]:
    tilt = float(random.uniform(0.0, TILT_MOST_RAD))
    share = tilt / TILT_MOST_RAD
    most_m = (1.0 - share) * DEPTH_MOST_M + share * TILTED_DEPTH_MOST_M
    # Forces rise steeply at the end, so deep presses are more likely: their density rises linearly.
    depth_m = DEPTH_LEAST_M + (most_m - DEPTH_LEAST_M) * math.sqrt(random.uniform())
    yield PathSegment("press", depth_m, tilt, _any_angle(random), _any_angle(random))
    move = random.uniform()
    if move < MOVED_SHARE:
        yield PathSegment("slide", float(random.uniform(*SLIDE_M)), azimuth_rad=_any_angle(random))
    elif move < 2.0 * MOVED_SHARE:
        angle = float(random.uniform(*TWIST_RAD)) * random.choice([-1.0, 1.0])
        yield PathSegment("twist", angle)


def _any_angle(random: np.random.Generator) -> float:
    return float(random.uniform(0.0, 2.0 * math.pi))
