"""Press a sphere 2 mm into the simulated fingertip and print the force, step by step.

Needs a station with the finite-element service, no hardware:

    palpate up --profile virtual        # in one terminal
    palpate fem serve                   # in another; it is ready after some seconds
    python docs/examples/simulate.py
"""

from __future__ import annotations

import sys
import uuid

from palpate import Client
from palpate.client.simulations import straight_path
from palpate.errors import PalpateError
from palpate.messages import SimulationRequest, SimulationStep


def show(number: int, step: SimulationStep) -> None:
    """Print a step when it has converged."""
    x, y, z = step.force
    pressure_kpa = step.fluid_pressure_pa / 1e3
    sys.stdout.write(f"{number:3}  {x:7.3f} {y:7.3f} {z:7.3f} N  {pressure_kpa:6.2f} kPa\n")


def main() -> None:
    """Request 20 steps towards the nail, starting 1 mm below the pad."""
    path = straight_path((-0.004, 0.0, -0.011), (-0.004, 0.0, -0.007), 20)
    request = SimulationRequest(uuid.uuid4().hex, "sphere_7mm", path)
    try:
        with Client() as robot:
            reply = robot.simulate(request, timeout_s=120, on_step=show)
    except PalpateError as error:  # its text says what was wrong, and a remedy
        sys.exit(str(error))
    sys.stdout.write(f"{reply.outcome.name.lower()} {reply.stopped_because}\n")


if __name__ == "__main__":
    main()
