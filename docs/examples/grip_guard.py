"""Open the gripper when it presses too hard, and also when nobody knows how hard it presses.

The guard asks for the newest force in each cycle of a control loop. A reading older than
``MAX_AGE_S`` is an error here, never a number: a finger that was unplugged must not look relaxed.

With a station without hardware:

    palpate up --profile virtual            # in one terminal
    python docs/examples/grip_guard.py      # in another: ten seconds, or so many as are given
"""

from __future__ import annotations

import sys
import time

import numpy as np

from palpate import Client
from palpate.errors import PalpateError, StaleError

PERIOD_S = 0.01
MAX_AGE_S = 0.05
MAX_FORCE_N = 5.0


class Gripper:
    """Yours: here it only says what it would do."""

    def __init__(self) -> None:
        self.is_open = False

    def open(self, why: str) -> None:
        """Let go."""
        if not self.is_open:
            print(f"opens: {why}")
        self.is_open = True

    def hold(self) -> None:
        """Keep the grip."""
        if self.is_open:
            print("holds again")
        self.is_open = False


def guard(robot: Client, gripper: Gripper, *, max_age_s: float = MAX_AGE_S) -> None:
    """One cycle."""
    try:
        estimate = robot.features("finger", max_age_s=max_age_s)
    except StaleError as error:
        gripper.open(error.problem)
        return
    # The estimate is uncertain, too: two standard deviations are added before it is trusted.
    force_n = float(np.linalg.norm(estimate.force) + 2.0 * np.linalg.norm(estimate.force_sd))
    if force_n > MAX_FORCE_N:
        gripper.open(f"{force_n:.1f} N may act")
    else:
        gripper.hold()


def main(seconds: float) -> None:
    """The control loop."""
    gripper = Gripper()
    try:
        with Client() as robot:
            end_s = time.monotonic() + seconds
            while time.monotonic() < end_s:
                guard(robot, gripper)
                time.sleep(PERIOD_S)
    except PalpateError as error:
        gripper.open("the client failed")
        sys.exit(str(error))
    print(f"done, {'open' if gripper.is_open else 'holding'}")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)
