"""A device for benchmarks: prepared frames at absolute deadlines, so that it needs no CPU time."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

from pydantic import Field

from palpate.config import StrictConfig
from palpate.errors import DeviceTimeout
from palpate.messages import PAC_SAMPLES, Origin, SensorType
from palpate_deploy.bench.harness import KINDS, SERIAL, SLOTS, SourceGate, bench_counts
from palpate_gateway.device import Device, DeviceIdentity, DeviceInfo
from palpate_gateway.readings import ElectrodeReading, Reading


class BenchOptions(StrictConfig):
    """Options of the benchmark's device.

    ``phase`` shifts its frames by a share of their period, so that those of many sensors do not
    coincide; it ends after ``frames``, 0 = never; the file ``gate``, by its byte ``gate_index``,
    pauses it.
    """

    rate_hz: float = Field(default=100.0, ge=1)
    phase: float = Field(default=0.0, ge=0, lt=1)
    frames: int = Field(default=0, ge=0)
    gate: Path | None = None
    gate_index: int = 0


class BenchDevice(Device):
    """Sends prepared frames at absolute deadlines while its gate is open."""

    options_class = BenchOptions

    def __init__(self, options: BenchOptions) -> None:
        super().__init__(
            DeviceInfo(
                driver="bench",
                sensor_type=SensorType.BIOTAC,
                model="prepared frames",
                rate_hz=options.rate_hz,
                live=True,
                finite=options.frames > 0,
                origin=Origin.SIMULATED,
            )
        )
        self._options = options
        self._period_s = 1 / options.rate_hz
        self._gate = None if options.gate is None else SourceGate(options.gate, options.gate_index)
        self._counts = bench_counts()
        self._sent = 0
        self._due_s: float | None = None

    @property
    def counters(self) -> Mapping[str, int]:
        """Frames delivered."""
        return {"frames": self._sent}

    def _open(self) -> DeviceIdentity:
        return DeviceIdentity(SERIAL, self._period_s / SLOTS)

    def _close(self) -> None:
        self._due_s = None

    def _read(self, timeout_s: float) -> list[Reading]:
        if self._options.frames and self._sent >= self._options.frames:
            return []
        if self._gate is not None and not self._gate.is_open:
            self._gate.wait()
            self._due_s = None
        if self._due_s is None:
            self._due_s = time.monotonic() + self._period_s * (1 + self._options.phase)
        wait_s = self._due_s - time.monotonic()
        if wait_s > timeout_s:
            time.sleep(timeout_s)
            raise DeviceTimeout("not due yet", remedy="wait longer")
        if wait_s > 0:
            time.sleep(wait_s)
        due_s, self._due_s = self._due_s, self._due_s + self._period_s
        counts = self._counts[self._sent % KINDS]
        self._sent += 1
        return [
            ElectrodeReading(
                tick=self._sent,
                time_s=due_s,
                missed_before=0,
                electrodes=counts[:19],
                pdc=int(counts[19]),
                pac=counts[20 : 20 + PAC_SAMPLES],
                tac=int(counts[42]),
                tdc=int(counts[43]),
                validity=(1 << SLOTS) - 1,
            )
        ]
