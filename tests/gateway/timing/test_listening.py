from __future__ import annotations

import pytest

from palpate_gateway.timing import listening
from palpate_gateway.timing.listening import Listening


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


def wait(heard: Listening, clock: Clock, late_s: float = 0.0) -> None:
    """A read that times out, so much too late."""
    clock.now_s += heard.begin() + late_s
    heard.heard_nothing()


def test_a_silence_is_told_when_it_is_due(clock: Clock) -> None:
    heard = Listening(0.045, 0.025)
    began_s = clock.now_s
    assert heard.begin() == pytest.approx(0.045)
    wait(heard, clock)
    assert heard.lost
    assert clock.now_s - began_s == pytest.approx(0.045)
    assert heard.begin() == 0.025
    wait(heard, clock)
    assert heard.silent_s == pytest.approx(0.07)
    heard.heard()
    assert not heard.lost


def test_a_timeout_that_comes_early_leaves_the_rest_to_wait(clock: Clock) -> None:
    heard = Listening(0.045, 0.025)
    heard.begin()
    clock.now_s += 0.02
    heard.heard_nothing()
    assert not heard.lost
    assert heard.begin() == pytest.approx(0.025)


def test_a_process_that_stood_still_has_not_listened(clock: Clock) -> None:
    heard = Listening(0.045, 0.025)
    wait(heard, clock, late_s=3.0)
    assert heard.silent_s == 0.0
    heard.heard()
    assert not heard.lost


def test_a_driver_that_always_takes_too_long_does_not_hide_a_silence(clock: Clock) -> None:
    heard = Listening(0.045, 0.025)
    wait(heard, clock, late_s=0.5)
    wait(heard, clock, late_s=0.5)
    assert heard.lost
