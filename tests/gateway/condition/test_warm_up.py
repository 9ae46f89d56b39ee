from __future__ import annotations

import math

import pytest

from palpate_gateway.condition.condition import WINDOW_S, WarmUp


def follow(
    warm_up: WarmUp, slope: float, seconds: float, *, begin_s: float = 0.0, tdc: float = 1500.0
) -> float:
    """TDC that rises steadily [counts/min], in blocks of 0.2 s; what it has become."""
    for k in range(round(seconds / 0.2)):
        rise = slope * 0.2 * k / 60.0
        warm_up.add(begin_s + 0.2 * k, tdc + rise + 0.3 * math.sin(7.0 * k))
    return tdc + slope * seconds / 60.0


def test_nothing_is_said_before_there_is_a_slope() -> None:
    warm_up = WarmUp()
    follow(warm_up, 100.0, 8.0)
    assert warm_up.slope_counts_per_min is None
    assert not warm_up.warming


@pytest.mark.parametrize(
    ("slope", "warming"),
    [(7.0, False), (-7.0, False), (27.0, False), (33.0, True), (60.0, True), (-60.0, True)],
)
def test_steep_is_warming_up(slope: float, warming: bool) -> None:
    warm_up = WarmUp()
    follow(warm_up, slope, 20.0)
    assert warm_up.slope_counts_per_min == pytest.approx(slope, abs=2.0)
    assert warm_up.warming is warming


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_it_settles_when_the_slope_is_flat_not_before(sign: float) -> None:
    warm_up = WarmUp()
    tdc = follow(warm_up, sign * 60.0, 40.0)
    tdc = follow(warm_up, sign * 17.0, 2 * WINDOW_S, begin_s=40.0, tdc=tdc)
    assert warm_up.warming
    follow(warm_up, sign * 13.0, 2 * WINDOW_S, begin_s=40.0 + 2 * WINDOW_S, tdc=tdc)
    assert not warm_up.warming


def test_a_touch_begins_the_slope_anew_and_keeps_what_is_known() -> None:
    warm_up = WarmUp()
    follow(warm_up, 60.0, 20.0)
    warm_up.begin()
    follow(warm_up, 0.0, 5.0, begin_s=25.0)
    assert warm_up.warming
    follow(warm_up, 0.0, 15.0, begin_s=30.0)
    assert not warm_up.warming


def test_a_gap_in_time_is_no_slope() -> None:
    warm_up = WarmUp()
    follow(warm_up, 0.0, 12.0)
    warm_up.add(1000.0, 1900.0)
    follow(warm_up, 0.0, 5.0, begin_s=1000.0)
    assert not warm_up.warming
