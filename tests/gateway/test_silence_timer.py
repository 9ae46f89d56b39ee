from __future__ import annotations

import pytest

from palpate_gateway.service import worker as listening
from palpate_gateway.service.worker import SilenceTimer


class Clock:
    """The host's clock, moved by hand."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(listening, "time", made)
    return made


def wait(timer: SilenceTimer, clock: Clock, late_s: float = 0.0) -> None:
    """A read that times out, so much too late."""
    clock.now_s += timer.begin() + late_s
    timer.timed_out()


def test_a_silence_is_told_when_it_is_due(clock: Clock) -> None:
    timer = SilenceTimer(0.045, 0.025)
    began_s = clock.now_s
    assert timer.begin() == pytest.approx(0.045)
    wait(timer, clock)
    assert timer.lost
    assert clock.now_s - began_s == pytest.approx(0.045)
    assert timer.begin() == 0.025
    wait(timer, clock)
    assert timer.silent_s == pytest.approx(0.07)
    timer.arrived()
    assert not timer.lost


def test_a_timeout_that_comes_early_leaves_the_rest_to_wait(clock: Clock) -> None:
    timer = SilenceTimer(0.045, 0.025)
    timer.begin()
    clock.now_s += 0.02
    timer.timed_out()
    assert not timer.lost
    assert timer.begin() == pytest.approx(0.025)


def test_a_process_that_stood_still_has_not_listened(clock: Clock) -> None:
    timer = SilenceTimer(0.045, 0.025)
    wait(timer, clock, late_s=3.0)
    assert timer.silent_s == 0.0
    timer.arrived()
    assert not timer.lost


def test_a_driver_that_always_takes_too_long_does_not_hide_a_silence(clock: Clock) -> None:
    timer = SilenceTimer(0.045, 0.025)
    wait(timer, clock, late_s=0.5)
    wait(timer, clock, late_s=0.5)
    assert timer.lost
