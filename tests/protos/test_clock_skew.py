"""A stamp in the future is no fresh one, from this host or from another, nor is one slept on."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate import clock
from palpate.bus import Session
from palpate.bus.topics import ELECTRODES
from palpate.config import LinkConfig
from palpate.errors import ClockSkewError, StaleError
from palpate.messages import ElectrodeFrame, Origin, Stamp

FrameOf = Callable[..., ElectrodeFrame]
WaitUntil = Callable[..., None]

SECOND_NS = 1_000_000_000
OTHER_HOST = clock.CLOCK_ID ^ 1


def stamped(ahead_s: float, clock_id: int) -> dict[str, Any]:
    """Times of a stamp so far in the future; the other clock of another host means nothing."""
    monotonic_ns, wall_ns = clock.now()
    ahead_ns = round(ahead_s * SECOND_NS)
    here = clock_id == clock.CLOCK_ID
    return {
        "monotonic_ns": monotonic_ns + ahead_ns if here else 7,
        "wall_ns": 7 if here else wall_ns + ahead_ns,
        "clock_id": clock_id,
    }


@pytest.mark.parametrize("clock_id", [clock.CLOCK_ID, OTHER_HOST], ids=["same", "other"])
@pytest.mark.parametrize("ahead_s", [1.0, 60.0, 3600.0])
def test_a_reading_from_the_future_has_no_age(clock_id: int, ahead_s: float) -> None:
    stamp = Stamp(1, 1, origin=Origin.LIVE, **stamped(ahead_s, clock_id))
    with pytest.raises(ClockSkewError, match="in the future") as caught:
        clock.checked_age_s(stamp)
    assert caught.value.skew_s == pytest.approx(ahead_s, abs=0.9)
    assert isinstance(caught.value, StaleError), "code that refuses old readings refuses it"
    assert ("wall clock" in caught.value.problem) is (clock_id == OTHER_HOST)


def test_wall_clocks_may_differ_by_what_is_known() -> None:
    stamp = Stamp(1, 1, origin=Origin.LIVE, **stamped(30.0, OTHER_HOST))
    assert -30.0 <= clock.checked_age_s(stamp, wall_clock_error_s=60.0) < 0
    here = Stamp(1, 1, origin=Origin.LIVE, **stamped(30.0, clock.CLOCK_ID))
    with pytest.raises(ClockSkewError):
        clock.checked_age_s(here, wall_clock_error_s=60.0)  # says nothing of this host's clock


@given(
    # No older than the monotonic clock of this host.
    age_s=st.floats(0.0, min(1e6, time.monotonic())),
    clock_id=st.sampled_from([clock.CLOCK_ID, OTHER_HOST]),
)
def test_what_lies_in_the_past_has_its_age(age_s: float, clock_id: int) -> None:
    began_s = time.monotonic()
    stamp = Stamp(1, 1, origin=Origin.LIVE, **stamped(-age_s, clock_id))
    found_s = clock.checked_age_s(stamp)
    took_s = time.monotonic() - began_s
    assert age_s - 1e-3 <= found_s <= age_s + took_s + 1e-3


@pytest.fixture
def asleep(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Lets the host seem to have been asleep for some seconds more."""
    true_ns, slept_ns = clock.since_boot_ns, 0
    monkeypatch.setattr(clock, "since_boot_ns", lambda: true_ns() + slept_ns)
    monkeypatch.setattr(clock, "_host_sleep", clock.HostSleep())

    def sleep(seconds: float) -> None:
        nonlocal slept_ns
        slept_ns += round(seconds * SECOND_NS)

    return sleep


def test_an_age_includes_the_time_that_the_host_was_asleep(
    asleep: Callable[[float], None],
) -> None:
    before = Stamp(1, 1, origin=Origin.LIVE, **stamped(0.0, clock.CLOCK_ID))
    assert clock.checked_age_s(before) < 60.0
    asleep(3600.0)
    assert 3600.0 <= clock.checked_age_s(before) < 3660.0
    after = Stamp(2, 2, origin=Origin.LIVE, **stamped(0.0, clock.CLOCK_ID))
    assert clock.checked_age_s(after) < 60.0
    asleep(7200.0)
    assert 7200.0 <= clock.checked_age_s(after) < 7260.0
    assert 10800.0 <= clock.checked_age_s(before) < 10860.0


def test_what_came_before_the_host_slept_is_not_the_latest(
    link: LinkConfig, frame_of: FrameOf, wait_until: WaitUntil, asleep: Callable[[float], None]
) -> None:
    with Session.open(link) as session:
        subscriber = session.subscriber(ELECTRODES)
        publisher = session.publisher(ELECTRODES, sensor="finger")
        publisher.put(frame_of(1, **stamped(0.0, clock.CLOCK_ID)))
        wait_until(lambda: subscriber.counters.get("received"))
        asleep(3600.0)
        with pytest.raises(StaleError, match=r"36\d\d\.\d+ s old"):
            subscriber.latest(max_age_s=600.0)
        publisher.put(frame_of(2, **stamped(0.0, clock.CLOCK_ID)))
        wait_until(lambda: subscriber.counters.get("received") == 2)
        assert subscriber.latest(max_age_s=600.0).message.stamp.sequence == 2


@pytest.mark.parametrize("clock_id", [clock.CLOCK_ID, OTHER_HOST], ids=["same", "other"])
def test_latest_refuses_the_future(
    pair: Any, frame_of: FrameOf, wait_until: WaitUntil, clock_id: int
) -> None:
    a, b = pair
    subscriber = b.subscriber(ELECTRODES)
    publisher = a.publisher(ELECTRODES, sensor="finger")
    wait_until(publisher.matched)
    publisher.put(frame_of(1, **stamped(60.0, clock_id)))
    wait_until(lambda: subscriber.counters.get("received"))
    with pytest.raises(ClockSkewError):
        subscriber.latest(max_age_s=5)


def test_a_reading_is_never_younger_than_its_arrival(
    link: LinkConfig, frame_of: FrameOf, wait_until: WaitUntil
) -> None:
    """A host whose clock is ahead, within what is allowed, keeps no reading fresh for longer."""
    lax = link.model_copy(update={"wall_clock_error_s": 10.0})
    with Session.open(lax) as session:
        subscriber = session.subscriber(ELECTRODES)
        publisher = session.publisher(ELECTRODES, sensor="finger")
        publisher.put(frame_of(1, **stamped(8.0, OTHER_HOST)))
        wait_until(lambda: subscriber.counters.get("received"))
        assert subscriber.latest(max_age_s=5.0).message.stamp.sequence == 1
        time.sleep(0.05)
        with pytest.raises(StaleError, match="old"):
            subscriber.latest(max_age_s=0.04)
