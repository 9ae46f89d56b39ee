"""A live BioTac's frame goes out first; what can wait is done shortly before the next is due."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pytest

from palpate.bus.topics import ELECTRODES, TARE
from palpate.config import StrictConfig
from palpate.errors import DeviceTimeout
from palpate.health import Health
from palpate.messages import Origin, SensorState, SensorType
from palpate_gateway.device import Device, DeviceIdentity, DeviceInfo
from palpate_gateway.readings import ElectrodeReading, Reading
from palpate_gateway.service.pipeline import Pipeline, Put
from palpate_gateway.service.worker import SensorWorker

RATE_HZ = 100.0
FRAMES = 5


class Prompt(Device):
    """Each frame comes when a read has timed out once, or without a pause; then it ends."""

    options_class = StrictConfig

    def __init__(self, events: list[str], *, pauses: bool) -> None:
        kind = SensorType.BIOTAC
        super().__init__(DeviceInfo("prompt", kind, "a test", RATE_HZ, True, True, Origin.LIVE))
        self._events, self._pauses = events, pauses
        self._reads = 0

    @property
    def counters(self) -> Mapping[str, int]:
        return {}

    def _open(self) -> DeviceIdentity:
        return DeviceIdentity("BT1", 1 / 4400)

    def _close(self) -> None:
        pass

    def _read(self, timeout_s: float) -> list[Reading]:
        self._reads += 1
        if self._pauses and self._reads % 2 == 0:
            self._events.append("pause")
            assert timeout_s < 1.0 / RATE_HZ
            raise DeviceTimeout("not yet", remedy="wait")
        frame = (self._reads + 1) // 2 if self._pauses else self._reads
        if frame > FRAMES:
            return []
        counts = np.full(19, 2000, np.uint16)
        pac = np.full(22, 2040, np.uint16)
        now_s = time.monotonic()
        return [ElectrodeReading(frame, now_s, 0, counts, 2400, pac, 2050, 1900, (1 << 44) - 1)]


class Noted(Pipeline):
    """Notes what is done, in order."""

    def __init__(self, info: DeviceInfo, events: list[str]) -> None:
        super().__init__(info, tare="query")
        self._events = events

    def push(
        self, readings: Iterable[Reading], arrival_ns: int, put: Put, *, follow_later: bool = False
    ) -> None:
        super().push(readings, arrival_ns, put, follow_later=follow_later)
        self._events.append("frame")

    def _watch(self, frame: Any) -> None:
        super()._watch(frame)
        self._events.append("judged")


class Sink:
    def __init__(self, events: list[str]) -> None:
        self._events = events

    def put(self, message: Any) -> None:
        self._events.append("published")

    def encode(self, message: Any) -> bytes:
        self._events.append("rehearsed")
        return b""


@pytest.mark.parametrize("pauses", [True, False])
def test_the_frame_first_and_the_rest_before_the_next_one(
    monkeypatch: pytest.MonkeyPatch, *, pauses: bool
) -> None:
    events: list[str] = []
    device, stop = Prompt(events, pauses=pauses), threading.Event()
    publishers: Any = dict.fromkeys((ELECTRODES.name, TARE.name), Sink(events))
    health = Health("gateway", "test")
    states: list[SensorState] = []
    show = health.set_sensor_state

    def note(name: str, state: SensorState, **how: Any) -> None:
        states.append(state)
        show(name, state, **how)

    monkeypatch.setattr(health, "set_sensor_state", note)
    worker = SensorWorker(
        "w", device, Noted(device.info, events), publishers, health, pace="recorded", stop=stop
    )
    worker.start()
    assert worker.ended.wait(20.0)
    assert worker.error is None
    assert worker.crash is None
    between = ["pause", "judged", "rehearsed"] if pauses else ["judged"]
    published = ["published", "frame"]
    if pauses:
        assert events == (published + between) * FRAMES
    else:  # the frame before is followed up when the next one has come, before that is stamped
        assert events == published + (between + published) * (FRAMES - 1) + between
    assert states[0] is SensorState.STARTING
    assert states[1] in (SensorState.LIVE, SensorState.WARMING), "told in either case"
