"""Tell palpate where the flange of a robot is, 250 times a second, from the control loop.

Needs a station; here the robot is a formula that goes up and down:

    palpate up --profile virtual            # in one terminal
    python docs/examples/robot_pose.py      # in another: ten seconds, or so many as are given
    palpate gateway probe pose_zenoh robot=arm indenter=sphere_7mm \
        'base_sensor.position_m=[0.4, 0, 0.1]' 'base_sensor.orientation_wxyz=[0, 1, 0, 0]' \
        'flange_indenter.position_m=[0, 0, 0.12]' 'flange_indenter.orientation_wxyz=[1, 0, 0, 0]'
"""

from __future__ import annotations

import math
import sys
import time

from palpate import Client
from palpate.errors import PalpateError

PERIOD_S = 0.004


def flange(time_s: float) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    """Position [m] and quaternion w x y z in the robot's base: ask your robot instead."""
    depth_m = 0.002 * math.sin(2.0 * math.pi * 0.5 * time_s)
    return (0.4, 0.0, 0.23 - depth_m), (0.0, 1.0, 0.0, 0.0)


def main(seconds: float) -> None:
    """The control loop: it never waits for palpate."""
    try:
        with Client() as client:
            poses = client.robot_pose_publisher("arm")
            began_s = now_s = time.monotonic()
            while now_s - began_s < seconds:
                position, orientation_wxyz = flange(now_s - began_s)
                # Better than the time of this call is the one at which the controller measured it.
                poses.put(position, orientation_wxyz, time_ns=round(now_s * 1e9))
                now_s += PERIOD_S
                time.sleep(max(now_s - time.monotonic(), 0.0))
            poses.close()
            told = poses.counters
    except PalpateError as error:  # says what was wrong and what to do about it
        sys.exit(str(error))
    sys.stdout.write(f"{told['published']} poses told, {told['dropped']} dropped\n")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)
