"""A driver that does not return: the gateway stops beating, and says which sensor it is."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest

from palpate.bus import Delivery
from palpate.bus.topics import ELECTRODES
from palpate.health import Health
from palpate.heartbeat import Turns
from palpate_gateway.clock.stamps import DueMessage
from palpate_gateway.service import node, worker
from palpate_gateway.service.publication import MessagePublisher
from palpate_gateway.virtual.finger import VirtualFinger

PATIENCE_S = 20.0


def _two_fingers() -> dict[str, Any]:
    return {
        "sensors": [
            {"name": name, "driver": "virtual", "options": {"model": "formula", "seed": seed}}
            for seed, name in enumerate(("good", "bad"))
        ]
    }


def test_a_driver_that_hangs_stops_the_heartbeat(bus: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    beats, returns = threading.Semaphore(0), threading.Event()
    returns.set()
    read = VirtualFinger._read

    def read_or_hang(finger: VirtualFinger, timeout_s: float) -> Any:
        if finger._options.seed == 1:
            assert returns.wait(PATIENCE_S)
        return read(finger, timeout_s)

    monkeypatch.setattr(VirtualFinger, "_read", read_or_hang)
    monkeypatch.setattr(node, "beat", lambda *_: beats.release())
    monkeypatch.setattr(worker, "_TURN_S", 0.3)
    with bus.gateway(_two_fingers()):
        for _ in range(5):
            assert beats.acquire(timeout=PATIENCE_S)
        returns.clear()

        def told() -> bool:
            status = bus.status()
            error = None if status is None else status.last_error
            return error is not None and "'bad' hangs" in error.message

        bus.until(told)
        while beats.acquire(blocking=False):
            pass
        assert not beats.acquire(timeout=0.5)
        # The other finger is read all the while: a timer would have noticed nothing.
        good = bus.session.subscriber(ELECTRODES, sensor="good", delivery=Delivery.NEWEST)
        now_ns = time.monotonic_ns()
        while good.next(PATIENCE_S).message.stamp.monotonic_ns < now_ns:
            pass
        returns.set()
        assert beats.acquire(timeout=PATIENCE_S), "it beats again when the driver returns"


def test_a_recording_with_a_long_pause_does_not_hang() -> None:
    """The thread of a recording may sleep for minutes until the next frame is due."""
    stop = threading.Event()
    turns = Turns()
    turns.next(-1.0)
    health = Health("gateway", "gateway")
    publisher = MessagePublisher({}, health, stop=stop, claim=lambda stream: None, turns=turns)
    due_ns = time.monotonic_ns() + 600 * 1_000_000_000
    item = DueMessage("electrodes", b"", due_ns)
    waits = threading.Thread(target=publisher.put, args=(item,))
    waits.start()
    deadline = time.monotonic() + PATIENCE_S
    while turns.are_late() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not turns.are_late()
    stop.set()
    waits.join(PATIENCE_S)
    assert not waits.is_alive()
