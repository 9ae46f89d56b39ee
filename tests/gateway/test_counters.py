"""Each event is counted once, however often a device is lost and looked for."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from palpate.bus.topics import ELECTRODES, TARE
from palpate.config import StrictConfig
from palpate.errors import DeviceError, DeviceLost
from palpate.health import Health
from palpate.messages import Origin, SensorType
from palpate_gateway.device import Device, DeviceIdentity, DeviceInfo
from palpate_gateway.readings import ElectrodeReading, Reading
from palpate_gateway.service import worker as served
from palpate_gateway.service.pipeline import Pipeline
from palpate_gateway.service.worker import SensorWorker

FRAMES = 5
ATTEMPTS = 4
"""The device is lost after its first opening, cannot be opened, then it can, and it ends."""


class ComesAndGoes(Device):
    """Counts from the last success on; as some drivers do, it keeps its counts when it is away."""

    options_class = StrictConfig

    def __init__(self) -> None:
        info = DeviceInfo("goes", SensorType.BIOTAC, "a test", 100.0, True, True, Origin.LIVE)
        super().__init__(info)
        self.worker: SensorWorker | None = None
        self.seen: list[int] = []
        self._attempts = self._count = 0

    @property
    def counters(self) -> Mapping[str, int]:
        return {"samples": self._count, "never": 0}

    def _open(self) -> DeviceIdentity:
        self._look()
        self._attempts += 1
        if 1 < self._attempts < ATTEMPTS:
            raise DeviceError("it is away", remedy="wait")
        self._count = 0
        return DeviceIdentity("BT1", 1 / 4400)

    def _close(self) -> None:
        self._look()

    def _look(self) -> None:
        assert self.worker is not None
        self.seen.append(self.worker.counters()["samples"])

    def _read(self, timeout_s: float) -> list[Reading]:
        if self._count == FRAMES:
            if self._attempts == 1:
                raise DeviceLost("it is gone", remedy="wait")
            return []
        self._count += 1
        counts, pac = np.full(19, 2000, np.uint16), np.full(22, 2040, np.uint16)
        now_s = time.monotonic()
        n = self._count
        return [ElectrodeReading(n, now_s, 0, counts, 2400, pac, 2050, 1900, (1 << 44) - 1)]


class Sink:
    def put(self, message: Any) -> None:
        pass

    def encode(self, message: Any) -> bytes:
        return b""


@pytest.fixture
def worker(monkeypatch: pytest.MonkeyPatch) -> SensorWorker:
    monkeypatch.setattr(served, "BACKOFF_S", (0.01, 0.01))
    device = ComesAndGoes()
    publishers: Any = dict.fromkeys((ELECTRODES.name, TARE.name), Sink())
    device.worker = SensorWorker(
        "w", device, Pipeline(device.info), publishers, Health("gateway", "test"),
        pace="recorded", stop=threading.Event(),
    )  # fmt: skip
    return device.worker


def test_a_device_that_is_away_counts_nothing_again(worker: SensorWorker) -> None:
    worker.start()
    assert worker.ended.wait(20.0)
    assert worker.crash is None
    assert isinstance(worker.device, ComesAndGoes)
    # At the first opening; when it is lost and at each attempt; at the end.
    assert worker.device.seen == [0] + [FRAMES] * ATTEMPTS + [2 * FRAMES]
    counters = worker.counters()
    assert (counters["samples"], counters["never"]) == (2 * FRAMES, 0)
    assert counters["device_lost"] == 1, "attempts that fail lose nothing"


class Busy(Counter[str]):
    """Its thread counts something new while another one looks through it."""

    def items(self) -> Iterator[tuple[str, int]]:  # type: ignore[override]
        for item in super().items():
            self[f"new {len(self)}"] += 1
            yield item


@pytest.mark.parametrize("name", ["_counters", "_device_counters"])
def test_they_are_told_while_something_new_is_counted(worker: SensorWorker, name: str) -> None:
    setattr(worker, name, Busy(silences=1))
    assert worker.counters()["silences"] == 1
