"""A service that answers messages with estimates: what features, field and synthesis share."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from palpate import clock
from palpate.bus import Publisher, Received, Session
from palpate.bus.topics import Topic
from palpate.errors import WireError
from palpate.health import Health
from palpate.messages import Origin, Stamp
from palpate_services.config import AnswererConfig

M = TypeVar("M")
E = TypeVar("E")

Answer = Callable[[str, M], E | str]
"""From the name of a sensor and a message of it to the estimate, or to the reason (as it is
counted) why there is none."""

_COUNT_PERIOD_NS = 200_000_000
_GAUGE_PERIOD_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Line(Generic[M, E]):
    """What a service makes of what.

    Attributes:
        service: Its name, which is also the task of its bundle.
        source: What it answers.
        target: What it answers with.
        received: Name of the counter of messages that came.
    """

    service: str
    source: Topic[M]
    target: Topic[E]
    received: str


class Freshness:
    """Whether a message may still be acted on.

    Args:
        config: The oldest that may, and whether replayed ones may.
    """

    def __init__(self, config: AnswererConfig) -> None:
        self._limit_s = config.max_age_s
        self._accept_replayed = config.accept_replayed

    def refusal(self, stamp: Stamp) -> str | None:
        """Why a message of this stamp gets no estimate; None = it may get one."""
        if stamp.origin is Origin.REPLAYED:
            return None if self._accept_replayed else "replayed_refused"
        limit_s = self._limit_s
        return "stale" if limit_s is not None and clock.age_s(stamp) > limit_s else None


class Pace:
    """Lets the first message of each period pass, by the clock of the messages.

    Not by the clock of this process: a replay, however fast, must give the same estimates again.

    Args:
        rate_hz: Messages a second and sensor at most [Hz]; None = all.
    """

    def __init__(self, rate_hz: float | None) -> None:
        self._period_ns = None if rate_hz is None else max(1, round(1e9 / rate_hz))
        self._last: dict[str, int] = {}

    def early(self, sensor: str, stamp: Stamp) -> bool:
        """Whether this period had its message."""
        if self._period_ns is None:
            return False
        return self._last.get(sensor) == stamp.monotonic_ns // self._period_ns

    def passed(self, sensor: str, stamp: Stamp) -> None:
        """A message of this period was answered."""
        if self._period_ns is not None:
            self._last[sensor] = stamp.monotonic_ns // self._period_ns


class Answerer(Generic[M, E]):
    """Answers messages with estimates and counts those it does not answer. Use from one thread.

    Args:
        line: What it makes of what.
        session: Where estimates are published.
        config: What it is told.
        health: Hears of every event.
        answer: Makes the estimate.
        rate_hz: Estimates a second and sensor at most [Hz]; None = no limit.
    """

    def __init__(
        self,
        line: Line[M, E],
        session: Session,
        config: AnswererConfig,
        health: Health,
        answer: Answer[M, E],
        *,
        rate_hz: float | None = None,
    ) -> None:
        self._line = line
        self._session = session
        self._health = health
        self._make = answer
        self._lossless = config.delivery == "every"
        self._sensors = frozenset(config.sensors)
        self._freshness = Freshness(config)
        self._pace = Pace(rate_hz)
        self._publishers: dict[str, Publisher[E]] = {}
        self._counts: Counter[str] = Counter()
        self._latencies_ns: list[int] = []
        self._busy_ns = 0
        self._counted_ns = self._gauged_ns = time.monotonic_ns()

    def answer(self, received: Received[M]) -> None:
        """Publish the estimate of a message, or count why there is none."""
        sensor = received.sensor
        if self._sensors and sensor not in self._sensors:
            return
        began_ns = time.monotonic_ns()
        self._counts[self._line.received] += 1
        stamp = self._line.source.stamp_of(received.message)
        assert stamp is not None, "every message that is answered has a stamp"
        reason = self._serve(sensor, stamp, received.message)
        ended_ns = time.monotonic_ns()
        self._busy_ns += ended_ns - began_ns
        if reason is not None:
            self._counts[reason] += 1
            return
        self._counts["estimates_published"] += 1
        # From the reading itself where its clock is ours and its time is now, else from arrival.
        live = stamp.origin is not Origin.REPLAYED and stamp.clock_id == clock.CLOCK_ID
        since_ns = stamp.monotonic_ns if live else received.received_monotonic_ns
        self._latencies_ns.append(ended_ns - since_ns)

    def _serve(self, sensor: str, stamp: Stamp, message: M) -> str | None:
        if (reason := self._freshness.refusal(stamp)) is not None:
            return reason
        if self._pace.early(sensor, stamp):
            return "skipped_rate"
        answer = self._make(sensor, message)
        if isinstance(answer, str):
            return str(answer)
        try:
            self._publisher(sensor).put(answer)
        except WireError as error:  # a finite answer that the contract still does not allow
            return f"unpublishable_{error.reason}"
        self._pace.passed(sensor, stamp)
        return None

    def _publisher(self, sensor: str) -> Publisher[E]:
        publisher = self._publishers.get(sensor)
        if publisher is None:
            target = self._line.target
            publisher = self._session.publisher(target, sensor=sensor, lossless=self._lossless)
            self._publishers[sensor] = publisher
            self._health.set_sensors(tuple(sorted(self._publishers)))
        return publisher

    def report(self, *, last: bool = False) -> None:
        """Hand counters and gauges over to health; call it often, it paces itself.

        Args:
            last: Hand over everything now.
        """
        now_ns = time.monotonic_ns()
        if last or now_ns - self._counted_ns >= _COUNT_PERIOD_NS:
            self._counted_ns = now_ns
            counts, self._counts = self._counts, Counter()
            for name, count in counts.items():
                self._health.count(name, count)
        period_ns = now_ns - self._gauged_ns
        if last or period_ns >= _GAUGE_PERIOD_NS:
            self._gauged_ns = now_ns
            self._health.gauge("busy_ratio", self._busy_ns / max(period_ns, 1))
            self._busy_ns = 0
            if self._latencies_ns:
                p50, p99 = np.percentile(self._latencies_ns, (50, 99)) * 1e-9
                self._health.gauge("latency_p50_s", float(p50))
                self._health.gauge("latency_p99_s", float(p99))
                self._latencies_ns = []
