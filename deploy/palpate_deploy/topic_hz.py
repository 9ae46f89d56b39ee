"""``palpate topic hz``: rate, jitter, bandwidth and loss of a stream."""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections import defaultdict
from dataclasses import dataclass, field

from palpate.bus import Delivery, Sample, Session
from palpate.bus.topics import TOPICS, Topic
from palpate.config import LinkConfig
from palpate.errors import StreamTimeout, WireError
from palpate_deploy.failure import FAILED
from palpate_deploy.topic_names import topic_named

_REPORT_S = 1.0


@dataclass(slots=True)
class Rate:
    """What was seen of one source.

    Attributes:
        messages: How many came.
        bytes: Their payloads [bytes].
        lost: Holes in the sequence of stamps, for streams whose sequences have none.
        rejected: Payloads that do not decode.
        missed: Frames the device itself lost, by the stamps.
        gaps_s: Time between two arrivals [s].
    """

    messages: int = 0
    bytes: int = 0
    lost: int = 0
    rejected: int = 0
    missed: int = 0
    gaps_s: list[float] = field(default_factory=list)
    _arrival_ns: int = 0
    _sequence: int | None = None

    def add(self, topic: Topic[object], sample: Sample) -> None:
        """Count one sample."""
        self.messages += 1
        self.bytes += len(sample.payload)
        if self._arrival_ns:
            self.gaps_s.append((sample.received_monotonic_ns - self._arrival_ns) * 1e-9)
        self._arrival_ns = sample.received_monotonic_ns
        try:
            stamp = topic.stamp_of(topic.codec.decode(sample.payload))
        except WireError:
            self.rejected += 1
            return
        if stamp is None:
            return
        step = stamp.sequence - (stamp.sequence - 1 if self._sequence is None else self._sequence)
        if topic.contiguous and step > 1:
            self.lost += step - 1
        self.missed += stamp.missed_before
        self._sequence = stamp.sequence

    def summary(self) -> dict[str, float | int | None]:
        """Numbers for people and machines; None where two messages would be needed."""
        total_s = sum(self.gaps_s)
        some = bool(self.gaps_s) and total_s > 0
        return {
            "messages": self.messages,
            "rate_hz": len(self.gaps_s) / total_s if some else None,
            "min_s": min(self.gaps_s) if some else None,
            "max_s": max(self.gaps_s) if some else None,
            "std_s": statistics.pstdev(self.gaps_s) if some else None,
            "bytes_per_s": self.bytes / total_s if some else None,
            "lost": self.lost,
            "missed_by_device": self.missed,
            "rejected": self.rejected,
        }


def measure(
    link: LinkConfig,
    station: str,
    name: str,
    sensor: str,
    seconds: float,
    *,
    as_json: bool,
) -> int:
    """Print the rate of a topic until ``seconds`` have passed (0 = Ctrl-C).

    Returns:
        0, or 1 if nothing was heard.

    Raises:
        ConfigError: There is no such topic.
        LinkError: There is no router.
    """
    topic = topic_named(name)
    rates: defaultdict[str, Rate] = defaultdict(Rate)
    with (
        Session.open(link, station=station) as session,
        session.tap([topic], sensor=sensor, delivery=Delivery.QUEUE) as tap,
    ):
        end = time.monotonic() + seconds if seconds else float("inf")
        report = time.monotonic() + _REPORT_S
        try:
            while (now := time.monotonic()) < end:
                if now >= report and not as_json:
                    print_rates(topic, rates)
                    report = now + _REPORT_S
                try:
                    sample = tap.next(max(0.0, min(end, report) - now))
                except StreamTimeout:
                    report = min(report, time.monotonic())
                    continue
                rates[sample.sensor].add(TOPICS[sample.topic], sample)
        except KeyboardInterrupt:
            pass
    if as_json:
        found = {source: rate.summary() for source, rate in sorted(rates.items())}
        print(json.dumps({"topic": name, "sources": found}, indent=2))
    else:
        print_rates(topic, rates)
    return 0 if rates else FAILED


def print_rates(topic: Topic[object], rates: dict[str, Rate]) -> None:
    """Print one line for each source."""
    if not rates:
        print(f"no {topic.name} heard; see what runs: palpate status", file=sys.stderr, flush=True)
    for source, rate in sorted(rates.items()):
        numbers = rate.summary()
        if numbers["rate_hz"] is None:
            print(f"{source}: {rate.messages} message", flush=True)
            continue
        print(
            f"{source}: {numbers['rate_hz']:.2f} Hz  "
            f"min {_ms(numbers['min_s'])}  max {_ms(numbers['max_s'])}  "
            f"std {_ms(numbers['std_s'])}  {(numbers['bytes_per_s'] or 0) / 1e3:.1f} kB/s  "
            f"lost {rate.lost}  missed by device {rate.missed}  rejected {rate.rejected}  "
            f"n {rate.messages}",
            flush=True,
        )


def _ms(seconds: float | int | None) -> str:
    return f"{(seconds or 0) * 1e3:.2f} ms"
