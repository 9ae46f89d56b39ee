"""What becomes of each query of a queryable, without a bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from palpate.bus import endpoints
from palpate.bus import queryable as queryable_module
from palpate.bus.attachments import attachment_of, deadline_of
from palpate.bus.queryable import Queryable, QueryAnswer, error_reply, single_reply
from palpate.bus.topics import ENCODING_PREFIX, MAX_PAYLOAD_BYTES
from palpate.codec import ERROR
from palpate.errors import ErrorCode, WireError
from palpate.messages import Tare, TareRequest

KEY = "any/key/of/a/queryable"
ASKED = endpoints.TARE.request
OURS = ENCODING_PREFIX + ASKED.schema


class Query:
    """What Zenoh hands over, and what came of it."""

    def __init__(
        self,
        payload: bytes | None,
        encoding: str | None = OURS,
        *,
        key: str = KEY,
        attachment: bytes | None = None,
    ) -> None:
        self.key_expr = key
        self.payload = None if payload is None else SimpleNamespace(to_bytes=lambda: payload)
        self.attachment = (
            None if attachment is None else SimpleNamespace(to_bytes=lambda: attachment)
        )
        self.encoding = encoding
        self.replies: list[bytes] = []
        self.errors: list[Any] = []
        self.ended = threading.Event()

    def reply(
        self, key: str, payload: bytes, *, encoding: object, attachment: bytes | None = None
    ) -> None:
        assert key == KEY
        self.replies.append(payload)

    def reply_err(self, payload: bytes, *, encoding: object) -> None:
        self.errors.append(ERROR.decode(payload))

    def drop(self) -> None:
        self.ended.set()


class Asked:
    """A queryable, and a bus that hands queries over as Zenoh's thread would."""

    def __init__(self, handler: Callable[[TareRequest], Tare], **options: int) -> None:
        self._on_query: Callable[[Any], None] | None = None
        self.undeclared = False
        self.queryable = Queryable(
            self,  # type: ignore[arg-type]
            KEY,
            endpoints.TARE,
            single_reply(handler),
            **{"capacity": 10, **options},
        )

    def declare_queryable(
        self, key: str, on_query: Callable[[Any], None], *, complete: bool
    ) -> object:
        assert key == KEY
        assert complete, "so that it is the best match of a query for one"
        self._on_query = on_query
        return SimpleNamespace(undeclare=lambda: setattr(self, "undeclared", True))

    def ask(self, query: Query) -> Query:
        assert self._on_query is not None
        self._on_query(query)
        return query


@pytest.fixture
def tare(examples: dict[str, Any]) -> Tare:
    found: Tare = examples["Tare"]
    return found


@pytest.mark.parametrize(
    ("encoding", "empty", "refused"),
    [
        (OURS, False, False),
        (None, False, False),
        (ENCODING_PREFIX + "palpate.v1.Status", False, True),
        (ENCODING_PREFIX + "palpate.v1.Status", True, False),
        (None, True, False),
    ],
)
def test_a_payload_of_another_schema_is_refused(
    tare: Tare, encoding: str | None, empty: bool, refused: bool
) -> None:
    asked: list[TareRequest] = []

    def handler(request: TareRequest) -> Tare:
        asked.append(request)
        return tare

    with Asked(handler).queryable as queryable:
        query = Query(None if empty else ASKED.encode(TareRequest(7, 50)), encoding)
        queryable._on_query(query)  # type: ignore[arg-type]
        assert query.ended.wait(10)
    assert (len(query.errors), len(query.replies)) == ((1, 0) if refused else (0, 1))
    if refused:
        assert query.errors[0].code is ErrorCode.INVALID_REQUEST
        assert not asked
    else:
        assert asked == [TareRequest() if empty else TareRequest(7, 50)]


def test_one_query_after_another_and_a_full_queue_says_when_to_ask_again(tare: Tare) -> None:
    go, busy, at_once = threading.Event(), threading.Semaphore(1), []

    def handler(_: TareRequest) -> Tare:
        at_once.append(busy.acquire(blocking=False))
        assert go.wait(10)
        busy.release()
        return tare

    asked = Asked(handler, capacity=2)
    first = asked.ask(Query(None))
    deadline = time.monotonic() + 10
    while not at_once:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    waiting = [asked.ask(Query(None)) for _ in range(2)]
    refused = asked.ask(Query(None))
    assert refused.ended.is_set()
    (error,) = refused.errors
    assert (error.code, error.retry_after_s) == (ErrorCode.RESOURCE_EXHAUSTED, 0.5)
    assert f"{KEY} has 2 queries waiting" in error.message
    go.set()
    asked.queryable.close()
    assert asked.undeclared
    for query in (first, *waiting):
        assert query.ended.is_set(), "what was accepted is answered"
        assert len(query.replies) == 1
    assert at_once == [True, True, True]


def test_closing_waits_for_what_was_accepted_and_ends_the_threads(tare: Tare) -> None:
    def handler(_: TareRequest) -> Tare:
        time.sleep(0.1)
        return tare

    asked = Asked(handler, workers=2)
    queries = [asked.ask(Query(None)) for _ in range(4)]
    asked.queryable.close()
    assert all(query.ended.is_set() for query in queries)
    assert not [one for one in threading.enumerate() if f"query {KEY}" in one.name]


def test_threads_do_not_keep_a_process_alive(tare: Tare) -> None:
    with Asked(lambda _: tare).queryable:
        (worker,) = [one for one in threading.enumerate() if f"query {KEY}" in one.name]
        assert worker.daemon


def test_a_reply_may_be_as_large_as_a_message() -> None:
    query = Query(None)
    codec: Any = SimpleNamespace(schema="palpate.v1.Tare", encode=lambda size: bytes(size))
    answer: QueryAnswer[int] = QueryAnswer(query, KEY, codec)  # type: ignore[arg-type]
    answer.send(MAX_PAYLOAD_BYTES)
    with pytest.raises(WireError, match="larger than a message may be") as caught:
        answer.send(MAX_PAYLOAD_BYTES + 1)
    assert caught.value.reason == "size"
    answer.end()
    answer.send(1)
    assert [len(reply) for reply in query.replies] == [MAX_PAYLOAD_BYTES], "nothing after the end"


def test_who_has_stopped_waiting_is_told_and_not_served(tare: Tare) -> None:
    go, served = threading.Event(), []

    def handler(request: TareRequest) -> Tare:
        served.append(request.tare_id)
        assert go.wait(10)
        return tare

    asked = Asked(handler)
    patient = asked.ask(Query(ASKED.encode(TareRequest(1)), attachment=b"foreign, no time"))
    deadline = time.monotonic() + 10
    while not served:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    late = asked.ask(Query(ASKED.encode(TareRequest(2)), attachment=attachment_of(0.01)))
    in_time = asked.ask(Query(ASKED.encode(TareRequest(3)), attachment=attachment_of(60.0)))
    time.sleep(0.05)
    go.set()
    asked.queryable.close()
    assert served == [1, 3], "no work for a caller that has left"
    assert [error.code for error in late.errors] == [ErrorCode.DEADLINE_EXCEEDED]
    assert len(patient.replies) == len(in_time.replies) == 1
    assert asked.queryable.counters == {"received": 3, "answered": 2, "expired": 1}


@pytest.mark.parametrize("text", [b"palpate.v1;timeout_ms=-5", b"palpate.v1;timeout_ms=\xff"])
def test_a_damaged_deadline_is_refused(tare: Tare, text: bytes) -> None:
    with Asked(lambda _: tare).queryable as queryable:
        query = Query(None, attachment=text)
        queryable._on_query(query)  # type: ignore[arg-type]
        assert query.ended.wait(10)
    assert [error.code for error in query.errors] == [ErrorCode.INVALID_REQUEST]
    assert queryable.counters == {"received": 1, "rejected_attachment": 1}


@pytest.mark.parametrize("seconds", [0.0004, 0.25, 3.0, 86_400.0])
def test_the_time_that_is_left_arrives(seconds: float) -> None:
    before = time.monotonic()
    deadline = deadline_of(attachment_of(seconds) + b";key=of a later version")
    assert before + seconds <= deadline <= time.monotonic() + seconds + 0.001


def test_one_question_is_for_one_sensor(tare: Tare) -> None:
    """A question to a wildcard would tare every finger."""
    with Asked(lambda _: tare).queryable as queryable:
        query = Query(None, key="any/key/*/a/queryable")
        queryable._on_query(query)  # type: ignore[arg-type]
        assert query.ended.wait(10)
    assert not query.replies
    assert "names more than one sensor" in query.errors[0].message


def test_the_hint_grows_with_the_queue_and_with_the_time_an_answer_takes(tare: Tare) -> None:
    go = threading.Event()
    asked = Asked(lambda _: (go.wait(10), tare)[1], capacity=4)

    def full() -> list[Query]:
        deadline = time.monotonic() + 10
        queries = [asked.ask(Query(None))]
        while asked.queryable.waiting:  # until the worker has it
            assert time.monotonic() < deadline
            time.sleep(0.01)
        return [*queries, *(asked.ask(Query(None)) for _ in range(4))]

    def answers_take(seconds: float) -> None:
        # While a handler is held: the end of one would change it.
        with asked.queryable._lock:
            asked.queryable._service_s = seconds

    def hint() -> float:
        (error,) = asked.ask(Query(None)).errors
        return float(error.retry_after_s)

    go.set()
    timed = [asked.ask(Query(None)) for _ in range(3)]
    assert all(query.ended.wait(10) for query in timed)
    go.clear()
    held = full()
    answers_take(0.01)
    quick = hint()
    time.sleep(0.3)
    assert hint() >= 0.3, "a handler that takes longer than before does not promise room at once"
    assert hint() > quick
    go.set()
    assert all(query.ended.wait(10) for query in held)
    go.clear()
    held = full()
    answers_take(2.0)
    assert 7.0 < hint() <= 8.0, "four wait, two seconds each"
    go.set()
    asked.queryable.close()


def test_closing_answers_what_a_hanging_handler_keeps_waiting(
    tare: Tare, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(queryable_module, "_CLOSE_S", 0.2)
    go = threading.Event()
    asked = Asked(lambda _: (go.wait(20), tare)[1], capacity=2)
    queries = [asked.ask(Query(None)) for _ in range(2)]
    asked.queryable.close()
    waiting = queries[-1]
    assert waiting.errors[0].code is ErrorCode.UNAVAILABLE
    assert waiting.errors[0].retry_after_s > 0
    go.set()


def test_a_question_that_zenoh_hands_over_after_the_end_is_refused(tare: Tare) -> None:
    asked = Asked(lambda _: tare)
    asked.queryable.close()
    (error,) = asked.ask(Query(None)).errors
    assert error.code is ErrorCode.UNAVAILABLE
    assert error.retry_after_s > 0


def test_an_error_of_any_length_and_any_text_arrives() -> None:
    reply = error_reply(ValueError("a\udcff" + "x" * 10_000_000))
    arrived = ERROR.decode(ERROR.encode(reply))
    assert arrived.code is ErrorCode.INTERNAL
    assert "characters more)" in arrived.message
