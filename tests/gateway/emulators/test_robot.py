"""The emulated robot: its clock."""

from __future__ import annotations

import threading
import time

import numpy as np

from palpate.bus.topics import ROBOT_POSE
from palpate.messages import Pose
from palpate_gateway.emulators.robot import RobotEmulator

PATIENCE_S = 20.0
STALL_S = 0.7
"""Longer than what the loop catches up [s]."""


class StallingRobot(RobotEmulator):
    """Notes its own time [s] and that of each message [ns]; its process stalls once."""

    def __init__(self) -> None:
        self.noted: list[tuple[float, int]] = []
        self.enough = threading.Event()
        self._at_s = 0.0
        super().__init__(self._tip_at, rate_hz=100.0)

    def _tip_at(self, t: float) -> Pose:
        self._at_s = t
        return Pose((0.0, 0.0, -0.01), (1.0, 0.0, 0.0, 0.0))

    def _tell(self, payload: bytes) -> None:
        if payload:
            self.noted.append((self._at_s, ROBOT_POSE.codec.decode(payload).time_ns))
            if len(self.noted) == 5:
                time.sleep(STALL_S)
            if len(self.noted) == 20:
                self.enough.set()
        super()._tell(payload)


def test_the_robots_clock_goes_on_while_its_process_gets_no_time() -> None:
    with StallingRobot() as robot:
        assert robot.enough.wait(PATIENCE_S)
    own_s, message_ns = np.array(robot.noted).T
    assert np.diff(own_s).max() > STALL_S / 2
    np.testing.assert_allclose(np.diff(message_ns) * 1e-9, np.diff(own_s), atol=1e-6)
