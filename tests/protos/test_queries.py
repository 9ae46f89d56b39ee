"""Asking over a bus: deadlines, retries, sizes, cancelling; and what a foreign service can do."""

from __future__ import annotations

import contextlib
import itertools
import math
import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
import zenoh

from palpate.bus import MAX_PAYLOAD_BYTES, Cancellation, Session, endpoints
from palpate.bus.query import LONGEST_S, ask_again
from palpate.bus.topics import sensor_key, service_key
from palpate.config import LinkConfig, parse_config
from palpate.errors import (
    ConfigError,
    ErrorCode,
    LinkError,
    PalpateError,
    RemoteError,
    StreamTimeout,
    WireError,
)
from palpate.health import Health, HealthReporter
from palpate.messages import FieldFrame, ServiceRequest, Tare, TareRequest

WaitUntil = Callable[..., None]
KEY = sensor_key("lab", "finger", "tare")
NOBODY = f"no gateway has a BioTac of this name: nobody answers on {KEY}"
TIMEOUT_S = 20.0


def _tare(session: Session, *, timeout_s: float = TIMEOUT_S) -> Tare:
    reply: Tare = session.query(endpoints.TARE, TareRequest(), sensor="finger", timeout_s=timeout_s)
    return reply


def _asked_aside(
    session: Session, *, timeout_s: float, cancellation: Cancellation | None = None
) -> Callable[[float], list[object]]:
    """Ask in a thread. The function returned waits so long [s] for the tare's id or the problem."""
    answers: list[object] = []

    def ask() -> None:
        with cancellation or contextlib.nullcontext():
            try:
                answers.append(_tare(session, timeout_s=timeout_s).tare_id)
            except PalpateError as error:
                answers.append(error.problem)

    asker = threading.Thread(target=ask, daemon=True)
    asker.start()

    def answer(wait_s: float) -> list[object]:
        asker.join(wait_s)
        return answers

    return answer


@pytest.fixture
def always_young(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sessions have just joined, however long a busy machine takes."""
    monkeypatch.setattr("palpate.bus.link._YOUNG_S", 10 * TIMEOUT_S)


def _reached(session: Session) -> bool:
    """Whether a raw queryable at ``KEY`` can be asked."""
    return bool(list(session._raw.get(KEY, timeout=TIMEOUT_S, payload=b"probe")))


def test_what_cannot_be_asked_is_refused_by_name_and_not_sent(pair: Any) -> None:
    _, b = pair
    for timeout_s in (0.0, -1.0, math.nan, math.inf, 1e30):
        with pytest.raises(ConfigError, match="timeout_s = ") as caught:
            _tare(b, timeout_s=timeout_s)
        assert caught.value.remedy
    for request in (TareRequest(frames=-1), TareRequest(tare_id=1 << 70)):
        with pytest.raises(ConfigError, match=r"TareRequest\(.*cannot be sent as palpate.v1"):
            b.query(endpoints.TARE, request, sensor="finger")
    for sensor in ("*", "**", "", "a/b", "Finger"):
        with pytest.raises(ConfigError, match="cannot stand in a Zenoh key"):
            b.query(endpoints.TARE, TareRequest(), sensor=sensor)


@pytest.mark.parametrize("lease_s", [math.inf, math.nan, 1e18, 0.0])
def test_a_lease_is_a_time(lease_s: float) -> None:
    with pytest.raises(ConfigError, match="lease_s"):
        parse_config(LinkConfig, {"lease_s": lease_s}, where="lab.toml [link]")


def test_a_request_that_is_too_large_is_not_sent(pair: Any, examples: dict[str, Any]) -> None:
    import dataclasses

    import numpy as np

    _, b = pair
    field: FieldFrame = examples["FieldFrame"]
    nodes = MAX_PAYLOAD_BYTES // 12 + 1
    large = dataclasses.replace(field, displacement=np.zeros((nodes, 3), np.float32))
    with pytest.raises(WireError, match="larger than a message may be") as caught:
        b.query(endpoints.SYNTHESISE, large, service="synthesis")
    assert caught.value.reason == "size"


@pytest.mark.parametrize("direct", [True, False])
def test_a_reply_that_is_too_large_for_the_way_is_not_blamed_on_the_load_alone(
    link: LinkConfig, direct: bool, wait_until: WaitUntil
) -> None:
    """Zenoh drops it at the receiver and tells nobody: a foreign service that answers 24 MB."""
    joined = link.model_copy(update={"direct": direct})
    with Session.open(joined) as a, Session.open(joined) as b:

        def answer(query: zenoh.Query) -> None:
            with query:
                probe = query.payload is not None and query.payload.to_bytes() == b"probe"
                query.reply(KEY, bytes(1 if probe else 24_000_000))

        a._raw.declare_queryable(KEY, answer, complete=True)
        wait_until(lambda: _reached(b), timeout_s=TIMEOUT_S)
        with pytest.raises((LinkError, StreamTimeout), match="larger than a message may be"):
            _tare(b, timeout_s=3.0)


def test_a_service_that_is_not_there_is_not_blamed_for_its_answer(pair: Any) -> None:
    _, b = pair
    with pytest.raises(LinkError, match=NOBODY):
        _tare(b)


def test_a_process_that_is_there_and_does_not_answer_is_not_said_to_be_absent(
    pair: Any, wait_until: Callable[..., None]
) -> None:
    """Zenoh does not tell who serves a key with wildcards."""
    a, b = pair
    a.presence("features", instance="one").ready()
    a._raw.declare_queryable(
        service_key("lab", "features", "one", "model"), lambda query: query.drop(), complete=True
    )
    wait_until(lambda: any(one.ready for one in b.alive()), timeout_s=TIMEOUT_S)
    with pytest.raises(LinkError, match="is served, but no answer"):
        b.query(endpoints.MODEL, ServiceRequest(), service="features", timeout_s=TIMEOUT_S)
    with pytest.raises(LinkError, match="no service answers"):
        b.query(endpoints.MODEL, ServiceRequest(), service="field", timeout_s=TIMEOUT_S)


def test_a_long_wait_is_not_waited_out_where_nobody_serves(pair: Any) -> None:
    _, b = pair
    answer = _asked_aside(b, timeout_s=LONGEST_S)
    assert answer(TIMEOUT_S) == [NOBODY]


def test_a_session_that_has_just_joined_waits_until_it_knows_who_serves(
    pair: Any, examples: dict[str, Any], always_young: None
) -> None:
    a, b = pair
    asked: list[TareRequest] = []
    tare: Tare = examples["Tare"]

    def handler(request: TareRequest) -> Tare:
        asked.append(request)
        return tare

    answer = _asked_aside(b, timeout_s=10 * TIMEOUT_S)
    assert answer(0.3) == [], "it is not said that nobody serves"
    a.queryable(endpoints.TARE, handler, sensor="finger")
    assert answer(TIMEOUT_S) == [tare.tare_id]
    assert len(asked) == 1


def test_a_question_that_is_lost_is_not_sent_again(pair: Any, always_young: None) -> None:
    """The service may have acted on it; that it is gone does not mean that nobody was asked."""
    a, b = pair
    asked: queue.SimpleQueue[zenoh.Query] = queue.SimpleQueue()
    queryable = a._raw.declare_queryable(KEY, asked.put, complete=True)
    answer = _asked_aside(b, timeout_s=10 * TIMEOUT_S)
    question = asked.get(timeout=TIMEOUT_S)
    queryable.undeclare()
    question.drop()
    (said,) = answer(TIMEOUT_S)
    assert str(said).startswith(f"{KEY} is served, but no answer arrived")
    assert asked.empty()


def test_who_waits_for_a_service_can_be_cancelled(pair: Any, always_young: None) -> None:
    _, b = pair
    cancellation = Cancellation()
    answer = _asked_aside(b, timeout_s=10 * TIMEOUT_S, cancellation=cancellation)
    assert answer(0.3) == []
    cancellation.cancel()
    assert answer(TIMEOUT_S) == [NOBODY]


def test_a_question_carries_the_time_that_its_caller_waits(
    pair: Any, wait_until: WaitUntil
) -> None:
    a, b = pair
    attachments: list[bytes] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            if query.attachment is not None:
                attachments.append(query.attachment.to_bytes())
            query.reply_err(b"no")

    a._raw.declare_queryable(KEY, answer, complete=True)
    wait_until(lambda: _reached(b), timeout_s=TIMEOUT_S)
    with pytest.raises(RemoteError, match="untyped error"):
        _tare(b, timeout_s=12.5)
    (attachment,) = attachments
    head, _, milliseconds = attachment.decode().partition("timeout_ms=")
    assert head == "palpate.v1;"
    assert 12_000 < int(milliseconds) <= 12_500


def test_a_refused_question_is_asked_again_until_there_is_room(
    pair: Any, examples: dict[str, Any], wait_until: WaitUntil
) -> None:
    a, b = pair
    asked: list[float] = []

    def handler(_: TareRequest) -> Tare:
        asked.append(time.monotonic())
        if len(asked) < 3:
            raise RemoteError(
                "busy",
                remedy="ask later",
                code=ErrorCode.RESOURCE_EXHAUSTED,
                retry_after_s=0.1,
            )
        tare: Tare = examples["Tare"]
        return tare

    a.queryable(endpoints.TARE, handler, sensor="finger")
    wait_until(lambda: not isinstance(_attempt(b), LinkError), timeout_s=TIMEOUT_S)
    assert len(asked) >= 3
    assert min(b - a for a, b in itertools.pairwise(asked)) >= 0.1


def _attempt(session: Session) -> object:
    try:
        return _tare(session)
    except PalpateError as error:
        return error


@pytest.mark.parametrize(
    ("code", "retry_after_s", "attempts"),
    [
        (ErrorCode.RESOURCE_EXHAUSTED, 0.01, 3),
        (ErrorCode.UNAVAILABLE, 0.01, 3),
        (ErrorCode.RESOURCE_EXHAUSTED, 0.0, 1),
        (ErrorCode.RESOURCE_EXHAUSTED, 60.0, 1),
        (ErrorCode.RESOURCE_EXHAUSTED, math.nan, 1),
        (ErrorCode.RESOURCE_EXHAUSTED, -1.0, 1),
        (ErrorCode.DEVICE, 0.01, 1),
    ],
)
def test_only_a_refusal_with_a_hint_is_followed_and_only_in_time(
    code: ErrorCode, retry_after_s: float, attempts: int
) -> None:
    left: list[float] = []

    def once(left_s: float) -> str:
        left.append(left_s)
        if len(left) < 3:
            raise RemoteError("no", remedy="later", code=code, retry_after_s=retry_after_s)
        return "room"

    if attempts == 3:
        assert ask_again(once, 30.0) == "room"
    else:
        with pytest.raises(RemoteError, match="no"):
            ask_again(once, 30.0)
    assert len(left) == attempts
    assert left == sorted(left, reverse=True)


def test_a_question_is_cancelled_from_another_thread(pair: Any, examples: dict[str, Any]) -> None:
    a, b = pair
    go, begun = threading.Event(), threading.Event()

    def handler(_: TareRequest) -> Tare:
        begun.set()
        go.wait(TIMEOUT_S)
        tare: Tare = examples["Tare"]
        return tare

    a.queryable(endpoints.TARE, handler, sensor="finger")
    cancellation, ended = Cancellation(), threading.Event()

    def ask() -> None:
        with cancellation:
            while not begun.is_set():  # the service may not be known here at first
                with pytest.raises(LinkError):
                    _tare(b, timeout_s=600.0)
        ended.set()

    asker = threading.Thread(target=ask, daemon=True)
    asker.start()
    assert begun.wait(TIMEOUT_S)
    cancellation.cancel()
    assert ended.wait(TIMEOUT_S), "600 s were not waited for"
    go.set()
    with cancellation, pytest.raises(PalpateError):
        _tare(b, timeout_s=600.0)


def test_a_flood_of_questions_is_refused_and_answered_in_the_end(
    pair: Any, examples: dict[str, Any], wait_until: WaitUntil
) -> None:
    """Far more callers than may wait: each is told when to come back, and none is lost."""
    a, b = pair
    tare: Tare = examples["Tare"]

    def handler(_: TareRequest) -> Tare:
        time.sleep(0.002)
        return tare

    queryable = a.queryable(endpoints.TARE, handler, sensor="finger", capacity=2)
    wait_until(lambda: not isinstance(_attempt(b), LinkError), timeout_s=TIMEOUT_S)
    answers: list[object] = []

    def ask() -> None:
        for _ in range(3):
            try:
                answers.append(_tare(b).tare_id)
            except PalpateError as error:
                answers.append(error)

    askers = [threading.Thread(target=ask, daemon=True) for _ in range(40)]
    for asker in askers:
        asker.start()
    for asker in askers:
        asker.join(3 * TIMEOUT_S)
    assert answers == [tare.tare_id] * 120
    assert queryable.counters["refused_full"] > 0
    assert queryable.waiting == 0


def test_the_status_counts_what_became_of_questions(
    pair: Any, examples: dict[str, Any], wait_until: WaitUntil
) -> None:
    a, b = pair
    with HealthReporter(a, Health("gateway", "gateway"), period_s=0.05):
        a.queryable(endpoints.TARE, lambda _: examples["Tare"], sensor="finger")
        wait_until(lambda: not isinstance(_attempt(b), LinkError), timeout_s=TIMEOUT_S)
        list(b._raw.get(KEY, payload=b"\xff", timeout=TIMEOUT_S))

        def counters() -> dict[str, int]:
            status = b.query(endpoints.STATUS, ServiceRequest(), timeout_s=TIMEOUT_S)
            assert status.gauges.get("waiting_questions", 0.0) >= 0.0
            return dict(status.counters)

        wait_until(lambda: counters().get("questions_rejected_schema") == 1, timeout_s=TIMEOUT_S)
        assert counters()["questions_answered"] == 1
        assert counters()["questions_received"] == 2, "those about the status do not count"
