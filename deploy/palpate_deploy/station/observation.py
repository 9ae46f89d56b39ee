"""A station as it is now: the statuses of its processes, and how fast their counters grow."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from palpate.bus import Delivery, Session
from palpate.bus.topics import STATUS
from palpate.census import ROUTER, ProcessName, ProcessReport, take_census
from palpate.errors import LinkError, StreamTimeout
from palpate.messages import Status
from palpate.process import Closing

SILENT_S = 4.0
"""A process publishes its status each second; one that has not for so long does not answer [s]."""

RATES_S = 3.0
"""Rates are means over about this long [s]; a single look waits for it."""

_FORGOTTEN_S = 60.0
_PROCESSES_MOST = 256
_POLL_S = 0.2


@dataclass(frozen=True, slots=True)
class ObservedProcess:
    """One process: its report, and what its counters did in the last seconds.

    Attributes:
        report: Whether it lives, is ready, and its status; without a status it does not answer.
        age_s: Time since its status came [s].
        rates_hz: How fast each counter grows [1/s]; empty before the second status.
    """

    report: ProcessReport
    age_s: float = 0.0
    rates_hz: Mapping[str, float] = field(default_factory=dict)


class _Heard:
    """The last statuses of one process."""

    def __init__(self, status: Status) -> None:
        self.status = status
        self.heard_s = time.monotonic()
        self._looks: deque[Status] = deque([status])

    def hear(self, status: Status) -> None:
        self.heard_s = time.monotonic()
        if status.uptime_s < self.status.uptime_s:  # another process, which counts from zero
            self._looks.clear()
        self.status = status
        self._looks.append(status)
        since_ns = status.monotonic_ns - round(1e9 * RATES_S)
        while len(self._looks) > 2 and self._looks[1].monotonic_ns <= since_ns:
            self._looks.popleft()

    def rates_hz(self) -> dict[str, float]:
        first, last = self._looks[0], self._looks[-1]
        between_s = 1e-9 * (last.monotonic_ns - first.monotonic_ns)
        if between_s < _POLL_S:
            return {}
        return {
            name: max(0.0, (count - first.counters.get(name, 0)) / between_s)
            for name, count in last.counters.items()
        }


class StationObserver(Closing):
    """Follows the statuses of a station in a thread of its own.

    ``expected`` are processes that should run, besides those that the station's supervisor names.
    """

    def __init__(self, session: Session, *, expected: Iterable[ProcessName] = ()) -> None:
        self._session = session
        self._expected = frozenset(expected)
        self._heard: dict[ProcessName, _Heard] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._statuses = session.subscriber(STATUS, delivery=Delivery.QUEUE)
        self._thread = threading.Thread(target=self._run, name="observer", daemon=True)
        self._thread.start()

    def ask(self, timeout_s: float) -> None:
        """Ask every process now; without it a first picture takes a second."""
        for report in take_census(self._session, expected=self._expected, timeout_s=timeout_s):
            if report.status is not None:
                self._hear(report.status)

    def look(self) -> list[ObservedProcess]:
        """Every process that lives, should live, or has been heard lately, by name."""
        present = {(one.service, one.instance): one.ready for one in self._session.alive()}
        if self._session.has_router():
            present[ROUTER] = True
        now_s = time.monotonic()
        with self._lock:
            for name, heard in list(self._heard.items()):
                gone = name not in present and now_s - heard.heard_s > SILENT_S
                if gone or now_s - heard.heard_s > _FORGOTTEN_S:
                    del self._heard[name]
            wanted = set(self._expected)
            for heard in self._heard.values():
                wanted.update((one.service, one.instance) for one in heard.status.processes)
            names = wanted | present.keys() | self._heard.keys()
            return [self._observed(name, present, now_s) for name in sorted(names)]

    def _observed(
        self, name: ProcessName, present: Mapping[ProcessName, bool], now_s: float
    ) -> ObservedProcess:
        heard = self._heard.get(name)
        fresh = heard is not None and now_s - heard.heard_s <= SILENT_S
        status = heard.status if heard is not None and fresh else None
        report = ProcessReport(*name, name in present, present.get(name, False), status)
        if heard is None:
            return ObservedProcess(report)
        rates_hz = heard.rates_hz() if fresh else {}
        return ObservedProcess(report, now_s - heard.heard_s, rates_hz)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._hear(self._statuses.next(_POLL_S).message)
            except StreamTimeout:
                continue
            except LinkError:  # the session is closed
                return

    def _hear(self, status: Status) -> None:
        name = status.service, status.instance
        with self._lock:
            if (heard := self._heard.get(name)) is not None:
                if status.monotonic_ns >= heard.status.monotonic_ns or (
                    status.uptime_s < heard.status.uptime_s
                ):
                    heard.hear(status)
            elif len(self._heard) < _PROCESSES_MOST:
                self._heard[name] = _Heard(status)

    def close(self) -> None:
        """Stop following."""
        self._stop.set()
        self._thread.join(timeout=2.0)
        self._statuses.close()
