"""``palpate topic echo``: messages, decoded."""

from __future__ import annotations

import dataclasses
import enum
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from palpate import clock
from palpate.bus import Delivery, Received, Session
from palpate.bus.topics import Topic
from palpate.config import LinkConfig
from palpate.errors import StreamTimeout
from palpate.messages import Stamp
from palpate_deploy.topic_names import topic_named


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
    """Print messages of a topic.

    Args:
        link: The station's router.
        station: Name of the station.
        name: The topic.
        sensor: One sensor, or ``*``.
        count: End after so many; 0 = at Ctrl-C.
        timeout_s: End when none comes for so long [s].
        as_json: One JSON object a line.

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
                            f"{rejected} payloads of {name} came and none is valid",
                            remedy="the publisher speaks another contract: compare its version",
                        ) from error
                    raise
                print(_json(received) if as_json else _text(topic, received), flush=True)
                done += 1
        except KeyboardInterrupt:
            pass


def plain(value: Any) -> Any:
    """A message as JSON's own kinds: digests as hex, enums by name, arrays as lists."""
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


def _json(received: Received[Any]) -> str:
    return json.dumps(
        {
            "station": received.station,
            "sensor": received.sensor,
            "received_monotonic_ns": received.received_monotonic_ns,
            "message": plain(received.message),
        }
    )


def _text(topic: Topic[Any], received: Received[Any]) -> str:
    lines = [f"--- {received.sensor}/{topic.name}"]
    for field in dataclasses.fields(received.message):
        value = getattr(received.message, field.name)
        if value is not None:
            lines.append(f"{field.name:20} {_readable(value)}")
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
    return json.dumps(plain(value), ensure_ascii=False) if value else str(value)
