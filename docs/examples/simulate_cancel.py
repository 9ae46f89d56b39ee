"""Watch how far a simulation is, and stop it: what has converged by then is answered.

With a station without hardware:

    palpate up --profile virtual            # in one terminal
    palpate fem serve                       # in another; it is ready after some seconds
    python docs/examples/simulate_cancel.py
"""

from __future__ import annotations

import sys
import uuid

from palpate import Client
from palpate.client.simulations import straight_path
from palpate.errors import PalpateError
from palpate.messages import SimulationProgress, SimulationRequest, SimulationStep

ENOUGH_N = 1.0


def main() -> None:
    """Press until the force is enough; Ctrl-C stops the simulation, too."""
    path = straight_path((-0.004, 0.0, -0.011), (-0.004, 0.0, -0.007), 40)
    request = SimulationRequest(uuid.uuid4().hex, "sphere_7mm", path)

    def told(progress: SimulationProgress) -> None:
        print(
            f"{progress.phase.name.lower():14} {progress.steps_done:2} of "
            f"{progress.steps_total} steps, {progress.elapsed_s:5.1f} s"
        )

    def stop_if_enough(number: int, step: SimulationStep) -> None:
        # Any process may stop it by its id; this one uses a second client for that.
        if step.force[2] > ENOUGH_N:
            with Client() as other:
                other.cancel_simulation(request.request_id)

    try:
        with Client() as robot:
            reply = robot.simulate(request, timeout_s=120, on_progress=told, on_step=stop_if_enough)
    except PalpateError as error:
        sys.exit(str(error))
    print(f"{reply.outcome.name.lower()}: {len(reply.steps)} steps")


if __name__ == "__main__":
    main()
