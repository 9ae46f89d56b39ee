"""Queries that always answer, presence, health, tares, the robot's client, joining the bus."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import zenoh

from palpate.bus import Delivery, Session, Subscriber, endpoints, run_router
from palpate.bus.tares import TareBook
from palpate.bus.topics import FEATURES, STATUS, sensor_key
from palpate.client import Client
from palpate.config import LinkConfig, parse_config
from palpate.errors import (
    ConfigError,
    DeviceError,
    ErrorCode,
    LinkError,
    RemoteError,
    StaleError,
    StreamTimeout,
)
from palpate.health import Health, HealthReporter
from palpate.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    ServiceState,
    Tare,
    TareRequest,
)

FrameOf = Callable[..., ElectrodeFrame]
WaitUntil = Callable[..., None]

PATIENCE_S = 20.0


def test_a_query_always_answers(pair: Any, examples: dict[str, Any], wait_until: WaitUntil) -> None:
    a, b = pair
    tare: Tare = examples["Tare"]

    def handler(request: TareRequest) -> Tare:
        if request.tare_id == 1:
            raise DeviceError("electrode E7 moves by 40 counts", remedy="lift the finger")
        if request.tare_id == 2:
            raise ZeroDivisionError("a defect")
        return tare

    a.queryable(endpoints.TARE, handler, sensor="finger")

    def ask(tare_id: int, **more: Any) -> Tare:
        reply: Tare = b.query(endpoints.TARE, TareRequest(tare_id), **{"sensor": "finger", **more})
        return reply

    wait_until(lambda: b.alive() == [])
    deadline = time.monotonic() + 30
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
    with pytest.raises(LinkError, match="nobody answers on"):
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


def test_a_slow_or_overloaded_service_is_told_as_such(
    pair: Any, examples: dict[str, Any], wait_until: WaitUntil
) -> None:
    a, b = pair
    busy, release = threading.Event(), threading.Event()

    def slow(_: TareRequest) -> Tare:
        busy.set()
        release.wait(PATIENCE_S)
        tare: Tare = examples["Tare"]
        return tare

    asked = a.queryable(endpoints.TARE, slow, sensor="finger", capacity=1)

    def ask(timeout_s: float = PATIENCE_S) -> ErrorCode | None:
        try:
            b.query(endpoints.TARE, TareRequest(), sensor="finger", timeout_s=timeout_s)
        except (LinkError, RemoteError, StreamTimeout) as error:
            return error.code
        return None

    release.set()
    wait_until(lambda: ask() is None)  # the other side has heard of it
    for event in (release, busy):
        event.clear()
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(ask)
        wait_until(busy.is_set)
        assert ask(0.3) is ErrorCode.DEADLINE_EXCEEDED, "it waits behind the first"
        assert asked.waiting == 1
        with asked._lock:
            asked._service_s = 60.0  # it would be asked again when that has passed
        assert [ask() for _ in range(4)] == [ErrorCode.RESOURCE_EXHAUSTED] * 4
        release.set()
        assert first.result(PATIENCE_S) is None
    release.clear()
    assert ask(0.3) is ErrorCode.DEADLINE_EXCEEDED, "it is worked for"
    release.set()


def test_a_quick_question_overtakes_a_slow_one(pair: Any, examples: dict[str, Any]) -> None:
    """Looking up a known tare must not wait for a tare that is being taken."""
    a, b = pair
    release = threading.Event()

    def handler(request: TareRequest) -> Tare:
        if request.tare_id == 0:
            release.wait(10)
        tare: Tare = examples["Tare"]
        return tare

    a.queryable(endpoints.TARE, handler, sensor="finger", workers=2)
    time.sleep(0.3)

    def ask(tare_id: int) -> Tare:
        reply: Tare = b.query(endpoints.TARE, TareRequest(tare_id), sensor="finger", timeout_s=5)
        return reply

    slow = threading.Thread(target=ask, args=(0,))
    slow.start()
    time.sleep(0.1)
    assert ask(7).tare_id == examples["Tare"].tare_id
    assert slow.is_alive()
    release.set()
    slow.join()


def test_presence_comes_and_goes(pair: Any, wait_until: WaitUntil) -> None:
    a, b = pair
    with a.presence("features", instance="features") as presence:
        wait_until(lambda: [(x.service, x.ready) for x in b.alive()] == [("features", False)])
        presence.ready()
        wait_until(lambda: [x.ready for x in b.alive()] == [True])
        presence.not_ready()
        wait_until(lambda: [x.ready for x in b.alive()] == [False])
    wait_until(lambda: b.alive() == [])


@pytest.mark.parametrize("direct", [True, False])
def test_no_router_is_said_and_what_to_do(free_port: int, direct: bool) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    link = LinkConfig(connect=(endpoint,), wait_for_router_s=0.3, direct=direct)
    with pytest.raises(LinkError, match=rf"no router at tcp/127.0.0.1:{free_port}.*palpate up"):
        Session.open(link)


@pytest.mark.parametrize("direct", [True, False])
def test_a_host_that_cannot_be_is_said(direct: bool) -> None:
    link = LinkConfig(connect=("tcp/lab..pc:7447",), wait_for_router_s=0.3, direct=direct)
    with pytest.raises(LinkError, match=r"lab\.\.pc:7447"):
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

    a.queryable(endpoints.TARE, handler, sensor="finger")
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


@pytest.mark.parametrize("name", ["estimate_features", "estimate_field"])
def test_the_first_frame_is_waited_for_within_the_time_of_the_question(
    link: LinkConfig, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    waits: list[float] = []
    wait = Subscriber.next

    def noted(self: Subscriber[Any], timeout_s: float) -> Any:
        waits.append(timeout_s)
        return wait(self, timeout_s)

    monkeypatch.setattr(Subscriber, "next", noted)
    with Client(link.connect[0], timeout_s=2.0) as robot:
        with pytest.raises(StaleError, match="has arrived yet"):
            getattr(robot, name)("elbow", timeout_s=0.1)
        assert 0.0 < max(waits) <= 0.1, "not the client's"
        with pytest.raises(ConfigError, match="timeout_s"):
            getattr(robot, name)("elbow", timeout_s=-1.0)


def test_only_the_first_call_of_a_sensor_waits(
    link: LinkConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A control loop that asks for a sensor that is not there must not stop at each call."""
    waits: list[float] = []
    wait = Subscriber.next

    def noted(self: Subscriber[Any], timeout_s: float) -> Any:
        waits.append(timeout_s)
        return wait(self, timeout_s)

    monkeypatch.setattr(Subscriber, "next", noted)
    with Client(link.connect[0], timeout_s=1.0) as robot:
        for sensor, is_first in (("thumb", True), ("thumb", False), ("index", True)):
            waits.clear()
            begin = time.monotonic()
            with pytest.raises(StaleError, match="has arrived yet"):
                robot.features(sensor)
            assert bool(waits) is is_first
            assert time.monotonic() - begin >= (1.0 if is_first else 0.0)
