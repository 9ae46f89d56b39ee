"""Health of a process: its counters, gauges and state, and the states of its sensors.

Published once a second and on each change of state, and given when asked. Bad news is told at once;
a trouble is over only when it has stayed away for a while, so that no state flaps.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from palpate import __version__, clock
from palpate.bus import Session, endpoints
from palpate.bus.queryable import error_reply
from palpate.bus.topics import STATUS as STATUS_TOPIC
from palpate.errors import PalpateError
from palpate.messages import (
    GAUGE_MAX,
    ChannelFault,
    ErrorReply,
    SensorState,
    SensorStatus,
    ServiceState,
    Status,
    SupervisedProcess,
)
from palpate.process import Closing, ProcessUsage

_log = logging.getLogger(__name__)


RECOVERY_S = 1.0
"""A degraded process is ready again when nothing has failed for this long [s]."""

SENSOR_RECOVERY_S = 0.5
"""A lost sensor is live again when it has delivered for this long without a silence [s]."""

_APART_S = 5e-3
"""Least time between two statuses [s]: changes that come together share one."""

_BURST = 5
_CHANGES_HZ = 5.0
"""So many statuses are sent at once one after another, and so many a second in the long run [Hz],
however fast states change."""

_LULL_MOST_S = 0.015
"""A regular report waits this long for a lull at most [s]: frames come every 10 ms."""

_AFTERWARDS_S = 0.002
"""So long after its work on a message a process leaves the cores to those that wait for it [s]."""

_DELIVERING = frozenset({SensorState.LIVE, SensorState.WARMING, SensorState.ZERO_LOST})


class Health:
    """Counters, gauges and state of one process. Safe to use from several threads.

    Per-frame events are counters here, not log lines.
    """

    def __init__(self, service: str, instance: str) -> None:
        self.service = service
        self.instance = instance
        self._lock = threading.Lock()
        self._counters: Counter[str] = Counter()
        self._gauges: dict[str, float] = {}
        self._sources: dict[str, frozenset[str]] = {}
        self._odd_gauges: set[str] = set()
        self._state = ServiceState.STARTING
        self._message = self._state_message = ""
        self._last_error: ErrorReply | None = None
        self._state_error: ErrorReply | None = None  # which made the state DEGRADED
        self._recovery: tuple[float, str] | None = None  # since when all is well, and the message
        self._sensors: tuple[str, ...] = ()
        self._sensor_states: dict[str, SensorStatus] = {}
        self._sensor_recovery: dict[str, SensorStatus] = {}
        self._processes: tuple[SupervisedProcess, ...] = ()
        self._models: tuple[str, ...] = ()
        self._usage = ProcessUsage()
        self._started = time.monotonic()
        self._version = __version__
        self.changed = threading.Event()
        """Set when the state changed, so that the reporter publishes it at once."""
        # What wakes the waiting reporter, and when it will wake by itself [s, monotonic].
        self._stirred = threading.Event()
        self._wakes_s = math.inf
        self._worked = threading.Event()

    def worked(self) -> None:
        """The process has just done its work on a message; others may wait for the result."""
        if not self._worked.is_set():
            self._worked.set()

    def await_lull(self) -> None:
        """Wait until regular work that can wait disturbs no message; not for long."""
        self._worked.clear()
        if self._worked.wait(_LULL_MOST_S):
            time.sleep(_AFTERWARDS_S)

    def tell(self) -> None:
        """Have the reporter publish at once."""
        self.changed.set()
        self._stirred.set()

    def await_change(self, timeout_s: float) -> bool:
        """Wait until something changed, the end of a trouble included; False = nothing did."""
        until_s = time.monotonic() + timeout_s
        while True:
            self._stirred.clear()
            due_s = self.settle()
            now_s = time.monotonic()
            if self.changed.is_set() or now_s >= until_s:
                return self.changed.is_set()
            self._wakes_s = until_s if due_s is None else min(until_s, now_s + due_s)
            self._stirred.wait(self._wakes_s - now_s)
            self._wakes_s = math.inf

    def _wake_by(self, due_s: float) -> None:
        """Have the reporter awake when a trouble is over; the caller holds the lock.

        It is woken only if it would sleep for longer: a trouble may begin to end a hundred times a
        second.

        Args:
            due_s: When it is over at the earliest [s, monotonic].
        """
        if due_s < self._wakes_s:
            self._stirred.set()

    def count(self, name: str, by: int = 1) -> None:
        """Add to a counter."""
        with self._lock:
            self._counters[name] += by

    def set_counts(self, counts: Mapping[str, int]) -> None:
        """Take over totals that are counted elsewhere, e.g. by a subscriber or a device."""
        with self._lock:
            self._counters.update({k: v - self._counters[k] for k, v in counts.items()})

    def gauge(self, name: str, value: float) -> None:
        """Set a gauge; its name ends in the unit.

        A value beyond ``GAUGE_MAX``, or NaN, takes the gauge away and is counted as
        ``gauges_not_finite``.
        """
        with self._lock:
            self._set_gauges({name: value})

    def set_gauges(self, source: str, gauges: Mapping[str, float]) -> None:
        """Set all gauges of a source, e.g. a sensor; those that it had and has no more are gone."""
        with self._lock:
            for name in self._sources.get(source, frozenset()) - gauges.keys():
                self._gauges.pop(name, None)
            self._sources[source] = frozenset(gauges)
            self._set_gauges(gauges)

    def _set_gauges(self, gauges: Mapping[str, float]) -> None:
        """Take over gauges; the caller holds the lock."""
        for name, value in gauges.items():
            if abs(value) <= GAUGE_MAX:  # NaN is not
                self._gauges[name] = value
                continue
            self._gauges.pop(name, None)
            self._counters["gauges_not_finite"] += 1
            if name not in self._odd_gauges:
                self._odd_gauges.add(name)
                _log.warning("gauge %s = %s measures nothing and is left out", name, value)

    def fail(self, error: PalpateError, *, degraded: bool = True) -> None:
        """Remember the last error; by default the state becomes DEGRADED, unless it is STOPPING.

        One that does not degrade is not shown before the state is no longer DEGRADED by another.
        """
        told = error_reply(error)
        with self._lock:
            new = told != self._last_error
            self._last_error = told
            self._message = error.problem
            if degraded and self._state is not ServiceState.STOPPING:
                self._state_error, self._state_message = told, error.problem
                new = new or self._state is not ServiceState.DEGRADED
                self._state, self._recovery = ServiceState.DEGRADED, None
        if new:
            self.tell()

    def over(self, error: PalpateError) -> None:
        """An error that did not degrade is over: the message is that of the state again."""
        with self._lock:
            if self._message == error.problem:
                self._message = self._state_message

    def set_state(self, state: ServiceState, message: str = "") -> None:
        """Set the state of this process; from DEGRADED it is READY after ``RECOVERY_S`` only.

        One that is STOPPING is not READY again, whatever a thread that does not know of it says.
        """
        with self._lock:
            if state is ServiceState.READY and self._state is ServiceState.STOPPING:
                return
            if state is ServiceState.READY and self._state is ServiceState.DEGRADED:
                since_s = time.monotonic() if self._recovery is None else self._recovery[0]
                self._recovery = since_s, message
                self._wake_by(since_s + RECOVERY_S)
                return
            different = state is not self._state
            self._state, self._recovery, self._state_error = state, None, None
            self._message = self._state_message = message
        if different:
            self.tell()

    @property
    def state(self) -> ServiceState:
        """The present state."""
        self.settle()
        return self._state

    def settle(self) -> float | None:
        """End the troubles that have stayed away for long enough.

        Returns:
            When it has to be called again at the latest [s from now]; None = no trouble is ending.
        """
        now_s = time.monotonic()
        with self._lock:
            left = []
            if self._recovery is not None:
                since_s, message = self._recovery
                if now_s >= since_s + RECOVERY_S:
                    self._state, self._recovery = ServiceState.READY, None
                    self._state_error = None
                    self._message = self._state_message = message
                    self.tell()
                else:
                    left.append(since_s + RECOVERY_S - now_s)
            for name, waiting in list(self._sensor_recovery.items()):
                due_s = 1e-9 * waiting.since_monotonic_ns + SENSOR_RECOVERY_S
                if now_s >= due_s:
                    del self._sensor_recovery[name]
                    self._show(waiting)
                else:
                    left.append(due_s - now_s)
        return min(left, default=None)

    @property
    def counters(self) -> dict[str, int]:
        """A copy of the counters."""
        with self._lock:
            return dict(self._counters)

    def set_sensors(self, sensors: tuple[str, ...]) -> None:
        """Name the sensors this process serves."""
        with self._lock:
            self._sensors = sensors

    def set_sensor_state(
        self,
        name: str,
        state: SensorState,
        *,
        faults: Sequence[ChannelFault] = (),
        message: str = "",
    ) -> None:
        """Set the state of a sensor; a change of state or faults is published at once.

        Only a lost sensor that delivers again is shown so after ``SENSOR_RECOVERY_S``.
        """
        status = SensorStatus(name, state, time.monotonic_ns(), tuple(faults), message)
        with self._lock:
            shown = self._sensor_states.get(name)
            waiting = self._sensor_recovery.pop(name, None)
            if shown is None or shown.state is not SensorState.LOST or state not in _DELIVERING:
                self._show(status)
            else:
                if waiting is not None:
                    status = replace(status, since_monotonic_ns=waiting.since_monotonic_ns)
                self._sensor_recovery[name] = status
                self._wake_by(1e-9 * status.since_monotonic_ns + SENSOR_RECOVERY_S)

    def _show(self, status: SensorStatus) -> None:
        """Take over the state of a sensor; the caller holds the lock."""
        before = self._sensor_states.get(status.name)
        if before is None or before.state is not status.state:
            self.tell()
        else:
            status = replace(status, since_monotonic_ns=before.since_monotonic_ns)
            if before.faults != status.faults:
                self.tell()
        self._sensor_states[status.name] = status

    def set_processes(self, processes: Sequence[SupervisedProcess]) -> None:
        """Name the processes that this one, a supervisor, keeps running."""
        with self._lock:
            self._processes = tuple(processes)

    def set_models(self, models: Sequence[str]) -> None:
        """Name the bundles that this process serves, each as ``name:version``."""
        with self._lock:
            self._models = tuple(models)

    def status(self) -> Status:
        """Everything as a message."""
        self.settle()
        monotonic_ns, wall_ns = clock.now()
        usage = self._usage.gauges()
        with self._lock:
            degraded = self._state is ServiceState.DEGRADED
            return Status(
                self.service,
                self.instance,
                self._state,
                monotonic_ns,
                wall_ns,
                time.monotonic() - self._started,
                self._version,
                dict(self._counters),
                {**usage, **self._gauges},
                self._sensors,
                self._state_message if degraded else self._message,
                self._state_error or self._last_error,
                tuple(self._sensor_states.values()),
                self._processes,
                self._models,
            )


class HealthReporter(Closing):
    """Publishes ``Status`` once a second and on each change of state, and answers when asked.

    ``refresh`` is called before each report, e.g. to take over a subscriber's counters. What became
    of the questions to this session is counted as ``questions_<event>``.
    """

    def __init__(
        self,
        session: Session,
        health: Health,
        *,
        period_s: float = 1.0,
        refresh: Callable[[], None] | None = None,
    ) -> None:
        self._session = session
        self._health = health
        self._period_s = period_s
        self._refresh = refresh
        self._stop = threading.Event()
        self._publisher = session.publisher(
            STATUS_TOPIC, service=health.service, instance=health.instance
        )
        self._queryable = session.queryable(
            endpoints.STATUS,
            lambda _: self._status(),
            service=health.service,
            instance=health.instance,
        )
        self._thread = threading.Thread(target=self._run, name="health", daemon=True)
        self._thread.start()

    def _status(self) -> Status:
        if self._refresh is not None:
            self._refresh()
        counters, waiting = self._session.questions()
        if counters:
            self._health.set_counts({f"questions_{name}": n for name, n in counters.items()})
            self._health.gauge("waiting_questions", waiting)
        return self._health.status()

    def _run(self) -> None:
        allowance, earned_s = float(_BURST), time.monotonic()
        while not self._stop.is_set():
            self._health.settle()
            # Cleared before the status is read: a change during the report is published next.
            self._health.changed.clear()
            try:
                self._publisher.put(self._status())
            except PalpateError as error:
                if not self._stop.is_set():
                    _log.warning("status not published: %s", error)
            except Exception:
                # Without its status a process that works would seem to be gone.
                _log.exception("status not published: defect")
            now_s = time.monotonic()
            allowance = min(_BURST, allowance + _CHANGES_HZ * (now_s - earned_s)) - 1.0
            earned_s = now_s
            self._stop.wait(max(_APART_S, -allowance / _CHANGES_HZ))
            if not self._health.await_change(self._period_s):
                self._health.await_lull()

    def close(self) -> None:
        """Report a last time and stop."""
        self._stop.set()
        self._health.tell()
        self._thread.join(timeout=2)
        try:
            self._publisher.put(self._status())
        except PalpateError as error:
            _log.warning("last status not published: %s", error)
        except Exception:
            # Whatever closes this has more to close.
            _log.exception("last status not published: defect")
