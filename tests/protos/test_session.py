"""The bus on loopback: deliveries, rejects, queries that always answer, presence."""

from __future__ import annotations

import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import zenoh

from palpate.protos import clock
from palpate.protos.client import Client
from palpate.protos.codec import ELECTRODE_FRAME, TARE, TARE_REQUEST
from palpate.protos.config import LinkConfig, parse_config
from palpate.protos.errors import (
    ConfigError,
    DeviceError,
    ErrorCode,
    LinkError,
    RemoteError,
    StaleError,
    StreamTimeout,
)
from palpate.protos.health import Health, HealthReporter
from palpate.protos.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    Origin,
    ServiceState,
    Tare,
    TareRequest,
)
from palpate.protos.session import Delivery, Session, run_router
from palpate.protos.tares import TareBook
from palpate.protos.topics import ELECTRODES, FEATURES, STATUS, sensor_key

FrameOf = Callable[..., ElectrodeFrame]


@pytest.fixture
def frame_of(examples: dict[str, Any]) -> FrameOf:
    def make(sequence: int, **stamp: Any) -> ElectrodeFrame:
        monotonic_ns, wall_ns = clock.now()
        facts = {
            "sequence": sequence,
            "monotonic_ns": monotonic_ns,
            "wall_ns": wall_ns,
            "clock_id": clock.CLOCK_ID,
        }
        frame: ElectrodeFrame = examples["ElectrodeFrame"]
        return dataclasses.replace(
            frame, stamp=dataclasses.replace(frame.stamp, **{**facts, **stamp})
        )

    return make


def wait_until(condition: Callable[[], object], timeout_s: float = 5.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "did not happen in time"
        time.sleep(0.01)


@pytest.fixture
def pair(link: LinkConfig) -> Any:
    """Two sessions on one bus."""
    with Session.open(link) as a, Session.open(link) as b:
        yield a, b


def test_frames_arrive_equal_and_in_order(pair: Any, frame_of: FrameOf) -> None:
    a, b = pair
    subscriber = b.subscriber(ELECTRODES, delivery=Delivery.QUEUE)
    publisher = a.publisher(ELECTRODES, sensor="finger")
    wait_until(publisher.matched)
    for sequence in range(1, 51):
        publisher.put(frame_of(sequence))
        received = subscriber.next(timeout_s=2)
        assert received.message.stamp.sequence == sequence
        assert (received.station, received.sensor) == ("lab", "finger")
    assert subscriber.counters["delivered"] == 50
    assert "lost_on_bus" not in subscriber.counters


def test_newest_wins_and_the_dropped_are_counted_but_not_as_lost(
    pair: Any, frame_of: FrameOf
) -> None:
    a, b = pair
    subscriber = b.subscriber(ELECTRODES, delivery=Delivery.NEWEST)
    fingers = [a.publisher(ELECTRODES, sensor=name) for name in ("left", "right")]
    wait_until(lambda: all(p.matched() for p in fingers))
    for sequence in range(1, 21):
        for publisher in fingers:
            publisher.put(frame_of(sequence))
    wait_until(lambda: subscriber.counters["received"] == 40)
    got = {subscriber.next(1).sensor: None for _ in range(2)}
    assert set(got) == {"left", "right"}
    with pytest.raises(StreamTimeout):
        subscriber.next(timeout_s=0.05)
    fingers[0].put(frame_of(21))
    fingers[1].put(frame_of(24))
    assert {subscriber.next(1).message.stamp.sequence for _ in range(2)} == {21, 24}
    assert subscriber.counters["dropped"] == 38
    assert subscriber.counters["lost_on_bus"] == 3  # 21, 22, 23 of the right finger


def test_every_loses_nothing_with_a_slow_consumer(pair: Any, frame_of: FrameOf) -> None:
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
        assert subscriber.next(timeout_s=5).message.stamp.sequence == sequence
    sender.join()
    assert "overflow" not in subscriber.counters


def test_a_full_queue_counts_what_it_refuses(pair: Any, frame_of: FrameOf) -> None:
    a, b = pair
    subscriber = b.subscriber(ELECTRODES, delivery=Delivery.QUEUE, capacity=10)
    publisher = a.publisher(ELECTRODES, sensor="finger")
    wait_until(publisher.matched)
    for sequence in range(1, 31):
        publisher.put(frame_of(sequence))
    wait_until(lambda: subscriber.counters["received"] == 30)
    assert [subscriber.next(1).message.stamp.sequence for _ in range(10)] == list(range(1, 11))
    assert subscriber.counters["overflow"] == 20


def test_latest_never_returns_an_old_reading(pair: Any, frame_of: FrameOf) -> None:
    a, b = pair
    subscriber = b.subscriber(ELECTRODES)
    with pytest.raises(StaleError, match="ever arrived"):
        subscriber.latest(max_age_s=1)
    publisher = a.publisher(ELECTRODES, sensor="finger")
    wait_until(publisher.matched)
    publisher.put(frame_of(1))
    wait_until(lambda: subscriber.counters.get("received"))
    assert subscriber.latest(max_age_s=5).message.stamp.sequence == 1
    assert subscriber.latest(max_age_s=5).message.stamp.sequence == 1  # nothing was consumed
    # Old by its stamp though it has just arrived.
    publisher.put(frame_of(2, monotonic_ns=time.monotonic_ns() - 10_000_000_000))
    wait_until(lambda: subscriber.counters["received"] == 2)
    with pytest.raises(StaleError, match="s old"):
        subscriber.latest(max_age_s=5)
    # From another host's clock, so the wall clock decides.
    publisher.put(frame_of(3, clock_id=1, monotonic_ns=0))
    wait_until(lambda: subscriber.counters["received"] == 3)
    assert subscriber.latest(max_age_s=5).message.stamp.sequence == 3


def test_duplicates_are_dropped_and_a_restarted_sender_is_followed(
    pair: Any, frame_of: FrameOf
) -> None:
    a, b = pair
    subscriber = b.subscriber(ELECTRODES, delivery=Delivery.QUEUE)
    publisher = a.publisher(ELECTRODES, sensor="finger")
    wait_until(publisher.matched)
    first, fifth = frame_of(1), frame_of(5)
    for frame in (first, fifth, fifth, first, frame_of(1)):
        publisher.put(frame)
    assert [subscriber.next(1).message.stamp.sequence for _ in range(3)] == [1, 5, 1]
    assert subscriber.counters["reordered"] == 2
    assert subscriber.counters["restarts"] == 1
    assert subscriber.counters["lost_on_bus"] == 3


def test_bad_payloads_are_counted_and_skipped(
    link: LinkConfig, frame_of: FrameOf, examples: dict[str, Any]
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
        assert subscriber.next(timeout_s=2).message.stamp.sequence == 1
        rejected = {k: v for k, v in subscriber.counters.items() if k.startswith("rejected_")}
        assert sum(rejected.values()) == len(bad)
        assert rejected["rejected_schema"] == 2
        for _, _, reason in bad:
            assert f"rejected_{reason}" in rejected


def test_ten_thousand_random_payloads_on_the_bus_are_all_accounted_for(
    link: LinkConfig, frame_of: FrameOf
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
        wait_until(lambda: subscriber.counters["received"] == count, 20)
        with contextlib.suppress(StreamTimeout):
            while True:
                subscriber.next(timeout_s=0.2)
        counters = subscriber.counters
        rejected = sum(v for k, v in counters.items() if k.startswith("rejected_"))
        assert rejected + counters["delivered"] + counters.get("reordered", 0) == count
        assert rejected > count / 20
    assert key.endswith("/finger/electrodes")


def test_a_query_always_answers(pair: Any, examples: dict[str, Any]) -> None:
    a, b = pair
    tare: Tare = examples["Tare"]

    def handler(request: TareRequest) -> Tare:
        if request.tare_id == 1:
            raise DeviceError("electrode E7 moves by 40 counts", remedy="lift the finger")
        if request.tare_id == 2:
            raise ZeroDivisionError("a defect")
        return tare

    a.queryable("tare", sensor="finger", request=TARE_REQUEST, reply=TARE, handler=handler)

    def ask(tare_id: int, **more: Any) -> Tare:
        reply: Tare = b.query(
            "tare",
            request=TareRequest(tare_id),
            request_codec=TARE_REQUEST,
            reply_codec=TARE,
            **{"sensor": "finger", **more},
        )
        return reply

    wait_until(lambda: b.alive() == [])
    deadline = time.monotonic() + 5
    while True:
        try:
            assert ask(0).tare_id == tare.tare_id
            break
        except LinkError:
            assert time.monotonic() < deadline
    with pytest.raises(RemoteError, match="E7 moves") as caught:
        ask(1)
    assert caught.value.code is ErrorCode.DEVICE
    assert caught.value.remedy == "lift the finger"
    with pytest.raises(RemoteError, match="ZeroDivisionError") as caught:
        ask(2)
    assert caught.value.code is ErrorCode.INTERNAL
    with pytest.raises(LinkError, match="nobody answers"):
        ask(0, sensor="thumb")
    for encoding, wanted in (
        ("application/protobuf;palpate.v1.TareRequest", b"do not parse"),
        ("zenoh/bytes", b"TareRequest"),
    ):
        (reply,) = b._raw.get(
            sensor_key("lab", "finger", "tare"),
            payload=b"\xff\xff",
            encoding=zenoh.Encoding(encoding),
        )
        assert reply.err is not None
        assert wanted in reply.err.payload.to_bytes()


def test_a_slow_or_overloaded_service_is_told_as_such(pair: Any, examples: dict[str, Any]) -> None:
    a, b = pair
    release = threading.Event()

    def slow(_: TareRequest) -> Tare:
        release.wait(10)
        tare: Tare = examples["Tare"]
        return tare

    a.queryable("tare", sensor="finger", request=TARE_REQUEST, reply=TARE, handler=slow, capacity=1)
    codes: list[object] = []

    def ask() -> None:
        try:
            b.query(
                "tare",
                sensor="finger",
                request=TareRequest(),
                request_codec=TARE_REQUEST,
                reply_codec=TARE,
                timeout_s=1.0,
            )
        except (RemoteError, StreamTimeout) as error:
            codes.append(error.code)

    time.sleep(0.2)
    askers = [threading.Thread(target=ask) for _ in range(6)]
    for asker in askers:
        asker.start()
        time.sleep(0.02)
    for asker in askers:
        asker.join()
    release.set()
    assert codes.count(ErrorCode.RESOURCE_EXHAUSTED) == 4
    assert codes.count(ErrorCode.DEADLINE_EXCEEDED) == 2


def test_presence_comes_and_goes(pair: Any) -> None:
    a, b = pair
    with a.presence("features", instance="features") as presence:
        wait_until(lambda: [(x.service, x.ready) for x in b.alive()] == [("features", False)])
        presence.ready()
        wait_until(lambda: [x.ready for x in b.alive()] == [True])
        presence.not_ready()
        wait_until(lambda: [x.ready for x in b.alive()] == [False])
    wait_until(lambda: b.alive() == [])


def test_no_router_is_said_and_what_to_do(free_port: int) -> None:
    link = LinkConfig(connect=(f"tcp/127.0.0.1:{free_port}",), wait_for_router_s=0.3)
    with pytest.raises(LinkError, match=rf"no router at tcp/127.0.0.1:{free_port}.*palpate up"):
        Session.open(link)


def test_port_in_use_is_said_and_what_to_do(link: LinkConfig) -> None:
    time.sleep(0.3)
    with pytest.raises(LinkError, match="port in use: tcp/"):
        run_router(link.connect, threading.Event())


def test_an_exposed_listener_needs_mutual_tls() -> None:
    with pytest.raises(ConfigError, match="without mutual TLS"):
        parse_config(LinkConfig, {"listen": ["tcp/0.0.0.0:7447"]}, where="lab.toml [link]")


def test_an_unknown_key_names_file_key_and_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"lab.toml \[link\]: unknown key 'conect'.*'connect'"):
        parse_config(LinkConfig, {"conect": []}, where="lab.toml [link]")


def test_names_that_cannot_stand_in_a_key_are_refused() -> None:
    with pytest.raises(ConfigError, match="'Left Finger'"):
        sensor_key("lab", "Left Finger", "electrodes")


def test_health_is_published_and_answers(pair: Any) -> None:
    a, b = pair
    health = Health("features", "features")
    statuses = b.subscriber(STATUS, delivery=Delivery.QUEUE)
    time.sleep(0.2)
    with HealthReporter(a, health, period_s=0.05):
        health.count("frames_received", 3)
        health.fail(DeviceError("unplugged", remedy="plug it in"))
        seen = statuses.next(timeout_s=2).message
        while seen.state is not ServiceState.DEGRADED:
            seen = statuses.next(timeout_s=2).message
    assert seen.counters["frames_received"] == 3
    assert seen.last_error is not None
    assert seen.last_error.remedy == "plug it in"


def test_a_tare_book_asks_when_it_does_not_know(pair: Any, examples: dict[str, Any]) -> None:
    a, b = pair
    tare: Tare = examples["Tare"]
    asked: list[int] = []

    def handler(request: TareRequest) -> Tare:
        asked.append(request.tare_id)
        return tare

    a.queryable("tare", sensor="finger", request=TARE_REQUEST, reply=TARE, handler=handler)
    book = TareBook(b, query_timeout_s=2)
    time.sleep(0.3)
    assert book.baseline("finger", tare.tare_id).tare_id == tare.tare_id
    assert book.baseline("finger", tare.tare_id).tare_id == tare.tare_id
    assert asked == [tare.tare_id]


def test_a_robot_needs_five_lines(
    link: LinkConfig, frame_of: FrameOf, examples: dict[str, Any]
) -> None:
    estimate: FeatureEstimate = dataclasses.replace(
        examples["FeatureEstimate"], source=frame_of(1).stamp
    )
    stop = threading.Event()

    def serve() -> None:
        with Session.open(link) as session:
            publisher = session.publisher(FEATURES, sensor="finger")
            sequence = 0
            while not stop.is_set():
                sequence += 1
                publisher.put(dataclasses.replace(estimate, source=frame_of(sequence).stamp))
                time.sleep(0.01)

    server = threading.Thread(target=serve)
    server.start()
    try:
        with Client(link.connect[0]) as robot:
            now = robot.features("finger", max_age_s=0.5)
            assert now.force.tolist() == estimate.force.tolist()
            with pytest.raises(StaleError):
                robot.features("thumb")
    finally:
        stop.set()
        server.join()
