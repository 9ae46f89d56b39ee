"""What a service publishes, counts and measures of each message, by a clock that tests set."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from palpate import clock
from palpate.bus import Delivery, ReceivedMessage, Session
from palpate.bus.topics import ELECTRODES, FEATURES
from palpate.codec import STAGE_TIMINGS
from palpate.config import LinkConfig
from palpate.health import Health
from palpate.messages import ElectrodeFrame, FeatureEstimate, Origin, StageTimings
from palpate_services.config import FeaturesServiceConfig
from palpate_services.inference import input_report, loop
from palpate_services.inference.estimates import EstimateRefusal, Estimation, Sample
from palpate_services.inference.loop import EstimatePublisher, ServiceRoute

MS = 1_000_000
START_NS = 10**12
ROUTE = ServiceRoute("features", ELECTRODES, FEATURES, "frames_received")

Frames = Callable[..., ElectrodeFrame]


class Station:
    """Session, health and clock of one publisher, and what it did with them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns = START_NS
        self.work_ns = self.tare_ns = self.encode_ns = 0
        self.timings: list[StageTimings] = []
        self.put: list[tuple[str, int]] = []
        self.gauges: dict[str, float] = {}
        self.of_estimates: dict[str, float] = {}
        self.sensors: tuple[str, ...] = ()
        self.refused: EstimateRefusal | None = None
        self.batches: list[int] = []
        self.closed: list[str] = []
        self.troubles: list[str] = []
        # By sensor; each is a bundle of its own.
        self.runtimes: dict[str, Any] = {}
        self.runtime = self.bundle()
        monkeypatch.setattr(loop, "time", SimpleNamespace(monotonic_ns=lambda: self.now_ns))

    def sample(self, sensor: str, frame: ElectrodeFrame, runtime: object) -> Any:
        self.now_ns += self.tare_ns
        return self.refused or Sample(np.zeros(19, np.float32))

    def encode(self, estimate: Any) -> Any:
        self.now_ns += self.encode_ns
        return estimate

    def run_all(self, samples: list[Any]) -> list[dict[str, Any]]:
        self.now_ns += self.work_ns
        self.batches.append(len(samples))
        return [{} for _ in samples]

    def bundle(self) -> Any:
        return type("Runtime", (), {"label": "any:1", "run_all": staticmethod(self.run_all)})()

    def make(
        self, *, rate_hz: float | None = None, duty: Any = None, **config: Any
    ) -> EstimatePublisher[Any, Any]:
        def publisher(topic: object, *, sensor: str, lossless: bool) -> object:
            assert topic is FEATURES
            assert not lossless

            def put_payload(estimate: Any, *, attachment: bytes) -> None:
                self.put.append((sensor, estimate))
                self.timings.append(STAGE_TIMINGS.decode(attachment))

            def close() -> None:
                self.closed.append(sensor)

            return SimpleNamespace(encode=self.encode, put_payload=put_payload, close=close)

        session = SimpleNamespace(publisher=publisher, wall_clock_error_s=0.05)
        health = SimpleNamespace(
            worked=lambda: None,
            gauge=self.gauges.__setitem__,
            set_gauges=lambda source, gauges: setattr(self, "of_estimates", gauges),
            set_sensors=lambda sensors: setattr(self, "sensors", sensors),
            fail=lambda error: self.troubles.append(str(error)),
        )
        given: Any = {"bundle": "any", "max_age_s": None, "accept_replayed": True, **config}
        return EstimatePublisher(
            ROUTE,
            session,  # type: ignore[arg-type]
            FeaturesServiceConfig(**given),
            health,  # type: ignore[arg-type]
            SimpleNamespace(
                describe=str,
                of=lambda sensor: self.runtimes.get(sensor, self.runtime),
                meet=lambda *_: False,
            ),  # type: ignore[arg-type]
            Estimation(self.sample, lambda frame, *_: frame.stamp.sequence),
            rate_hz=rate_hz,
            duty=duty,
        )


@pytest.fixture
def station(monkeypatch: pytest.MonkeyPatch) -> Station:
    return Station(monkeypatch)


@pytest.fixture
def came(make_frame: Frames) -> Callable[..., ReceivedMessage[ElectrodeFrame]]:
    """A message as a subscriber hands it over."""

    def make(
        sequence: int, at_ns: int, *, sensor: str = "finger", arrived_ns: int = 0, **frame: Any
    ) -> ReceivedMessage[ElectrodeFrame]:
        message = make_frame(sequence, monotonic_ns=at_ns, **frame)
        arrived_ns = arrived_ns or at_ns
        return ReceivedMessage(message, b"", "lab", sensor, arrived_ns, stamp=message.stamp)

    return make


Came = Callable[..., ReceivedMessage[ElectrodeFrame]]


def test_the_first_message_of_each_period_is_answered(station: Station, came: Came) -> None:
    """By the stamps, and each sensor by itself: 20 of 100 a second."""
    publisher = station.make(rate_hz=20.0)
    for k in range(12):
        publisher.take([came(k, START_NS + 10 * k * MS)])
    publisher.take([came(50, START_NS, sensor="thumb")])
    assert station.put == [("finger", 0), ("finger", 5), ("finger", 10), ("thumb", 50)]
    assert publisher.counters == {
        "frames_received": 13, "estimates_published": 4, "skipped_rate": 9,
    }  # fmt: skip
    assert station.sensors == ("finger", "thumb")


def test_a_message_without_an_estimate_leaves_its_period_to_the_next(
    station: Station, came: Came
) -> None:
    publisher = station.make(rate_hz=20.0)
    station.refused = EstimateRefusal.UNTARED
    publisher.take([came(1, START_NS)])
    station.refused = None
    publisher.take([came(2, START_NS + MS)])
    assert station.put == [("finger", 2)]
    assert publisher.counters["untared"] == 1


def test_a_standby_that_refuses_some_messages_is_in_no_trouble(
    station: Station, came: Came, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor is it blind to a sensor of which it refuses all."""
    seconds = SimpleNamespace(monotonic=lambda: 1e-9 * station.now_ns)
    monkeypatch.setattr(input_report, "time", seconds)
    duty = SimpleNamespace(
        take=lambda *_: None, holds=lambda _: False, report=lambda: None, release=lambda _: None
    )
    publisher = station.make(duty=duty)

    def run(refused_every: int) -> None:
        for k in range(300):
            station.now_ns += 10 * MS
            station.refused = EstimateRefusal.STALE if k % refused_every == 0 else None
            publisher.take([came(k, station.now_ns)])
            publisher.report()

    run(refused_every=20)
    assert (station.put, station.troubles) == ([], [])
    assert publisher.counters == {"frames_received": 300, "standby": 285, "stale": 15}
    run(refused_every=1)
    assert "'finger' is refused (stale)" in station.troubles[-1]


def test_a_rehearsal_has_no_effect(station: Station, came: Came) -> None:
    """And there is none for a message that got no estimate: it might have to wait for a tare."""
    publisher = station.make()
    answered, refused = came(1, START_NS), came(2, START_NS + 10 * MS)
    publisher.take([answered])
    publisher.rehearse(answered)
    publisher.rehearse(refused)
    assert station.batches == [1, 1]
    assert station.put == [("finger", 1)]
    assert publisher.counters == {"frames_received": 1, "estimates_published": 1}


def test_sensors_of_others_are_not_even_counted(station: Station, came: Came) -> None:
    publisher = station.make(sensors=("finger",))
    publisher.take([came(1, START_NS, sensor="thumb")])
    publisher.take([came(2, START_NS)])
    assert station.put == [("finger", 2)]
    assert publisher.counters["frames_received"] == 1


@pytest.mark.parametrize(
    ("changes", "latency_s"),
    [
        ({}, 0.0035),
        ({"origin": Origin.REPLAYED}, 0.0025),
        ({"clock_id": clock.CLOCK_ID ^ 1}, 0.0025),
    ],
)
def test_latency_counts_from_the_reading_where_its_clock_is_ours(
    station: Station, came: Came, changes: dict[str, Any], latency_s: float
) -> None:
    """Read at 0, arrived at 1 ms, taken at 3 ms, answered at 3.5 ms."""
    publisher = station.make()
    clock_id = changes.pop("clock_id", clock.CLOCK_ID)
    received = came(1, START_NS, arrived_ns=START_NS + MS, **changes)
    object.__setattr__(received.message.stamp, "clock_id", clock_id)
    station.now_ns, station.work_ns = START_NS + 3 * MS, MS // 2
    publisher.take([received])
    publisher.report(last=True)
    assert station.of_estimates["latency_p50_s"] == pytest.approx(latency_s)


def test_gauges_are_of_the_last_period(station: Station, came: Came) -> None:
    publisher = station.make()
    for k in range(1, 101):  # of 1 to 100 ms
        station.now_ns, station.work_ns = START_NS + 5 * k * MS, MS
        publisher.take([came(k, station.now_ns - (k - 1) * MS)])
    station.now_ns = START_NS + 999 * MS
    publisher.report()
    assert not station.gauges, "a second is not over"
    station.now_ns = START_NS + 1000 * MS
    publisher.report()
    assert station.gauges["busy_ratio"] == pytest.approx(0.1)
    assert station.of_estimates["latency_p50_s"] == pytest.approx(0.0505)
    assert station.of_estimates["latency_p99_s"] == pytest.approx(0.09901)
    assert station.of_estimates["batch_mean_samples"] == 1.0
    publisher.report(last=True)  # no time has passed, and nothing was published
    assert station.gauges == {"busy_ratio": 0.0}
    assert station.of_estimates == {}, "old numbers are not shown as present ones"


def test_counters_are_as_old_as_the_look_at_them(station: Station, came: Came) -> None:
    """A rate is a difference of counters by the time between two statuses."""
    publisher = station.make()
    for k in range(3):
        publisher.take([came(k, START_NS)])
        assert publisher.counters == {"frames_received": k + 1, "estimates_published": k + 1}


def test_sensors_of_one_bundle_share_a_run(station: Station, came: Came) -> None:
    publisher = station.make()
    station.runtimes = {"thumb": station.bundle()}
    names = ("finger", "thumb", "middle", "ring")
    publisher.take([came(n, START_NS, sensor=name) for n, name in enumerate(names)])
    assert sorted(station.batches) == [1, 3]
    assert sorted(station.put) == sorted((name, n) for n, name in enumerate(names))


def test_the_rate_holds_for_messages_that_waited_together(station: Station, came: Came) -> None:
    publisher = station.make(rate_hz=20.0)
    waited = [came(n, START_NS + 10 * n * MS) for n in range(7)]
    publisher.take([came(50, START_NS, sensor="thumb"), *waited])
    assert station.put == [("thumb", 50), ("finger", 0), ("finger", 5)]


def test_a_sensor_without_a_bundle_is_counted(station: Station, came: Came) -> None:
    publisher = station.make()
    station.runtimes = {"thumb": None}
    publisher.take([came(1, START_NS, sensor="thumb"), came(2, START_NS)])
    assert station.put == [("finger", 2)]
    assert publisher.counters["no_model"] == 1


def test_sensors_are_bounded_and_silent_ones_forgotten(
    station: Station, came: Came, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "SENSORS_MOST", 2)
    publisher = station.make(rate_hz=1.0)
    for n in range(4):
        publisher.take([came(n, START_NS, sensor=f"s{n}")])
    assert [sensor for sensor, _ in station.put] == ["s0", "s1"]
    assert publisher.counters["sensors_refused"] == 2
    for minute in (1, 2):  # s1 goes on, s0 is silent
        station.now_ns = START_NS + minute * 60_000 * MS
        publisher.report()
        publisher.take([came(5, station.now_ns, sensor="s1")])
    assert station.sensors == ("s1",)
    assert station.closed == ["s0"]
    publisher.take([came(6, station.now_ns, sensor="s3")])
    assert station.put[-1] == ("s3", 6)


def test_what_has_come_is_answered_before_it_leaves(
    link: LinkConfig, make_bundle: Callable[..., Path], make_frame: Frames
) -> None:
    """Five frames; the service is told to stop while it works on the first."""
    stop, begun, go = threading.Event(), threading.Event(), threading.Event()
    kept: list[Health] = []

    def prepare(session: Session, models: object, health: Health) -> Any:
        kept.append(health)

        def slow(sensor: str, frame: ElectrodeFrame, runtime: object) -> Any:
            begun.set()
            assert go.wait(20)
            return Sample(np.zeros(19, np.float32))

        def complete(frame: ElectrodeFrame, *_: object) -> FeatureEstimate:
            place = np.zeros(3, np.float32)
            return FeatureEstimate(
                frame.stamp, "BT", bytes(32), 5, True, place + 1, place, place, place
            )

        return Estimation(slow, complete)

    config = FeaturesServiceConfig(bundle=str(make_bundle()), delivery="every", max_age_s=None)
    service = threading.Thread(
        target=loop.serve,
        args=(ROUTE, config, link, "lab", stop),
        kwargs={"instance": "features", "prepare": prepare},
    )
    service.start()
    with Session.open(link) as session:
        estimates = session.subscriber(FEATURES, delivery=Delivery.QUEUE)
        sender = session.publisher(ELECTRODES, sensor="finger", lossless=True)
        deadline = time.monotonic() + 20
        while not sender.matched():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        for sequence in range(1, 6):
            sender.put(make_frame(sequence))
        assert begun.wait(20)
        time.sleep(0.3)  # the others arrive meanwhile
        stop.set()
        go.set()
        service.join(20)
        assert [estimates.next(5.0).message.source.sequence for _ in range(5)] == [1, 2, 3, 4, 5]
    assert kept[0].counters["estimates_published"] == 5


def test_timings_say_where_the_time_went(station: Station, came: Came) -> None:
    publisher = station.make()
    station.tare_ns, station.work_ns, station.encode_ns = 2 * MS, 5 * MS, MS
    station.now_ns = START_NS + 10 * MS
    arrived = dataclasses.replace(came(1, START_NS, arrived_ns=START_NS + 3 * MS), decode_s=0.0005)
    publisher.take([arrived])
    (timings,) = station.timings
    found = [round(getattr(timings, name) * 1e3, 3) for name in timings.__slots__]
    assert found == [3.0, 6.5, 0.5, 2.0, 5.0, 1.0]


@pytest.mark.parametrize("origin", [Origin.REPLAYED, Origin.SIMULATED])
def test_an_age_by_a_clock_that_says_nothing_of_it_is_none(
    station: Station, came: Came, origin: Origin
) -> None:
    publisher = station.make()
    message = came(1, START_NS, origin=origin)
    if origin is Origin.SIMULATED:
        stamp = dataclasses.replace(message.message.stamp, clock_id=clock.CLOCK_ID ^ 1)
        frame = dataclasses.replace(message.message, stamp=stamp)
        message = dataclasses.replace(message, message=frame, stamp=stamp)
    publisher.take([message])
    assert station.timings[0].age_at_arrival_s is None
