from __future__ import annotations

import importlib
from typing import Any

import pytest

from palpate.messages import FaultKind
from palpate_gateway.condition.channel_health import REMEDIES, ChannelHealth, describe
from palpate_gateway.condition.stillness import FrameBlocks

fakes: Any = importlib.import_module("condition_fakes")
LAYOUT = fakes.LAYOUT


class Watch:
    """A finger, and the watch over its channels."""

    def __init__(self) -> None:
        self.finger = fakes.Finger(11)
        self.health = ChannelHealth(19)
        self._blocks = FrameBlocks(LAYOUT, fakes.RATE_HZ)

    def go(self, seconds: float, *, untouched: bool = False) -> dict[FaultKind, tuple[str, ...]]:
        """Let time pass; the faults at its end."""
        for frame in self.finger.frames(seconds):
            block = self._blocks.add(frame)
            if block is not None:
                self.health.add(block, untouched=untouched)
        return {fault.kind: tuple(fault.channels) for fault in self.health.faults}


def test_an_intact_sensor_has_none() -> None:
    watch = Watch()
    for noise in (0.0, 0.4, 5.0):
        watch.finger.noise = noise
        assert watch.go(20.0, untouched=True) == {}
    assert set(watch.health.counters.values()) == {0}
    assert watch.health.usable.all()


def test_a_strong_press_saturates_and_lets_go() -> None:
    watch = Watch()
    watch.finger.fixed = {2: 0, 5: 4095}
    assert watch.go(0.4) == {FaultKind.SATURATED: ("E3", "E6")}
    assert not watch.health.usable[2]
    assert watch.go(5.0) == {FaultKind.SATURATED: ("E3", "E6")}, "while it is pressed: not dead"
    watch.finger.fixed = {}
    assert watch.go(0.4) == {}
    assert watch.health.usable.all()
    assert watch.health.counters["channels_saturated"] == 2


def test_a_knock_is_no_saturation() -> None:
    watch = Watch()
    watch.finger.fixed = {4: 4095}
    watch.go(0.1)
    watch.finger.fixed = {}
    assert watch.go(0.3) == {}


@pytest.mark.parametrize("value", [0, 4095])
def test_at_the_end_of_the_range_untouched_it_is_dead(value: int) -> None:
    watch = Watch()
    watch.finger.fixed = {9: value}
    assert watch.go(1.2, untouched=True) == {FaultKind.DEAD: ("E10",)}


def test_without_valid_words_it_is_dead_and_comes_back() -> None:
    watch = Watch()
    watch.go(1.0)
    watch.finger.invalid = 1 << 6 | 1 << LAYOUT.tdc_bit
    assert watch.go(1.4) == {FaultKind.DEAD: ("E7", "TDC")}
    assert not watch.health.usable[6]
    watch.finger.invalid = 0
    assert watch.go(1.2) == {}
    assert watch.health.counters["channels_dead"] == 2


def test_parity_errors_now_and_then_are_not_death() -> None:
    watch = Watch()
    for k in range(300):
        watch.finger.invalid = 1 << 6 if k % 3 == 0 else 0
        assert watch.go(0.01) == {}


def test_an_electrode_that_stands_while_others_vary_is_stuck() -> None:
    watch = Watch()
    watch.finger.fixed = {6: 3100}
    assert watch.go(2.8) == {}
    assert watch.go(0.4) == {FaultKind.STUCK: ("E7",)}
    watch.finger.noise = 0.0
    assert watch.go(5.0) == {FaultKind.STUCK: ("E7",)}, "it has not moved since"
    watch.finger.fixed = {}
    watch.finger.noise = 4.0
    assert watch.go(0.4) == {}
    assert watch.health.counters["channels_stuck"] == 1


def test_a_quiet_sensor_shows_it_when_it_is_touched() -> None:
    watch = Watch()
    watch.finger.noise = 0.4
    watch.finger.fixed = {6: 3100}
    assert watch.go(10.0, untouched=True) == {}
    for k in range(150):
        watch.finger.press(1.0 * k)
        watch.go(0.01)
    assert watch.go(0.2) == {FaultKind.STUCK: ("E7",)}


def test_pac_without_noise_is_stuck() -> None:
    watch = Watch()
    watch.finger.pac_noise = 0.0
    assert watch.go(1.4) == {FaultKind.STUCK: ("PAC",)}
    watch.finger.pac_noise = 2.0
    assert watch.go(0.4) == {}


def test_a_line_that_repeats_old_words_sticks_in_every_channel() -> None:
    watch = Watch()
    watch.finger.noise = watch.finger.pac_noise = 0.0
    assert watch.go(1.4) == {FaultKind.STUCK: (*(f"E{k}" for k in range(1, 20)), "PAC")}
    assert not watch.health.usable.any()
    watch.finger.noise, watch.finger.pac_noise = 4.0, 4.0
    assert watch.go(0.4) == {}


def test_pac_at_its_end_is_saturated_and_without_words_dead() -> None:
    watch = Watch()
    watch.finger.pac_noise = 1e9  # clipped at both ends: loud, but not saturated
    assert watch.go(1.0) == {}
    watch.finger.pac_noise = 4.0
    watch.finger.invalid = LAYOUT.all_valid >> LAYOUT.first_pac_bit << LAYOUT.first_pac_bit
    assert watch.go(1.4) == {FaultKind.DEAD: ("PAC",)}


def test_a_device_with_one_sample_of_pac_a_frame_is_intact() -> None:
    watch = Watch()
    watch.finger.invalid = LAYOUT.all_valid >> 23 << 23
    assert watch.go(3.0, untouched=True) == {}


def test_levels_of_an_air_bubble_and_of_a_thin_layer_are_odd() -> None:
    watch = Watch()
    watch.finger.offset[13] = -1700.0
    assert watch.go(0.4) == {}, "only at rest"
    assert watch.go(0.2, untouched=True) == {FaultKind.ODD: ("E14",)}
    watch.finger.offset[:] = -1700.0
    assert watch.go(0.2, untouched=True) == {FaultKind.ODD: tuple(f"E{k}" for k in range(1, 20))}
    assert watch.health.counters["channels_odd"] == 19


def test_faults_are_gauged_and_described() -> None:
    watch = Watch()
    watch.finger.fixed = {0: 4095, 3: 0, 6: 3100}
    watch.go(3.2)
    assert watch.health.gauges() == {
        "saturated_channels": 2.0,
        "dead_channels": 0.0,
        "stuck_channels": 1.0,
        "odd_channels": 0.0,
    }
    assert describe(watch.health.faults) == "E1, E4 saturated; E7 stuck"
    assert set(REMEDIES) == set(FaultKind) - {FaultKind.UNKNOWN}


def test_opened_again_it_judges_anew() -> None:
    watch = Watch()
    watch.finger.fixed = {6: 3100}
    watch.go(2.8)
    watch.health.begin()
    assert watch.go(2.8) == {}
