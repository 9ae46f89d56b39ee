"""What the virtual indenter does: episodes of approach, press, shear, hold, release.

Each episode is a pure function of (seed, number), and its depth and shear are pure functions of
time, so the finger can be computed in blocks of any size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate_gateway.virtual.geometry import Array, SkinPoint, skin_point

CLEARANCE_M = 3.0e-3
"""Distance of the waiting indenter from the skin [m]."""

# The region over the electrodes: ventral side and tip, where the real sensor feels.
_ARC_M = (-13.0e-3, 6.5e-3)
_ANGLE_RAD = (-0.95, 0.95)
_DEPTH_M = (0.5e-3, 3.0e-3)
_SHEAR_M = (0.2e-3, 1.2e-3)
_SHEARED_SHARE = 0.75
"""Share of the episodes that shear."""


@dataclass(frozen=True, slots=True)
class Episode:
    """One touch, or a pause.

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


def pause(duration_s: float) -> Episode:
    """Nothing touches the finger."""
    place = skin_point(0.0, 0.0)
    return Episode(place, place.along, -CLEARANCE_M, 0.0, (0.0,) * 5, duration_s)


def touch(seed: int, number: int) -> Episode:
    """Episode ``number`` of the finger with this seed."""
    random = np.random.default_rng([seed, 1, number])
    place = skin_point(random.uniform(*_ARC_M), random.uniform(*_ANGLE_RAD))
    towards = random.uniform(-np.pi, np.pi)
    sheared = random.uniform() < _SHEARED_SHARE
    spans = random.uniform((0.20, 0.4, 0.3, 0.1, 0.3), (0.30, 1.0, 0.7, 0.4, 0.6))
    ends = np.cumsum(spans).tolist()
    return Episode(
        place=place,
        direction=np.cos(towards) * place.along + np.sin(towards) * place.across,
        depth_m=random.uniform(*_DEPTH_M),
        shear_m=random.uniform(*_SHEAR_M) if sheared else 0.0,
        times_s=(ends[0], ends[1], ends[2], ends[3], ends[4]),
        duration_s=ends[4] + random.uniform(0.15, 0.4),
    )


def ease(time_s: Array, start_s: float, end_s: float) -> Array:
    """Smooth step from 0 at ``start_s`` to 1 at ``end_s``: no jump of the velocity."""
    share = np.clip((time_s - start_s) / max(end_s - start_s, 1e-9), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)
