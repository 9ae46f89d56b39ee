"""The live view of a station for browsers: drawn while somebody watches, in parts that are kept.

A child draws, as it does beside a recorder. What it has drawn lasts for one chapter; then another
child begins the next one, so that what Rerun keeps in memory is bounded. The last two chapters are
kept for who comes later. A viewer asks for one part after another and is sent nothing unasked: a
slow one holds up nobody.
"""

from __future__ import annotations

import contextlib
import math
import secrets
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from palpate.bus import Delivery, Session, Tap
from palpate.bus.tares import TareBook
from palpate.bus.topics import FIELD, FIELD_TRUTH, TARE, TOPICS
from palpate.errors import PalpateError, StreamTimeout
from palpate.messages import (
    NO_TARE,
    ElectrodeFrame,
    FeatureEstimate,
    FieldEstimate,
    Stamp,
    SynthesisEstimate,
    Tare,
)
from palpate.process import Closing
from palpate_services.viewer.layout import MAX_SENSORS, SensorContents
from palpate_services.viewer.live_view import DrawnPart, LiveView, ViewMessage, ViewPlan
from palpate_services.viewer.timeline import DRAW_PERIOD_NS, SensorTimeline

UNWATCHED_S = 20.0
"""Nothing is drawn when nobody has asked for so long [s]."""

CHAPTER_BYTES = 16_000_000
"""A chapter ends at this size [bytes]: half a minute of a moving skin, many minutes of one at rest.
What is kept is at most two of them and the last part of each."""

ANSWER_BYTES = 4_000_000
"""Parts in one answer have at most this size together [bytes], unless one alone has more."""

PERIOD_S = 1.0
"""Time between two parts [s]. Viewers take in a few pieces for each picture that they draw: at
0.5 s one without a graphics card falls behind for ever."""

SET_BACK_NS = 1_000_000_000
"""A wall clock that goes back by more than this was set back [ns]; by less, hosts may differ."""

GONE_S = 20.0
"""A sensor that has sent nothing for so long loses its tab when another one needs it [s]."""

_AGAIN_S = 5.0
_CLOSE_S = 2.0
_CAPACITY = 512  # 40 MB if all are fields
_TURN_S = 0.2
_FIELDS = frozenset({FIELD.name, FIELD_TRUTH.name})
_ESTIMATES = (FeatureEstimate, FieldEstimate, SynthesisEstimate)


@dataclass(frozen=True, slots=True)
class ViewPart:
    """What a viewer gets.

    Attributes:
        place: Names the end of this part in the next question.
        data: A complete ``.rbl``, or one ``.rrd`` or more, one after another.
    """

    place: str
    data: bytes


class KeptParts:
    """The parts of the last two chapters, and the present layout. Safe to use from several threads.

    A place is ``RUN-PART-LAYOUT``: a viewer of another run, or one that has fallen behind what is
    kept, begins with the oldest part.
    """

    def __init__(self) -> None:
        self.contents: Mapping[str, SensorContents] = {}
        """What the layout shows."""
        self._run = secrets.token_hex(8)
        self._lock = threading.Lock()
        self._layout, self._layouts = b"", 0
        self._parts: deque[tuple[int, int, bytes]] = deque()  # chapter, number, data
        self._number = 0
        self._chapter_bytes: Counter[int] = Counter()

    @property
    def run(self) -> str:
        """Differs for each object."""
        return self._run

    def add(self, chapter: int, part: DrawnPart) -> None:
        """Keep a part; chapters before the last one are forgotten."""
        with self._lock:
            if part.layout:
                self._layout, self._layouts = part.layout, self._layouts + 1
                self.contents = part.contents
            if part.data:
                self._number += 1
                self._parts.append((chapter, self._number, part.data))
                self._chapter_bytes[chapter] += len(part.data)
            while self._parts and self._parts[0][0] < chapter - 1:
                self._chapter_bytes.pop(self._parts.popleft()[0], None)

    def chapter_bytes(self, chapter: int) -> int:
        """Size of a chapter so far [bytes]."""
        with self._lock:
            return self._chapter_bytes[chapter]

    def clear(self) -> None:
        """Forget all parts; viewers go on with the next one."""
        with self._lock:
            self._parts.clear()
            self._chapter_bytes.clear()
            self.contents = {}

    def after(self, place: str) -> ViewPart | None:
        """What comes after a place; an empty or unknown one is the beginning. None = nothing yet.

        The layout comes first, and again where it has changed.
        """
        run, number, layouts = _read_place(place)
        with self._lock:
            if run != self._run:
                number = layouts = 0
            if layouts != self._layouts:
                return ViewPart(self._place(number, self._layouts), self._layout)
            # Parts in one answer are for viewers that take longer for an answer than for its parts.
            several: list[bytes] = []
            for _, kept, data in self._parts:
                if kept > number:
                    if several and sum(map(len, several)) + len(data) > ANSWER_BYTES:
                        break
                    several.append(data)
                    number = kept
            if several:
                return ViewPart(self._place(number, layouts), b"".join(several))
        return None

    def _place(self, number: int, layouts: int) -> str:
        return f"{self._run}-{number}-{layouts}"


def _read_place(place: str) -> tuple[str, int, int]:
    parts = place.split("-")
    if len(parts) != 3 or not all(p.isascii() and p.isdigit() and len(p) < 16 for p in parts[1:]):
        return "", 0, 0
    return parts[0], int(parts[1]), int(parts[2])


def _gone(last_ns: int, now_ns: int) -> bool:
    return now_ns - last_ns > GONE_S * 1e9


class WatchedView(Closing):
    """Has a station drawn while somebody watches. ``next_part`` is for other threads.

    Counts ``view_rejected`` (messages that break the contract), ``view_no_room`` (messages of more
    sensors than a view shows) and what ``LiveView`` counts.
    """

    def __init__(self, session: Session, *, title: str, bundles: tuple[str, ...] = ()) -> None:
        self.parts = KeptParts()
        self._session = session
        self._title, self._bundles = title, bundles
        self._asked_s = float("-inf")
        self._counts: Counter[str] = Counter()
        self._tap: Tap | None = None
        self._tares: TareBook | None = None
        self._view: LiveView | None = None
        self._ending: list[LiveView] = []
        self._chapter = 0
        self._begun_s = -math.inf
        self._lacks_room = False
        self._told: set[tuple[str, int]] = set()
        self._sensors: dict[str, int] = {}  # when it last sent, monotonic clock [ns]
        self._field_drawn_ns: dict[tuple[str, str], int] = {}
        self._wall_ns: dict[tuple[str, str], int] = {}

    def next_part(self, place: str) -> ViewPart | None:
        """What a viewer draws next; the question says that somebody watches."""
        self._asked_s = time.monotonic()
        return self.parts.after(place)

    @property
    def watched(self) -> bool:
        """Whether somebody has asked lately."""
        return time.monotonic() - self._asked_s < UNWATCHED_S

    def turn(self) -> Counter[str]:
        """Do what is due, for a fraction of a second; returns what was counted since before."""
        if self.watched:
            self._draw()
        elif self._tap is not None:
            self._end_chapter()
            self._tap.close()
            self._tap = None
            self.parts.clear()
        self._ending = [view for view in self._ending if not self._over(view)]
        counts, self._counts = self._counts, Counter()
        return counts

    def close(self) -> None:
        """Stop drawing."""
        self._end_chapter()
        if self._tap is not None:
            self._tap.close()
            self._tap = None
        for view in self._ending:
            view.close(_CLOSE_S)

    def _draw(self) -> None:
        if self._tares is None:
            self._tares = TareBook(self._session)
        if self._tap is None:
            topics = [TOPICS[name] for name in sorted(SensorTimeline.TOPICS)]
            self._tap = self._session.tap(topics, delivery=Delivery.QUEUE, capacity=_CAPACITY)
            self._sensors.clear()
        if self._view is not None:
            counts = self._view.take_counts()
            self._counts.update(counts)
            full = self.parts.chapter_bytes(self._chapter) > CHAPTER_BYTES
            if full or counts["view_failed"]:
                self._end_chapter()
        if self._view is None and time.monotonic() - self._begun_s > _AGAIN_S:
            self._begin_chapter()
        until_s = time.monotonic() + _TURN_S
        try:
            while time.monotonic() < until_s:
                self._take(self._tap)
        except StreamTimeout:
            pass

    def _begin_chapter(self) -> None:
        self._chapter += 1
        self._begun_s = time.monotonic()
        self._told.clear()
        now_ns = time.monotonic_ns()
        if self._lacks_room:
            alive = {name: ns for name, ns in self._sensors.items() if not _gone(ns, now_ns)}
            self._sensors, self._lacks_room = alive, False
        shown = self.parts.contents
        plan = ViewPlan(
            None,
            self._title,
            0,
            self._bundles,
            period_s=PERIOD_S,
            recording_id=self.parts.run,
            known={name: shown[name] for name in shown if name in self._sensors},
        )
        chapter, parts = self._chapter, self.parts
        self._view = LiveView(plan, lambda part: parts.add(chapter, part))

    def _end_chapter(self) -> None:
        if self._view is not None:
            self._view.finish()
            self._ending.append(self._view)
            self._view = None

    def _over(self, view: LiveView) -> bool:
        if not view.join(0.0):
            return False
        self._counts.update(view.take_counts())
        return True

    def _take(self, tap: Tap) -> None:
        sample = tap.next(0.0)
        if self._view is None:
            return
        now_ns = sample.received_monotonic_ns
        if sample.sensor not in self._sensors and len(self._sensors) >= MAX_SENSORS:
            self._counts["view_no_room"] += 1
            if any(_gone(last_ns, now_ns) for last_ns in self._sensors.values()):
                self._end_chapter()  # the next one has room
                self._lacks_room = True
            return
        stream = sample.sensor, sample.topic
        if sample.topic in _FIELDS:
            # Large, and the view leaves out most of them anyway.
            last_ns = self._field_drawn_ns.get(stream, 0)
            if now_ns - last_ns < DRAW_PERIOD_NS:
                return
            self._field_drawn_ns[stream] = now_ns
        topic = TOPICS[sample.topic]
        message = None
        with contextlib.suppress(PalpateError):
            if topic.codec.schema == sample.schema:
                message = topic.codec.decode(sample.payload)
        if message is None:
            self._counts["view_rejected"] += 1
            return
        self._sensors[sample.sensor] = now_ns
        if not isinstance(message, Tare) and self._set_back(stream, message):
            # Viewers stay at the latest time of a recording: they get another one.
            self._end_chapter()
            self._begun_s = -math.inf
            self.parts = KeptParts()
            self._wall_ns.clear()
            return
        if isinstance(message, Tare):
            self._told.add((sample.sensor, message.tare_id))
        elif isinstance(message, ElectrodeFrame):
            self._tell_tare(sample.sensor, message.tare_id)
        self._view.offer(ViewMessage(sample.sensor, sample.topic, sample.payload))

    def _set_back(self, stream: tuple[str, str], message: Any) -> bool:
        """Whether a message was taken long before the last one of its stream, by the wall clock."""
        stamp: Stamp = message.source if isinstance(message, _ESTIMATES) else message.stamp
        last_ns = self._wall_ns.get(stream, stamp.wall_ns)
        self._wall_ns[stream] = stamp.wall_ns
        return last_ns - stamp.wall_ns > SET_BACK_NS

    def _tell_tare(self, sensor: str, tare_id: int) -> None:
        """Hand over the tare that a frame names, once a chapter."""
        if tare_id == NO_TARE or (sensor, tare_id) in self._told or self._tares is None:
            return
        tare = self._tares.find(sensor, tare_id)
        if tare is not None and self._view is not None:
            self._told.add((sensor, tare_id))
            self._view.offer(ViewMessage(sensor, TARE.name, TARE.codec.encode(tare)))
