"""The counter of an RDT sensor as a clock."""

from __future__ import annotations

import pytest

from palpate.errors import DeviceLost
from palpate_gateway.wrench.rdt import CHECK_S, CounterClock


def test_goes_on_over_its_end() -> None:
    clock = CounterClock(1000.0, "it")
    first = clock.follow(2**32 - 500, 7.0, new_epoch=True)
    second = clock.follow(500, 8.0, new_epoch=False)
    assert first is not None
    assert second is not None
    assert second - first == pytest.approx(1.0)


@pytest.mark.parametrize(("raw", "lost"), [(12_000, False), (11_000, True), (9_000, True)])
def test_a_gap_that_is_longer_than_the_counter_says_is_a_restart(raw: int, lost: bool) -> None:
    clock = CounterClock(1000.0, "it")
    clock.follow(10_000, 5.0, new_epoch=True)
    if lost:
        with pytest.raises(DeviceLost, match="it: its counter did not continue"):
            clock.follow(raw, 7.0, new_epoch=True)
    else:
        assert clock.follow(raw, 7.0, new_epoch=True) == 12.0


@pytest.mark.parametrize("rate_hz", [7912, 0])
def test_a_wrong_rate_is_found(rate_hz: int) -> None:
    clock = CounterClock(7000.0, "it")
    for k in range(2):
        clock.follow(round(rate_hz * k * CHECK_S), k * CHECK_S, new_epoch=False)
    assert not clock.wrong
    with pytest.raises(DeviceLost, match=f"runs at {rate_hz} Hz, not 7000 Hz"):
        clock.follow(round(rate_hz * 2 * CHECK_S), 2 * CHECK_S, new_epoch=False)
    assert clock.wrong


def test_a_pause_of_ours_is_none() -> None:
    clock = CounterClock(1000.0, "it")
    clock.follow(0, 0.0, new_epoch=True)
    # For 15 s nothing is read; what waited comes at once.
    for raw in (1, 5_000, 15_000):
        clock.follow(raw, 15.0, new_epoch=False)
    for raw in range(16_000, 60_000, 1000):
        clock.follow(raw, raw / 1000.0, new_epoch=False)
    assert not clock.wrong


def test_an_unknown_rate_tells_no_time() -> None:
    clock = CounterClock(None, "it")
    assert clock.follow(100, 0.0, new_epoch=True) is None
    assert clock.follow(8_000, 1.0, new_epoch=True) is None
    with pytest.raises(DeviceLost, match="it was restarted"):
        clock.follow(5, 2.0, new_epoch=True)


@pytest.mark.parametrize("before", [1_000_000_000, 3_000_000_000])
def test_a_restart_is_found_wherever_a_counter_of_unknown_rate_was(before: int) -> None:
    clock = CounterClock(None, "it")
    clock.follow(before, 0.0, new_epoch=True)
    with pytest.raises(DeviceLost, match="it was restarted"):
        clock.follow(500, 1.5, new_epoch=True)
