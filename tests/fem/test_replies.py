"""Replies go out at the pace of a caller's link, and hold up nobody else; the pool is a fake."""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from palpate.errors import ErrorCode, RemoteError, WireError
from palpate.health import Health
from palpate_fem.config import FingertipParameters
from palpate_fem.result import IndentationOutcome
from palpate_fem.service import node, replies
from palpate_fem.service.config import FemConfig
from palpate_fem.service.jobs import JobEnded, JobEvent, JobFailed, JobWaiting, SimulationJob

fakes: Any = importlib.import_module("fem_fakes")

PATIENCE_S = 20.0
END = JobEnded(IndentationOutcome.COMPLETE)


class HandPool:
    """Keeps the jobs; the test says what happens to them."""

    def __init__(self) -> None:
        self.jobs: dict[str, Callable[[JobEvent], None]] = {}
        self.cancelled: list[str] = []
        self.refuses = False

    def submit(self, job: SimulationJob, on_event: Callable[[JobEvent], None]) -> None:
        if self.refuses:
            raise RemoteError("full", remedy="wait", code=ErrorCode.RESOURCE_EXHAUSTED)
        self.jobs[job.id] = on_event

    def cancel(self, job_id: str) -> bool:
        self.cancelled.append(job_id)
        return True

    def close(self) -> None:
        return


class LinkedAnswer:
    """An answer to a caller whose link passes on replies while it is open."""

    def __init__(self, *, is_open: bool = True) -> None:
        self.arrived_ns = time.monotonic_ns()
        self.link = threading.Event()
        if is_open:
            self.link.set()
        self.sent: list[Any] = []
        self.ended = threading.Event()
        self.on_last: Callable[[], None] = lambda: None

    def send(self, reply: Any) -> None:
        if not reply.more:
            self.on_last()
        assert self.link.wait(PATIENCE_S)
        self.sent.append(reply.progress.waiting_before if reply.more else reply.outcome.name)

    def fail(self, error: BaseException) -> None:
        assert self.link.wait(PATIENCE_S)
        self.sent.append(error)
        self.ended.set()

    def end(self) -> None:
        self.ended.set()


class PoolByHand:
    """The service with a `HandPool`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.pool = HandPool()
        monkeypatch.setattr(node, "_pool_of", lambda *_: self.pool)
        publisher = SimpleNamespace(put=lambda _: None)
        session: Any = SimpleNamespace(station="lab", publisher=lambda *_, **__: publisher)
        self.health = Health("fem", "fem")
        self.service = node.SimulationService(
            session, FemConfig(), FingertipParameters(), self.health, None
        )

    def ask(self, name: str, *, is_open: bool = True) -> LinkedAnswer:
        answer: Any = LinkedAnswer(is_open=is_open)
        self.service.simulate(fakes.request(name), answer)
        found: LinkedAnswer = answer
        return found

    def happens(self, name: str, *events: JobEvent) -> None:
        """Report events as a thread of the pool does, which must not wait for any caller."""

        def report() -> None:
            for event in events:
                self.pool.jobs[name](event)

        thread = threading.Thread(target=report, daemon=True)
        thread.start()
        thread.join(PATIENCE_S / 2)
        assert not thread.is_alive(), "the pool's thread waits for a caller"


@pytest.fixture
def by_hand(monkeypatch: pytest.MonkeyPatch) -> PoolByHand:
    return PoolByHand(monkeypatch)


def test_a_caller_whose_link_stands_still_holds_up_nobody(by_hand: PoolByHand) -> None:
    slow, quick = by_hand.ask("slow", is_open=False), by_hand.ask("quick")
    by_hand.happens("slow", *map(JobWaiting, range(5)), END)
    by_hand.happens("quick", JobWaiting(7), END)
    assert quick.ended.wait(PATIENCE_S)
    assert quick.sent == [7, "COMPLETE"]
    assert slow.sent == []
    slow.link.set()
    assert slow.ended.wait(PATIENCE_S)
    assert slow.sent == [0, 1, 2, 3, 4, "COMPLETE"], "late, but all and in order"


def test_the_id_is_free_before_the_last_reply(by_hand: PoolByHand) -> None:
    answer = by_hand.ask("same")
    again: list[LinkedAnswer] = []
    answer.on_last = lambda: again.append(by_hand.ask("same"))
    by_hand.happens("same", END)
    assert answer.ended.wait(PATIENCE_S)
    assert len(again) == 1
    by_hand.happens("same", END)
    assert again[0].ended.wait(PATIENCE_S)


def test_a_caller_that_stays_behind_loses_its_own_simulation(
    by_hand: PoolByHand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replies, "BEHIND_S", 0.0)
    slow, quick = by_hand.ask("slow", is_open=False), by_hand.ask("quick")
    by_hand.happens("slow", *map(JobWaiting, range(2 * replies.BEHIND_MOST)))
    assert by_hand.pool.cancelled == ["slow"]
    assert by_hand.health.counters["callers_too_slow"] == 1
    by_hand.happens("slow", JobEnded(IndentationOutcome.CANCELLED))
    by_hand.happens("quick", END)
    assert quick.ended.wait(PATIENCE_S)
    slow.link.set()
    assert slow.ended.wait(PATIENCE_S)
    *before, error = slow.sent
    assert before == list(range(len(before)))
    assert len(before) <= replies.BEHIND_MOST
    assert isinstance(error, RemoteError)
    assert error.code is ErrorCode.RESOURCE_EXHAUSTED
    assert "too slow" in error.problem


def test_many_replies_at_once_are_no_reason_to_give_up(by_hand: PoolByHand) -> None:
    answer = by_hand.ask("many", is_open=False)
    count = 3 * replies.BEHIND_MOST
    by_hand.happens("many", *map(JobWaiting, range(count)), END)
    answer.link.set()
    assert answer.ended.wait(PATIENCE_S)
    assert answer.sent == [*range(count), "COMPLETE"]
    assert by_hand.pool.cancelled == []


def test_a_result_that_cannot_be_sent_stops_its_own_job_only(by_hand: PoolByHand) -> None:
    """Its id may belong to another job by the time that it was to be sent."""
    answer = by_hand.ask("same")

    def asked_again() -> None:
        by_hand.ask("same")
        raise WireError("not finite", remedy="mend it", reason="value")

    answer.on_last = asked_again
    by_hand.happens("same", END)
    assert answer.ended.wait(PATIENCE_S)
    by_hand.service.close()
    assert "cannot be sent" in str(answer.sent[-1])
    assert by_hand.pool.cancelled == []


def test_a_refused_request_leaves_no_thread(by_hand: PoolByHand) -> None:
    before = set(threading.enumerate())
    by_hand.pool.refuses = True
    with pytest.raises(RemoteError, match="full"):
        by_hand.ask("refused")
    for thread in set(threading.enumerate()) - before:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def test_the_service_ends_when_the_last_replies_are_out(by_hand: PoolByHand) -> None:
    answer = by_hand.ask("last", is_open=False)
    stopping = JobFailed(ErrorCode.UNAVAILABLE, "stopping", "ask again")
    by_hand.happens("last", stopping)
    opener = threading.Timer(0.2, answer.link.set)
    opener.start()
    by_hand.service.close()
    opener.join()
    (error,) = answer.sent
    assert error.code is ErrorCode.UNAVAILABLE
