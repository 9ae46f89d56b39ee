"""The features service on a real bus: what it answers, what it refuses, what it counts."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from palpate.bus import Delivery, Session, endpoints
from palpate.bus.topics import ELECTRODES, FEATURES, TARE, sensor_key
from palpate.codec import (
    ELECTRODE_FRAME,
)
from palpate.codec import TARE as TARE_CODEC
from palpate.config import LinkConfig
from palpate.errors import ConfigError, StreamTimeout
from palpate.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    Origin,
    ServiceRequest,
    ServiceState,
    Status,
    Tare,
    TareRequest,
)
from palpate_services.config import (
    FeaturesServiceConfig,
    FieldServiceConfig,
    SynthesisServiceConfig,
)
from palpate_services.inference.estimates import estimate
from palpate_services.inference.model import Runtime
from palpate_services.inference.services import run_estimating

Frames = Callable[..., ElectrodeFrame]
Tares = Callable[..., Tare]
Until = Callable[[Callable[[], bool]], None]
Serve = Callable[..., AbstractContextManager[Session]]


def test_by_default_old_messages_get_no_estimate() -> None:
    """The ages that docs/tare-and-health.md names."""
    configs = FeaturesServiceConfig(), FieldServiceConfig(), SynthesisServiceConfig()
    assert [config.max_age_s for config in configs] == [0.05, 0.1, 0.2]


@pytest.fixture
def serve(link: LinkConfig, make_bundle: Callable[..., Path], until: Until) -> Serve:
    """Run the service while the block runs; the block gets a session of its own."""

    @contextmanager
    def running(**config: Any) -> Iterator[Session]:
        stop = threading.Event()
        settings = FeaturesServiceConfig(
            bundle=str(make_bundle()), **{"unannounced": True, **config}
        )
        node = threading.Thread(target=run_estimating, args=(settings, link, "lab", stop))
        node.start()
        try:
            with Session.open(link) as session:
                until(lambda: any(a.service == "features" and a.ready for a in session.alive()))
                yield session
        finally:
            stop.set()
            node.join(timeout=30)
        assert not node.is_alive()

    return running


def announce(session: Session, sensor: str, tare: Tare) -> None:
    """Publish a tare as a gateway does, and answer for it: a frame may overtake the stream."""
    session.queryable(endpoints.TARE, lambda _: tare, sensor=sensor)
    session.publisher(TARE, sensor=sensor).put(tare)


def ask_status(session: Session) -> Status:
    return session.query(endpoints.STATUS, ServiceRequest(), service="features", timeout_s=5.0)


def counters(session: Session) -> dict[str, int]:
    return dict(ask_status(session).counters)


def test_answers_frames_and_says_what_it_is(
    serve: Serve, make_frame: Frames, make_tare: Tares, until: Until
) -> None:
    with serve(max_age_s=10.0) as session:
        estimates = session.subscriber(FEATURES, delivery=Delivery.QUEUE)
        frames = session.publisher(ELECTRODES, sensor="finger")
        announce(session, "finger", make_tare())
        for sequence in range(1, 21):
            frames.put(make_frame(sequence))
            got = estimates.next(5.0)
            assert got.sensor == "finger"
            assert got.message.source.sequence == sequence
        until(lambda: counters(session).get("estimates_published") == 20)
        status = ask_status(session)
        assert status.state is ServiceState.READY
        assert status.sensors == ("finger",)
        until(lambda: ask_status(session).gauges.get("latency_p50_s", 0.0) > 0)
        metadata = session.query(endpoints.MODEL, ServiceRequest(), service="features")
        assert metadata.bundle_sha256 == got.message.bundle_sha256


def test_a_stop_does_not_wait_for_the_end_of_a_live_stream(
    serve: Serve, link: LinkConfig, make_frame: Frames, make_tare: Tares
) -> None:
    """It answers what has come; after ``drain_s`` it would be too late for ``serve``."""
    ended = threading.Event()

    def send(robot: Session) -> None:
        frames = robot.publisher(ELECTRODES, sensor="finger")
        sequence = 0
        while not ended.wait(0.01):
            sequence += 1
            frames.put(make_frame(sequence))

    with Session.open(link) as robot:
        sender = threading.Thread(target=send, args=(robot,))
        with serve(max_age_s=10.0, drain_s=30.0) as session:
            estimates = session.subscriber(FEATURES)
            announce(robot, "finger", make_tare())
            sender.start()
            estimates.next(5.0)
        ended.set()
        sender.join()


def test_one_sensor_of_the_station_is_served(
    serve: Serve, make_frame: Frames, make_tare: Tares, until: Until
) -> None:
    with serve(max_age_s=10.0, sensors=("finger",)) as session:
        estimates = session.subscriber(FEATURES, delivery=Delivery.QUEUE)
        for sensor in ("thumb", "finger"):
            announce(session, sensor, make_tare())
            session.publisher(ELECTRODES, sensor=sensor).put(make_frame(1))
        assert estimates.next(5.0).sensor == "finger"
        until(lambda: counters(session).get("frames_received") == 1)
        with pytest.raises(StreamTimeout):
            estimates.next(0.1)


def test_latency_counts_from_the_reading_and_of_a_replay_from_the_arrival(
    serve: Serve, make_frame: Frames, make_tare: Tares, until: Until
) -> None:
    with serve(max_age_s=10.0, accept_replayed=True) as session:
        announce(session, "finger", make_tare())
        frames = session.publisher(ELECTRODES, sensor="finger")
        for origin, least_s, most_s in ((Origin.SIMULATED, 3.0, 9.0), (Origin.REPLAYED, 0.0, 2.9)):
            frames.put(make_frame(1 + int(origin), age_s=3.0, origin=origin))
            # The gauges are those of the last period in which there were estimates.
            until(
                lambda least_s=least_s, most_s=most_s: (  # type: ignore[misc]
                    least_s < ask_status(session).gauges.get("latency_p50_s", -1.0) < most_s
                )
            )


def test_refuses_what_it_must_and_counts_it(
    serve: Serve, make_frame: Frames, make_tare: Tares, until: Until
) -> None:
    good = make_frame().validity
    with serve(max_age_s=10.0) as session:
        estimates = session.subscriber(FEATURES, delivery=Delivery.QUEUE)
        announce(session, "finger", make_tare())
        wanted: dict[str, int] = {}
        # One sensor each, so that newest-wins and the order of stamps play no part.
        spoiled: dict[str, dict[str, Any]] = {
            "stale": {"age_s": 60.0},
            "clock_skew": {"age_s": -3600.0},
            "untared": {"tare_id": 0},
            "invalid_channels": {"validity": good ^ 1},
            "replayed_refused": {"origin": Origin.REPLAYED},
            "tare_unknown": {"tare_id": 77},
        }
        for name, changes in spoiled.items():
            sensor = f"s-{name}"
            if name != "tare_unknown":
                announce(session, sensor, make_tare())
            session.publisher(ELECTRODES, sensor=sensor).put(make_frame(**changes))
            wanted[name] = 1
            until(lambda: all(counters(session).get(k) == v for k, v in wanted.items()))
        with pytest.raises(StreamTimeout):
            estimates.next(0.1)
        session.publisher(ELECTRODES, sensor="finger").put(make_frame(99))
        assert estimates.next(5.0).message.source.sequence == 99


def test_broken_payloads_are_counted_and_harm_nobody(
    serve: Serve, make_frame: Frames, make_tare: Tares, until: Until
) -> None:
    good = ELECTRODE_FRAME.encode(make_frame(1))
    eighteen: Any = ELECTRODE_FRAME.message_type.FromString(good)
    eighteen.electrodes = eighteen.electrodes[:36]
    with serve(max_age_s=10.0) as session:
        estimates = session.subscriber(FEATURES, delivery=Delivery.QUEUE)
        frames = session.publisher(ELECTRODES, sensor="finger")
        frames.put_payload(eighteen.SerializeToString())
        until(lambda: counters(session).get("rejected_electrode_count") == 1)
        frames.put_payload(b"\xff" * 40)
        until(lambda: counters(session).get("rejected_parse") == 1)
        announce(session, "finger", make_tare())
        frames.put(make_frame(2))
        assert estimates.next(5.0).message.source.sequence == 2


def test_nan_baseline_is_never_used(
    serve: Serve, make_frame: Frames, make_tare: Tares, until: Until
) -> None:
    poisoned: Any = TARE_CODEC.message_type.FromString(TARE_CODEC.encode(make_tare()))
    poisoned.electrodes[3] = float("nan")
    with serve(max_age_s=10.0) as session:
        estimates = session.subscriber(FEATURES, delivery=Delivery.QUEUE)
        session.publisher(TARE, sensor="finger").put_payload(poisoned.SerializeToString())
        session.publisher(ELECTRODES, sensor="finger").put(make_frame())
        until(lambda: counters(session).get("tare_unknown") == 1)
        with pytest.raises(StreamTimeout):
            estimates.next(0.1)


def test_newest_frame_wins_behind_a_slow_model(
    serve: Serve,
    make_frame: Frames,
    make_tare: Tares,
    until: Until,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    quick = Runtime.run

    def slow(self: Runtime, sample: Any) -> Any:
        time.sleep(0.03)
        return quick(self, sample)

    with serve(max_age_s=None) as session:
        monkeypatch.setattr(Runtime, "run", slow)
        estimates = session.subscriber(FEATURES, delivery=Delivery.QUEUE)
        frames = session.publisher(ELECTRODES, sensor="finger")
        announce(session, "finger", make_tare())
        for sequence in range(1, 101):
            frames.put(make_frame(sequence))
            time.sleep(0.002)
        answered = [estimates.next(5.0).message.source.sequence]
        while answered[-1] != 100:
            answered.append(estimates.next(5.0).message.source.sequence)
        assert answered == sorted(set(answered))
        until(lambda: counters(session).get("estimates_published") == len(answered))
        final = counters(session)
        assert final["dropped_newest_wins"] == 100 - len(answered) > 0
        assert final.get("lost_on_bus", 0) == 0


def test_lost_tare_of_one_sensor_does_not_hold_up_another(
    serve: Serve, make_frame: Frames, make_tare: Tares, until: Until
) -> None:
    release = threading.Event()

    def hangs(_: TareRequest) -> Tare:
        release.wait(20)
        return make_tare(77)

    with serve(max_age_s=None, tare_timeout_s=0.1) as session:
        session.queryable(endpoints.TARE, hangs, sensor="lost")
        estimates = session.subscriber(FEATURES, sensor="finger", delivery=Delivery.QUEUE)
        announce(session, "finger", make_tare())
        lost = session.publisher(ELECTRODES, sensor="lost")
        finger = session.publisher(ELECTRODES, sensor="finger")
        for sequence in range(1, 31):
            lost.put(make_frame(sequence, tare_id=77))
            finger.put(make_frame(sequence))
            assert estimates.next(5.0).message.source.sequence == sequence
        until(lambda: counters(session).get("tare_unknown", 0) > 20)
        release.set()


def test_lossless_replay_answers_every_frame_with_the_bytes_of_the_estimator(
    serve: Serve, bundle: Any, make_frame: Frames, make_tare: Tares
) -> None:
    from palpate.codec import FEATURE_ESTIMATE
    from palpate_services.inference.model import load

    replayed = [make_frame(n, origin=Origin.REPLAYED, monotonic_ns=n) for n in range(1, 501)]
    with serve(delivery="every", accept_replayed=True) as session:
        estimates = session.subscriber(FEATURES, delivery=Delivery.EVERY)
        announce(session, "finger", make_tare())
        frames = session.publisher(ELECTRODES, sensor="finger", lossless=True)
        for frame in replayed:
            frames.put(frame)
        answers = [estimates.next(5.0).payload for _ in replayed]
    runtime = load(bundle, "features")
    for frame, payload in zip(replayed, answers, strict=True):
        wanted = estimate(frame, make_tare(), runtime)
        assert isinstance(wanted, FeatureEstimate)
        found = FEATURE_ESTIMATE.decode(payload)
        np.testing.assert_array_equal(found.force, wanted.force)
        assert found.source == wanted.source


def test_ready_token_goes_when_it_stops(serve: Serve, link: LinkConfig, until: Until) -> None:
    with Session.open(link) as observer:
        with serve():
            until(lambda: [a.ready for a in observer.alive()] == [True])
        until(lambda: observer.alive() == [])


def test_unknown_bundle_lists_what_there_is() -> None:
    with pytest.raises(ConfigError, match="bundle 'no-such'"):
        run_estimating(
            FeaturesServiceConfig(bundle="no-such"), LinkConfig(), "lab", threading.Event()
        )


def test_a_service_without_tares_is_degraded_until_it_gets_one(
    serve: Serve, make_frame: Frames, make_tare: Tares, until: Until
) -> None:
    with serve(max_age_s=10.0) as session:
        frames = session.publisher(ELECTRODES, sensor="finger")
        sequence = iter(range(1, 1_000_000))

        def state_after_a_frame() -> ServiceState:
            frames.put(make_frame(next(sequence)))
            return ask_status(session).state

        until(lambda: state_after_a_frame() is ServiceState.DEGRADED)
        error = ask_status(session).last_error
        assert error is not None
        assert "'finger' is refused (tare_unknown)" in error.message
        assert "tare" in error.remedy
        announce(session, "finger", make_tare())
        until(lambda: state_after_a_frame() is ServiceState.READY)


def test_a_model_that_hangs_stops_the_heartbeat(
    serve: Serve, make_frame: Frames, make_tare: Tares, monkeypatch: pytest.MonkeyPatch
) -> None:
    beats, returns = threading.Semaphore(0), threading.Event()
    run = Runtime.run_all

    def run_or_hang(runtime: Runtime, *values: Any) -> Any:
        assert returns.wait(20)
        return run(runtime, *values)

    with serve(max_age_s=60.0) as session:
        monkeypatch.setattr("palpate_services.inference.loop.beat", lambda *_: beats.release())
        for _ in range(3):
            assert beats.acquire(timeout=20), "it beats although nothing comes"
        monkeypatch.setattr(Runtime, "run_all", run_or_hang)
        estimates = session.subscriber(FEATURES, delivery=Delivery.QUEUE)
        announce(session, "finger", make_tare())
        session.publisher(ELECTRODES, sensor="finger").put(make_frame(1))
        while beats.acquire(timeout=0.5):
            pass
        returns.set()
        estimates.next(20)
        assert beats.acquire(timeout=20)


def test_invented_sensors_are_not_followed(
    serve: Serve, make_frame: Frames, make_tare: Tares, until: Until
) -> None:
    """Only what a gateway claims is served; the service keeps nothing of other names."""
    names = 300
    with serve(max_age_s=20.0, unannounced=False) as session:
        estimates = session.subscriber(FEATURES, delivery=Delivery.QUEUE)
        payload = ELECTRODE_FRAME.encode(make_frame(1))
        encoding = zenoh.Encoding(ELECTRODES.encoding)
        for number in range(names):
            key = sensor_key("lab", f"invented{number}", "electrodes")
            session._raw.put(key, payload, encoding=encoding)
        until(lambda: counters(session).get("unannounced") == names)
        with session.claims(session_id=9, instance="gateway", lease_s=2.0) as claims:
            claims.want("finger")
            assert claims.wait("finger", 20.0)
            announce(session, "finger", make_tare())
            frames = session.publisher(ELECTRODES, sensor="finger")
            frames.put(make_frame(1))
            for sequence in range(2, 100):  # the claim may come after the first of them
                frames.put(make_frame(sequence))
                with contextlib.suppress(StreamTimeout):
                    assert estimates.next(0.2).sensor == "finger"
                    break
            else:
                raise AssertionError("the claimed finger got no estimate")
        assert ask_status(session).sensors == ("finger",)
