"""Streams on loopback: what each delivery promises, and what is refused is counted."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import zenoh

from palpate.bus import Delivery, Session
from palpate.bus.topics import ELECTRODES, TARE, sensor_key
from palpate.codec import ELECTRODE_FRAME
from palpate.config import LinkConfig
from palpate.errors import (
    LinkError,
    StaleError,
    StreamTimeout,
)
from palpate.messages import (
    ElectrodeFrame,
    Origin,
)

FrameOf = Callable[..., ElectrodeFrame]
WaitUntil = Callable[..., None]

PATIENCE_S = 20.0


def test_frames_arrive_equal_and_in_order(
    pair: Any, frame_of: FrameOf, wait_until: WaitUntil
) -> None:
    a, b = pair
    subscriber = b.subscriber(ELECTRODES, delivery=Delivery.QUEUE)
    publisher = a.publisher(ELECTRODES, sensor="finger")
    wait_until(publisher.matched)
    for sequence in range(1, 51):
        publisher.put(frame_of(sequence))
        received = subscriber.next(PATIENCE_S)
        assert received.message.stamp.sequence == sequence
        assert (received.station, received.sensor) == ("lab", "finger")
    assert subscriber.counters["delivered"] == 50
    assert "lost_on_bus" not in subscriber.counters


def test_newest_wins_and_the_dropped_are_counted_but_not_as_lost(
    pair: Any, frame_of: FrameOf, wait_until: WaitUntil
) -> None:
    a, b = pair
    subscriber = b.subscriber(ELECTRODES, delivery=Delivery.NEWEST)
    fingers = [a.publisher(ELECTRODES, sensor=name, lossless=True) for name in ("left", "right")]
    wait_until(lambda: all(p.matched() for p in fingers))
    for sequence in range(1, 21):
        for publisher in fingers:
            publisher.put(frame_of(sequence))
    wait_until(lambda: subscriber.counters.get("received") == 40)
    got = {subscriber.next(PATIENCE_S).sensor: None for _ in range(2)}
    assert set(got) == {"left", "right"}
    with pytest.raises(StreamTimeout):
        subscriber.next(timeout_s=0.05)
    fingers[0].put(frame_of(21))
    fingers[1].put(frame_of(24))
    assert {subscriber.next(PATIENCE_S).message.stamp.sequence for _ in range(2)} == {21, 24}
    assert subscriber.counters["dropped"] == 38
    assert subscriber.counters["lost_on_bus"] == 3  # 21, 22, 23 of the right finger


def test_a_deeper_newest_keeps_the_last_few_in_order(
    pair: Any, frame_of: FrameOf, wait_until: WaitUntil
) -> None:
    a, b = pair
    subscriber = b.subscriber(ELECTRODES, delivery=Delivery.NEWEST, depth=3)
    publisher = a.publisher(ELECTRODES, sensor="finger", lossless=True)
    wait_until(publisher.matched)
    for sequence in range(1, 11):
        publisher.put(frame_of(sequence))
    wait_until(lambda: subscriber.counters.get("received") == 10)
    assert [subscriber.next(PATIENCE_S).message.stamp.sequence for _ in range(3)] == [8, 9, 10]
    with pytest.raises(StreamTimeout):
        subscriber.next(timeout_s=0.05)
    assert subscriber.counters["dropped"] == 7
    assert "lost_on_bus" not in subscriber.counters


def test_every_loses_nothing_with_a_slow_consumer(
    pair: Any, frame_of: FrameOf, wait_until: WaitUntil
) -> None:
    a, b = pair
    subscriber = b.subscriber(ELECTRODES, delivery=Delivery.EVERY, capacity=8)
    publisher = a.publisher(ELECTRODES, sensor="finger", lossless=True)
    wait_until(publisher.matched)
    count = 3000

    def send() -> None:
        for sequence in range(1, count + 1):
            publisher.put(frame_of(sequence, origin=Origin.REPLAYED))

    sender = threading.Thread(target=send)
    sender.start()
    for sequence in range(1, count + 1):
        if sequence % 100 == 0:
            time.sleep(0.002)
        assert subscriber.next(PATIENCE_S).message.stamp.sequence == sequence
    sender.join()
    assert "overflow" not in subscriber.counters


def test_without_direct_links_nothing_is_overtaken(link: LinkConfig, frame_of: FrameOf) -> None:
    """Frames that are sent while links still come up arrive in order: there is one path."""
    indirect = link.model_copy(update={"direct": False})
    count = 2000
    with Session.open(indirect) as a:
        subscriber = a.subscriber(ELECTRODES, delivery=Delivery.EVERY, capacity=64)
        with Session.open(indirect) as b:
            publisher = b.publisher(ELECTRODES, sensor="finger", lossless=True)

            def send() -> None:
                for sequence in range(1, count + 1):
                    publisher.put(frame_of(sequence, origin=Origin.REPLAYED))

            sender = threading.Thread(target=send)
            sender.start()
            got = [subscriber.next(PATIENCE_S).message.stamp.sequence]
            while got[-1] < count:
                got.append(subscriber.next(PATIENCE_S).message.stamp.sequence)
            sender.join()
    assert got == list(range(got[0], count + 1))
    assert not {"reordered", "restarts", "lost_on_bus"} & set(subscriber.counters)


def test_a_tap_keeps_the_order_across_topics(
    link: LinkConfig, frame_of: FrameOf, examples: dict[str, Any], wait_until: WaitUntil
) -> None:
    """A recorded frame must not stand before the tare that was sent before it."""
    indirect = link.model_copy(update={"direct": False})
    with Session.open(indirect) as a, Session.open(indirect) as b:
        tap = a.tap([ELECTRODES, TARE], delivery=Delivery.EVERY, capacity=4096)
        tares = b.publisher(TARE, sensor="finger", lossless=True)
        frames = b.publisher(ELECTRODES, sensor="finger", lossless=True)
        wait_until(lambda: tares.matched() and frames.matched())
        for sequence in range(1, 501):
            tares.put(examples["Tare"])
            frames.put(frame_of(sequence))
        topics = [tap.next(PATIENCE_S).topic for _ in range(1000)]
    assert topics == ["tare", "electrodes"] * 500


def test_a_full_queue_counts_what_it_refuses(
    pair: Any, frame_of: FrameOf, wait_until: WaitUntil
) -> None:
    a, b = pair
    subscriber = b.subscriber(ELECTRODES, delivery=Delivery.QUEUE, capacity=10)
    publisher = a.publisher(ELECTRODES, sensor="finger", lossless=True)
    wait_until(publisher.matched)
    for sequence in range(1, 31):
        publisher.put(frame_of(sequence))
    wait_until(lambda: subscriber.counters.get("received") == 30)
    got = [subscriber.next(PATIENCE_S).message.stamp.sequence for _ in range(10)]
    assert got == list(range(1, 11))
    assert subscriber.counters["overflow"] == 20


def test_latest_never_returns_an_old_reading(
    pair: Any, frame_of: FrameOf, wait_until: WaitUntil
) -> None:
    a, b = pair
    subscriber = b.subscriber(ELECTRODES)
    with pytest.raises(StaleError, match="arrived yet"):
        subscriber.latest(max_age_s=PATIENCE_S)
    publisher = a.publisher(ELECTRODES, sensor="finger")
    wait_until(publisher.matched)
    publisher.put(frame_of(1))
    wait_until(lambda: subscriber.counters.get("received"))
    for _ in range(2):  # nothing is consumed
        assert subscriber.latest(max_age_s=PATIENCE_S).message.stamp.sequence == 1
    # Old by its stamp though it has just arrived.
    old_ns = time.monotonic_ns() - round(2e9 * PATIENCE_S)
    publisher.put(frame_of(2, monotonic_ns=old_ns))
    wait_until(lambda: subscriber.counters["received"] == 2)
    with pytest.raises(StaleError, match="s old"):
        subscriber.latest(max_age_s=PATIENCE_S)
    # From another host's clock, so the wall clock decides.
    publisher.put(frame_of(3, clock_id=1, monotonic_ns=0))
    wait_until(lambda: subscriber.counters["received"] == 3)
    assert subscriber.latest(max_age_s=PATIENCE_S).message.stamp.sequence == 3


def test_duplicates_are_dropped_and_a_restarted_sender_is_followed(
    pair: Any, frame_of: FrameOf, wait_until: WaitUntil
) -> None:
    a, b = pair
    subscriber = b.subscriber(ELECTRODES, delivery=Delivery.QUEUE)
    publisher = a.publisher(ELECTRODES, sensor="finger", lossless=True)
    wait_until(publisher.matched)
    first, fifth = frame_of(1), frame_of(5)
    for frame in (first, fifth, frame_of(6), fifth, first, frame_of(1), frame_of(2)):
        publisher.put(frame)
    assert [subscriber.next(PATIENCE_S).message.stamp.sequence for _ in range(5)] == [1, 5, 6, 1, 2]
    assert subscriber.counters["reordered"] == 2
    assert subscriber.counters["restarts"] == 1
    assert subscriber.counters["lost_on_bus"] == 3


def test_bad_payloads_are_counted_and_skipped(
    link: LinkConfig, frame_of: FrameOf, examples: dict[str, Any], wait_until: WaitUntil
) -> None:
    """Wrong schema, future contract, 18 electrodes, noise: counted by reason; good frames flow."""
    key = sensor_key("lab", "finger", "electrodes")
    good = ELECTRODE_FRAME.encode(frame_of(1))
    message = ELECTRODE_FRAME.message_type.FromString(good)
    message.electrodes = b"\0" * 36  # type: ignore[attr-defined]
    encoding = "application/protobuf;palpate.v1.ElectrodeFrame"
    bad = [
        (good, "application/protobuf;palpate.v1.WrenchFrame", "schema"),
        (good, "application/protobuf;palpate.v2.ElectrodeFrame", "future_contract"),
        (good, "text/plain", "schema"),
        (message.SerializeToString(), encoding, "electrode_count"),
        (b"\xff" * 40, encoding, "parse"),
        (b"", encoding, "sensor_type"),
    ]
    with Session.open(link) as session, Session.open(link) as other:
        subscriber = session.subscriber(ELECTRODES, delivery=Delivery.QUEUE)
        raw = other._raw  # a sender that does not keep the contract
        publisher = other.publisher(ELECTRODES, sensor="finger")
        wait_until(publisher.matched)
        for payload, wrong, _ in bad:
            raw.put(key, payload, encoding=zenoh.Encoding(wrong))
        # Another priority would overtake them.
        wait_until(lambda: subscriber.counters.get("received") == len(bad))
        publisher.put(frame_of(1))
        assert subscriber.next(PATIENCE_S).message.stamp.sequence == 1
        rejected = {k: v for k, v in subscriber.counters.items() if k.startswith("rejected_")}
        assert sum(rejected.values()) == len(bad)
        assert rejected["rejected_schema"] == 2
        for _, _, reason in bad:
            assert f"rejected_{reason}" in rejected


def test_ten_thousand_random_payloads_on_the_bus_are_all_accounted_for(
    link: LinkConfig, frame_of: FrameOf, wait_until: WaitUntil
) -> None:
    random = np.random.default_rng(7)
    key = sensor_key("lab", "finger", "electrodes")
    good = ELECTRODE_FRAME.encode(frame_of(1))
    count = 10_000
    with Session.open(link) as session, Session.open(link) as other:
        subscriber = session.subscriber(ELECTRODES, delivery=Delivery.QUEUE, capacity=count)
        publisher = other.publisher(ELECTRODES, sensor="finger", lossless=True)
        wait_until(publisher.matched)
        for _ in range(count):
            payload = bytearray(good)
            payload[int(random.integers(len(payload)))] ^= 1 << int(random.integers(8))
            publisher.put_payload(bytes(payload))
        wait_until(lambda: subscriber.counters["received"] == count)
        with contextlib.suppress(StreamTimeout):
            while True:
                subscriber.next(timeout_s=0.2)
        counters = subscriber.counters
        names = ("delivered", "reordered", "other_session")
        counted = sum(v for k, v in counters.items() if k in names or k.startswith("rejected_"))
        assert count - 1 <= counted <= count, "one may be held until another follows"
        assert counted - counters["delivered"] > count / 20
    assert key.endswith("/finger/electrodes")


@pytest.mark.parametrize("delivery", [Delivery.NEWEST, Delivery.QUEUE])
def test_how_many_wait_is_known(
    pair: Any, frame_of: FrameOf, wait_until: WaitUntil, delivery: Delivery
) -> None:
    a, b = pair
    stream = b.subscriber(ELECTRODES, delivery=delivery, depth=3)
    tap = b.tap([ELECTRODES])
    publisher = a.publisher(ELECTRODES, sensor="finger", lossless=True)
    wait_until(publisher.matched)
    for sequence in range(1, 4):
        publisher.put(frame_of(sequence))
    wait_until(lambda: (stream.waiting, tap.waiting) == (3, 3))
    stream.next(PATIENCE_S)
    tap.next(PATIENCE_S)
    assert (stream.waiting, tap.waiting) == (2, 2)


@pytest.mark.parametrize("delivery", Delivery)
@pytest.mark.parametrize("closed", ["stream", "session"])
def test_one_that_waits_is_told_that_it_is_closed(delivery: Delivery, closed: str) -> None:
    """With ``QUEUE`` and ``EVERY`` it waited on, and then said that nothing had come."""
    with Session.open(LinkConfig(connect=())) as session:
        stream = session.subscriber(ELECTRODES, delivery=delivery)
        waits = threading.Event()
        told: list[Exception] = []

        def wait() -> None:
            waits.set()
            try:
                stream.next(PATIENCE_S)
            except Exception as error:
                told.append(error)

        thread = threading.Thread(target=wait)
        thread.start()
        assert waits.wait(PATIENCE_S)
        (stream if closed == "stream" else session).close()
        thread.join(2 * PATIENCE_S)
        assert [type(one) for one in told] == [LinkError]
        with pytest.raises(LinkError, match="closed"):
            stream.next(0.0)


def test_a_tap_is_emptied_after_it_was_closed(
    pair: tuple[Session, Session], frame_of: FrameOf, wait_until: WaitUntil
) -> None:
    a, b = pair
    tap = b.tap([ELECTRODES])
    publisher = a.publisher(ELECTRODES, sensor="finger")
    wait_until(publisher.matched)
    for sequence in (1, 2):
        publisher.put(frame_of(sequence))
    wait_until(lambda: tap.waiting == 2)
    tap.close()
    for _ in range(2):
        assert tap.next(0.0).sensor == "finger"
    with pytest.raises(LinkError, match="electrodes is closed"):
        tap.next(0.0)
