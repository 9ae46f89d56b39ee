"""The robot's client: streams, callbacks, and what it refuses by name."""

from __future__ import annotations

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
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any, cast

import pytest
import zenoh
from tests.protos.robot_client import (
    CALLS,
    LIVE_S,
    Finger,
    FrameOf,
    WaitUntil,
    public_names,
    simulation_request,
)

from palpate import Client
from palpate.bus import Session, endpoints, run_router
from palpate.bus.topics import FEATURES
from palpate.bus.zenoh_session import close_zenoh
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
from palpate.messages import FeatureEstimate, FieldFrame


@pytest.fixture
def robot(link: LinkConfig) -> Iterator[Client]:
    with Client(link.connect[0], timeout_s=LIVE_S) as robot:
        yield robot


@pytest.mark.parametrize(
    ("method", "age_s"),
    [
        *((name, 0.05) for name in ("features", "electrodes")),
        *((name, 0.2) for name in ("field", "synthesis")),
        *((name, 0.2) for name in sorted(public_names(Client)) if name.startswith("stream_")),
    ],
)
def test_by_default_old_readings_are_not_delivered(method: str, age_s: float) -> None:
    parameters = inspect.signature(getattr(Client, method)).parameters
    assert parameters["max_age_s"].default == age_s


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


def test_a_first_call_that_is_interrupted_costs_no_later_one(
    finger: Finger, robot: Client, wait_until: WaitUntil
) -> None:
    """Ctrl-C in a notebook: the client got no estimate ever after."""
    finger.silent = True
    main = threading.main_thread().ident
    assert main is not None
    interrupt = threading.Timer(0.3, signal.pthread_kill, (main, signal.SIGINT))

    def ask() -> None:
        interrupt.start()
        robot.features("finger")

    with pytest.raises(KeyboardInterrupt):
        ask()
    finger.silent = False

    def answered() -> bool:
        with suppress(StaleError):  # of the time before it sent again
            return robot.features("finger", max_age_s=LIVE_S).source.sequence > 0
        return False

    wait_until(answered, timeout_s=LIVE_S)


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


def test_a_callback_that_exits_does_not_end_its_watch(
    finger: Finger, robot: Client, wait_until: WaitUntil, caplog: pytest.LogCaptureFixture
) -> None:
    """``sys.exit()`` in a callback ended the thread, and nobody was told."""

    def callback(_: FeatureEstimate) -> None:
        sys.exit("stop")

    with robot.stream_features("finger", max_age_s=LIVE_S).call(callback) as watch:
        wait_until(lambda: watch.counters["callback_errors"] > 2, timeout_s=LIVE_S)
    assert "SystemExit: stop" in caplog.text


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
    called: list[int] = []

    def once(estimate: FeatureEstimate) -> None:
        if not finger.silent:  # else it was on its way before the silence
            called.append(estimate.source.sequence)
            watch.close()
            done.set()

    watch = stream.call(once, on_error=told.append)
    wait_until(lambda: len(told) >= 2, timeout_s=LIVE_S)
    assert all(isinstance(error, StreamTimeout) for error in told)
    finger.silent = False
    assert done.wait(LIVE_S)
    watch.close()
    assert len(called) == 1


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
        lambda robot: robot.synthesise(cast("FieldFrame", simulation_request())),
        lambda robot: robot.simulate(simulation_request(), sensor="*"),
        lambda robot: robot.simulate(simulation_request(), timeout_s=-1.0),
        lambda robot: robot.simulate(simulation_request(), timeout_s=math.nan),
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


_NOBODY_HOLDS = """
import gc, sys, threading
from palpate import Client

seen = threading.Semaphore(0)

def watch():
    return Client(sys.argv[1], timeout_s=20).stream_features("finger", max_age_s=20.0).call(
        lambda estimate: seen.release()
    )

def iterate():
    for estimate in Client(sys.argv[1], timeout_s=20).stream_features("finger", max_age_s=20.0):
        seen.release()

if sys.argv[2] == "watch":
    watch()
else:
    threading.Thread(target=iterate, daemon=True).start()
for _ in range(5):
    assert seen.acquire(timeout=20)
gc.collect()
for _ in range(200):
    assert seen.acquire(timeout=20)
print("ends")
"""


@pytest.mark.parametrize("use", ["watch", "iterate"])
def test_a_stream_in_use_keeps_its_client(link: LinkConfig, finger: Finger, use: str) -> None:
    """Nobody closed the client at the end of the program, which was aborted: exit 134."""
    result = subprocess.run(
        [sys.executable, "-c", _NOBODY_HOLDS, link.connect[0], use],
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


@pytest.fixture(scope="module")
def closed_robot(
    router: Callable[[], AbstractContextManager[LinkConfig]],
) -> Iterator[Client]:
    with router() as link, Client(link.connect[0], timeout_s=LIVE_S) as robot:
        robot.close()
        yield robot


@pytest.mark.parametrize("name", sorted(public_names(Client) - {"close"}))
def test_every_call_of_a_closed_client_says_that_it_is_closed(
    closed_robot: Client, examples: dict[str, Any], name: str
) -> None:
    with pytest.raises(LinkError, match="the client is closed -> open a new Client"):
        CALLS[name](closed_robot, examples)


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
