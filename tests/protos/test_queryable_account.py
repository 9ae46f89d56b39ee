"""What becomes of each query of a queryable, without a bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from palpate.bus import endpoints
from palpate.bus.query import MAX_REPLY_BYTES, Queryable, QueryAnswer, single_reply
from palpate.bus.topics import ENCODING_PREFIX
from palpate.codec import ERROR
from palpate.errors import ErrorCode, WireError
from palpate.messages import Tare, TareRequest

KEY = "any/key/of/a/queryable"
ASKED = endpoints.TARE.request
OURS = ENCODING_PREFIX + ASKED.schema


class Query:
    """What Zenoh hands over, and what came of it."""

    def __init__(self, payload: bytes | None, encoding: str | None = OURS) -> None:
        self.payload = None if payload is None else SimpleNamespace(to_bytes=lambda: payload)
        self.encoding = encoding
        self.replies: list[bytes] = []
        self.errors: list[Any] = []
        self.ended = threading.Event()

    def reply(self, key: str, payload: bytes, *, encoding: object) -> None:
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
    answer.send(MAX_REPLY_BYTES)
    with pytest.raises(WireError, match="larger than a message may be") as caught:
        answer.send(MAX_REPLY_BYTES + 1)
    assert caught.value.reason == "size"
    answer.end()
    answer.send(1)
    assert [len(reply) for reply in query.replies] == [MAX_REPLY_BYTES], "nothing after the end"
