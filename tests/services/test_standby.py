"""Several features services for one sensor: one publishes, whatever starts, ends or hangs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from palpate.bus import Delivery, Session, Subscriber, endpoints
from palpate.bus.topics import ELECTRODES, FEATURES, TARE, duty_root
from palpate.config import LinkConfig
from palpate.errors import ErrorCode, StreamTimeout
from palpate.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    ServiceRequest,
    ServiceState,
    Status,
    Tare,
)
from palpate_services.config import FeaturesServiceConfig
from palpate_services.inference.services import run_estimating

Frames = Callable[..., ElectrodeFrame]
Until = Callable[[Callable[[], bool]], None]
Replica = Callable[..., AbstractContextManager[threading.Event]]


@pytest.fixture
def replica(link: LinkConfig, until: Until) -> Replica:
    """Run a features service of this instance while the block runs."""

    @contextmanager
    def running(instance: str, bundle: Path, **more: Any) -> Iterator[threading.Event]:
        stop = threading.Event()
        settings = {"unannounced": True, "max_age_s": 60.0, **more}
        config = FeaturesServiceConfig(bundle=str(bundle), **settings)
        node = threading.Thread(
            target=run_estimating, args=(config, link, "lab", stop), kwargs={"instance": instance}
        )
        node.start()
        try:
            with Session.open(link) as session:
                until(lambda: any(a.instance == instance and a.ready for a in session.alive()))
            yield stop
        finally:
            stop.set()
            node.join(timeout=60)
        assert not node.is_alive()

    return running


class Finger:
    """Frames of one finger, and the estimates of them."""

    def __init__(self, session: Session, make_frame: Frames, tare: Tare) -> None:
        self._make, self.sequence = make_frame, 0
        session.queryable(endpoints.TARE, lambda _: tare, sensor="finger")
        session.publisher(TARE, sensor="finger").put(tare)
        self._frames = session.publisher(ELECTRODES, sensor="finger")
        self.estimates: Subscriber[FeatureEstimate] = session.subscriber(
            FEATURES, delivery=Delivery.QUEUE
        )
        self._session = session

    def send(self, **frame: Any) -> bool:
        """Send a frame."""
        self.sequence += 1
        self._frames.put(self._make(self.sequence, **frame))
        return True

    def touch(self) -> FeatureEstimate | None:
        """Send a frame; its estimate, if one comes."""
        self.send()
        try:
            while True:
                found = self.estimates.next(0.5).message
                if found.source.sequence == self.sequence:
                    return found
        except StreamTimeout:
            return None

    def touch_until_estimated(self) -> FeatureEstimate:
        deadline = time.monotonic() + 60.0
        while (found := self.touch()) is None:
            assert time.monotonic() < deadline, "nobody took over"
        return found

    def status(self, instance: str) -> Status:
        return self._session.query(
            endpoints.STATUS,
            ServiceRequest(),
            service="features",
            instance=instance,
            timeout_s=10.0,
        )


def stood_by(finger: Finger, instance: str) -> int:
    """Frames for which a replica stood by."""
    return finger.status(instance).counters.get("standby", 0)


@pytest.fixture
def finger(
    link: LinkConfig, make_frame: Frames, make_tare: Callable[..., Tare]
) -> Iterator[Finger]:
    with Session.open(link) as session:
        yield Finger(session, make_frame, make_tare())


def test_one_publishes_and_the_other_takes_over(
    replica: Replica,
    make_bundle: Callable[..., Path],
    finger: Finger,
    link: LinkConfig,
    until: Until,
) -> None:
    bundle = make_bundle()
    with ExitStack() as first, ExitStack() as both, Session.open(link) as session:
        first.enter_context(replica("features-a", bundle))
        assert finger.touch_until_estimated()
        until(lambda: [one.instance for one in session.holders(duty_root("features"), "finger")]
              == ["features-a"])  # fmt: skip
        both.enter_context(replica("features-b", bundle))
        until(lambda: finger.touch() is not None and stood_by(finger, "features-b") >= 10)
        waiting = finger.status("features-b")
        assert waiting.counters.get("estimates_published", 0) == 0
        assert waiting.state is ServiceState.READY
        until(lambda: "features-a" in finger.status("features-b").message)
        assert finger.status("features-b").gauges["standby_sensors"] == 1.0
        # Each frame had one estimate: a second one would have been counted.
        assert not finger.estimates.counters.get("reordered")
        first.close()
        finger.touch_until_estimated()
        until(lambda: finger.status("features-b").gauges.get("standby_sensors") == 0.0)
        # It does not give the sensor back to one that comes later.
        with replica("features-a", bundle):
            until(lambda: finger.touch() is not None and stood_by(finger, "features-a") > 0)


def test_a_standby_says_so_again_after_a_trouble_and_afterwards_what_it_serves(
    replica: Replica, make_bundle: Callable[..., Path], finger: Finger, until: Until
) -> None:
    bundle = make_bundle()
    with ExitStack() as first:
        first.enter_context(replica("features-a", bundle))
        finger.touch_until_estimated()
        with replica("features-b", bundle):

            def said() -> tuple[ServiceState, str]:
                found = finger.status("features-b")
                return found.state, found.message

            ready = ServiceState.READY
            until(lambda: finger.touch() is not None and "standby for finger" in said()[1])
            until(lambda: finger.send(validity=1) and said()[0] is ServiceState.DEGRADED)
            until(lambda: finger.touch() is not None and said()[0] is ready)
            assert "standby for finger: features-a" in said()[1]
            first.close()
            finger.touch_until_estimated()
            until(lambda: finger.touch() is not None and "standby" not in said()[1])
            assert said() == (ready, "serving test:1")


def test_a_standby_with_another_bundle_says_so(
    replica: Replica, make_bundle: Callable[..., Path], finger: Finger, until: Until
) -> None:
    with ExitStack() as first, ExitStack() as second:
        first.enter_context(replica("features-a", make_bundle()))
        before = finger.touch_until_estimated()
        second.enter_context(replica("features-b", make_bundle(name="another")))
        until(lambda: finger.touch() is not None
              and finger.status("features-b").state is ServiceState.DEGRADED)  # fmt: skip
        error = finger.status("features-b").last_error
        assert error is not None
        assert error.code is ErrorCode.UNAVAILABLE
        assert before.bundle_sha256.hex()[:12] in error.message
        first.close()
        after = finger.touch_until_estimated()
        assert after.bundle_sha256 != before.bundle_sha256, "which bundle answered is not visible"
        until(lambda: finger.status("features-b").state is ServiceState.READY)


def test_a_standby_takes_over_from_one_that_refuses_everything(
    replica: Replica, make_bundle: Callable[..., Path], finger: Finger, until: Until
) -> None:
    """As where the clock of the active service's host was set."""
    bundle = make_bundle()

    def old() -> float:
        finger.send(age_s=20.0)
        return finger.status("features-b").counters.get("estimates_published", 0)

    with replica("features-a", bundle, max_age_s=10.0):
        assert finger.touch_until_estimated()
        with replica("features-b", bundle):
            until(lambda: finger.touch() is not None and stood_by(finger, "features-b") > 0)
            assert finger.status("features-b").counters.get("estimates_published", 0) == 0
            until(lambda: old() >= 5)
            assert finger.status("features-a").counters["stale"] > 0
            twice = finger.estimates.counters.get("reordered", 0)
            until(lambda: finger.touch() is not None and stood_by(finger, "features-a") > 0)
            assert finger.estimates.counters.get("reordered", 0) == twice


def test_a_standby_may_start_first(
    replica: Replica, make_bundle: Callable[..., Path], finger: Finger, until: Until
) -> None:
    """Whoever comes first publishes, whatever it is called."""
    bundle = make_bundle()
    with replica("features-b", bundle):
        finger.touch_until_estimated()
        with replica("features-a", bundle):
            until(lambda: finger.touch() is not None and stood_by(finger, "features-a") >= 5)
            assert finger.status("features-a").counters.get("estimates_published", 0) == 0


def test_of_some_that_start_together_one_publishes(
    replica: Replica, make_bundle: Callable[..., Path], finger: Finger, until: Until
) -> None:
    bundle = make_bundle()
    names = [f"features-{letter}" for letter in "abc"]
    with ExitStack() as stack:
        for name in names:
            stack.enter_context(replica(name, bundle))
        for _ in range(20):
            finger.touch()

        def waiting() -> list[float]:
            return sorted(finger.status(one).gauges.get("standby_sensors", -1.0) for one in names)

        until(lambda: finger.touch() is not None and waiting() == [0.0, 1.0, 1.0])
        twice = finger.estimates.counters.get("reordered", 0)
        for _ in range(10):
            assert finger.touch() is not None
        assert finger.estimates.counters.get("reordered", 0) == twice
