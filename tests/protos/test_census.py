"""Who lives at a station and what it says: complete, also for a process that has just joined."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack

import pytest

from palpate.bus import Session, endpoints
from palpate.census import ROUTER, take_census
from palpate.client import Client
from palpate.config import LinkConfig
from palpate.errors import LinkError
from palpate.health import Health, HealthReporter
from palpate.messages import ServiceRequest, ServiceState, Status, SupervisedProcess

NAMES = ("features", "field", "gateway", "recorder", "synthesis")
LOOKS = 12
"""Fresh sessions; before the cure, one look in five on an idle host missed a process."""


@pytest.fixture
def station(link: LinkConfig) -> Iterator[dict[str, tuple[Session, Health]]]:
    """Processes that live, serve and answer, each in a session of its own."""
    with ExitStack() as stack:
        running = {}
        for name in NAMES:
            session = stack.enter_context(Session.open(link))
            health = Health(name, name)
            health.set_state(ServiceState.READY)
            stack.enter_context(HealthReporter(session, health, period_s=60.0))
            session.presence(name, instance=name).ready()
            running[name] = session, health
        deadline = time.monotonic() + 20.0
        while len(running["field"][0].alive()) < len(NAMES):
            assert time.monotonic() < deadline
        yield running


def test_a_session_that_has_just_joined_sees_every_process(
    station: dict[str, tuple[Session, Health]], link: LinkConfig
) -> None:
    for _ in range(LOOKS):
        with Session.open(link) as fresh:
            found = fresh.alive()
        assert [(one.service, one.ready) for one in found] == [(name, True) for name in NAMES]


def test_a_question_of_a_session_that_has_just_joined_reaches_everyone(
    station: dict[str, tuple[Session, Health]], link: LinkConfig
) -> None:
    for look in range(LOOKS):
        with Session.open(link) as fresh:
            answers = fresh.query_all(endpoints.STATUS, ServiceRequest(), timeout_s=20.0)
            one = fresh.query(endpoints.STATUS, ServiceRequest(), service=NAMES[look % len(NAMES)])
        assert one.service == NAMES[look % len(NAMES)]
        assert {answer.service for answer in answers if isinstance(answer, Status)} == set(NAMES)


def test_a_robot_that_has_just_joined_gets_every_status(
    station: dict[str, tuple[Session, Health]], link: LinkConfig
) -> None:
    for _ in range(LOOKS):
        with Client(link.connect[0], timeout_s=20.0) as robot:
            assert [one.service for one in robot.status()] == list(NAMES)
            assert {one.service for one in robot.alive()} == set(NAMES)


def test_a_session_through_the_router_is_its_own_observer(link: LinkConfig) -> None:
    with Session.open(link.model_copy(update={"direct": False})) as session:
        assert session.observer() is session
    with Session.open(link) as session:
        assert session.observer() is session.observer() is not session


def test_what_is_expected_and_does_not_live_is_reported(
    station: dict[str, tuple[Session, Health]], link: LinkConfig
) -> None:
    with Session.open(link) as session:
        census = take_census(session, expected=[("fem", "fem"), ROUTER], timeout_s=0.5)
    found = {one.service: (one.alive, one.ready, one.status is not None) for one in census}
    assert found == {
        **dict.fromkeys(NAMES, (True, True, True)),
        "fem": (False, False, False),
        "router": (True, True, False),
    }


def test_what_the_supervisor_keeps_running_is_expected(
    station: dict[str, tuple[Session, Health]], link: LinkConfig
) -> None:
    station["recorder"][1].set_processes([SupervisedProcess("fem", "left", "backoff", restarts=3)])
    with Session.open(link) as session:
        census = take_census(session, timeout_s=0.5)
    (one,) = [one for one in census if one.service == "fem"]
    assert (one.instance, one.alive, one.status) == ("left", False, None)


def test_a_process_that_lives_and_does_not_answer_is_reported(
    station: dict[str, tuple[Session, Health]], link: LinkConfig
) -> None:
    with Session.open(link) as mute:
        mute.presence("fem", instance="fem").ready()
        with Session.open(link) as session:
            census = take_census(session, timeout_s=0.5)
    (one,) = [one for one in census if one.service == "fem"]
    assert (one.alive, one.ready, one.status) == (True, True, None)


def test_presence_is_known_while_the_router_is_away(
    router: Callable[[], AbstractContextManager[LinkConfig]],
) -> None:
    with ExitStack() as stack:
        with router() as link:
            served = stack.enter_context(Session.open(link))
            served.presence("features", instance="features").ready()
            session = stack.enter_context(Session.open(link))
            deadline = time.monotonic() + 20.0
            own_view = session._raw
            while not own_view.info.peers_zid():
                assert time.monotonic() < deadline
                time.sleep(0.01)
            assert [one.service for one in session.alive()] == ["features"]
        assert [one.service for one in session.alive()] == ["features"]


def test_nothing_known_without_a_router_is_an_error_and_not_an_empty_station(
    router: Callable[[], AbstractContextManager[LinkConfig]],
) -> None:
    with ExitStack() as stack:
        with router() as link:
            robot = stack.enter_context(Client(link.connect[0], timeout_s=0.5))
            assert robot.status() == []
        deadline = time.monotonic() + 20.0
        while robot.session.observer().has_router():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        with pytest.raises(LinkError, match="the router is gone"):
            robot.status()
