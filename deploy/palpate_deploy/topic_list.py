"""``palpate topic list``: the contract's streams, and which are heard now."""

from __future__ import annotations

import json
import time
from collections import defaultdict
from dataclasses import dataclass, field

from rich.console import Console
from rich.table import Table

from palpate.bus import Session
from palpate.bus.topics import TOPICS
from palpate.config import LinkConfig
from palpate.errors import StreamTimeout


@dataclass(slots=True)
class _Heard:
    """What came of one topic."""

    messages: int = 0
    sources: set[str] = field(default_factory=set)


def list_topics(link: LinkConfig, station: str, seconds: float, *, as_json: bool) -> None:
    """Listen to everything for a while and print the topic table.

    Raises:
        LinkError: There is no router.
    """
    heard: defaultdict[str, _Heard] = defaultdict(_Heard)
    with Session.open(link, station=station) as session:
        with session.tap(list(TOPICS.values())) as tap:
            began = time.monotonic()
            while (left := began + seconds - time.monotonic()) > 0:
                try:
                    sample = tap.next(left)
                except StreamTimeout:
                    break
                heard[sample.topic].messages += 1
                heard[sample.topic].sources.add(sample.sensor)
    if as_json:
        rows = [
            {
                "topic": topic.name,
                "message": topic.codec.schema,
                "usual_rate_hz": topic.rate_hz,
                "sources": sorted(heard[topic.name].sources),
                "messages": heard[topic.name].messages,
                "rate_hz": round(_rate_hz(heard[topic.name], seconds), 2),
            }
            for topic in TOPICS.values()
        ]
        print(json.dumps({"station": station, "topics": rows}, indent=2))
        return
    table = Table(title=f"station {station}, {seconds:g} s of listening", title_justify="left")
    for column in ("topic", "message", "from", "Hz now", "Hz usual", "what"):
        table.add_column(column, justify="right" if column.startswith("Hz") else "left")
    for topic in TOPICS.values():
        now = heard[topic.name]
        table.add_row(
            topic.name,
            topic.codec.schema.rpartition(".")[2],
            " ".join(sorted(now.sources)) or "[dim]-[/]",
            f"{_rate_hz(now, seconds):.1f}" if now.messages else "[dim]-[/]",
            f"{topic.rate_hz:g}" if topic.rate_hz else "events",
            topic.doc,
        )
    Console().print(table)


def _rate_hz(heard: _Heard, seconds: float) -> float:
    """Messages per second of one source."""
    return heard.messages / seconds / max(1, len(heard.sources))
