"""The transformation from poses of a robot's flange to poses of the indenter's tip.

::

    carries = "indenter"   pose_sensor_indenter = base_sensor^-1  *  base_flange  *  flange_indenter
    carries = "biotac"     pose_sensor_indenter = (base_flange * flange_sensor)^-1  *  base_indenter

The robot publishes ``base_flange``; the other poses are constant and are options. The indenter's
frame has its origin in the tip, and indents along its +z.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, model_validator

from palpate.config import StrictConfig
from palpate.messages import Pose
from palpate.rigid import compose, inverse, is_rotation, normalised, quaternion_length
from palpate_gateway.readings import ClockObservation, PoseReading

REACH_M = 100.0
"""No robot reaches further from its base [m]: a larger coordinate is damage, or is in mm."""

_NEEDED = {
    "indenter": ("base_sensor", "flange_indenter"),
    "biotac": ("flange_sensor", "base_indenter"),
}


def within_reach(position: Sequence[float]) -> bool:
    """Whether a robot can be there; position [m], shape ``(3,)``."""
    return all(abs(part) <= REACH_M for part in position)


class PoseOptions(StrictConfig):
    """A constant pose; its key names the two frames.

    Attributes:
        position_m: Origin of the second frame in the first [m].
        orientation_wxyz: Unit quaternion of the second frame in the first.
    """

    position_m: tuple[float, float, float]
    orientation_wxyz: tuple[float, float, float, float]

    @model_validator(mode="after")
    def _is_pose(self) -> PoseOptions:
        if not all(map(math.isfinite, self.position_m)):
            raise ValueError(f"position_m {self.position_m} is not finite")
        if not within_reach(self.position_m):
            raise ValueError(
                f"position_m {self.position_m} is out of any robot's reach: give metres, not mm"
            )
        if not is_rotation(self.orientation_wxyz):
            raise ValueError(
                f"orientation_wxyz {self.orientation_wxyz} has length "
                f"{quaternion_length(self.orientation_wxyz):.4g}, not 1: "
                "give a unit quaternion w x y z"
            )
        return self

    @property
    def pose(self) -> Pose:
        """The pose as a value."""
        return normalised(Pose(self.position_m, self.orientation_wxyz))


def _check_indenter(name: str) -> str:
    if not (0 < len(name) <= 64 and name.isascii() and name.isprintable()):
        raise ValueError("an indenter's name is 1-64 printable ASCII characters")
    return name


class PlacementOptions(StrictConfig):
    """Options of every driver of robot poses.

    Attributes:
        indenter: Standard name, e.g. ``"sphere_7mm"``.
        carries: What is fixed to the flange; the other one does not move.
        base_sensor: BioTac's sensor frame in the robot's base, if the robot carries the indenter.
        flange_indenter: Indenter, origin at its tip, in the flange, in the same case.
        flange_sensor: BioTac's sensor frame in the flange, if the robot carries the BioTac.
        base_indenter: Indenter in the robot's base, in the same case.
    """

    indenter: Annotated[str, AfterValidator(_check_indenter)]
    carries: Literal["indenter", "biotac"] = "indenter"
    base_sensor: PoseOptions | None = None
    flange_indenter: PoseOptions | None = None
    flange_sensor: PoseOptions | None = None
    base_indenter: PoseOptions | None = None

    @model_validator(mode="after")
    def _is_complete(self) -> PlacementOptions:
        needed = _NEEDED[self.carries]
        both = f"where the robot carries the {self.carries}, give {needed[0]} and {needed[1]}"
        for name in sorted({name for pair in _NEEDED.values() for name in pair}):
            given = getattr(self, name) is not None
            if given is not (name in needed):
                raise ValueError(f"{name} is {'not used' if given else 'missing'}: {both}")
        return self


class Placement:
    """The transformation that `PlacementOptions` describe."""

    def __init__(self, options: PlacementOptions) -> None:
        first, second = (getattr(options, name).pose for name in _NEEDED[options.carries])
        self._indenter = options.indenter
        self._before = inverse(first)
        self._after = second
        self._robot_moves_sensor = options.carries == "biotac"

    def tip(self, base_flange: Pose) -> Pose:
        """Pose of the indenter in the sensor frame.

        Args:
            base_flange: Pose of the flange in the robot's base; finite, with a unit quaternion up
                to rounding.
        """
        moving = normalised(base_flange)
        if self._robot_moves_sensor:
            moving = inverse(moving)
        return normalised(compose(compose(self._before, moving), self._after))

    def reading(
        self,
        base_flange: Pose,
        *,
        tick: int,
        time_s: float,
        missed_before: int = 0,
        observed: ClockObservation | None = None,
    ) -> PoseReading:
        """A reading of the tip; contact is not known."""
        tip = self.tip(base_flange)
        return PoseReading(
            tick=tick,
            time_s=time_s,
            indenter=self._indenter,
            position=np.array(tip.position),
            orientation=np.array(tip.orientation),
            in_contact=None,
            missed_before=missed_before,
            observed=observed,
        )
