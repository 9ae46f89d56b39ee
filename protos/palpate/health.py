"""Health of a process: its counters, gauges and state, and the states of its sensors.

Published once a second and on each change of state, and given when asked.
"""

from __future__ import annotations

import logging
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
    ChannelFault,
    ErrorReply,
    SensorState,
    SensorStatus,
    ServiceState,
    Status,
)
from palpate.process import Closing

_log = logging.getLogger(__name__)


_APART_S = 5e-3
"""Least time between two statuses [s], however fast states change."""


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
        self._state = ServiceState.STARTING
        self._message = ""
        self._last_error: ErrorReply | None = None
        self._sensors: tuple[str, ...] = ()
        self._sensor_states: dict[str, SensorStatus] = {}
        self._started = time.monotonic()
        self._version = __version__
        self.changed = threading.Event()
        """Set when the state changed, so that the reporter publishes it at once."""

    def count(self, name: str, by: int = 1) -> None:
        """Add to a counter."""
        with self._lock:
            self._counters[name] += by

    def set_counts(self, counts: Mapping[str, int]) -> None:
        """Take over totals that are counted elsewhere, e.g. by a subscriber or a device."""
        with self._lock:
            self._counters.update({k: v - self._counters[k] for k, v in counts.items()})

    def gauge(self, name: str, value: float) -> None:
        """Set a gauge; its name ends in the unit."""
        with self._lock:
            self._gauges[name] = value

    def fail(self, error: PalpateError, *, degraded: bool = True) -> None:
        """Remember the last error; by default the state becomes DEGRADED."""
        with self._lock:
            self._last_error = error_reply(error)
            if degraded:
                self._state = ServiceState.DEGRADED
            self._message = error.problem
        self.changed.set()

    def set_state(self, state: ServiceState, message: str = "") -> None:
        """Set the state of this process."""
        with self._lock:
            different = state is not self._state
            self._state = state
            self._message = message
        if different:
            self.changed.set()

    @property
    def state(self) -> ServiceState:
        """The state last set."""
        return self._state

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
        """Set the state of a sensor; a change of state or faults is published at once."""
        status = SensorStatus(name, state, time.monotonic_ns(), tuple(faults), message)
        with self._lock:
            before = self._sensor_states.get(name)
            if before is not None and before.state is state:
                status = replace(status, since_monotonic_ns=before.since_monotonic_ns)
            self._sensor_states[name] = status
            same = before is not None and before.state is state and before.faults == status.faults
        if not same:
            self.changed.set()

    def status(self) -> Status:
        """Everything as a message."""
        monotonic_ns, wall_ns = clock.now()
        with self._lock:
            return Status(
                self.service,
                self.instance,
                self._state,
                monotonic_ns,
                wall_ns,
                time.monotonic() - self._started,
                self._version,
                dict(self._counters),
                dict(self._gauges),
                self._sensors,
                self._message,
                self._last_error,
                tuple(self._sensor_states.values()),
            )


class HealthReporter(Closing):
    """Publishes ``Status`` once a second and on each change of state, and answers when asked.

    ``refresh`` is called before each report, e.g. to take over a subscriber's counters.
    """

    def __init__(
        self,
        session: Session,
        health: Health,
        *,
        period_s: float = 1.0,
        refresh: Callable[[], None] | None = None,
    ) -> None:
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
        return self._health.status()

    def _run(self) -> None:
        while not self._stop.is_set():
            self._health.changed.clear()
            try:
                self._publisher.put(self._status())
            except PalpateError as error:
                if not self._stop.is_set():
                    _log.warning("status not published: %s", error)
            # States that change faster than this share a report; `changed` is cleared before the
            # status is read, so that a change during the report is published next.
            self._stop.wait(_APART_S)
            self._health.changed.wait(self._period_s)

    def close(self) -> None:
        """Report a last time and stop."""
        self._stop.set()
        self._health.changed.set()
        self._thread.join(timeout=2)
        try:
            self._publisher.put(self._status())
        except PalpateError as error:
            _log.warning("last status not published: %s", error)
