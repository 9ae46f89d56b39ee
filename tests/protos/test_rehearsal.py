"""A consumer that waits gets ready for the next message with the last one, without effect."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from palpate.bus import Delivery, ReceivedMessage, Session
from palpate.bus.topics import ELECTRODES
from palpate.messages import ElectrodeFrame

FRAMES = 100


@contextmanager
def stream(
    session: Session, frame_of: Callable[..., ElectrodeFrame], gap_s: float
) -> Iterator[None]:
    publisher = session.publisher(ELECTRODES, sensor="finger")
    deadline_s = time.monotonic() + 20.0
    while not publisher.matched():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)

    def send() -> None:
        for sequence in range(1, FRAMES + 1):
            publisher.put(frame_of(sequence, monotonic_ns=time.monotonic_ns()))
            time.sleep(gap_s)

    sender = threading.Thread(target=send)
    sender.start()
    yield
    sender.join()


@pytest.mark.parametrize("delivery", [Delivery.NEWEST, Delivery.QUEUE])
def test_in_every_pause_once_with_the_last_message(
    pair: tuple[Session, Session],
    frame_of: Callable[..., ElectrodeFrame],
    delivery: Delivery,
) -> None:
    sender, receiver = pair
    rehearsed: list[int] = []
    taken: list[int] = []

    def rehearse(last: ReceivedMessage[ElectrodeFrame]) -> None:
        rehearsed.append(last.message.stamp.sequence)
        assert rehearsed[-1] == taken[-1]

    frames = receiver.subscriber(
        ELECTRODES, sensor="finger", delivery=delivery, depth=FRAMES, rehearse=rehearse
    )
    with stream(sender, frame_of, 0.01):
        while len(taken) < FRAMES:
            taken.append(frames.next(5.0).message.stamp.sequence)
    assert taken == list(range(1, FRAMES + 1))
    assert frames.counters == {"received": FRAMES, "delivered": FRAMES}
    assert len(set(rehearsed)) == len(rehearsed)
    assert bool(rehearsed) is (delivery is Delivery.NEWEST)


def test_not_while_messages_follow_one_another(
    pair: tuple[Session, Session], frame_of: Callable[..., ElectrodeFrame]
) -> None:
    """Nor after the end of a stream: that a message is due is known for one pause only."""
    sender, receiver = pair
    rehearsed: list[float] = []
    frames = receiver.subscriber(
        ELECTRODES,
        sensor="finger",
        depth=FRAMES,
        rehearse=lambda _: rehearsed.append(time.monotonic()),
    )
    with stream(sender, frame_of, 0.0005):
        last_s = time.monotonic()
        while frames.next_batch(0.3):
            last_s = time.monotonic()
    assert sum(when_s > last_s for when_s in rehearsed) <= 1
    assert len(rehearsed) < FRAMES // 2


def test_who_needs_longer_begins_earlier(
    pair: tuple[Session, Session], frame_of: Callable[..., ElectrodeFrame]
) -> None:
    """So that the frame does not find it still rehearsing: a large network takes that long."""
    sender, receiver = pair
    begins: dict[float, dict[int, float]] = {0.0: {}, 0.0018: {}}

    def consume(takes_s: float) -> None:
        def rehearse(last: ReceivedMessage[ElectrodeFrame]) -> None:
            begins[takes_s][last.message.stamp.sequence] = time.monotonic()
            time.sleep(takes_s)

        frames = receiver.subscriber(ELECTRODES, sensor="finger", rehearse=rehearse)
        while frames.next_batch(1.0):
            pass

    consumers = [threading.Thread(target=consume, args=(takes_s,)) for takes_s in begins]
    for consumer in consumers:
        consumer.start()
    with stream(sender, frame_of, 0.01):
        pass
    for consumer in consumers:
        consumer.join()
    quick, slow = begins.values()
    both = sorted(quick.keys() & slow.keys())[10:]
    earlier = sum(slow[sequence] < quick[sequence] for sequence in both)
    assert earlier > len(both) / 2 > 5
