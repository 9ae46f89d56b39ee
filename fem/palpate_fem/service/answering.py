"""One request on its way: what the pool says of it, told to the one who asked."""

from __future__ import annotations

import time

from palpate.bus import Publisher, QueryAnswer
from palpate.errors import ErrorCode, LinkError, RemoteError
from palpate.messages import (
    SimulationPhase,
    SimulationProgress,
    SimulationReply,
    SimulationRequest,
)
from palpate_fem.result import IndentationOutcome
from palpate_fem.service.jobs import Began, Ended, Event, Failed, Pressurising, Stepped, Waiting
from palpate_fem.service.reply import OUTCOMES, as_step


class Asked:
    """A request that was accepted.

    Args:
        request: As it came.
        answer: Where its steps go.
        progress: Where others can follow it.

    Attributes:
        steps_done: Steps that were sent.
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
        self._since = time.monotonic()
        self._mesh = b""

    @property
    def elapsed_s(self) -> float:
        """Since it was accepted [s]."""
        return time.monotonic() - self._since

    def hear(self, event: Event) -> None:
        """Tell the caller.

        Raises:
            WireError: A result that the contract does not allow.
        """
        match event:
            case Waiting(before):
                self._tell(SimulationPhase.WAITING, before)
            case Pressurising():
                self._tell(SimulationPhase.PRESSURISING)
            case Began(fingertip):
                self._mesh = fingertip.mesh.sha256
                self._tell(SimulationPhase.INDENTING)
            case Stepped(step):
                index, self.steps_done = self.steps_done, self.steps_done + 1
                now = self._now(SimulationPhase.INDENTING)
                self.answer.send(
                    SimulationReply(
                        self.request.request_id,
                        self._mesh,
                        (as_step(step, self.request),),
                        elapsed_s=now.elapsed_s,
                        more=True,
                        first_step=index,
                        progress=now,
                    )
                )
                self._publish(now)
            case Ended():
                self._end(event)
            case Failed():
                self.answer.fail(event.error())

    def _end(self, event: Ended) -> None:
        if event.outcome is IndentationOutcome.DEADLINE and not self.steps_done:
            self.answer.fail(
                RemoteError(
                    f"no step converged within {self.elapsed_s:.1f} s: {event.reason}",
                    remedy="allow more time (deadline_s); palpate status shows how many wait",
                    code=ErrorCode.DEADLINE_EXCEEDED,
                )
            )
            return
        self.answer.send(
            SimulationReply(
                self.request.request_id,
                self._mesh,
                (),
                event.reason or _reason(event.outcome),
                self.elapsed_s,
                first_step=self.steps_done,
                outcome=OUTCOMES[event.outcome],
                travel_m=event.travel_m,
            )
        )
        self.answer.end()

    def _tell(self, phase: SimulationPhase, waiting_before: int = 0) -> None:
        now = self._now(phase, waiting_before)
        self.answer.send(
            SimulationReply(
                self.request.request_id,
                self._mesh,
                (),
                elapsed_s=now.elapsed_s,
                more=True,
                first_step=self.steps_done,
                progress=now,
            )
        )
        self._publish(now)

    def _now(self, phase: SimulationPhase, waiting_before: int = 0) -> SimulationProgress:
        return SimulationProgress(
            self.request.request_id,
            self.steps_done,
            len(self.request.path) - 1,
            self.elapsed_s,
            phase,
            waiting_before,
        )

    def _publish(self, progress: SimulationProgress) -> None:
        try:
            self._progress.put(progress)
        except LinkError:  # for onlookers only; the answer does not depend on it
            return


def _reason(outcome: IndentationOutcome) -> str:
    """What ``stopped_because`` says where the solver gave no reason."""
    return "" if outcome is IndentationOutcome.COMPLETE else outcome.value
