"""The robot's client: streams, callbacks, asyncio, and what it refuses by name."""

from __future__ import annotations

import asyncio
import dataclasses
import inspect
import itertools
import logging
import math
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any, cast

import pytest
import zenoh

from palpate import AsyncClient, Client
from palpate.bus import Session, endpoints, run_router
from palpate.bus.topics import FEATURES
from palpate.bus.zenoh_session import close_zenoh
from palpate.client.simulations import straight_path
from palpate.config import LinkConfig
from palpate.errors import (
    ClockSkewError,
    ConfigError,
    LinkError,
    PalpateError,
    SensorChanged,
    StaleError,
    StreamTimeout,
)
from palpate.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    SimulationProgress,
    SimulationReply,
    SimulationRequest,
    Tare,
    TareRequest,
)

FrameOf = Callable[..., ElectrodeFrame]
WaitUntil = Callable[..., None]
LIVE_S = 20.0
"""Longest wait for what has to happen."""


def _public(kind: type) -> set[str]:
    return {name for name, _ in inspect.getmembers(kind, callable) if name[0] != "_"}


class Finger:
    """Publishes features of ``finger`` 100 times a second, as a service does."""

    def __init__(self, session: Session, frame_of: FrameOf, estimate: FeatureEstimate) -> None:
        self._publisher = session.publisher(FEATURES, sensor="finger")
        self._frame_of, self._estimate = frame_of, estimate
        self.delay_ns = 0
        self.silent = False
        self.serial = estimate.sensor_serial
        self._stop = threading.Event()
        self.sequence = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            if not self.silent:
                self.sequence += 1
                stamp = self._frame_of(self.sequence).stamp
                stamp = dataclasses.replace(
                    stamp, monotonic_ns=max(stamp.monotonic_ns - self.delay_ns, 1)
                )
                self._publisher.put(
                    dataclasses.replace(self._estimate, source=stamp, sensor_serial=self.serial)
                )

    def close(self) -> None:
        self._stop.set()
        self._thread.join(LIVE_S)


@pytest.fixture
def finger(link: LinkConfig, frame_of: FrameOf, examples: dict[str, Any]) -> Iterator[Finger]:
    with Session.open(link) as session:
        finger = Finger(session, frame_of, examples["FeatureEstimate"])
        yield finger
        finger.close()


@pytest.fixture
def robot(link: LinkConfig) -> Iterator[Client]:
    with Client(link.connect[0], timeout_s=LIVE_S) as robot:
        yield robot


def test_a_stream_is_iterated_and_ends_when_it_is_closed(finger: Finger, robot: Client) -> None:
    seen: list[int] = []
    stream = robot.stream_features("finger", max_age_s=LIVE_S, timeout_s=LIVE_S)
    for estimate in stream:
        seen.append(estimate.source.sequence)
        if len(seen) == 5:
            stream.close()
    assert len(seen) == 5
    assert seen == sorted(set(seen)), "each one once, in order"
    assert list(stream) == []


def test_a_slow_consumer_gets_the_newest_and_knows_what_it_skipped(
    finger: Finger, robot: Client, wait_until: WaitUntil
) -> None:
    with robot.stream_features("finger", max_age_s=LIVE_S, timeout_s=LIVE_S) as stream:
        first = next(stream).source.sequence
        begun = finger.sequence
        wait_until(lambda: finger.sequence > begun + 20, timeout_s=LIVE_S)
        assert next(stream).source.sequence > first + 10
        assert stream.counters["dropped"] > 5


def test_a_stream_says_that_it_is_silent_and_goes_on(finger: Finger, robot: Client) -> None:
    with robot.stream_features("finger", max_age_s=LIVE_S, timeout_s=0.3) as stream:
        finger.silent = True
        with pytest.raises(StreamTimeout, match=r"no features on .*/finger/features within 0.3 s"):
            list(stream)
        finger.silent = False
        assert next(stream).source.sequence > 0


def test_a_stream_never_delivers_an_old_reading(finger: Finger, robot: Client) -> None:
    finger.delay_ns = 60_000_000_000
    with robot.stream_features("finger", max_age_s=5.0, timeout_s=0.5) as stream:
        with pytest.raises(StaleError, match=r"too old, the last one 6\d\.\d+ s where 5 s"):
            list(stream)
        assert stream.counters["stale"] > 0
    finger.delay_ns = -60_000_000_000
    with (
        robot.stream_features("finger", max_age_s=5.0, timeout_s=0.5) as stream,
        pytest.raises(ClockSkewError, match="in the future"),
    ):
        list(stream)


def test_closing_the_client_ends_its_streams(link: LinkConfig, finger: Finger) -> None:
    ended = threading.Event()
    robot = Client(link.connect[0], timeout_s=LIVE_S)
    stream = robot.stream_features("nobody", timeout_s=None)

    def wait() -> None:
        list(stream)
        ended.set()

    threading.Thread(target=wait, daemon=True).start()
    watch = robot.stream_features("finger", max_age_s=LIVE_S).call(lambda _: None)
    robot.close()
    assert ended.wait(LIVE_S)
    watch._thread.join(LIVE_S)
    assert not watch._thread.is_alive()


def test_a_callback_runs_in_a_thread_of_ours_and_may_fail(
    finger: Finger, robot: Client, wait_until: WaitUntil, caplog: pytest.LogCaptureFixture
) -> None:
    threads: set[str] = set()

    def callback(estimate: FeatureEstimate) -> None:
        threads.add(threading.current_thread().name)
        if estimate.source.sequence % 2:
            raise ZeroDivisionError("a defect of the user's")

    stream = robot.stream_features("finger", max_age_s=LIVE_S, depth=100)
    with caplog.at_level(logging.ERROR), stream.call(callback) as watch:
        wait_until(lambda: watch.counters["callback_errors"] > 3, timeout_s=LIVE_S)
        wait_until(lambda: watch.counters["called"] > 8, timeout_s=LIVE_S)
    assert threads == {"palpate callback"}
    records = [record for record in caplog.records if "callback" in record.getMessage()]
    assert len(records) == 1, "not a line for every frame"
    assert "a defect of the user's" in caplog.text
    called = watch.counters["called"]
    time.sleep(0.05)
    assert watch.counters["called"] == called, "closed is closed"


def test_another_sensor_under_the_name_is_told_once(finger: Finger, robot: Client) -> None:
    told: list[PalpateError] = []
    called: list[str] = []
    others = robot.stream_features("finger", max_age_s=LIVE_S)
    with (
        robot.stream_features("finger", max_age_s=LIVE_S) as stream,
        others.call(lambda one: called.append(one.sensor_serial), on_error=told.append) as watch,
    ):
        before = next(stream).sensor_serial
        assert robot.features("finger", max_age_s=LIVE_S).sensor_serial == before
        assert robot.next_features("finger", timeout_s=LIVE_S).message.sensor_serial == before
        finger.serial = "BT-OTHER"
        with pytest.raises(SensorChanged, match=f"is of sensor BT-OTHER now, .* {before} -> if it"):
            list(itertools.takewhile(lambda one: one.sensor_serial == before, stream))
        assert next(stream).sensor_serial == "BT-OTHER"
        with pytest.raises(SensorChanged):
            list(iter(lambda: robot.features("finger", max_age_s=LIVE_S).sensor_serial, "BT-OTHER"))
        assert robot.features("finger", max_age_s=LIVE_S).sensor_serial == "BT-OTHER"
        with pytest.raises(SensorChanged):
            list(iter(lambda: robot.next_features("finger").message.sensor_serial, "BT-OTHER"))
        while "BT-OTHER" not in called:
            time.sleep(0.01)
        assert [type(error) for error in told] == [SensorChanged]
        assert watch.counters["silences"] == 0


def test_a_callback_is_told_of_a_silence_and_may_close_its_own_watch(
    finger: Finger, robot: Client, wait_until: WaitUntil
) -> None:
    told: list[PalpateError] = []
    finger.silent = True
    stream = robot.stream_features("finger", max_age_s=LIVE_S, timeout_s=0.1)
    done = threading.Event()

    def once(_: FeatureEstimate) -> None:
        watch.close()
        done.set()

    watch = stream.call(once, on_error=told.append)
    wait_until(lambda: len(told) >= 2, timeout_s=LIVE_S)
    assert all(isinstance(error, StreamTimeout) for error in told)
    finger.silent = False
    assert done.wait(LIVE_S)
    assert watch.counters["called"] == 1


@contextmanager
def _router(endpoint: str) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=run_router, args=((endpoint,), stop), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(LIVE_S)


@pytest.mark.parametrize("direct", [True, False])
def test_streams_and_questions_go_on_after_router_and_service_were_gone(
    free_port: int,
    direct: bool,
    frame_of: FrameOf,
    examples: dict[str, Any],
    wait_until: WaitUntil,
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    joined = LinkConfig(connect=(endpoint,), wait_for_router_s=LIVE_S, direct=direct)

    @contextmanager
    def service() -> Iterator[Finger]:
        with Session.open(joined) as session:
            session.queryable(endpoints.TARE, lambda _: examples["Tare"], sensor="finger")
            finger = Finger(session, frame_of, examples["FeatureEstimate"])
            yield finger
            finger.close()

    def answers() -> bool:
        try:
            return bool(client.tare("finger", timeout_s=LIVE_S).tare_id)
        except LinkError:
            return False

    seen: list[int] = []
    with _router(endpoint):
        client = Client(endpoint, timeout_s=LIVE_S)
        watch = client.stream_features("finger", max_age_s=LIVE_S).call(
            lambda estimate: seen.append(estimate.source.sequence)
        )
        with service():
            wait_until(lambda: len(seen) > 3, timeout_s=LIVE_S)
            wait_until(answers, timeout_s=LIVE_S)
    with _router(endpoint):
        with service():
            count = len(seen)
            wait_until(lambda: len(seen) > count + 3, timeout_s=LIVE_S)
            wait_until(answers, timeout_s=LIVE_S)
            assert client.features("finger", max_age_s=LIVE_S).source.sequence
        watch.close()
        client.close()


@pytest.mark.parametrize(
    "call",
    [
        lambda robot: robot.features("*"),
        lambda robot: robot.features("finger/features"),
        lambda robot: robot.features("finger", max_age_s=math.nan),
        lambda robot: robot.features("finger", max_age_s=-1.0),
        lambda robot: robot.next_features("*"),
        lambda robot: robot.next_features("finger", timeout_s=-1.0),
        lambda robot: robot.stream_features("*"),
        lambda robot: robot.stream_features("finger", timeout_s=0.0),
        lambda robot: robot.stream_features("finger", max_age_s=math.nan),
        lambda robot: robot.stream_features("finger", depth=0),
        lambda robot: robot.tare("*"),
        lambda robot: robot.tare("finger", frames=-1),
        lambda robot: robot.tare("finger", frames=2**40),
        lambda robot: robot.tare("finger", timeout_s=-1.0),
        lambda robot: robot.tare("finger", timeout_s=math.inf),
        lambda robot: robot.zero("wrist", readings=-1),
        lambda robot: robot.model(service="no/such"),
        lambda robot: robot.cancel_simulation("r-1", sensor="*"),
        lambda robot: robot.simulate(_request(), sensor="*"),
        lambda robot: robot.simulate(_request(), timeout_s=-1.0),
        lambda robot: robot.simulate(_request(), timeout_s=math.nan),
        lambda robot: robot.robot_pose_publisher("*"),
    ],
)
def test_what_is_wrong_is_refused_by_name_at_once(
    shared_robot: Client, call: Callable[[Client], object]
) -> None:
    with pytest.raises(ConfigError) as caught:
        call(shared_robot)
    assert caught.value.remedy


@pytest.fixture(scope="module")
def shared_robot(
    router: Callable[[], AbstractContextManager[LinkConfig]],
) -> Iterator[Client]:
    with router() as link, Client(link.connect[0], timeout_s=LIVE_S) as robot:
        yield robot


def _request() -> SimulationRequest:
    path = straight_path((-0.004, 0.0, -0.011), (-0.004, 0.0, -0.007), 2)
    return SimulationRequest("r-1", "sphere_7mm", path)


_LEFT_OPEN = """
import sys, threading
from palpate import Client

seen = threading.Semaphore(0)
robot = Client(sys.argv[1], timeout_s=20)
robot.stream_features("finger", max_age_s=20.0).call(lambda estimate: seen.release())
for _ in range(5):
    assert seen.acquire(timeout=20)
robot.features("finger", max_age_s=20.0)
print("ends")
"""


def test_a_program_that_leaves_its_client_open_ends_well(link: LinkConfig, finger: Finger) -> None:
    """Zenoh's threads would call into an interpreter that is gone: it was aborted, exit 134."""
    for _ in range(3):
        result = subprocess.run(
            [sys.executable, "-c", _LEFT_OPEN, link.connect[0]],
            capture_output=True,
            text=True,
            timeout=6 * LIVE_S,
            check=False,
        )
        assert (result.returncode, result.stdout, result.stderr) == (0, "ends\n", "")


_FORKS = """
import os, signal, sys
from palpate import Client
from palpate.errors import LinkError

def in_child(work):
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    signal.alarm(60)  # a child that hangs is ended, which its exit code shows
    work()
    sys.exit(0)  # closes what it inherited

def new():
    return Client(sys.argv[1], timeout_s=20)

def fresh():
    with new() as robot:
        robot.features("finger", max_age_s=20.0)

def refused():
    calls = (
        new,
        lambda: robot.features("finger", max_age_s=20.0),
        lambda: robot.next_features("finger", timeout_s=20.0),
        lambda: next(stream),
        lambda: poses.put((0, 0, 0), (1, 0, 0, 0)),
        lambda: robot.stream_wrench("finger"),
        lambda: robot.tare("finger"),
        robot.alive,
        robot.census,
        robot.model,
        robot.session.observer,
    )
    for call in calls:
        try:
            call()
        except LinkError as error:
            assert "spawn" in error.remedy
        else:
            raise AssertionError(call)
    robot.close()

print("before", in_child(fresh), flush=True)
robot = new()
stream = robot.stream_features("finger", max_age_s=20.0)
poses = robot.robot_pose_publisher("arm")
next(stream), robot.features("finger", max_age_s=20.0), robot.next_features("finger")
print("after", in_child(refused), flush=True)
next(stream), robot.alive()
print("ends")
"""


def test_a_fork_after_a_client_was_opened_is_refused_and_hangs_nowhere(
    link: LinkConfig, finger: Finger
) -> None:
    """Zenoh's threads do not exist in the child, where every call waited for them for ever."""
    result = subprocess.run(
        [sys.executable, "-c", _FORKS, link.connect[0]],
        capture_output=True,
        text=True,
        timeout=12 * LIVE_S,
        check=False,
    )
    assert (result.stdout, result.stderr) == ("before 0\nafter 0\nends\n", "")


_CALLS: dict[str, Callable[[Any, dict[str, Any]], object]] = {
    "features": lambda robot, _: robot.features("finger"),
    "electrodes": lambda robot, _: robot.electrodes("finger"),
    "field": lambda robot, _: robot.field("finger"),
    "synthesis": lambda robot, _: robot.synthesis("finger"),
    "stream_features": lambda robot, _: robot.stream_features("finger"),
    "stream_electrodes": lambda robot, _: robot.stream_electrodes("finger"),
    "stream_field": lambda robot, _: robot.stream_field("finger"),
    "stream_synthesis": lambda robot, _: robot.stream_synthesis("finger"),
    "stream_wrench": lambda robot, _: robot.stream_wrench("finger"),
    "estimate_features": lambda robot, of: robot.estimate_features("finger", of["ElectrodeFrame"]),
    "estimate_field": lambda robot, of: robot.estimate_field("finger", of["ElectrodeFrame"]),
    "field_basis": lambda robot, _: robot.field_basis(),
    "synthesise": lambda robot, of: robot.synthesise(of["FieldFrame"]),
    "synthesise_from": lambda robot, of: robot.synthesise_from(of["FieldFrame"]),
    "next_features": lambda robot, _: robot.next_features("finger"),
    "robot_pose_publisher": lambda robot, _: robot.robot_pose_publisher("arm"),
    "tare": lambda robot, _: robot.tare("finger"),
    "zero": lambda robot, _: robot.zero("finger"),
    "simulate": lambda robot, _: robot.simulate(_request()),
    "cancel_simulation": lambda robot, _: robot.cancel_simulation("r-1"),
    "model": lambda robot, _: robot.model(),
    "alive": lambda robot, _: robot.alive(),
    "status": lambda robot, _: robot.status(),
    "census": lambda robot, _: robot.census(),
}
"""Every call of a client, of its name."""


@pytest.fixture(scope="module")
def closed_robot(
    router: Callable[[], AbstractContextManager[LinkConfig]],
) -> Iterator[Client]:
    with router() as link, Client(link.connect[0], timeout_s=LIVE_S) as robot:
        robot.close()
        yield robot


@pytest.mark.parametrize("name", sorted(_public(Client) - {"close"}))
def test_every_call_of_a_closed_client_says_that_it_is_closed(
    closed_robot: Client, examples: dict[str, Any], name: str
) -> None:
    with pytest.raises(LinkError, match="the client is closed -> open a new Client"):
        _CALLS[name](closed_robot, examples)


def test_a_closed_client_that_has_read_says_that_it_is_closed(
    link: LinkConfig, finger: Finger
) -> None:
    """What it has subscribed to is closed with it, and said so in words of Zenoh's source."""
    with Client(link.connect[0], timeout_s=LIVE_S) as robot:
        robot.features("finger", max_age_s=LIVE_S)
        robot.next_features("finger", timeout_s=LIVE_S)
        subscriber = robot.session.subscriber(FEATURES, sensor="finger")
    for call in (robot.features, robot.next_features):
        with pytest.raises(LinkError, match="the client is closed -> open a new Client"):
            call("finger")
    with pytest.raises(LinkError, match=r"finger/features is closed -> open"):
        subscriber.next(LIVE_S)


def test_what_a_closed_client_has_made_says_that_it_is_closed(link: LinkConfig) -> None:
    with Client(link.connect[0], timeout_s=LIVE_S) as robot:
        poses = robot.robot_pose_publisher("arm")
    with pytest.raises(LinkError, match="closed"):
        poses.matched()
    with pytest.raises(LinkError, match="closed"):
        poses.put((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


_ROUTER = """
import sys, threading
from palpate.bus import run_router
run_router((sys.argv[1],), threading.Event())
"""


def test_leaving_a_router_that_hangs_ends_well(free_port: int, wait_until: WaitUntil) -> None:
    """After a look for processes it takes Zenoh 10 s, and mostly ended in an error of its own."""
    endpoint = f"tcp/127.0.0.1:{free_port}"

    def listens() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", free_port)) == 0

    router = subprocess.Popen([sys.executable, "-c", _ROUTER, endpoint])
    try:
        wait_until(listens, LIVE_S)
        client = Client(endpoint, timeout_s=1.0)
        client.status()  # it joins
        router.send_signal(signal.SIGSTOP)
        with suppress(LinkError):
            client.status()
        client.close()
    finally:
        router.kill()
        router.wait()


def test_joining_is_given_up_although_leaving_takes_long(
    free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh takes 10 s to leave a router that hangs, also one that has never answered."""
    told, left = threading.Event(), threading.Event()

    def leave(session: zenoh.Session) -> None:
        if told.wait(LIVE_S):
            left.set()
        close_zenoh(session)

    monkeypatch.setattr("palpate.bus.link.close_zenoh", leave)
    with pytest.raises(LinkError):
        Client(f"tcp/127.0.0.1:{free_port}", timeout_s=0.1)
    told.set()
    assert left.wait(LIVE_S), "it was left before the error came"


def test_a_session_that_does_not_close_is_given_up(caplog: pytest.LogCaptureFixture) -> None:
    class Hanging:
        def close(self) -> None:
            raise zenoh.ZError("close operation timed out!")

    close_zenoh(cast("zenoh.Session", Hanging()))
    assert "router hangs" in caplog.text


@pytest.mark.parametrize(
    "options",
    [
        {"connect": "nonsense"},
        {"connect": "udp/127.0.0.1:1"},
        {"timeout_s": -1.0},
        {"timeout_s": math.nan},
        {"station": "The Lab"},
        {"tls": "/no/such/folder", "connect": "tls/127.0.0.1:7447"},
        {"connect": "tls/127.0.0.1:7447"},
    ],
)
def test_a_client_that_cannot_be_is_refused_by_name(options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as caught:
        Client(**options)
    assert caught.value.remedy


def test_router_and_station_may_come_from_the_environment(
    link: LinkConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PALPATE_CONNECT", link.connect[0])
    monkeypatch.setenv("PALPATE_STATION", "cellar")
    with Client(timeout_s=LIVE_S) as robot:
        assert robot.session.station == "cellar"


# --- asyncio --------------------------------------------------------------------------------------


def test_every_method_of_the_client_is_there_for_asyncio() -> None:
    assert _public(Client) - {"close"} <= _public(AsyncClient)


@pytest.mark.parametrize("name", ["alive", "features", "tare"])
def test_an_async_client_whose_session_is_closed_says_so(
    link: LinkConfig, examples: dict[str, Any], name: str
) -> None:
    async def call() -> object:
        async with AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot:
            robot.sync.close()
            return await cast("Coroutine[Any, Any, object]", _CALLS[name](robot, examples))

    with pytest.raises(LinkError, match="closed"):
        asyncio.run(call())


def test_an_async_client_streams_asks_and_leaves_the_loop_free(
    link: LinkConfig, finger: Finger, examples: dict[str, Any]
) -> None:
    async def scene() -> None:
        async with AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot:
            seen: list[int] = []
            async for estimate in robot.stream_features("finger", max_age_s=LIVE_S):
                seen.append(estimate.source.sequence)
                if len(seen) == 3:
                    break
            assert seen == sorted(set(seen))
            estimate = await robot.features("finger", max_age_s=LIVE_S)
            assert estimate.force.tolist() == examples["FeatureEstimate"].force.tolist()
            with pytest.raises(LinkError, match="no gateway has a BioTac of this name"):
                await robot.tare("nobody")
            with pytest.raises(ConfigError):
                await robot.features("*")
            turns = 0

            async def count() -> None:
                nonlocal turns
                while True:
                    await asyncio.sleep(0.005)
                    turns += 1

            counting = asyncio.create_task(count())
            with pytest.raises(StreamTimeout):
                await robot.next_features("nobody", timeout_s=0.5)
            counting.cancel()
            assert turns >= 3, "the loop ran while the call waited"
        with pytest.raises(LinkError, match="async with"):
            await robot.features("finger")

    asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


def test_an_async_stream_says_that_it_is_silent_and_goes_on(
    link: LinkConfig, finger: Finger
) -> None:
    async def scene() -> None:
        async with (
            AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot,
            robot.stream_features("finger", max_age_s=LIVE_S, timeout_s=0.3) as stream,
        ):
            await anext(stream)
            finger.silent = True
            with pytest.raises(StreamTimeout):
                [_ async for _ in stream]
            finger.silent = False
            while True:
                try:
                    await anext(stream)
                except StreamTimeout:
                    continue
                break
            await stream.aclose()
            with pytest.raises(StopAsyncIteration):
                await anext(stream)

    asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


def test_an_async_stream_tells_of_another_sensor_though_its_task_is_slow(
    link: LinkConfig, finger: Finger
) -> None:
    async def scene() -> None:
        async with (
            AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot,
            robot.stream_features("finger", max_age_s=LIVE_S) as stream,
        ):
            await anext(stream)
            finger.serial = "BT-OTHER"
            skipped = stream.counters["skipped"]
            while stream.counters["skipped"] < skipped + 20:  # enough to push it out
                await asyncio.sleep(0.05)
            with pytest.raises(SensorChanged):
                await anext(stream)
            assert (await anext(stream)).sensor_serial == "BT-OTHER"

    asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


async def _begun(
    ask: Callable[[], Coroutine[Any, Any, object]], begun: threading.Event
) -> asyncio.Task[object]:
    """A question that has reached its service, which may not be known here at first."""
    while True:
        asking = asyncio.create_task(ask())
        while not asking.done():
            if begun.is_set():
                return asking
            await asyncio.sleep(0.01)
        assert isinstance(asking.exception(), LinkError)


def test_cancelling_a_task_ends_its_question_and_its_stream(
    link: LinkConfig, finger: Finger, examples: dict[str, Any], wait_until: WaitUntil
) -> None:
    begun, go = threading.Event(), threading.Event()

    def handler(_: TareRequest) -> Tare:
        begun.set()
        go.wait(LIVE_S)
        tare: Tare = examples["Tare"]
        return tare

    async def scene(session: Session) -> None:
        async with AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot:
            asking = await _begun(lambda: robot.tare("slow", timeout_s=600.0), begun)
            asking.cancel()
            with pytest.raises(asyncio.CancelledError):
                await asking

            async def listen() -> None:
                async for _ in robot.stream_features("nobody", timeout_s=None):
                    raise AssertionError

            listening = asyncio.create_task(listen())
            await asyncio.sleep(0.1)
            listening.cancel()
            with pytest.raises(asyncio.CancelledError):
                await listening

    with Session.open(link) as session:
        session.queryable(endpoints.TARE, handler, sensor="slow")
        asyncio.run(asyncio.wait_for(scene(session), 3 * LIVE_S))
        go.set()
    wait_until(
        lambda: not [one for one in threading.enumerate() if one.name.startswith("palpate c")],
        timeout_s=LIVE_S,
    )


def test_a_simulation_reports_into_the_loop_and_is_stopped_with_its_task(
    link: LinkConfig, wait_until: WaitUntil
) -> None:
    """The answering side only knows the caller's token, as the finite-element service does."""
    gone, begun = threading.Event(), threading.Event()

    def simulate(request: SimulationRequest, answer: Any) -> None:
        for done in range(3):
            progress = SimulationProgress(request.request_id, done, 3, 0.1)
            answer.send(
                SimulationReply(request.request_id, bytes(32), (), progress=progress, more=True)
            )
        if request.request_id == "endless":
            begun.set()
            return
        answer.send(SimulationReply(request.request_id, bytes(32), ()))
        answer.end()

    async def scene() -> None:
        loop = asyncio.get_running_loop()
        steps: list[int] = []

        def on_progress(progress: SimulationProgress) -> None:
            assert asyncio.get_running_loop() is loop
            steps.append(progress.steps_done)

        async with AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot:
            request = _request()
            while not steps:
                with suppress(LinkError):  # the service is not known here yet
                    await robot.simulate(request, on_progress=on_progress)
            assert steps == [0, 1, 2]
            endless = dataclasses.replace(request, request_id="endless")
            asking = await _begun(lambda: robot.simulate(endless, timeout_s=600.0), begun)
            asking.cancel()
            with pytest.raises(asyncio.CancelledError):
                await asking
            assert await asyncio.to_thread(gone.wait, LIVE_S), "the service hears of it"

    with Session.open(link) as session:
        session.watch_callers(lambda *_: gone.set() if begun.is_set() else None)
        session.stream_queryable(endpoints.SIMULATE, simulate, sensor="twin")
        asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


def test_joining_without_a_router_fails_and_may_be_cancelled(
    free_port: int, wait_until: WaitUntil
) -> None:
    async def scene() -> None:
        with pytest.raises(LinkError, match="no router"):
            async with AsyncClient(f"tcp/127.0.0.1:{free_port}", timeout_s=0.2):
                pass
        joining = asyncio.create_task(
            AsyncClient(f"tcp/127.0.0.1:{free_port}", timeout_s=1.0).__aenter__()
        )
        await asyncio.sleep(0.1)
        joining.cancel()
        with pytest.raises(asyncio.CancelledError):
            await joining

    asyncio.run(asyncio.wait_for(scene(), LIVE_S))
    wait_until(
        lambda: not [one for one in threading.enumerate() if one.name.startswith("palpate c")],
        timeout_s=LIVE_S,
    )
