"""One sensor's thread: open, read, publish; and when the device is lost, open again.

Readings that waited, because this process or its host stood still, go out with the times at which
they were sampled, so that consumers see by the stamps that they are old.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from functools import partial
from math import inf
from typing import Any, Literal

from palpate.bus import Publisher, QueryAnswer
from palpate.errors import (
    ClaimedElsewhere,
    DeviceError,
    DeviceLost,
    DeviceTimeout,
    LinkError,
    PalpateError,
)
from palpate.health import Health
from palpate.heartbeat import Turns
from palpate.messages import NO_TARE, Tare, TareRequest, WrenchZero, WrenchZeroRequest
from palpate_gateway.clock.stamps import (
    ArrivalClock,
    ClockMap,
    FileClock,
    LiveClock,
    PacedClock,
    PacedStart,
)
from palpate_gateway.clock.wall_clock import WallClock
from palpate_gateway.device import Device, silence_of
from palpate_gateway.readings import ElectrodeReading, Reading
from palpate_gateway.service.pipeline import Pipeline
from palpate_gateway.service.publication import LATE_S, MessagePublisher
from palpate_gateway.service.requests import SensorRequests
from palpate_gateway.service.sensor_key import SensorKey
from palpate_gateway.service.sensor_report import SensorReport
from palpate_gateway.tare import TARE_LEAST
from palpate_gateway.wrench.device import WrenchDevice
from palpate_gateway.wrench.zeroing import ZERO_LEAST, Zeroing

_log = logging.getLogger(__name__)

BACKOFF_S = (0.2, 0.4)
"""First and longest wait before a lost device is opened again [s]: once it can be, its frames come
again within a second, and finding it takes up to half of that."""

LOST_S = 0.04
"""A live sensor is reported lost when it is silent for longer than this, and for three of its
frames [s]: consumers then know within 50 ms."""

_READ_S = 0.5
_SILENT_READ_S = 0.025
_TURN_S = 2.0
"""A live sensor is read, and its readings published, in far less [s]."""

_STALL_S = 0.02
"""A read that takes longer than it was allowed by more than this [s] shows that the process stood
still; what came meanwhile has not been read yet."""

_SHORTEST_S = 1e-3

_LEAD_S = 0.0018
"""So long before the next frame of a live BioTac is due, the last one is followed up [s]: right
after it was published, services and clients need the cores more."""

_PAUSE_LEAST_S = 0.004
"""Frames that come closer to one another are followed up at once [s]."""

_REMEDY = "look at palpate status; tare when it is back"


class SilenceTimer:
    """Measures for how long a device has been silent, of the time in which this process listened.

    Args:
        lost_s: A silence longer than this is reported [s].
        read_s: How long one read waits during such a silence [s].
    """

    def __init__(self, lost_s: float, read_s: float) -> None:
        self._lost_s, self._read_s = lost_s, read_s
        self.silent_s = 0.0
        """How long nothing came [s]."""
        self._began_s = time.monotonic()
        self._allowed_s = read_s
        self._stalled = False

    @property
    def lost(self) -> bool:
        """Whether the silence is long enough to be reported."""
        return self.silent_s >= self._lost_s

    def begin(self) -> float:
        """A read begins: how long it may wait [s], so that a silence is reported when it is due."""
        left_s = self._lost_s - self.silent_s
        self._allowed_s = max(left_s, _SHORTEST_S) if left_s > 0.0 else self._read_s
        self._began_s = time.monotonic()
        return self._allowed_s

    def arrived(self) -> None:
        """Something came, and was worked off."""
        self.silent_s, self._stalled = 0.0, False

    def timed_out(self) -> None:
        """The read that was begun brought nothing."""
        took_s = time.monotonic() - self._began_s
        # Once only: a driver that always takes too long must not hide that nothing comes.
        if took_s > self._allowed_s + _STALL_S and not self._stalled:
            self._stalled = True
            return
        self.silent_s += took_s


class SensorWorker:
    """Moves one device's readings to the bus until it ends or ``stop`` is set.

    Args:
        name: The sensor's name in keys.
        device: A closed device.
        pipeline: Its pipeline.
        publishers: A publisher for each stream it may publish.
        health: Receives its state and its errors.
        pace: How a recording is paced.
        stop: Ends the thread.
        wall: The wall clock of the process; None = a new one.
        key: The key under which it publishes; None = nobody else can.
        fingers: How many tactile sensors the process reads, all together.
        start: Of a recording at its pace, shared by the sensors of its file; None = it is alone.
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
        key: SensorKey | None = None,
        fingers: int = 1,
        start: PacedStart | None = None,
    ) -> None:
        self.name = name
        self.device = device
        self._start = start or PacedStart()
        self.pipeline = pipeline
        self.error: PalpateError | None = None
        """Why a recording ended early."""
        self.crash: BaseException | None = None
        """A defect that ended the thread."""
        self.serving = False
        """Whether the device is open and has delivered."""
        self.silent = False
        """Whether nothing has come for longer than ``LOST_S``."""
        self.ended = threading.Event()
        """Set when the thread has nothing more to do."""
        self._turns = Turns()
        self._fingers = fingers
        self._calm_s = 0.0
        self._delivered = False
        """Whether readings went out that were not followed up yet."""
        self._hangs = False
        self._health = health
        self._pace = pace
        self._wall = wall or WallClock()
        self._clock_map: ClockMap | None = None
        self._stop = stop
        self._key = key or SensorKey()
        self._publisher = MessagePublisher(
            publishers, health, stop=stop, claim=self._key.check, turns=self._turns, name=name
        )
        self._counters: Counter[str] = Counter()
        self._device_counters: Counter[str] = Counter()
        self._added = False
        """Whether these hold those of the device, which keeps them until it is opened again."""
        self._report = SensorReport(name, health)
        self._wrench = device if isinstance(device, WrenchDevice) else None
        self.zeroing = None if self._wrench is None else Zeroing(name, self._wrench)
        """Takes the zero of a force/torque sensor on request; None = another kind of sensor."""
        rate_hz = device.info.rate_hz
        self._tares: SensorRequests[Tare] = SensorRequests(
            name, what="tare", readings="frames", rate_hz=rate_hz
        )
        self._zeros: SensorRequests[WrenchZero] = SensorRequests(
            name, what="zero", readings="readings", rate_hz=rate_hz
        )
        self._thread = threading.Thread(target=self._run, name=f"sensor {name}", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def join(self, timeout_s: float) -> None:
        """Wait for the thread's end; ``stop`` must be set or the source finite."""
        if self._thread.ident is not None:  # else it was never started
            self._thread.join(timeout_s)

    def counters(self) -> dict[str, int]:
        """Everything counted for this sensor since the start."""
        # Copies: other threads count new events while the counters are added.
        present = dict(self.device.counters)
        device = Counter(self._device_counters) + Counter({} if self._added else present)
        device.pop("frames", None)  # the pipeline counts what was published
        # The pipeline counts the missing frames of every device; adding Counters drops zeros.
        zeros = dict.fromkeys(present.keys() - {"frames"}, 0)
        own = Counter(self._counters) + Counter(self._publisher.counters)
        if self._clock_map is not None:
            own += Counter(self._clock_map.counters)
        return {**zeros, **device, **own, **self.pipeline.counters}

    def gauges(self) -> dict[str, float]:
        """Present measurements: latency, clock, condition."""
        gauges = self._publisher.gauges()
        if self._clock_map is not None:
            gauges.update(self._clock_map.gauges())
        if self.pipeline.condition is not None:
            gauges.update(self.pipeline.condition.gauges())
        return gauges

    @property
    def sound(self) -> bool:
        """Whether it delivers, and nothing that it delivers is known to be wrong."""
        return not (
            self.error or self.silent or self._publisher.has_rejected or self._report.is_wrong
        )

    def hangs(self) -> bool:
        """Whether the thread does not come back, e.g. from its driver."""
        late = self._turns.are_late()
        if late and not self._hangs:
            self._health.fail(
                DeviceError(
                    f"sensor {self.name!r} hangs: its driver does not return",
                    remedy="the gateway is started again by `palpate up`; its log shows where",
                )
            )
        self._hangs = late
        return late

    def _run(self) -> None:
        self._report.starts()
        try:
            self._serve()
        except LinkError as error:
            # Without the bus no sensor can be served: the supervisor restarts the process.
            if not self._stop.is_set():
                self.crash = error
        except PalpateError as error:
            self.error = error
        except BaseException as error:
            # Handed to the main thread, which ends the process: nobody would see a thread die.
            _log.exception("sensor %s: defect", self.name)
            self.crash = error
        finally:
            self.serving = False
            self._start.leave()
            self._give_up("the sensor has ended")
            self._turns.next(LATE_S)
            self.device.close()
            self._turns.next(inf)
            self._report.ended(self.error)
            self.ended.set()

    def _serve(self) -> None:
        backoff_s = BACKOFF_S[0]
        # Before the device is opened: some can serve one process only, and it may be another's.
        while self._key.wait(self._stop, self._is_taken):
            self._turns.next(LATE_S)
            try:
                self.device.open()
                self._added = False
                self._key.opened(self.device.identity.serial)
                if self._clock_map is not None:
                    self._counters += Counter(self._clock_map.counters)
                self._clock_map = self._clock()
                self.pipeline.begin(self.device.identity, self._clock_map)
                self._calm_s, self._delivered = self._calm(), False
                if self._pump():
                    return
            except ClaimedElsewhere as error:
                if not self.device.info.live:
                    raise
                self.serving = self.silent = False
                self._counters["taken_over"] += 1
                self._is_taken(error)
                self._give_up(error.problem)
            except DeviceError as error:
                if not self.device.info.live:
                    self.pipeline.finish(self._publisher.put)
                    raise
                if self.serving:
                    backoff_s = BACKOFF_S[0]
                    self._counters["device_lost"] += 1
                self.serving = self.silent = False
                self._report.is_lost(error, backoff_s)
                self._give_up(error.problem)
            if not self._added:
                self._device_counters += Counter(self.device.counters)
                self._added = True
            self._turns.next(LATE_S)
            self.device.close()
            self._turns.next(inf)  # another gateway may hold the key for as long as it likes
            self._stop.wait(backoff_s)
            backoff_s = min(2.0 * backoff_s, BACKOFF_S[1])

    def _is_taken(self, error: ClaimedElsewhere) -> None:
        """Another gateway publishes under its key; it may have taken the zero, and a load since."""
        self._report.is_taken(error)
        if self._wrench is not None:
            self._wrench.expect_load()

    def _clock(self) -> ClockMap:
        identity = self.device.identity
        if self.device.info.live:
            return (LiveClock if identity.has_clock else ArrivalClock)(self._wall)
        if self._pace == "recorded":
            return PacedClock(self._start)
        return FileClock(identity.serial, identity.start_wall_ns)

    def _pump(self) -> bool:
        """Read and publish; True when a finite source has ended or ``stop`` is set."""
        info = self.device.info
        read_s = _SILENT_READ_S if info.live else _READ_S
        silence = SilenceTimer(max(LOST_S, 3.0 / info.rate_hz) if info.live else inf, read_s)
        before: dict[str, int] = {}
        turn_s = _TURN_S + self._key.patience_s if info.live else LATE_S
        while not self._stop.is_set():
            self._turns.next(turn_s)
            readings, timeout = None, None
            try:
                readings = self._read(min(silence.begin(), _READ_S))
            except DeviceTimeout as error:
                timeout = error
            heard = readings is not None and self._is_heard(readings)
            if not heard:
                if not silence.silent_s:
                    before = dict(self.device.counters)
                silence.timed_out()
                if info.live and silence.silent_s >= self.device.gone_s:
                    problem, remedy = silence_of(
                        f"sensor {self.name!r}",
                        self.device.gone_s,
                        self.device.counters,
                        before,
                        "check its power and cable; it is opened again by itself",
                    )
                    raise DeviceLost(problem, remedy=remedy) from timeout
                if silence.lost and self.serving and not self.silent:
                    self.silent = True
                    self._counters["silences"] += 1
                    self._report.is_silent(silence.silent_s)
            if readings is None:
                continue
            read_ns = time.monotonic_ns()
            self.silent = self.silent and not heard
            if not readings:
                self.pipeline.finish(self._publisher.put)
                self._report.tare_refused(self.pipeline.tare_error)
                return True
            if self._delivered:  # these came early
                self._follow_up()
            put = partial(self._publisher.put, read_ns=read_ns)
            self.pipeline.push(readings, read_ns, put, follow_later=self._calm_s > 0.0)
            self._health.worked()
            self.serving, self._delivered = self.serving or heard, True
            if self.zeroing is not None:
                self._turns.next(LATE_S)
                self.zeroing.follow(readings)
            if not self._calm_s:
                self._follow_up()
            if heard:
                silence.arrived()
        return True

    def _is_heard(self, readings: list[Reading]) -> bool:
        """Whether these show that the sensor lives: of a finger, its frames, and nothing else."""
        if not readings or not self.device.info.live or self.pipeline.condition is None:
            return True
        return any(isinstance(one, ElectrodeReading) for one in readings)

    def _calm(self) -> float:
        """How long after a frame the thread leaves the cores to others [s]; 0 = not at all."""
        info = self.device.info
        period_s = 1.0 / info.rate_hz
        if not info.live or self.pipeline.condition is None:
            return 0.0
        # With many fingers, one's calm is another's frame.
        return period_s - _LEAD_S if period_s >= self._fingers * _PAUSE_LEAST_S else 0.0

    def _read(self, timeout_s: float) -> list[Reading]:
        """The next readings; shortly before they are due, the last ones are followed up."""
        if not self._delivered or self._calm_s >= timeout_s:
            return self.device.read(timeout_s)
        try:
            return self.device.read(self._calm_s)
        except DeviceTimeout:
            self._follow_up()
            self._publisher.rehearse()
        return self.device.read(timeout_s - self._calm_s)

    def _follow_up(self) -> None:
        """What can wait of the work for the last readings: condition, tares, status."""
        self._delivered = False
        self.pipeline.follow_up(self._publisher.put)
        self._report.tare_refused(self.pipeline.tare_error)
        if self.serving and not self.silent:
            lost = self._wrench is not None and self._wrench.zero_lost
            self._report.delivers(self.pipeline.condition, zero_lost=lost)

    def _give_up(self, why: str) -> None:
        """Fail the requests: they must not wait for a sensor that is gone."""
        self.pipeline.give_up(why)
        if self.zeroing is not None:
            self.zeroing.give_up(why)

    def answer_tare(self, request: TareRequest, answer: QueryAnswer[Tare], caller: str) -> None:
        """Look a tare up at once, or tare with the next frames; may be called from any thread.

        ``caller`` is the ``caller_key`` of the caller, empty = it has none.

        Raises:
            RemoteError: The id is not known (NOT_FOUND), too many frames are wanted
                (INVALID_REQUEST), or too many requests wait (RESOURCE_EXHAUSTED).
            DeviceError: The sensor does not deliver.
        """
        if request.tare_id != NO_TARE:
            answer.send(self.pipeline.ledger.find(request.tare_id))
            answer.end()
            return
        usual = self.pipeline.tare_frames
        frames = self._tares.check_count(request.frames, least=TARE_LEAST, usual=usual)
        self._check_serving()
        self._tares.serve(
            answer,
            lambda: self.pipeline.ask_tare(frames, anyway=request.anyway),
            caller=caller,
            readings=frames,
            in_turn=False,
            slack_s=2.0 + frames / self.device.info.rate_hz,
        )

    def answer_zero(
        self, request: WrenchZeroRequest, answer: QueryAnswer[WrenchZero], caller: str
    ) -> None:
        """Take the load of a force/torque sensor as zero; as ``answer_tare`` otherwise."""
        assert self.zeroing is not None, "only a force/torque sensor has a zero"
        zeroing = self.zeroing
        count = self._zeros.check_count(request.readings, least=ZERO_LEAST, usual=zeroing.usual)
        self._check_serving()
        self._zeros.serve(
            answer,
            lambda: zeroing.ask(count),
            caller=caller,
            readings=2 * count,
            in_turn=True,
            slack_s=10.0 + 2.0 * count / self.device.info.rate_hz,
        )

    def caller_gone(self, caller: str, when_s: float) -> None:
        """Drop the requests of a caller that has left; see ``Session.watch_callers``."""
        self._tares.caller_gone(caller, when_s)
        self._zeros.caller_gone(caller, when_s)

    def _check_serving(self) -> None:
        if not self.serving:
            raise DeviceError(f"sensor {self.name!r} does not deliver at present", remedy=_REMEDY)
