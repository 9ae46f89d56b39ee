from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from palpate_gateway.condition.condition import TouchState, UntouchedLevel, is_drift

fakes: Any = importlib.import_module("condition_fakes")
ALL = np.ones(19, np.bool_)


def touch(level: UntouchedLevel) -> TouchState:
    """What is known now; it changes, which a type checker does not see."""
    return level.touch


def tared() -> UntouchedLevel:
    level = UntouchedLevel()
    level.tared(fakes.Finger().tare())
    return level


def test_before_the_first_tare_nothing_is_known() -> None:
    level = UntouchedLevel()
    level.moved()
    level.rests_at(fakes.LEVELS, 2400.0, ALL)
    assert touch(level) is TouchState.UNKNOWN


def test_drift_is_followed_however_far_it_goes() -> None:
    level = tared()
    for drift in range(0, 300, 2):
        level.rests_at(fakes.LEVELS + drift, 2400.0, ALL)
        assert touch(level) is TouchState.UNTOUCHED
        assert level.drift_counts == drift


def test_the_electrode_that_drifted_most_is_told() -> None:
    level = tared()
    drift = np.full(19, 5.0)
    drift[11] = -14.0
    level.rests_at(fakes.LEVELS + drift, 2401.0, ALL)
    assert (level.drift_electrode, level.drift_counts) == (11, 14.0)


def test_a_constant_press_is_not_untouched() -> None:
    level = tared()
    finger = fakes.Finger()
    for counts in (60.0, 300.0):
        finger.press(counts)
        level.moved()
        assert touch(level) is TouchState.MOVING
        level.rests_at(fakes.LEVELS + finger.offset, finger.pdc, ALL)
        assert touch(level) is TouchState.HELD


def test_the_pressure_alone_gives_a_press_away() -> None:
    level = tared()
    level.rests_at(fakes.LEVELS, 2400.0 + 45.0, ALL)
    assert touch(level) is TouchState.HELD


def test_released_it_rests_where_it_did_give_or_take_a_little() -> None:
    level = tared()
    level.moved()
    level.rests_at(fakes.LEVELS + 300.0, 2900.0, ALL)
    assert touch(level) is TouchState.HELD
    level.moved()
    level.rests_at(fakes.LEVELS + 15.0 * np.cos(np.arange(19)), 2425.0, ALL)
    assert touch(level) is TouchState.UNTOUCHED


def test_many_small_steps_of_a_press_do_not_add_up_to_drift() -> None:
    """A press that comes too slowly for each step to be seen is seen by its sum."""
    level, finger = tared(), fakes.Finger()
    states = []
    for counts in range(0, 100):
        finger.press(float(counts))
        level.rests_at(fakes.LEVELS + finger.offset, finger.pdc, ALL)
        states.append(level.touch)
    assert states[5] is TouchState.UNTOUCHED
    assert states[-1] is TouchState.HELD


def test_a_dead_electrode_does_not_hide_that_it_is_untouched() -> None:
    level = tared()
    usable = ALL.copy()
    usable[3] = False
    levels = fakes.LEVELS.copy()
    levels[3] = 0.0
    level.rests_at(levels, 2400.0, usable)
    assert touch(level) is TouchState.UNTOUCHED
    assert level.drift_counts == 0.0


def test_what_drift_is() -> None:
    even, one = np.full(19, 160.0), np.zeros(19)
    even[::3] += 30.0
    one[4] = -60.0
    assert is_drift(even, 5.0, ALL)
    assert not is_drift(even, 60.0, ALL)
    assert not is_drift(one, 0.0, ALL)
