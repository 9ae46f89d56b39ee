"""What a subscriber counts, message by message, without a bus: drops here, losses there."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from palpate.bus import Delivery
from palpate.bus.delivery import FifoQueue, NewestQueue
from palpate.bus.pubsub import Subscriber
from palpate.bus.ring import Alarm
from palpate.bus.tap import Tap
from palpate.bus.topics import ELECTRODES, sensor_key
from palpate.errors import LinkError, StaleError, StreamTimeout
from palpate.messages import ElectrodeFrame, Origin

FrameOf = Callable[..., ElectrodeFrame]
SECOND_NS = 1_000_000_000
RING = 4096


class Bus:
    """Stands for the session; tests hand over messages as its thread would."""

    def __init__(self, delivery: Delivery, *, capacity: int = 100, depth: int | None = None):
        self._callback: Callable[[Any], None] | None = None
        self._ring: deque[Any] = deque(maxlen=RING)
        more: dict[str, Any] = {} if depth is None else {"depth": depth}
        self.subscriber: Subscriber[ElectrodeFrame] = Subscriber(
            self,  # type: ignore[arg-type]
            ELECTRODES,
            "any",
            delivery=delivery,
            alarm=Alarm(),
            capacity=capacity,
            **more,
        )

    def declare_subscriber(self, key: str, handler: Any) -> object:
        assert key == "any"
        if not isinstance(handler, zenoh.handlers.RingChannel):
            self._callback = handler
        ring = SimpleNamespace(try_recv=lambda: self._ring.popleft() if self._ring else None)
        return SimpleNamespace(undeclare=lambda: None, handler=ring)

    def send(self, frame: ElectrodeFrame, sensor: str = "finger") -> None:
        sample = SimpleNamespace(
            key_expr=sensor_key("lab", sensor, "electrodes"),
            encoding=ELECTRODES.encoding,
            attachment=None,
            payload=zenoh.ZBytes(ELECTRODES.codec.encode(frame)),
        )
        if self._callback is None:
            self._ring.append(sample)
        else:
            self._callback(sample)

    def wake(self) -> None:
        """What ends a wait, of this subscriber or another one of the session."""
        self._ring.append(SimpleNamespace(encoding="palpate/wake", payload=b""))

    def come(self, frames: int) -> list[int]:
        """Sequences of the next messages."""
        return [self.subscriber.next(0.0).message.stamp.sequence for _ in range(frames)]

    def count(self, name: str) -> int:
        return self.subscriber.counters.get(name, 0)


def test_newest_wins_counts_what_it_drops_of_each_key() -> None:
    counters: Counter[str] = Counter()
    waiting: NewestQueue[int] = NewestQueue(counters, depth=2)
    for item in range(5):
        waiting.put("a", item)
    waiting.put("b", 10)
    assert [waiting.get(0.0) for _ in range(3)] == [(3, 3), (4, 3), (10, 0)]
    assert waiting.get(0.0) is None
    assert counters == {"dropped": 3}


def test_a_full_queue_counts_what_it_refuses_of_each_key() -> None:
    counters: Counter[str] = Counter()
    waiting: FifoQueue[int] = FifoQueue(counters, 2, sender_waits=False)
    for item in range(4):
        waiting.put("a", item)
    waiting.put("b", 10)
    assert [waiting.get(0.0), waiting.get(0.0)] == [(0, 0), (1, 0)]
    waiting.put("a", 4)
    waiting.put("b", 11)
    assert [waiting.get(0.0), waiting.get(0.0)] == [(4, 2), (11, 1)]
    assert counters == {"overflow": 3}


@pytest.mark.parametrize("delivery", [Delivery.QUEUE, Delivery.EVERY])
@pytest.mark.parametrize("timeout_s", [0.0, 20.0])
def test_what_had_arrived_is_taken_before_the_end_is_told(
    delivery: Delivery, timeout_s: float, frame_of: FrameOf
) -> None:
    bus = Bus(delivery)
    for sequence in (1, 2, 3):
        bus.send(frame_of(sequence))
    bus.subscriber.close()
    assert bus.come(1) == [1]
    left = bus.subscriber.next_batch(timeout_s, more_s=timeout_s)
    assert [one.message.stamp.sequence for one in left] == [2, 3]
    for _ in range(2):
        with pytest.raises(LinkError, match="closed"):
            bus.subscriber.next(timeout_s)


@pytest.mark.parametrize("delivery", [Delivery.NEWEST, Delivery.QUEUE])
def test_what_is_dropped_here_is_not_lost_on_the_bus(delivery: Delivery, frame_of: FrameOf) -> None:
    """Before the first message that is taken, and after each one."""
    bus = Bus(delivery, capacity=1)
    sequence = 0
    for dropped in (2, 3, 0, 1):
        for _ in range(dropped + 1):
            sequence += 1
            bus.send(frame_of(sequence))
        bus.come(1)
    assert bus.count("lost_on_bus") == 0
    assert bus.count("dropped") + bus.count("overflow") == 6
    assert (bus.count("received"), bus.count("delivered")) == (10, 4)


def test_holes_in_the_sequence_are_lost_on_the_bus(frame_of: FrameOf) -> None:
    bus = Bus(Delivery.NEWEST)
    for sequence in (4, 5, 8):  # 6 and 7 never came; 4 is dropped here, before anything is known
        bus.send(frame_of(sequence))
        if sequence != 4:
            bus.come(1)
    assert bus.count("lost_on_bus") == 2
    for sequence in (9, 10, 12):  # 9 and 10 are dropped here, 11 never came
        bus.send(frame_of(sequence))
    assert bus.come(1) == [12]
    assert (bus.count("lost_on_bus"), bus.count("dropped")) == (3, 3)
    bus.send(frame_of(14))
    assert bus.come(1) == [14]
    assert bus.count("lost_on_bus") == 4


def test_what_a_full_ring_has_dropped_is_not_lost_on_the_bus(frame_of: FrameOf) -> None:
    bus = Bus(Delivery.NEWEST, depth=5000)
    bus.send(frame_of(1))
    bus.come(1)
    for sequence in range(2, 5002):
        bus.send(frame_of(sequence))
        if sequence > 5000:
            bus.wake()  # has a place in the ring, too
    assert bus.come(1) == [5003 - RING]
    assert (bus.count("dropped"), bus.count("lost_on_bus")) == (5001 - RING, 0)
    bus.come(RING - 2)
    bus.send(frame_of(5003))
    assert bus.come(1) == [5003]
    assert bus.count("lost_on_bus") == 1


def test_each_sender_has_an_account_of_its_own(frame_of: FrameOf) -> None:
    bus = Bus(Delivery.QUEUE)
    for sequence, sensor in ((1, "finger"), (70, "thumb"), (2, "finger"), (71, "thumb")):
        bus.send(frame_of(sequence), sensor)
    assert bus.come(4) == [1, 70, 2, 71]
    assert bus.count("lost_on_bus") == bus.count("reordered") == bus.count("restarts") == 0


@pytest.mark.parametrize(
    ("origin", "last", "second", "counted"),
    [
        (Origin.LIVE, (7, 5), (7, 5), "reordered"),  # the same message again
        (Origin.LIVE, (7, 5), (6, 4), "reordered"),  # a late one
        (Origin.LIVE, (7, 5), (6, 5), "reordered"),
        (Origin.LIVE, (7, 5), (1, 6), "restarts"),  # counts from 1, by a later clock
        (Origin.LIVE, (1500, 5), (499, 4), "restarts"),  # farther back than messages are reordered
        (Origin.LIVE, (1500, 5), (500, 4), "reordered"),
        (Origin.REPLAYED, (7, 5), (1, 1), "restarts"),  # a record that starts over
        (Origin.REPLAYED, (7, 5), (7, 5), "reordered"),
    ],
)
@pytest.mark.parametrize("delivery", [Delivery.QUEUE, Delivery.EVERY])
def test_a_sequence_that_falls_is_a_restart_or_out_of_order(
    frame_of: FrameOf,
    delivery: Delivery,
    origin: Origin,
    last: tuple[int, int],
    second: tuple[int, int],
    counted: str,
) -> None:
    bus = Bus(delivery)

    def send(sequence: int, at_s: float) -> None:
        bus.send(frame_of(sequence, monotonic_ns=int(at_s * SECOND_NS), origin=origin))

    send(last[0] - 1, last[1] - 0.5)
    send(*last)
    assert bus.come(2) == [last[0] - 1, last[0]]
    send(*second)
    if counted == "restarts" and delivery is Delivery.QUEUE:
        # A wrong message looks the same. The next one tells, and then both are delivered.
        with pytest.raises(StreamTimeout):
            bus.subscriber.next(0.0)
        send(second[0] + 1, second[1] + 0.5)
        assert bus.come(2) == [second[0], second[0] + 1]
    elif counted == "restarts":
        assert bus.come(1) == [second[0]]
    else:
        with pytest.raises(StreamTimeout):
            bus.subscriber.next(0.0)
    assert {name: bus.count(name) for name in ("restarts", "reordered", "lost_on_bus")} == {
        "restarts": 0, "reordered": 0, "lost_on_bus": 0, counted: 1,
    }  # fmt: skip


def test_newest_keeps_one_unless_told_otherwise(frame_of: FrameOf) -> None:
    for depth, kept in ((None, [3]), (2, [2, 3])):
        bus = Bus(Delivery.NEWEST, depth=depth)
        for sequence in (1, 2, 3):
            bus.send(frame_of(sequence))
        assert bus.come(len(kept)) == kept


def test_latest_is_the_newest_of_all_sensors(frame_of: FrameOf) -> None:
    bus = Bus(Delivery.NEWEST)
    with pytest.raises(StaleError, match="has arrived yet"):
        bus.subscriber.latest(10.0)
    bus.send(frame_of(1), "finger")
    bus.send(frame_of(2), "thumb")
    assert bus.subscriber.latest(10.0).message.stamp.sequence == 2
    assert bus.come(2) == [1, 2], "nothing is consumed"


def test_a_tap_skips_and_counts_what_has_no_address(frame_of: FrameOf) -> None:
    session: Any = SimpleNamespace(
        declare_subscriber=lambda key, callback: SimpleNamespace(undeclare=lambda: None)
    )
    tap = Tap(session, ["any"], delivery=Delivery.QUEUE, capacity=10)
    payload = ELECTRODES.codec.encode(frame_of(1))
    for key in ("no/key/of/ours", sensor_key("lab", "finger", "electrodes")):
        tap._on_sample(
            SimpleNamespace(  # type: ignore[arg-type]
                key_expr=key,
                encoding=ELECTRODES.encoding,
                payload=zenoh.ZBytes(payload),
            )
        )
    sample = tap.next(0.0)
    assert (sample.topic, sample.station, sample.sensor) == ("electrodes", "lab", "finger")
    assert sample.payload == payload
    assert ELECTRODES.encoding.endswith(f";{sample.schema}")
    counters = tap.counters
    assert counters.pop("received") == 2
    assert list(counters.values()) == [1], counters
    began = time.monotonic()
    with pytest.raises(StreamTimeout):
        tap.next(0.05)
    assert time.monotonic() - began < 5.0
