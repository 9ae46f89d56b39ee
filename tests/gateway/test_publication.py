"""The end of a sensor's way: latency of its messages, and which of them do not count for it."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest

from palpate.health import Health
from palpate_gateway.clock.stamps import DueMessage
from palpate_gateway.service.publication import MessagePublisher


class Slow:
    """Takes 20 ms for each message."""

    def __init__(self) -> None:
        self.payloads: list[bytes] = []

    def put_payload(self, payload: bytes) -> None:
        time.sleep(0.02)
        self.payloads.append(payload)


def message_publisher(publisher: Any, stop: threading.Event) -> MessagePublisher:
    health = Health("gateway", "test")
    return MessagePublisher({"x": publisher}, health, stop=stop, claim=lambda stream: None)


def test_latency_from_reading_to_bus() -> None:
    publisher = Slow()
    out = message_publisher(publisher, threading.Event())
    assert out.gauges() == {}
    out.put(DueMessage("x", b"z", 0))
    assert out.gauges() == {}, "it came of no reading"
    for _ in range(3):
        read_ns = time.monotonic_ns()
        for payload in (b"a", b"b"):
            out.put(DueMessage("x", payload, 0), read_ns=read_ns)
    gauges = out.gauges()
    assert 0.02 <= gauges["publish_p50_s"]
    assert 0.04 * 0.9 <= gauges["publish_p99_s"], "of both, the second waits for the first"
    assert len(publisher.payloads) == 7


def test_latencies_of_a_sensor_that_delivers_no_more_are_not_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = message_publisher(Slow(), threading.Event())
    out.put(DueMessage("x", b"a", 0), read_ns=time.monotonic_ns())
    assert out.gauges()
    later_ns = time.monotonic_ns() + 10_000_000_000
    monkeypatch.setattr(time, "monotonic_ns", lambda: later_ns)
    assert out.gauges() == {}
    out.put(DueMessage("x", b"b", 0), read_ns=later_ns)
    assert out.gauges()


def test_latency_begins_with_the_read_not_with_publishing() -> None:
    """Stamping comes before: a gateway that is slow there must show it."""
    out = message_publisher(Slow(), threading.Event())
    out.put(DueMessage("x", b"a", 0), read_ns=time.monotonic_ns() - 1_000_000_000)
    assert out.gauges()["publish_p50_s"] >= 1.02


def test_who_waits_for_a_recording_is_not_slow() -> None:
    out = message_publisher(Slow(), threading.Event())
    now_ns = time.monotonic_ns()
    out.put(DueMessage("x", b"a", due_ns=now_ns + 30_000_000), read_ns=now_ns)
    assert out.gauges() == {}


def test_a_stop_ends_the_wait() -> None:
    stop, publisher = threading.Event(), Slow()
    stop.set()
    due_ns = time.monotonic_ns() + 60_000_000_000
    message_publisher(publisher, stop).put(DueMessage("x", b"a", due_ns=due_ns))
    assert publisher.payloads == []


def test_another_sensors_stream_is_not_published() -> None:
    def claimed(stream: str) -> None:
        raise ValueError(stream)

    publisher = Slow()
    health = Health("gateway", "test")
    out = MessagePublisher({"x": publisher}, health, stop=threading.Event(), claim=claimed)  # type: ignore[dict-item]
    with pytest.raises(ValueError, match="x"):
        out.put(DueMessage("x", b"a", 0))
    assert publisher.payloads == []
