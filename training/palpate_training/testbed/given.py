"""What a user gives on the command line for each arm: ``left=FILE``, and kinematics from URDFs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from palpate.errors import ConfigError
from palpate_training.testbed.kinematics import Arm
from palpate_training.testbed.plan import ARMS
from palpate_training.testbed.transform import Transform


def by_arm(words: Sequence[str], flag: str) -> dict[str, Path]:
    """Files by arm, from words such as ``left=FILE``.

    Args:
        words: As given.
        flag: For messages, e.g. ``--urdf``.

    Raises:
        ConfigError: A word is no such pair, names another arm, or an arm comes twice.
    """
    found: dict[str, Path] = {}
    for word in words:
        arm, given, file = word.partition("=")
        if arm not in ARMS or not given or not file:
            raise ConfigError(f"{flag} {word}", remedy=f"write {flag} left=FILE or right=FILE")
        if arm in found:
            raise ConfigError(f"{flag}: the {arm} arm comes twice", remedy="give each arm one file")
        found[arm] = Path(file)
    return found


def arms_of(urdf: Mapping[str, Path], tip_frame: str | None, tool_m: float) -> dict[str, Arm]:
    """Kinematics of arms with their tool.

    Args:
        urdf: A URDF by arm; may be empty.
        tip_frame: Link or joint that carries the tool.
        tool_m: From there to the tip along that frame's z [m].

    Raises:
        ConfigError: No frame is named, or a URDF cannot be used.
    """
    if urdf and tip_frame is None:
        raise ConfigError(
            "--urdf without --tip-frame", remedy="name the frame of the URDF that carries the tool"
        )
    tool = Transform(np.eye(3), np.array([0.0, 0.0, tool_m]))
    return {arm: Arm.from_urdf(path, tip_frame or "", tool) for arm, path in urdf.items()}
