"""Whom a subscriber follows, what it keeps of them, and how its threads wait."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from palpate.bus import Delivery, Publisher, Session
from palpate.bus.pubsub import MOST_SOURCES
from palpate.bus.topics import ELECTRODES, sensor_key
from palpate.codec import ELECTRODE_FRAME
from palpate.config import LinkConfig
from palpate.errors import LinkError, StreamTimeout
from palpate.messages import ElectrodeFrame

FrameOf = Callable[..., ElectrodeFrame]
WaitUntil = Callable[..., None]
LIVE_S = 20.0


def invent(session: Session, frame: ElectrodeFrame, count: int) -> None:
    """One frame each under so many names that nobody has announced."""
    payload = ELECTRODE_FRAME.encode(frame)
    for number in range(count):
        session._raw.put(
            sensor_key("lab", f"invented{number}", "electrodes"),
            payload,
            encoding=ELECTRODES.encoding,
        )


class TestNames:
    def test_invented_names_take_no_place_of_a_sensor_that_is_followed(
        self, pair: Any, frame_of: FrameOf, wait_until: WaitUntil
    ) -> None:
        a, b = pair
        subscriber = b.subscriber(ELECTRODES)
        finger = a.publisher(ELECTRODES, sensor="finger")
        wait_until(finger.matched)
        finger.put(frame_of(1))
        assert subscriber.next(LIVE_S).sensor == "finger"
        names = 5 * MOST_SOURCES
        invent(a, frame_of(1), names)
        wait_until(lambda: subscriber.counters.get("received") == names + 1, LIVE_S)
        assert subscriber.counters["rejected_names"] == names + 1 - MOST_SOURCES
        assert len(subscriber.next_batch(LIVE_S, most=names)) == MOST_SOURCES - 1
        finger.put(frame_of(2))
        assert subscriber.next(LIVE_S).message.stamp.sequence == 2
        assert len(subscriber._sources) == MOST_SOURCES

    def test_only_announced_sensors_are_followed(
        self, pair: Any, frame_of: FrameOf, wait_until: WaitUntil
    ) -> None:
        a, b = pair
        subscriber = b.subscriber(ELECTRODES, announced=True)
        finger = a.publisher(ELECTRODES, sensor="finger")
        wait_until(finger.matched)
        invent(a, frame_of(1), 3 * MOST_SOURCES)
        finger.put(frame_of(1))
        wait_until(lambda: subscriber.counters.get("received", 0) > 3 * MOST_SOURCES, LIVE_S)
        assert subscriber.counters["unannounced"] == 3 * MOST_SOURCES + 1
        assert subscriber.next_batch(0.0) == []
        assert not subscriber._sources

        with a.claims(session_id=7, instance="gateway", lease_s=2.0) as claims:
            claims.want("finger")
            assert claims.wait("finger", LIVE_S)
            sequence = 1

            def followed() -> bool:
                nonlocal sequence
                sequence += 1
                finger.put(frame_of(sequence, session_id=7))
                return bool(subscriber.next_batch(0.1))

            wait_until(followed, LIVE_S)
            assert "rejected_names" not in subscriber.counters

    def test_of_many_those_that_are_named(
        self, pair: Any, frame_of: FrameOf, wait_until: WaitUntil
    ) -> None:
        a, b = pair
        subscriber = b.subscriber(ELECTRODES, sensors=("left", "right"))
        fingers = [a.publisher(ELECTRODES, sensor=name) for name in ("left", "thumb", "right")]
        wait_until(lambda: all(finger.matched() for finger in fingers))
        for finger in fingers:
            finger.put(frame_of(1))
        wait_until(lambda: subscriber.counters.get("received") == 3, LIVE_S)
        assert {got.sensor for got in subscriber.next_batch(LIVE_S)} == {"left", "right"}
        assert subscriber.counters["of_others"] == 1


class TestSessions:
    def test_the_frames_of_two_gateways_are_never_mixed(
        self, pair: Any, frame_of: FrameOf, wait_until: WaitUntil
    ) -> None:
        a, b = pair
        newest, queued = b.subscriber(ELECTRODES), b.subscriber(ELECTRODES, delivery=Delivery.QUEUE)
        finger = a.publisher(ELECTRODES, sensor="finger")
        wait_until(finger.matched)
        for sequence in (1, 2):
            finger.put(frame_of(sequence, session_id=1))
        for sequence in range(3, 20):
            finger.put(frame_of(1000 + sequence, session_id=2))
            finger.put(frame_of(sequence, session_id=1))
        wait_until(
            lambda: newest.counters.get("received") == queued.counters.get("received") == 36, LIVE_S
        )
        got = queued.next_batch(LIVE_S)
        assert [one.message.stamp.sequence for one in got] == list(range(1, 20))
        assert newest.latest(LIVE_S).message.stamp.session_id == 1
        for subscriber in (newest, queued):
            assert subscriber.counters["other_session"] == 17
            assert "lost_on_bus" not in subscriber.counters


class TestWaiting:
    def test_a_batch_is_what_waits(
        self, pair: Any, frame_of: FrameOf, wait_until: WaitUntil
    ) -> None:
        a, b = pair
        subscriber = b.subscriber(ELECTRODES)
        assert subscriber.next_batch(0.01) == []
        fingers = [a.publisher(ELECTRODES, sensor=name) for name in ("left", "right", "thumb")]
        wait_until(lambda: all(finger.matched() for finger in fingers))
        for finger in fingers:
            finger.put(frame_of(1))
        wait_until(lambda: subscriber.counters.get("received") == 3, LIVE_S)
        assert [got.sensor for got in subscriber.next_batch(LIVE_S, most=2)] == ["left", "right"]
        assert [got.sensor for got in subscriber.next_batch(LIVE_S, most=2)] == ["thumb"]
        threading.Timer(0.2, lambda: fingers[1].put(frame_of(2))).start()
        fingers[0].put(frame_of(2))
        got = subscriber.next_batch(LIVE_S, most=2, more_s=LIVE_S)
        assert [one.sensor for one in got] == ["left", "right"], "it waited for the second"

    def test_a_wait_ends_in_time_and_nobody_sees_how(
        self, link: LinkConfig, frame_of: FrameOf
    ) -> None:
        with Session.open(link) as session:
            tap = session.tap([ELECTRODES])
            others = [session.subscriber(ELECTRODES, delivery=way) for way in Delivery]
            exact = session.subscriber(ELECTRODES, sensor="finger")
            for _ in range(3):
                began_s = time.monotonic()
                with pytest.raises(StreamTimeout):
                    exact.next(0.05)
                assert 0.05 <= time.monotonic() - began_s < LIVE_S
            with pytest.raises(StreamTimeout):
                tap.next(0.05)
            assert not any(one.counters for one in (*others, exact))
            assert not tap.counters
            session.publisher(ELECTRODES, sensor="finger").put(frame_of(1))
            assert exact.next(LIVE_S).message.stamp.sequence == 1
            assert tap.next(LIVE_S).sensor == "finger"

    def test_who_waits_is_told_that_it_was_closed(self, link: LinkConfig) -> None:
        with Session.open(link) as session:
            subscriber = session.subscriber(ELECTRODES)
            threading.Timer(0.2, subscriber.close).start()
            with pytest.raises(LinkError, match="closed"):
                subscriber.next(LIVE_S)
            assert subscriber.counters == {}

    def test_a_session_closes_while_threads_close_and_publish_what_is_its(
        self, link: LinkConfig, frame_of: FrameOf
    ) -> None:
        ended: list[int] = []
        for count in range(1, 31):
            with Session.open(link) as session:
                subscriber = session.subscriber(ELECTRODES)
                newest = session.subscriber(ELECTRODES, delivery=Delivery.NEWEST)
                finger = session.publisher(ELECTRODES, sensor="finger")

                def publish(finger: Publisher[ElectrodeFrame] = finger) -> None:
                    try:
                        while True:
                            finger.put(frame_of(1))
                    except LinkError:
                        ended.append(threading.get_ident())

                threads = [
                    threading.Thread(target=target, daemon=True)
                    for target in (publish, publish, subscriber.close, newest.close, finger.close)
                ]
                for thread in threads:
                    thread.start()
            for thread in threads:
                thread.join(LIVE_S)
                assert not thread.is_alive()
            assert len(ended) == 2 * count

    def test_others_may_look_while_one_waits(
        self, pair: Any, frame_of: FrameOf, wait_until: WaitUntil
    ) -> None:
        a, b = pair
        count = 500
        subscriber = b.subscriber(ELECTRODES, depth=count)
        finger = a.publisher(ELECTRODES, sensor="finger", lossless=True)
        wait_until(finger.matched)
        done = threading.Event()

        def look() -> None:
            while not done.is_set():
                assert subscriber.counters.get("lost_on_bus", 0) == 0

        lookers = [threading.Thread(target=look) for _ in range(2)]
        for thread in lookers:
            thread.start()
        try:
            for sequence in range(1, count + 1):
                finger.put(frame_of(sequence))
                if sequence % 7 == 0:
                    time.sleep(0.001)
            got = [subscriber.next(LIVE_S).message.stamp.sequence for _ in range(count)]
        finally:
            done.set()
            for thread in lookers:
                thread.join()
        assert got == list(range(1, count + 1))
        assert subscriber.counters == {"received": count, "delivered": count}
