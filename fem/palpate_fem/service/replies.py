"""From the events of a job to the replies that its caller gets, at the pace of its link."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

from palpate.bus import Publisher, QueryAnswer
from palpate.errors import ErrorCode, LinkError, RemoteError
from palpate.messages import (
    SimulationPhase,
    SimulationProgress,
    SimulationReply,
    SimulationRequest,
)
from palpate_fem.result import IndentationOutcome, IndentationStep
from palpate_fem.service.jobs import (
    JobEnded,
    JobEvent,
    JobFailed,
    JobStarted,
    JobWaiting,
    Pressurising,
    StepConverged,
)
from palpate_fem.service.requests import OUTCOMES, as_step

_log = logging.getLogger(__name__)

BEHIND_MOST = 64
"""Events of a job that may wait for its caller's link, however long they do."""

BEHIND_S = 30.0
"""How long the oldest of more than those may wait [s]; then the job is given up."""


class EventOutbox:
    """Passes on the events of one job in order, from a thread of its own.

    To send a reply takes as long as its caller's link does; the threads of the pool serve others,
    too.

    Args:
        pass_on: Called with each event, from that thread. ``JobEnded`` or ``JobFailed`` is the
            last.
    """

    def __init__(self, pass_on: Callable[[JobEvent], None]) -> None:
        self._pass_on = pass_on
        self._changed = threading.Condition()
        self._events: deque[tuple[float, JobEvent | None]] = deque()  # None = there are no more
        self._behind = self._over = False
        self._thread = threading.Thread(target=self._run, name="replies", daemon=True)
        self._thread.start()

    @property
    def is_open(self) -> bool:
        """Whether there may be something left to pass on."""
        return self._thread.is_alive()

    def put(self, event: JobEvent) -> bool:
        """Pass on an event soon; never waits.

        Returns:
            False, once, if too many wait for too long: the job is to be cancelled. They are dropped
            then, and the caller gets an error in place of the job's end.
        """
        now_s = time.monotonic()
        last = isinstance(event, JobEnded | JobFailed)
        with self._changed:
            if self._over or (self._behind and not last):
                return True
            self._over = last
            self._events.append((now_s, _too_slow() if self._behind else event))
            self._changed.notify()
            if last or len(self._events) <= BEHIND_MOST or now_s - self._events[0][0] <= BEHIND_S:
                return True
            self._behind = True
            self._events.clear()
            return False

    def drop(self) -> None:
        """End without events: its job was refused."""
        with self._changed:
            self._over = True
            self._events.append((0.0, None))
            self._changed.notify()

    def join(self, timeout_s: float) -> None:
        """Wait until the last event has been passed on, but no longer than so [s]."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._events)
                _, event = self._events.popleft()
            if event is None:
                return
            try:
                self._pass_on(event)
            except Exception:  # a defect; the job's end must be passed on nevertheless
                _log.exception("an event of a simulation is lost")
            if isinstance(event, JobEnded | JobFailed):
                return


def _too_slow() -> JobFailed:
    return JobFailed(
        ErrorCode.RESOURCE_EXHAUSTED,
        f"the link to the caller is too slow: more than {BEHIND_MOST} replies waited for it, the "
        f"oldest for {BEHIND_S:g} s",
        "ask for fewer fields or fewer steps, or over a faster link",
    )


class ActiveSimulation:
    """An accepted request: turns the events of its job into replies and progress.

    Args:
        request: As received.
        answer: Sends the replies to the caller.
        progress: Publishes progress for everybody else.

    Attributes:
        steps_done: Steps that were sent.
        since_s: When it was accepted [s, monotonic].
    """

    def __init__(
        self,
        request: SimulationRequest,
        answer: QueryAnswer[SimulationReply],
        progress: Publisher[SimulationProgress],
    ) -> None:
        self.request = request
        self.answer = answer
        self.steps_done = 0
        self._progress = progress
        self.since_s = time.monotonic()
        self._mesh = b""

    @property
    def elapsed_s(self) -> float:
        """Time since it was accepted [s]."""
        return time.monotonic() - self.since_s

    def on_event(self, event: JobEvent) -> None:
        """Send what an event means to the caller.

        Raises:
            WireError: A result that the contract does not allow.
        """
        match event:
            case JobWaiting(before):
                self._send(SimulationPhase.WAITING, waiting_before=before)
            case Pressurising():
                self._send(SimulationPhase.PRESSURISING)
            case JobStarted(fingertip):
                self._mesh = fingertip.mesh.sha256
                self._send(SimulationPhase.INDENTING)
            case StepConverged(step):
                self._send(SimulationPhase.INDENTING, step)
            case JobEnded():
                self._end(event)
            case JobFailed():
                self.answer.fail(event.error())

    def _send(
        self,
        phase: SimulationPhase,
        step: IndentationStep | None = None,
        *,
        waiting_before: int = 0,
    ) -> None:
        """Send progress, with a step if one has converged."""
        first = self.steps_done
        self.steps_done += step is not None
        progress = SimulationProgress(
            self.request.request_id,
            self.steps_done,
            len(self.request.path) - 1,
            self.elapsed_s,
            phase,
            waiting_before,
        )
        self.answer.send(
            SimulationReply(
                self.request.request_id,
                self._mesh,
                () if step is None else (as_step(step, self.request),),
                elapsed_s=progress.elapsed_s,
                more=True,
                first_step=first,
                progress=progress,
            )
        )
        try:
            self._progress.put(progress)
        except LinkError:  # for onlookers only; the answer does not depend on it
            return

    def _end(self, event: JobEnded) -> None:
        if event.outcome is IndentationOutcome.DEADLINE and not self.steps_done:
            self.answer.fail(
                RemoteError(
                    f"no step converged within {self.elapsed_s:.1f} s: {event.reason}",
                    remedy="allow more time (deadline_s); palpate status shows how many wait",
                    code=ErrorCode.DEADLINE_EXCEEDED,
                )
            )
            return
        no_reason = "" if event.outcome is IndentationOutcome.COMPLETE else event.outcome.value
        self.answer.send(
            SimulationReply(
                self.request.request_id,
                self._mesh,
                (),
                event.reason or no_reason,
                self.elapsed_s,
                first_step=self.steps_done,
                outcome=OUTCOMES[event.outcome],
                travel_m=event.travel_m,
            )
        )
        self.answer.end()
