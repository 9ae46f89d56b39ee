"""The book of tares: a frame's tare is found however late a consumer, or its gateway, starts."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from palpate.bus import Session, endpoints
from palpate.bus.tares import TareBook
from palpate.bus.topics import TARE
from palpate.config import LinkConfig
from palpate.errors import ErrorCode, LinkError, RemoteError, StreamTimeout
from palpate.messages import Tare, TareRequest

Wait = Callable[..., None]
PATIENCE_S = 20.0


@pytest.fixture
def tare(examples: dict[str, Any]) -> Tare:
    found: Tare = examples["Tare"]
    return found


def test_a_tare_of_before_is_asked_for_without_waiting(
    pair: tuple[Session, Session], tare: Tare, wait_until: Wait
) -> None:
    gateway, consumer = pair
    gateway.publisher(TARE, sensor="finger").put(tare)
    gateway.queryable(endpoints.TARE, lambda _: tare, sensor="finger")
    book = TareBook(consumer)
    book.find("finger", tare.tare_id)
    wait_until(lambda: book.find("finger", tare.tare_id) is not None, PATIENCE_S)


def test_a_gateway_that_starts_later_or_again_is_found(
    pair: tuple[Session, Session], tare: Tare, wait_until: Wait
) -> None:
    gateway, consumer = pair
    book = TareBook(consumer, query_timeout_s=0.5)
    with pytest.raises((LinkError, StreamTimeout)):
        book.baseline("finger", tare.tare_id)
    knows = threading.Event()

    def handler(request: TareRequest) -> Tare:
        if not knows.is_set():
            raise RemoteError("it has just started", remedy="wait", code=ErrorCode.NOT_FOUND)
        return replace(tare, tare_id=request.tare_id)

    gateway.queryable(endpoints.TARE, handler, sensor="finger")
    wait_until(lambda: _not_found(book, tare.tare_id), PATIENCE_S)
    knows.set()
    wait_until(lambda: book.find("finger", tare.tare_id) is not None, PATIENCE_S)
    assert book.baseline("finger", 4711).tare_id == 4711


def _not_found(book: TareBook, tare_id: int) -> bool:
    try:
        book.baseline("finger", tare_id)
    except RemoteError as error:
        return error.code is ErrorCode.NOT_FOUND
    except (LinkError, StreamTimeout):
        return False
    return False


def test_a_gateway_that_hangs_holds_up_no_frame(
    pair: tuple[Session, Session], tare: Tare, wait_until: Wait
) -> None:
    gateway, consumer = pair
    release = threading.Event()

    def hangs(_: TareRequest) -> Tare:
        release.wait(PATIENCE_S)
        return tare

    gateway.queryable(endpoints.TARE, hangs, sensor="lost")
    gateway.queryable(endpoints.TARE, lambda _: tare, sensor="finger")
    book = TareBook(consumer)
    assert book.find("lost", tare.tare_id) is None
    # Not even the look-up of another sensor waits for it without end.
    wait_until(lambda: book.find("finger", tare.tare_id) is not None, PATIENCE_S)
    assert book.find("lost", tare.tare_id) is None
    release.set()
    wait_until(lambda: book.find("lost", tare.tare_id) is not None, PATIENCE_S)


def test_the_stream_is_as_good_as_an_answer(
    pair: tuple[Session, Session], tare: Tare, wait_until: Wait
) -> None:
    gateway, consumer = pair
    book = TareBook(consumer)
    assert book.find("finger", tare.tare_id) is None
    publisher = gateway.publisher(TARE, sensor="finger")
    deadline = time.monotonic() + PATIENCE_S
    while book.find("finger", tare.tare_id) is None:
        assert time.monotonic() < deadline
        publisher.put(tare)
        time.sleep(0.05)


def test_another_tare_than_the_one_asked_for_is_no_answer(
    pair: tuple[Session, Session], tare: Tare
) -> None:
    gateway, consumer = pair
    asked: list[int] = []

    def wrong(request: TareRequest) -> Tare:
        asked.append(request.tare_id)
        return tare

    gateway.queryable(endpoints.TARE, wrong, sensor="finger")
    book = TareBook(consumer, query_timeout_s=1.0)
    for _ in range(20):
        assert book.find("finger", 4711) is None
        time.sleep(0.05)
    assert 1 <= len(asked) <= 10  # in a second; its pauses grow


def test_invented_tares_fill_nothing(link: LinkConfig) -> None:
    with Session.open(link) as session:
        book = TareBook(session)
        before = threads_that_ask()
        for number in range(5_000):
            assert book.find(f"finger-{number}", number + 1) is None
        assert len(book._wanted) <= 256
        assert threads_that_ask() <= before + 1


def threads_that_ask() -> int:
    return sum(thread.name == "tares" for thread in threading.enumerate())
