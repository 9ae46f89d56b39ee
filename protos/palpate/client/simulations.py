"""Requests of simulations: straight paths, and the parts of the answer joined into one reply."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence

from palpate.bus import Session, endpoints
from palpate.errors import WireError
from palpate.messages import (
    Pose,
    SimulationProgress,
    SimulationReply,
    SimulationRequest,
    SimulationStep,
)

OnProgress = Callable[[SimulationProgress], None]
OnStep = Callable[[int, SimulationStep], None]
"""Called with the number of a step and the step."""

GRACE_S = 8.0
"""How long after its deadline an answer is still waited for [s]: a solver that does not stop by
itself is ended by the service 5 s after the deadline, and the service then answers."""

_UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def straight_path(
    start: Sequence[float],
    end: Sequence[float],
    steps: int,
    *,
    orientation: tuple[float, float, float, float] = _UPRIGHT,
) -> tuple[Pose, ...]:
    """Poses of an indenter that moves straight.

    Args:
        start: Where its tip is first [m], sensor frame; it must not touch the skin there.
        end: Where its tip is last [m].
        steps: Steps between the two; the path has one pose more than steps.
        orientation: Unit quaternion w x y z; the identity presses along +z, from the pad towards
            the nail.
    """
    if steps < 1:
        raise ValueError(f"{steps} steps lead nowhere")
    (x, y, z), (dx, dy, dz) = start, (b - a for a, b in zip(start, end, strict=True))
    return tuple(
        Pose((x + dx * k / steps, y + dy * k / steps, z + dz * k / steps), orientation)
        for k in range(steps + 1)
    )


def ask_simulation(
    session: Session,
    request: SimulationRequest,
    *,
    sensor: str,
    timeout_s: float,
    on_progress: OnProgress | None = None,
    on_step: OnStep | None = None,
) -> SimulationReply:
    """Ask the finite-element service and join its answer.

    ``Client.simulate`` explains the arguments; the request's deadline, if it has one, may shorten
    ``timeout_s``. While this call waits, a token on the bus shows it. If this process ends or is
    interrupted, the token vanishes and the service stops the simulation.

    Raises:
        LinkError: No finite-element service runs.
        RemoteError: It refuses, or cannot go on. Steps that had converged were given to
            ``on_step``.
        StreamTimeout: No answer within ``GRACE_S`` after the deadline.
        WireError: The request, or an answer, breaks the contract.
    """
    deadline_s = min(request.deadline_s or math.inf, timeout_s)
    asked = dataclasses.replace(request, deadline_s=deadline_s)
    with session.caller_token(request.request_id):
        parts = session.query_stream(
            endpoints.SIMULATE, asked, sensor=sensor, timeout_s=deadline_s + GRACE_S
        )
        return join(parts, on_progress=on_progress, on_step=on_step)


def join(
    parts: Iterable[SimulationReply],
    *,
    on_progress: OnProgress | None = None,
    on_step: OnStep | None = None,
) -> SimulationReply:
    """One reply of the parts of an answer.

    Raises:
        WireError: A part is missing (reason ``"incomplete"``).
    """
    steps: list[SimulationStep] = []
    mesh = b""
    for part in parts:
        if part.progress is not None and on_progress is not None:
            on_progress(part.progress)
        if part.steps and part.first_step != len(steps):
            raise _incomplete(f"step {len(steps)} is missing, {part.first_step} came")
        for step in part.steps:
            steps.append(step)
            if on_step is not None:
                on_step(len(steps) - 1, step)
        mesh = part.mesh_sha256 or mesh
        if not part.more:
            return dataclasses.replace(
                part, mesh_sha256=mesh, steps=tuple(steps), first_step=0, progress=None
            )
    raise _incomplete(f"it ended after step {len(steps)} without a last message")


def _incomplete(problem: str) -> WireError:
    return WireError(
        f"the answer to a simulation is incomplete: {problem}",
        remedy="ask again; if it happens again, look at the log of the fem service",
        reason="incomplete",
    )
