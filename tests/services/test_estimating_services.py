"""What every estimating service keeps: features, field and synthesis on a real bus."""

from __future__ import annotations

import dataclasses
import importlib
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from palpate.bus import Delivery, Session, endpoints
from palpate.bus.topics import ELECTRODES, FEATURES, FIELD, FIELD_TRUTH, SYNTHESIS, TARE, Topic
from palpate.config import LinkConfig
from palpate.errors import StreamTimeout
from palpate.files.bundle import read_bundle
from palpate.messages import ElectrodeFrame, Origin, ServiceRequest, Status, Tare
from palpate_services.config import (
    FeaturesServiceConfig,
    FieldServiceConfig,
    SynthesisServiceConfig,
)
from palpate_services.inference.estimates import estimate, estimate_field, synthesise
from palpate_services.inference.model import Runtime, load
from palpate_services.inference.services import run_estimating

bundles: Any = importlib.import_module("field_bundles")

Frames = Callable[..., ElectrodeFrame]
Until = Callable[[Callable[[], bool]], None]


@dataclasses.dataclass(frozen=True)
class Case:
    """One service: how it is run, what goes in, what comes out, and by which pure function."""

    name: str
    config: Callable[..., Any]
    source: Topic[Any]
    target: Topic[Any]
    make: Callable[[ElectrodeFrame], Any]
    pure: Callable[[Any, Tare, Runtime], Any]
    received: str
    source_name: str = ""

    def options(self) -> dict[str, Any]:
        """Options that make it answer every message."""
        return {"rate_hz": None} if self.name == "field" else {}


def _electrodes(frame: ElectrodeFrame) -> ElectrodeFrame:
    return frame


def _known(frame: ElectrodeFrame) -> Any:
    return bundles.truth(frame.stamp, 1e-5 * frame.stamp.sequence)


def _guessed(frame: ElectrodeFrame) -> Any:
    return bundles.guess(frame.stamp, 1e-5 * frame.stamp.sequence)


def _synthesise(message: Any, _: Tare, runtime: Runtime) -> Any:
    return synthesise(message, runtime)


CASES = {
    "features": Case(
        "features", FeaturesServiceConfig, ELECTRODES, FEATURES, _electrodes,
        estimate, "frames_received",
    ),
    "field": Case(
        "field", FieldServiceConfig, ELECTRODES, FIELD, _electrodes, estimate_field,
        "frames_received",
    ),
    "synthesis of truth": Case(
        "synthesis", SynthesisServiceConfig, FIELD_TRUTH, SYNTHESIS, _known,
        _synthesise, "fields_received", "truth",
    ),
    "synthesis of estimates": Case(
        "synthesis", SynthesisServiceConfig, FIELD, SYNTHESIS, _guessed, _synthesise,
        "fields_received", "estimate",
    ),
}  # fmt: skip


@pytest.fixture(params=list(CASES))
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]


@pytest.fixture
def folder(case: Case, tmp_path: Path, make_bundle: Callable[..., Path]) -> Path:
    if case.name == "features":
        return make_bundle()
    written: Path = bundles.write(tmp_path / "bundle", case.name)
    return written


Serve = Callable[..., AbstractContextManager[Session]]


@pytest.fixture
def serve(case: Case, folder: Path, link: LinkConfig, until: Until) -> Serve:
    """Run the service while the block runs; the block gets a session of its own."""

    @contextmanager
    def running(**config: Any) -> Iterator[Session]:
        stop = threading.Event()
        source = {"source": case.source_name} if case.source_name else {}
        options = {"unannounced": True, **case.options(), **config}
        settings = case.config(bundle=str(folder), **source, **options)
        node = threading.Thread(target=run_estimating, args=(settings, link, "lab", stop))
        node.start()
        try:
            with Session.open(link) as session:
                until(lambda: any(a.service == case.name and a.ready for a in session.alive()))
                yield session
        finally:
            stop.set()
            node.join(timeout=30)
        assert not node.is_alive()

    return running


def announce(session: Session, tare: Tare, sensor: str = "finger") -> None:
    """Publish a tare as a gateway does, and answer for it: a frame may overtake the stream."""
    session.queryable(endpoints.TARE, lambda _: tare, sensor=sensor)
    session.publisher(TARE, sensor=sensor).put(tare)


def status_of(session: Session, case: Case) -> Status:
    return session.query(endpoints.STATUS, ServiceRequest(), service=case.name, timeout_s=5.0)


class TestEstimatingService:
    """The contract of a service that answers messages with estimates."""

    def test_answers_counts_and_says_what_it_is(
        self,
        case: Case,
        folder: Path,
        serve: Serve,
        make_frame: Frames,
        make_tare: Callable[..., Tare],
        until: Until,
    ) -> None:
        with serve(max_age_s=10.0) as session:
            estimates = session.subscriber(case.target, delivery=Delivery.QUEUE)
            messages = session.publisher(case.source, sensor="finger")
            announce(session, make_tare())
            for sequence in range(1, 11):
                messages.put(case.make(make_frame(sequence)))
                got = estimates.next(5.0)
                assert got.sensor == "finger"
                assert got.message.source.sequence == sequence
            until(lambda: status_of(session, case).counters.get("estimates_published") == 10)
            status = status_of(session, case)
            assert status.counters[case.received] == 10
            assert status.sensors == ("finger",)
            metadata = session.query(endpoints.MODEL, ServiceRequest(), service=case.name)
            assert metadata.task == case.name
            assert metadata.bundle_sha256 == got.message.bundle_sha256 == read_bundle(folder).sha256

    def test_refuses_old_and_replayed_messages_and_broken_payloads(
        self,
        case: Case,
        serve: Serve,
        make_frame: Frames,
        make_tare: Callable[..., Tare],
        until: Until,
    ) -> None:
        with serve(max_age_s=10.0) as session:
            estimates = session.subscriber(case.target, delivery=Delivery.QUEUE)
            wanted: dict[str, int] = {}
            spoiled: dict[str, dict[str, Any]] = {
                "stale": {"age_s": 60.0},
                "clock_skew": {"age_s": -3600.0},
                "replayed_refused": {"origin": Origin.REPLAYED},
            }
            for name, changes in spoiled.items():
                announce(session, make_tare(), f"s-{name}")
                messages = session.publisher(case.source, sensor=f"s-{name}")
                messages.put(case.make(make_frame(**changes)))
                wanted[name] = 1
            finger = session.publisher(case.source, sensor="finger")
            finger.put_payload(b"\xff" * 40)
            wanted["rejected_parse"] = 1
            until(lambda: wanted.items() <= status_of(session, case).counters.items())
            with pytest.raises(StreamTimeout):
                estimates.next(0.1)
            announce(session, make_tare())
            finger.put(case.make(make_frame(99)))
            assert estimates.next(5.0).message.source.sequence == 99

    def test_lossless_replay_gives_the_bytes_of_the_pure_function(
        self,
        case: Case,
        folder: Path,
        serve: Serve,
        make_frame: Frames,
        make_tare: Callable[..., Tare],
    ) -> None:
        frames = [make_frame(n, origin=Origin.REPLAYED, monotonic_ns=n) for n in range(1, 101)]
        replayed = [case.make(frame) for frame in frames]
        with serve(delivery="every", accept_replayed=True) as session:
            estimates = session.subscriber(case.target, delivery=Delivery.EVERY)
            announce(session, make_tare())
            messages = session.publisher(case.source, sensor="finger", lossless=True)
            for message in replayed:
                messages.put(message)
            answers = [estimates.next(5.0).payload for _ in replayed]
        runtime = load(read_bundle(folder), case.name)
        wanted = [
            case.target.codec.encode(case.pure(message, make_tare(), runtime))
            for message in replayed
        ]
        assert answers == wanted
        assert len(set(answers)) == len(answers)

    def test_serves_the_sensors_it_is_told_to(
        self,
        case: Case,
        serve: Serve,
        make_frame: Frames,
        make_tare: Callable[..., Tare],
    ) -> None:
        with serve(max_age_s=10.0, sensors=("finger", "thumb")) as session:
            estimates = session.subscriber(case.target, delivery=Delivery.QUEUE)
            for sensor in ("toe", "finger"):
                announce(session, make_tare(), sensor)
                session.publisher(case.source, sensor=sensor).put(case.make(make_frame(1)))
            assert estimates.next(5.0).sensor == "finger"
            with pytest.raises(StreamTimeout):
                estimates.next(0.1)

    def test_ready_token_goes_when_it_stops(
        self, serve: Serve, link: LinkConfig, until: Until
    ) -> None:
        with Session.open(link) as observer:
            with serve():
                # A token takes its way over the bus, on a loaded host a while.
                until(lambda: [a.ready for a in observer.alive()] == [True])
            until(lambda: observer.alive() == [])
