"""The rate of slots is measured: a wrong one is told, a pause or a loss is none."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_gateway.biotac.slot_rate import SlotRate

SLOTS = 44
"""Slots that are read at once."""


def followed(
    rate: SlotRate, stamps_s: np.ndarray, *, placed: int = 0, lost: np.ndarray | None = None
) -> list[float]:
    """What is told of slots with these stamps, read one round at a time."""
    told = []
    for end in range(SLOTS, len(stamps_s), SLOTS):
        gone = 0 if lost is None else int(lost[end - 1])
        told.append(rate.follow(placed + end, gone, float(stamps_s[end - 1])))
    return [one for one in told if one is not None]


def slots_at(hz: float, seconds: float, begin_s: float = 0.0) -> np.ndarray:
    """Stamps of slots, late by up to a millisecond."""
    sampled_s = begin_s + np.arange(round(hz * seconds)) / hz
    late_s = np.random.default_rng(1).uniform(0.0, 1e-3, len(sampled_s))
    return np.maximum.accumulate(sampled_s + late_s)


@pytest.mark.parametrize("hz", [4390.0, 4400.0, 4330.0, 4470.0])
def test_a_rate_that_can_be_followed_is_right(hz: float) -> None:
    rate = SlotRate(4400.0)
    assert not rate.right
    assert followed(rate, slots_at(hz, 60.0)) == []
    assert rate.right


@pytest.mark.parametrize("hz", [2200.0, 3942.0, 4200.0, 4290.0, 4510.0, 8800.0])
def test_a_wrong_rate_is_measured_in_three_seconds(hz: float) -> None:
    rate = SlotRate(4400.0)
    told = followed(rate, slots_at(hz, 3.0))
    assert len(told) == 1
    assert told[0] == pytest.approx(hz, rel=0.005)
    assert not rate.right


def test_a_rate_that_changes_later_is_told() -> None:
    rate = SlotRate(4400.0)
    before = slots_at(4400.0, 20.0)
    assert followed(rate, before) == []
    told = followed(rate, slots_at(4000.0, 29.0, begin_s=20.0), placed=len(before))
    assert told[:1] == [pytest.approx(4000.0, rel=0.005)]


@pytest.mark.parametrize("pause_s", [0.05, 0.3, 2.0])
def test_pauses_are_no_wrong_rate(pause_s: float) -> None:
    stamps_s = slots_at(4400.0, 60.0)
    for second in range(0, 60, 7):
        stamps_s[stamps_s >= second + 0.1] += pause_s / (1 + second % 3)
    rate = SlotRate(4400.0)
    assert followed(rate, stamps_s) == []
    assert rate.right


def test_a_bus_that_loses_slots_is_not_judged() -> None:
    # Of ten frames one is lost, and one slot more: the rate of what comes is wrong.
    stamps_s = slots_at(4400.0, 30.0)
    number = np.arange(len(stamps_s))
    kept = number % 440 >= 45
    lost = (number // 440 + 1)[kept]
    rate = SlotRate(4400.0)
    assert followed(rate, stamps_s[kept], lost=lost) == []
    assert not rate.right
