"""A session that lives for months keeps nothing of what was closed before it."""

from __future__ import annotations

import contextlib
import gc
import os
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from tests.protos.robot_client import Finger

from palpate.bus import Delivery, Session, endpoints
from palpate.bus.link import _close_all
from palpate.bus.tares import TareBook
from palpate.bus.topics import ELECTRODES, FEATURES
from palpate.client import Client
from palpate.config import LinkConfig
from palpate.errors import LinkError, StreamTimeout
from palpate.messages import Tare, TareRequest

PATIENCE_S = 20.0


def no_tare(request: TareRequest) -> Tare:
    raise AssertionError(f"nobody asks: {request}")


MADE: dict[str, Callable[[Session], Any]] = {
    "publisher": lambda session: session.publisher(ELECTRODES, sensor="finger"),
    "subscriber": lambda session: session.subscriber(FEATURES, sensor="finger"),
    "tap": lambda session: session.tap([FEATURES]),
    "newest tap": lambda session: session.tap([FEATURES], delivery=Delivery.NEWEST),
    "queryable": lambda session: session.queryable(endpoints.TARE, no_tare, sensor="finger"),
    "claims": lambda session: session.claims(instance="one", lease_s=2.0),
    "presence": lambda session: session.presence("features", instance="one"),
    "foreign publisher": lambda session: session.foreign_publisher("rt/force"),
    "foreign subscriber": lambda session: session.foreign_subscriber("rt/force"),
    "foreign token": lambda session: session.foreign_token("rt/force"),
}


@pytest.fixture
def alone() -> Iterator[Session]:
    with Session.open(LinkConfig(connect=())) as session:
        yield session


@pytest.mark.parametrize("what", MADE)
def test_what_was_closed_is_forgotten_with_the_next_of_its_kind(alone: Session, what: str) -> None:
    make = MADE[what]
    with make(alone) as first:
        gone = weakref.ref(first)
    del first
    make(alone)
    gc.collect()
    assert gone() is None


@pytest.mark.parametrize("what", MADE)
def test_what_is_open_is_closed_with_its_session(what: str) -> None:
    with Session.open(LinkConfig(connect=())) as session:
        made, other = MADE[what](session), MADE["publisher"](session)
    assert (made.closed, other.closed) == (True, True)


@pytest.mark.parametrize("what", ["subscriber", "tap", "newest tap", "foreign subscriber"])
def test_who_takes_messages_of_a_closed_session_is_told(what: str) -> None:
    """Told at once that none came in time, a loop that tries again span."""
    with Session.open(LinkConfig(connect=())) as session:
        stream = MADE[what](session)
        with pytest.raises(StreamTimeout):
            stream.next(0.01)
    with pytest.raises(LinkError, match="closed -> open the session again"):
        stream.next(0.01)


def test_a_tare_that_is_not_known_is_refused_by_a_closed_session() -> None:
    with Session.open(LinkConfig(connect=())) as session:
        book = TareBook(session)
        assert book.find("finger", 7) is None
    with pytest.raises(LinkError, match="closed -> open the session again"):
        book.find("finger", 7)


def test_questions_to_what_was_closed_still_count(
    pair: tuple[Session, Session], examples: dict[str, Any]
) -> None:
    """A gateway whose key is taken over, and given back, answers by another one."""
    asking, answering = pair
    for _ in range(3):
        with answering.queryable(endpoints.TARE, lambda _: examples["Tare"], sensor="finger"):
            asking.query(
                endpoints.TARE, examples["TareRequest"], sensor="finger", timeout_s=PATIENCE_S
            )
    counters, waiting = answering.questions()
    assert (counters, waiting) == ({"received": 3, "answered": 3}, 0)


def test_a_stream_that_is_closed_while_a_thread_waits_is_forgotten(alone: Session) -> None:
    """The wait that ended set its alarm once more, and the alarm kept it for ever."""

    def wait() -> None:
        waits.set()
        with pytest.raises(LinkError, match="closed"):
            stream.next(PATIENCE_S)

    alarm = alone._get_alarm()
    for _ in range(3):
        waits = threading.Event()
        stream = alone.subscriber(FEATURES, sensor="finger")
        thread = threading.Thread(target=wait)
        thread.start()
        assert waits.wait(PATIENCE_S)
        stream.close()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
    assert alarm._deadlines == {}
    stream = alone.subscriber(FEATURES, sensor="finger")
    with pytest.raises(StreamTimeout):
        stream.next(0.01)  # the alarm goes on to wake others


def test_a_pose_publisher_that_is_closed_is_gone_from_the_bus(
    link: LinkConfig, wait_until: Callable[..., None]
) -> None:
    with Client(link.connect[0], timeout_s=PATIENCE_S) as client:
        with client.robot_pose_publisher("arm") as first:
            gone = weakref.ref(first)
        with pytest.raises(LinkError):
            first.matched()
        del first
        client.robot_pose_publisher("arm")
        wait_until(lambda: gc.collect() >= 0 and gone() is None, PATIENCE_S)


def test_a_session_whose_closing_was_interrupted_is_closed_at_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = Session.open(LinkConfig(connect=()))
    stream = session.subscriber(FEATURES, sensor="finger")
    with monkeypatch.context() as pressed:

        def interrupted() -> None:
            raise KeyboardInterrupt

        pressed.setattr(stream, "close", interrupted)
        with pytest.raises(KeyboardInterrupt):
            session.close()
    _close_all()
    with pytest.raises(LinkError, match="closed"):
        session.publisher(ELECTRODES, sensor="finger")


def test_clients_that_nobody_holds_leave_the_bus(
    link: LinkConfig, finger: Finger, wait_until: Callable[..., None]
) -> None:
    """Zenoh's sessions lived on behind them, and nobody could close them."""
    with Session.open(link) as session, session.publisher(FEATURES, sensor="finger") as service:

        def ask() -> None:
            robot = Client(link.connect[0], timeout_s=PATIENCE_S)
            robot.features("finger", max_age_s=PATIENCE_S)
            wait_until(service.matched, PATIENCE_S)

        for _ in range(3):
            ask()
        gc.collect()
        wait_until(lambda: not service.matched(), PATIENCE_S)


def test_a_pose_publisher_in_use_keeps_its_client(
    link: LinkConfig, wait_until: Callable[..., None]
) -> None:
    poses = Client(link.connect[0], timeout_s=PATIENCE_S).robot_pose_publisher("arm")
    gc.collect()
    time.sleep(0.5)  # for who would leave the bus
    poses.put((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    wait_until(lambda: poses.counters["published"] == 1, PATIENCE_S)
    poses.close()


_PEER = """
import sys
from palpate.bus import Session
from palpate.config import LinkConfig
with Session.open(LinkConfig(connect=(sys.argv[1],), wait_for_router_s=60)):
    print("joined", flush=True)
    sys.stdin.read()
"""


def sockets() -> int:
    found = 0
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):  # the listing's own
            found += os.readlink(f"/proc/self/fd/{name}").startswith("socket:")
    return found


def test_sessions_that_were_open_for_a_moment_leave_no_sockets(
    link: LinkConfig, wait_until: Callable[..., None]
) -> None:
    """Links that came up while one closed stayed for ever; on a busy host they come up late."""
    with contextlib.ExitStack() as ending:

        def start(program: str) -> subprocess.Popen[str]:
            process = subprocess.Popen(
                [sys.executable, "-c", program, link.connect[0]],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            ending.callback(process.communicate)
            ending.callback(process.kill)
            return process

        for peer in [start(_PEER) for _ in range(2)]:
            assert peer.stdout is not None
            assert peer.stdout.readline() == "joined\n"
        for _ in range(2 * (os.cpu_count() or 1)):
            start("while True: pass")
        before = sockets()
        for _ in range(25):
            Session.open(link).close()
        wait_until(lambda: sockets() <= before, PATIENCE_S)
