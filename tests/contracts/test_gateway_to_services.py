"""Gateway and services together: every service has the tare of a frame, whichever started first."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest

from palpate.bus import Delivery, Session, Subscriber, endpoints
from palpate.bus.topics import ELECTRODES, FEATURES, FIELD
from palpate.config import LinkConfig, parse_config
from palpate.messages import FeatureEstimate, TareRequest
from palpate_gateway.config import GatewayConfig
from palpate_gateway.service import node
from palpate_services.config import FeaturesServiceConfig, FieldServiceConfig
from palpate_services.inference.services import run_estimating

PATIENCE_S = 30.0


@contextmanager
def running(run: Callable[[threading.Event], None]) -> Iterator[None]:
    """A process's work in a thread; its error, if it ends with one."""
    stop = threading.Event()
    errors: list[BaseException] = []

    def guarded() -> None:
        try:
            run(stop)
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=guarded)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert not errors, errors


@contextmanager
def gateway(link: LinkConfig, *, fingers: int = 1) -> Iterator[None]:
    options = {"model": "formula", "rate_hz": 100, "untouched_s": 600}
    sensors = [
        {"name": f"finger-{k}", "driver": "virtual", "options": {**options, "unit": k}}
        for k in range(1, fingers + 1)
    ]
    values = {"sensors": sensors, "tare_frames": 20}
    config = parse_config(GatewayConfig, values, where="test")
    with running(lambda stop: node.run(config, link, "lab", stop)):
        yield


@contextmanager
def features(link: LinkConfig, instance: str = "features") -> Iterator[None]:
    config = FeaturesServiceConfig(bundle="features-twin", max_age_s=None)
    with running(lambda stop: run_estimating(config, link, "lab", stop, instance=instance)):
        yield


@contextmanager
def field(link: LinkConfig) -> Iterator[None]:
    config = FieldServiceConfig(bundle="field-twin", max_age_s=None)
    with running(lambda stop: run_estimating(config, link, "lab", stop)):
        yield


@pytest.fixture
def session(link: LinkConfig) -> Iterator[Session]:
    with Session.open(link) as opened:
        yield opened


def tared(session: Session, sensor: str = "finger-1", *, not_by: int = 0) -> int:
    """The id of the tare in force, by the frames of a sensor."""
    frames = session.subscriber(ELECTRODES, sensor=sensor, delivery=Delivery.QUEUE)
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        tare_id = frames.next(PATIENCE_S).message.tare_id
        if tare_id not in (0, not_by):
            frames.close()
            return tare_id
    raise AssertionError("it was not tared")


def estimate_with(estimates: Subscriber[FeatureEstimate], tare_id: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while estimates.next(PATIENCE_S).message.tare_id != tare_id:
        assert time.monotonic() < deadline, "no estimate has the tare"


def test_services_that_start_after_the_tare_get_it(link: LinkConfig, session: Session) -> None:
    estimates = session.subscriber(FEATURES, delivery=Delivery.QUEUE)
    fields = session.subscriber(FIELD, delivery=Delivery.QUEUE)
    with gateway(link):
        tare_id = tared(session)
        with features(link), features(link, "spare"), field(link):
            estimate_with(estimates, tare_id)
            assert fields.next(PATIENCE_S).message.tare_id == tare_id


def test_a_service_follows_a_gateway_that_is_started_again(
    link: LinkConfig, session: Session
) -> None:
    estimates = session.subscriber(FEATURES, delivery=Delivery.QUEUE)
    with features(link):
        before = 0
        for _ in range(3):
            with gateway(link):
                tare_id = tared(session, not_by=before)
                estimate_with(estimates, tare_id)
                before = tare_id


def test_a_service_that_starts_while_others_tare_gets_its_tares(
    link: LinkConfig, session: Session
) -> None:
    """Two long requests kept every late service without a baseline."""
    estimates = {
        name: session.subscriber(FEATURES, sensor=name, delivery=Delivery.QUEUE)
        for name in ("finger-1", "finger-2", "finger-3")
    }
    with gateway(link, fingers=3), ThreadPoolExecutor(9) as pool, ExitStack() as stack:
        tares = {name: tared(session, name) for name in estimates}
        long: list[Any] = [
            pool.submit(
                session.query_all,
                endpoints.TARE,
                TareRequest(frames=1000),
                sensor=name,
                timeout_s=PATIENCE_S,
            )
            for name in estimates
            for _ in range(3)
        ]
        stack.enter_context(features(link))
        for name, tare_id in tares.items():
            estimate_with(estimates[name], tare_id)
        # And each new baseline is followed.
        for one in long:
            for tare in one.result(PATIENCE_S):
                assert tare.frames_averaged == 1000
        for name in estimates:
            now = tared(session, name, not_by=tares[name])
            estimate_with(estimates[name], now)
