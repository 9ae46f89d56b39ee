"""A driver whose frames break the contract: they are counted, told once, and not published."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pytest

from palpate.bus.topics import WRENCH
from palpate.config import StrictConfig
from palpate.errors import PalpateError
from palpate.health import Health
from palpate.messages import Origin, ServiceState
from palpate_gateway.device import Device, DeviceIdentity, DeviceInfo
from palpate_gateway.readings import Reading, WrenchReading
from palpate_gateway.service.pipeline import Pipeline, Put
from palpate_gateway.service.worker import SensorWorker


class Babbler(Device):
    """Its readings alternate between good ones and ones whose serial number does not fit."""

    options_class = StrictConfig

    def __init__(self) -> None:
        super().__init__(DeviceInfo("babbler", None, "a test", 100.0, True, False, Origin.LIVE))
        self.read_so_far = 0

    @property
    def counters(self) -> Mapping[str, int]:
        return {}

    def _open(self) -> DeviceIdentity:
        return DeviceIdentity("x" * 100, 0.01)

    def _close(self) -> None:
        pass

    def _read(self, timeout_s: float) -> list[Reading]:
        self.read_so_far += 1
        serial = "fine" if self.read_so_far % 2 else "x" * 65
        three = np.zeros(3, np.float32)
        time.sleep(1e-3)
        return [WrenchReading(self.read_so_far, time.monotonic(), three, three, serial)]


class Sink:
    def __init__(self) -> None:
        self.payloads: list[bytes] = []

    def put(self, message: Any) -> None:
        self.payloads.append(WRENCH.codec.encode(message))


def test_rejected_frames_are_counted_and_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    device, sink, health, stop = Babbler(), Sink(), Health("gateway", "test"), threading.Event()
    told: list[PalpateError] = []
    fail = health.fail

    def note(error: PalpateError, **how: Any) -> None:
        told.append(error)
        fail(error, **how)

    monkeypatch.setattr(health, "fail", note)
    worker = SensorWorker(
        "w",
        device,
        Pipeline(device.info),
        {WRENCH.name: sink},  # type: ignore[dict-item]
        health,
        pace="recorded",
        stop=stop,
    )
    worker.start()
    deadline = time.monotonic() + 20.0
    while worker.counters().get("frames_rejected", 0) < 10:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    stop.set()
    worker.join(5.0)
    assert worker.crash is None
    assert len(sink.payloads) >= 10
    assert [error.reason for error in told] == ["serial"]  # type: ignore[attr-defined]
    assert "sensor 'w': " in told[0].problem
    assert health.state is ServiceState.DEGRADED
    assert not worker.sound
    assert device.is_open is False


def test_a_name_too_long_for_a_frame_keeps_its_end() -> None:
    with Babbler() as device:
        assert device.identity.serial == "x" * 64


class SlowPipeline(Pipeline):
    """Takes 50 ms to stamp."""

    def push(
        self, readings: Iterable[Reading], arrival_ns: int, put: Put, *, follow_later: bool = False
    ) -> None:
        time.sleep(0.05)
        super().push(readings, arrival_ns, put, follow_later=follow_later)


class Waiter(Babbler):
    """Its readings come after half a second."""

    def _read(self, timeout_s: float) -> list[Reading]:
        time.sleep(0.5)
        return super()._read(timeout_s)


def test_latency_counts_from_the_arrival_of_the_reading() -> None:
    """All that the gateway does with a reading counts, but not the wait for the reading."""
    device, sink, stop = Waiter(), Sink(), threading.Event()
    publishers: Any = {WRENCH.name: sink}
    health = Health("gateway", "test")
    pipeline = SlowPipeline(device.info)
    worker = SensorWorker("w", device, pipeline, publishers, health, pace="recorded", stop=stop)
    worker.start()
    deadline = time.monotonic() + 20.0
    while "publish_p50_s" not in worker.gauges():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    stop.set()
    worker.join(5.0)
    assert 0.05 <= worker.gauges()["publish_p50_s"] < 0.5
