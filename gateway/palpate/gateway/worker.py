"""One sensor's thread: open, read, publish; and when the device is lost, open again."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from typing import Any, Literal

from palpate.gateway.device import Device
from palpate.gateway.pipeline import Outgoing, Pipeline
from palpate.gateway.timing.clock_map import ClockMap, FileClock, LiveClock, PacedClock
from palpate.protos.errors import (
    DeviceError,
    DeviceLost,
    DeviceTimeout,
    ErrorCode,
    LinkError,
    PalpateError,
    RemoteError,
    WireError,
)
from palpate.protos.health import Health
from palpate.protos.messages import NO_TARE, Tare, TareRequest
from palpate.protos.session import Publisher

_log = logging.getLogger(__name__)

BACKOFF_S = (0.2, 1.0)
"""First and longest wait before a lost device is opened again [s]."""

LOST_S = 0.05
"""A live sensor that is silent for longer, and for three of its frames, is said to be lost [s]."""

_READ_S = 0.5
_GONE_S = 2.0
"""A live device that has been silent for so long is closed and opened again."""

_ENCODERS_DECIDE = "the frame was not published; this is a defect of the device driver"


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
        self._publishers = publishers
        self._health = health
        self._pace = pace
        self._stop = stop
        self._counters: Counter[str] = Counter()
        self._device_counters: Counter[str] = Counter()
        self._tare_error: DeviceError | None = None
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
        return {**zeros, **device, **self._counters, **self.pipeline.counters}

    def tare(self, request: TareRequest) -> Tare:
        """Answer a tare request: look one up, or tare with the next frames.

        Raises:
            RemoteError: The id is not known (NOT_FOUND).
            DeviceError: The sensor does not deliver, is touched, or a channel is invalid.
        """
        if request.tare_id != NO_TARE:
            return self.pipeline.ledger.find(request.tare_id)
        if not self.serving:
            raise DeviceError(
                f"sensor {self.name!r} does not deliver at present",
                remedy="look at palpate status; tare when it is back",
            )
        frames = request.frames or self.pipeline.tare_frames
        wait_s = 2.0 + 2.0 * frames / self.device.info.rate_hz
        future = self.pipeline.ask_tare(request.frames)
        try:
            return future.result(timeout=wait_s)
        except TimeoutError as error:
            if isinstance(error, PalpateError):
                raise
            future.cancel()
            raise RemoteError(
                f"sensor {self.name!r} did not deliver {frames} good frames within {wait_s:.1f} s",
                remedy="look at palpate status; tare when it is back",
                code=ErrorCode.DEADLINE_EXCEEDED,
                retry_after_s=1.0,
            ) from error

    def _run(self) -> None:
        try:
            self._serve()
        except LinkError as error:
            # Without the bus no sensor can be served: the supervisor starts the process afresh.
            if not self._stop.is_set():
                self.crash = error
        except PalpateError as error:
            self._fail(error)
        except BaseException as error:
            # Carried to the main thread, which ends the process; a thread would die unseen.
            _log.exception("sensor %s: defect", self.name)
            self.crash = error
        finally:
            self.serving = False
            self.device.close()
            self.ended.set()

    def _serve(self) -> None:
        backoff_s = BACKOFF_S[0]
        while not self._stop.is_set():
            try:
                self.device.open()
                self.pipeline.begin(self.device.identity, self._clock())
                if self._pump():
                    return
            except DeviceError as error:
                if not self.device.info.live:
                    self._publish(self.pipeline.finish())
                    raise
                if self.serving:
                    backoff_s = BACKOFF_S[0]
                self.serving = self.silent = False
                self._counters["device_lost"] += 1
                self._health.fail(error)
                _log.warning(
                    "sensor %s lost, open again in %.1f s: %s", self.name, backoff_s, error
                )
            self._device_counters += Counter(self.device.counters)
            self.device.close()
            self._stop.wait(backoff_s)
            backoff_s = min(2.0 * backoff_s, BACKOFF_S[1])

    def _clock(self) -> ClockMap:
        if self.device.info.live:
            return LiveClock()
        if self._pace == "recorded":
            return PacedClock()
        identity = self.device.identity
        return FileClock(identity.serial, identity.start_wall_ns)

    def _pump(self) -> bool:
        """Read and publish; True when a finite source has ended or ``stop`` is set."""
        info = self.device.info
        lost_s = max(LOST_S, 3.0 / info.rate_hz)
        read_s = lost_s / 2.0 if info.live else _READ_S
        heard_s = time.monotonic()
        while not self._stop.is_set():
            try:
                readings = self.device.read(read_s)
            except DeviceTimeout as error:
                silent_s = time.monotonic() - heard_s
                if info.live and silent_s >= _GONE_S:
                    raise DeviceLost(
                        f"sensor {self.name!r} has been silent for {silent_s:.1f} s",
                        remedy="check its power and cable; it is opened again by itself",
                    ) from error
                if info.live and silent_s >= lost_s:
                    self._note_silence(silent_s)
                continue
            heard_s = time.monotonic()
            self.silent = False
            if not readings:
                self._publish(self.pipeline.finish())
                self._note_tare()
                return True
            self._publish(self.pipeline.push(readings, time.monotonic_ns()))
            self._note_tare()
            self.serving = True
        return True

    def _note_silence(self, silent_s: float) -> None:
        """Tell once of a silence."""
        if self.silent or not self.serving:
            return
        self.silent = True
        self._counters["silences"] += 1
        self._health.fail(
            DeviceTimeout(
                f"sensor {self.name!r} is lost: silent for {1e3 * silent_s:.0f} ms",
                remedy="check its power and cable; it is read on by itself",
            )
        )

    def _publish(self, items: list[Outgoing]) -> None:
        for item in items:
            if item.due_ns:
                wait_s = (item.due_ns - time.monotonic_ns()) * 1e-9
                if wait_s > 0 and self._stop.wait(wait_s):
                    return
            publisher = self._publishers[item.topic]
            try:
                if isinstance(item.message, bytes):
                    publisher.put_payload(item.message)
                else:
                    publisher.put(item.message)
            except WireError as error:
                self._counters["frames_rejected"] += 1
                self._health.fail(
                    WireError(error.problem, remedy=_ENCODERS_DECIDE, reason=error.reason)
                )

    def _note_tare(self) -> None:
        """Tell once of a refused tare."""
        error = self.pipeline.tare_error
        if error is not self._tare_error:
            self._tare_error = error
            if error is not None:
                self._health.fail(error, degraded=False)
                _log.warning("sensor %s: %s", self.name, error)

    def _fail(self, error: PalpateError) -> None:
        self.error = error
        self._health.fail(error)
        _log.error("sensor %s: %s", self.name, error)
