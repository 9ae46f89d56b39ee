"""How far the robot's tip is off, for each unit and arm of an experiment.

Sideways it is what the registration procedure leaves, drawn by its own error model. Along the
dorsal axis it is what each unit was fitted to: published forces tell how deep they were pressed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate_fem.population.member import Member
from palpate_training.experiment.clearance import pad_poses, simulate_registrations
from palpate_training.experiment.kinematics import Arm
from palpate_training.experiment.plan import ARMS
from palpate_training.experiment.stand_in_arm import FLANGE, sensor_robot, tool, write_arm_urdf

Floats = NDArray[np.float64]


def registration_errors(members: Sequence[Member], seed: int) -> dict[str, Floats]:
    """Tip by kinematics and registration minus true tip [m], for each arm (U, 3), sensor frame.

    Args:
        members: The units, each of which was mounted and registered anew.
        seed: Of the draws.
    """
    errors = {}
    for number, side in enumerate(ARMS):
        poses = pad_poses(1.0 if side == "left" else -1.0)
        found = simulate_registrations(
            stand_in_arm(side), sensor_robot(side), poses, draws=len(members), seed=seed + number
        )
        drawn = found.constant.copy()
        drawn[:, 2] = [-member.overtravel_m for member in members]
        errors[side] = drawn
    return errors


def stand_in_arm(side: str) -> Arm:
    """The open stand-in arm of a side, with its tool."""
    with tempfile.TemporaryDirectory() as folder:
        urdf = write_arm_urdf(side, Path(folder) / f"{side}.urdf")
        return Arm.from_urdf(urdf, FLANGE, tool())
