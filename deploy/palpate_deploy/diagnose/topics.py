"""``palpate topic``: which streams there are, their messages, rates and losses."""

from __future__ import annotations

import dataclasses
import difflib
import enum
import json
import math
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from palpate import clock
from palpate.bus import Delivery, ReceivedMessage, Session, TapSample
from palpate.bus.continuity import Holes
from palpate.bus.topics import TOPICS, Topic
from palpate.config import LinkConfig
from palpate.errors import ConfigError, StreamTimeout, WireError, printable
from palpate.messages import Stamp
from palpate_deploy.station.logs import FAILED, cell


def topic_named(name: str) -> Topic[Any]:
    """A topic of the contract; a ``ConfigError`` names the nearest."""
    topic = TOPICS.get(name)
    if topic is None:
        near = difflib.get_close_matches(name, TOPICS, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ConfigError(
            f"topic {name!r} does not exist", remedy=f"{hint}known: {', '.join(TOPICS)}"
        )
    return topic


def list_topics(link: LinkConfig, station: str, seconds: float, *, as_json: bool) -> None:
    """Receive all topics for a while and print them as a table.

    Raises:
        LinkError: There is no router.
    """
    messages: Counter[str] = Counter()
    sources: defaultdict[str, set[str]] = defaultdict(set)
    with Session.open(link, station=station) as session:
        with session.tap(list(TOPICS.values())) as tap:
            began = time.monotonic()
            while (left := began + seconds - time.monotonic()) > 0:
                try:
                    sample = tap.next(left)
                except StreamTimeout:
                    break
                messages[sample.topic] += 1
                sources[sample.topic].add(sample.sensor)
    # Messages per second of one source.
    rates_hz = {name: messages[name] / seconds / max(1, len(sources[name])) for name in TOPICS}
    if as_json:
        rows = [
            {
                "topic": name,
                "message": topic.codec.schema,
                "usual_rate_hz": topic.rate_hz,
                "sources": sorted(sources[name]),
                "messages": messages[name],
                "rate_hz": round(rates_hz[name], 2),
            }
            for name, topic in TOPICS.items()
        ]
        print(json.dumps({"station": station, "topics": rows}, indent=2))
        return
    table = Table(title=f"station {station}, {seconds:g} s of listening", title_justify="left")
    for column in ("topic", "message", "from", "Hz now", "Hz usual", "what"):
        table.add_column(column, justify="right" if column.startswith("Hz") else "left")
    for name, topic in TOPICS.items():
        table.add_row(
            name,
            topic.codec.schema.rpartition(".")[2],
            cell(" ".join(sorted(sources[name]))) or "[dim]-[/]",
            f"{rates_hz[name]:.1f}" if messages[name] else "[dim]-[/]",
            f"{topic.rate_hz:g}" if topic.rate_hz else "events",
            topic.doc,
        )
    Console().print(table)


def echo_topic(
    link: LinkConfig,
    station: str,
    name: str,
    sensor: str,
    *,
    count: int,
    timeout_s: float,
    as_json: bool,
) -> None:
    """Print messages of a topic: ``count`` (0 = until Ctrl-C), until none comes for ``timeout_s``.

    Raises:
        ConfigError: There is no such topic.
        LinkError: There is no router.
        StreamTimeout: Nothing came.
    """
    topic = topic_named(name)
    with Session.open(link, station=station) as session:
        service = sensor if topic.per_service else "*"
        stream = session.subscriber(topic, sensor=sensor, service=service, delivery=Delivery.QUEUE)
        done = 0
        try:
            while not count or done < count:
                try:
                    received = stream.next(timeout_s)
                except StreamTimeout as error:
                    rejected = sum(
                        n for k, n in stream.counters.items() if k.startswith("rejected_")
                    )
                    if rejected:
                        raise StreamTimeout(
                            f"{rejected} payloads of {name} came, none is valid",
                            remedy="the publisher speaks another contract: compare its version",
                        ) from error
                    raise
                text = _json(received) if as_json else printable(_text(topic, received), keep="\n")
                print(text, flush=True)
                done += 1
        except KeyboardInterrupt:
            pass


def plain(value: Any) -> Any:
    """A message as JSON types: digests as hex, enums by name, arrays as lists."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, enum.Enum):
        return value.name.lower()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def _json(received: ReceivedMessage[Any]) -> str:
    return json.dumps(
        {
            "station": received.station,
            "sensor": received.sensor,
            "received_monotonic_ns": received.received_monotonic_ns,
            "message": plain(received.message),
        }
    )


def _text(topic: Topic[Any], received: ReceivedMessage[Any]) -> str:
    lines = [f"--- {received.sensor}/{topic.name}"]
    for part in dataclasses.fields(received.message):
        value = getattr(received.message, part.name)
        if value is not None:
            lines.append(f"{part.name:20} {_readable(value)}")
    return "\n".join(lines)


def _readable(value: Any) -> str:
    if isinstance(value, Stamp):
        age_ms = clock.age_s(value) * 1e3
        missed = f", {value.missed_before} missed before" if value.missed_before else ""
        return f"#{value.sequence} {value.origin.name.lower()}, {age_ms:.1f} ms old{missed}"
    if isinstance(value, np.ndarray):
        precision = 0 if value.dtype.kind in "ui" else 4
        return np.array2string(
            value, precision=precision, suppress_small=False, max_line_width=100, threshold=60
        )
    if isinstance(value, bytes):
        return value.hex()[:12]
    if isinstance(value, Mapping):
        return "  ".join(f"{key} {item:g}" for key, item in sorted(value.items())) or "-"
    if isinstance(value, enum.Enum):
        return value.name.lower()
    return json.dumps(_short(plain(value)), ensure_ascii=False) if value else str(value)


def _short(value: Any) -> Any:
    """Without what is not given, and without digits that nobody reads."""
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, dict):
        return {key: _short(one) for key, one in value.items() if one is not None}
    return [_short(one) for one in value] if isinstance(value, list) else value


_REPORT_S = 1.0


@dataclass(slots=True)
class StreamRate:
    """Rate and losses of one source.

    ``bytes`` is the size of the payloads, ``rejected`` counts those that do not decode; ``lost``
    are gaps in the sequence numbers of contiguous streams, ``overflow`` messages that came faster
    than they were counted here, and ``missed`` the frames that the device itself lost, by
    ``missed_before``.
    """

    messages: int = 0
    bytes: int = 0
    lost: int = 0
    overflow: int = 0
    rejected: int = 0
    missed: int = 0
    _gaps: int = 0  # between two arrivals; of them mean, sum of squared deviations, and range [s]
    _mean_s: float = 0.0
    _squares_s2: float = 0.0
    _min_s: float = float("inf")
    _max_s: float = 0.0
    _arrival_ns: int = 0
    _holes: Holes = field(default_factory=Holes)

    def add(self, topic: Topic[object], sample: TapSample) -> None:
        """Count one sample."""
        self.messages += 1
        self.bytes += len(sample.payload)
        if self._arrival_ns:
            self._add_gap((sample.received_monotonic_ns - self._arrival_ns) * 1e-9)
        self._arrival_ns = sample.received_monotonic_ns
        self.overflow = sample.lost_here
        try:
            stamp = topic.stamp_of(topic.codec.decode(sample.payload))
        except WireError:
            self.rejected += 1
            return
        if stamp is None:
            return
        if topic.contiguous:
            arrived_ns = sample.received_monotonic_ns
            self.lost += self._holes.take(
                sample.key, stamp, arrived_ns=arrived_ns, lost_here=sample.lost_here
            )
        self.missed += stamp.missed_before

    def _add_gap(self, gap_s: float) -> None:
        """Welford's sums: all gaps of a command that is left on would fill the memory."""
        self._gaps += 1
        off_s = gap_s - self._mean_s
        self._mean_s += off_s / self._gaps
        self._squares_s2 += off_s * (gap_s - self._mean_s)
        self._min_s, self._max_s = min(self._min_s, gap_s), max(self._max_s, gap_s)

    def summary(self) -> dict[str, float | int | None]:
        """The numbers to print; None where they need two messages and there is one."""
        total_s = self._gaps * self._mean_s
        some = total_s > 0
        return {
            "messages": self.messages,
            "rate_hz": self._gaps / total_s if some else None,
            "min_s": self._min_s if some else None,
            "max_s": self._max_s if some else None,
            "std_s": math.sqrt(self._squares_s2 / self._gaps) if some else None,
            "bytes_per_s": self.bytes / total_s if some else None,
            "lost": self.lost,
            "overflow": self.overflow,
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
    """Print the rate of a topic until ``seconds`` have passed (0 = Ctrl-C); 1 if no message came.

    Raises:
        ConfigError: There is no such topic.
        LinkError: There is no router.
    """
    topic = topic_named(name)
    rates: defaultdict[str, StreamRate] = defaultdict(StreamRate)
    with (
        Session.open(link, station=station) as session,
        session.tap([topic], sensor=sensor, delivery=Delivery.QUEUE) as tap,
    ):
        end = time.monotonic() + seconds if seconds else float("inf")
        report = time.monotonic() + _REPORT_S
        told = False  # that nothing came
        try:
            while (now := time.monotonic()) < end:
                if now >= report and not as_json:
                    if rates or not told:
                        print_rates(topic, rates)
                    told = True
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
    elif rates or not told:
        print_rates(topic, rates)
    return 0 if rates else FAILED


def print_rates(topic: Topic[object], rates: dict[str, StreamRate]) -> None:
    """Print one line for each source."""
    if not rates:
        print(f"no {topic.name} came; see what runs: palpate status", file=sys.stderr, flush=True)
    for source, rate in sorted(rates.items()):
        numbers = rate.summary()
        source = printable(source)
        if numbers["rate_hz"] is None:
            print(f"{source}: {rate.messages} message", flush=True)
            continue
        print(
            f"{source}: {numbers['rate_hz']:.2f} Hz  "
            f"min {_ms(numbers['min_s'])}  max {_ms(numbers['max_s'])}  "
            f"std {_ms(numbers['std_s'])}  {(numbers['bytes_per_s'] or 0) / 1e3:.1f} kB/s  "
            f"lost {rate.lost}  overflow {rate.overflow}  missed by device {rate.missed}  "
            f"rejected {rate.rejected}  n {rate.messages}",
            flush=True,
        )


def _ms(seconds: float | int | None) -> str:
    return f"{(seconds or 0) * 1e3:.2f} ms"
