"""One sensor's thread: open, read, publish; and when the device is lost, open again.

Readings that waited, because this process or its host stood still, go out with the times at which
they were taken: who reads them tells by their stamps that they are old.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from math import inf
from typing import Any, Literal

from palpate.bus import Publisher
from palpate.errors import (
    DeviceError,
    DeviceLost,
    DeviceTimeout,
    LinkError,
    PalpateError,
)
from palpate.health import Health
from palpate_gateway.device import Device
from palpate_gateway.outlet import Outlet
from palpate_gateway.pipeline import Pipeline
from palpate_gateway.sensor_report import SensorReport
from palpate_gateway.timing.clock_map import (
    ArrivalClock,
    ClockMap,
    FileClock,
    LiveClock,
    PacedClock,
)
from palpate_gateway.timing.listening import Listening
from palpate_gateway.timing.wall_clock import WallClock
from palpate_gateway.wrench.device import WrenchDevice
from palpate_gateway.wrench.zeroing import Zeroing

_log = logging.getLogger(__name__)

BACKOFF_S = (0.2, 0.4)
"""First and longest wait before a lost device is opened again [s]: once it can be, its frames come
again within a second, and finding it takes up to half of that."""

LOST_S = 0.04
"""A live sensor that is silent for longer, and for three of its frames, is said to be lost [s]: so
that who listens knows within 50 ms."""

_READ_S = 0.5
_SILENT_READ_S = 0.025


class SensorWorker:
    """Moves one device's readings to the bus until it ends or ``stop`` is set.

    Args:
        name: The sensor's name in keys.
        device: A closed device.
        pipeline: Its pipeline.
        publishers: A publisher for each stream it may publish.
        health: Told of errors.
        pace: How a recording is paced.
        stop: Ends the thread.
        wall: The wall clock of the process; None = one of its own.
        claim: Called with the name of its stream before each message; raises where another sensor
            publishes that.
    """

    def __init__(
        self,
        name: str,
        device: Device,
        pipeline: Pipeline,
        publishers: dict[str, Publisher[Any]],
        health: Health,
        *,
        pace: Literal["recorded", "fast"],
        stop: threading.Event,
        wall: WallClock | None = None,
        claim: Callable[[str], None] = lambda stream: None,
    ) -> None:
        self.name = name
        self.device = device
        self.pipeline = pipeline
        self.error: PalpateError | None = None
        """Why a recording ended early."""
        self.crash: BaseException | None = None
        """A defect that ended the thread."""
        self.serving = False
        """Whether the device is open and has delivered."""
        self.silent = False
        """Whether it has stopped to deliver, for longer than ``LOST_S``."""
        self.ended = threading.Event()
        """Set when the thread has nothing more to do."""
        self._health = health
        self._pace = pace
        self._wall = wall or WallClock()
        self._clock_map: ClockMap | None = None
        self._stop = stop
        self._outlet = Outlet(publishers, health, stop=stop, claim=claim)
        self._counters: Counter[str] = Counter()
        self._device_counters: Counter[str] = Counter()
        self._report = SensorReport(name, health)
        self._wrench = device if isinstance(device, WrenchDevice) else None
        self.zeroing = None if self._wrench is None else Zeroing(name, self._wrench)
        """Takes the zero of a force/torque sensor when asked; None = it is none."""
        self._thread = threading.Thread(target=self._run, name=f"sensor {name}", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def join(self, timeout_s: float) -> None:
        """Wait for the thread's end; ``stop`` must be set or the source finite."""
        self._thread.join(timeout_s)

    def counters(self) -> dict[str, int]:
        """Everything counted for this sensor since the start."""
        device = self._device_counters + Counter(self.device.counters)
        device.pop("frames", None)  # the pipeline counts what was published
        # The pipeline's word on missing frames covers every device; Counter drops zeros.
        zeros = dict.fromkeys(self.device.counters.keys() - {"frames"}, 0)
        own = self._counters + self._outlet.counters
        return {**zeros, **device, **own, **self.pipeline.counters}

    def gauges(self) -> dict[str, float]:
        """What is measured of this sensor at present."""
        gauges = self._outlet.gauges()
        if self._clock_map is not None:
            gauges.update(self._clock_map.gauges())
        if self.pipeline.condition is not None:
            gauges.update(self.pipeline.condition.gauges())
        return gauges

    @property
    def sound(self) -> bool:
        """Whether it delivers, as far as it should, and nothing that is known to be wrong."""
        return not (self.error or self.silent or self._outlet.refuses or self._report.untrue)

    def _run(self) -> None:
        self._report.starts()
        try:
            self._serve()
        except LinkError as error:
            # Without the bus no sensor can be served: the supervisor starts the process afresh.
            if not self._stop.is_set():
                self.crash = error
        except PalpateError as error:
            self.error = error
        except BaseException as error:
            # Carried to the main thread, which ends the process; a thread would die unseen.
            _log.exception("sensor %s: defect", self.name)
            self.crash = error
        finally:
            self.serving = False
            self._give_up("the sensor has ended")
            self.device.close()
            self._report.ended(self.error)
            self.ended.set()

    def _serve(self) -> None:
        backoff_s = BACKOFF_S[0]
        while not self._stop.is_set():
            try:
                self.device.open()
                self._clock_map = self._clock()
                self.pipeline.begin(self.device.identity, self._clock_map)
                if self._pump():
                    return
            except DeviceError as error:
                if not self.device.info.live:
                    self._outlet.put(self.pipeline.finish())
                    raise
                if self.serving:
                    backoff_s = BACKOFF_S[0]
                self.serving = self.silent = False
                self._counters["device_lost"] += 1
                self._report.is_lost(error, backoff_s)
                self._give_up(error.problem)
            self._device_counters += Counter(self.device.counters)
            self.device.close()
            self._stop.wait(backoff_s)
            backoff_s = min(2.0 * backoff_s, BACKOFF_S[1])

    def _clock(self) -> ClockMap:
        identity = self.device.identity
        if self.device.info.live:
            tells_time = identity.tells_time
            return LiveClock(self._wall) if tells_time else ArrivalClock(self._wall)
        if self._pace == "recorded":
            return PacedClock()
        return FileClock(identity.serial, identity.start_wall_ns)

    def _pump(self) -> bool:
        """Read and publish; True when a finite source has ended or ``stop`` is set."""
        info = self.device.info
        read_s = _SILENT_READ_S if info.live else _READ_S
        listening = Listening(max(LOST_S, 3.0 / info.rate_hz) if info.live else inf, read_s)
        while not self._stop.is_set():
            try:
                readings = self.device.read(min(listening.begin(), _READ_S))
            except DeviceTimeout as error:
                listening.heard_nothing()
                if info.live and listening.silent_s >= self.device.gone_s:
                    raise DeviceLost(
                        f"sensor {self.name!r} has been silent for {listening.silent_s:.1f} s",
                        remedy="check its power and cable; it is opened again by itself",
                    ) from error
                if listening.lost and self.serving and not self.silent:
                    self.silent = True
                    self._counters["silences"] += 1
                    self._report.is_silent(listening.silent_s)
                continue
            read_ns = time.monotonic_ns()
            self.silent = False
            if not readings:
                self._outlet.put(self.pipeline.finish())
                self._report.tare_refused(self.pipeline.tare_error)
                return True
            self._outlet.put_read(self.pipeline.push(readings, read_ns), read_ns)
            self._report.tare_refused(self.pipeline.tare_error)
            self.serving = True
            if self.zeroing is not None:
                self.zeroing.follow(readings)
            lost = self._wrench is not None and self._wrench.zero_lost
            self._report.delivers(self.pipeline.condition, zero_lost=lost)
            listening.heard()
        return True

    def _give_up(self, why: str) -> None:
        """Who waits for a zero must not wait for a sensor that is gone."""
        if self.zeroing is not None:
            self.zeroing.give_up(why)
