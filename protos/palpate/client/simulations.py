"""Requests of simulations: straight paths, and the parts of the answer joined into one reply.

Several finite-element services may answer under one name. A simulation is a pure function of its
request, so what one of them does not finish is asked of another.
"""

from __future__ import annotations

import dataclasses
import math
import random
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import ParamSpec

import numpy as np
from numpy.typing import NDArray

from palpate.bus import Session, endpoints
from palpate.bus.topics import duty_root
from palpate.client.streams import is_cancelled
from palpate.config import check_name
from palpate.errors import (
    ErrorCode,
    LinkError,
    PalpateError,
    RemoteError,
    ReplicaDiffers,
    StreamTimeout,
    WireError,
)
from palpate.messages import (
    Pose,
    SimulationCancelRequest,
    SimulationProgress,
    SimulationReply,
    SimulationRequest,
    SimulationStep,
)

P = ParamSpec("P")

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


_SAME, _LEAST_FORCE_N = 1e-2, 0.01
"""Share of the largest force, or of this one [N], by which a step of two services may differ: one
may have a GPU (ADR 26)."""

_COMES_BACK_S, _POLL_S = 2.0, 0.05
"""How long another service is waited for where one was lost, as what cut that one off may have cut
off both, and how often it is looked for [s]."""


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

    The answer of a service that is killed, stopped or cut off ends, at the latest after the lease
    of its link (2 s); then another one is asked, and also when one has no room. When none is left,
    the error of the last one is raised; if that one was lost, after two seconds in which the link
    of another one may come back. What ``on_progress`` and ``on_step`` raise ends the call.

    Raises:
        LinkError: No finite-element service runs.
        RemoteError: It refuses, or cannot go on. Steps that had converged were given to
            ``on_step``.
        ReplicaDiffers: One ended, and another answers for another fingertip, or with other forces
            in steps that were given to ``on_step``.
        StreamTimeout: No answer within ``GRACE_S`` after the deadline, or it was over before a
            service could be asked.
        WireError: The request, or an answer, breaks the contract.
    """
    check_name(sensor, "sensor")
    deadline_s = min(request.deadline_s or math.inf, timeout_s)
    end_s = time.monotonic() + deadline_s
    told = _Told(on_step, on_progress)
    asked: set[str] = set()
    error: PalpateError | None = None
    with session.caller_token(request.request_id):
        while True:
            was_lost = error is not None and not isinstance(error, RemoteError)
            patience_s = min(_COMES_BACK_S, end_s - time.monotonic()) if was_lost else 0.0
            replica = _next_replica(session, sensor, asked, patience_s)
            left_s = end_s - time.monotonic()
            if error is not None and (replica is None or left_s <= 0.0):
                raise error
            if left_s <= 0.0:
                raise StreamTimeout(
                    f"the {deadline_s:g} s were over before a service was asked",
                    remedy="allow more time",
                )
            again = dataclasses.replace(request, deadline_s=left_s)
            wait_s = left_s + GRACE_S
            # A service of an older palpate, or one of a name used twice, has no key of its own.
            parts = (
                session.query_stream(endpoints.SIMULATE, again, sensor=sensor, timeout_s=wait_s)
                if replica is None
                else session.query_stream(
                    endpoints.SIMULATE_AT, again, service="fem", instance=replica, timeout_s=wait_s
                )
            )
            try:
                return join(told.watch(parts), on_progress=told.progress, on_step=told.step)
            except (LinkError, RemoteError, WireError) as failure:
                if failure is told.callers_error or is_cancelled():
                    raise
                if replica is None or not _may_ask_another(failure):
                    raise
                error = failure


def _next_replica(session: Session, sensor: str, asked: set[str], patience_s: float) -> str | None:
    """A service that answers for ``sensor`` and is not in ``asked``, by chance; it is added.

    If there is none, it is waited for as long as it may. One whose name a service of another sensor
    has, too, is none: its own key would lead to either.
    """
    end_s = time.monotonic() + patience_s
    while True:
        held = session.holders(duty_root("simulate"), "*")
        elsewhere = {one.instance for one in held if one.sensor != sensor}
        left = {one.instance for one in held if one.sensor == sensor} - elsewhere - asked
        if left:
            break
        if time.monotonic() >= end_s or is_cancelled():
            return None
        time.sleep(_POLL_S)
    chosen = random.choice(sorted(left))
    asked.add(chosen)
    return chosen


def _may_ask_another(error: PalpateError) -> bool:
    if isinstance(error, RemoteError):
        return error.code in (ErrorCode.RESOURCE_EXHAUSTED, ErrorCode.UNAVAILABLE)
    return isinstance(error, LinkError) or getattr(error, "reason", "") == "incomplete"


class _Told:
    """Tells the caller each step once, although a second service begins again with the first.

    ``callers_error`` is what a function of the caller has raised; it is not the service's.
    """

    def __init__(self, on_step: OnStep | None, on_progress: OnProgress | None) -> None:
        self._on_step = on_step
        self._on_progress = on_progress
        self.callers_error: Exception | None = None
        self._told: list[NDArray[np.float64]] = []  # their forces [N], each of shape (3,)
        self._mesh = b""

    def watch(self, parts: Iterable[SimulationReply]) -> Iterator[SimulationReply]:
        """The same parts, which must be of the fingertip that others were of."""
        for part in parts:
            if self._mesh and part.mesh_sha256 not in (b"", self._mesh):
                raise ReplicaDiffers(
                    f"the service that began had the mesh {self._mesh.hex()[:12]}, and the one "
                    f"that took over has {part.mesh_sha256.hex()[:12]}",
                    remedy="give all of them the same version and parameters: palpate fleet",
                )
            self._mesh = part.mesh_sha256 or self._mesh
            yield part

    def progress(self, progress: SimulationProgress) -> None:
        """How far the service is that answers now."""
        if self._on_progress is not None:
            self._call(self._on_progress, progress)

    def _call(self, function: Callable[P, None], *args: P.args, **named: P.kwargs) -> None:
        try:
            function(*args, **named)
        except Exception as error:
            self.callers_error = error
            raise

    def step(self, number: int, step: SimulationStep) -> None:
        """A step of the service that answers now."""
        if self._on_step is None:  # the reply has the steps of one service
            return
        if number == len(self._told):
            self._told.append(step.force)
            self._call(self._on_step, number, step)
            return
        apart_n = float(np.linalg.norm(step.force - self._told[number]))
        largest_n = max(float(np.linalg.norm(force)) for force in self._told)
        if apart_n > _SAME * max(largest_n, _LEAST_FORCE_N):
            raise ReplicaDiffers(
                f"the service that took over went another way than the one that began: in step "
                f"{number + 1} their forces are {apart_n:.3f} N apart",
                remedy="ask again with shorter steps; give all services a GPU, or none",
            )


def ask_cancellation(session: Session, request_id: str, *, sensor: str, timeout_s: float) -> bool:
    """Stop a simulation, whichever service computes it; whether one did.

    Raises:
        PalpateError: None answers.
    """
    check_name(sensor, "sensor")
    replies = session.query_all(
        endpoints.CANCEL_SIMULATION,
        SimulationCancelRequest(request_id),
        sensor=sensor,
        timeout_s=timeout_s,
    )
    answers = [reply for reply in replies if not isinstance(reply, PalpateError)]
    if not answers:
        raise (
            replies[0]
            if replies and isinstance(replies[0], PalpateError)
            else LinkError(
                f"no service simulates for {sensor!r}",
                remedy="start the service: palpate up; see what runs: palpate status",
            )
        )
    return any(answer.found for answer in answers)


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
