from __future__ import annotations

import importlib
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.gateway.pipelines import pushed

from palpate.clock import CLOCK_ID
from palpate.errors import DeviceError
from palpate.messages import ElectrodeFrame, FaultKind
from palpate_gateway.clock.stamps import DueMessage, FileClock
from palpate_gateway.condition.condition import Condition, RetareRules, TouchState
from palpate_gateway.condition.stillness import StillLimits
from palpate_gateway.drivers import make_device
from palpate_gateway.service.pipeline import Pipeline
from palpate_gateway.tare import TareCollector

fakes: Any = importlib.import_module("condition_fakes")


def condition(retare: RetareRules | None = None) -> Condition:
    return Condition(fakes.LAYOUT, fakes.RATE_HZ, StillLimits(), retare)


def touch(made: Condition) -> TouchState:
    """What is known now; it changes, which a type checker does not see."""
    return made.level.touch


def feed(made: Condition, frames: Iterable[ElectrodeFrame]) -> set[TouchState]:
    """What it says of touches on the way."""
    return {made.level.touch for frame in frames if made.add(frame)}


def test_a_press_and_its_release() -> None:
    made, finger = condition(), fakes.Finger()
    feed(made, finger.frames(1.0))
    assert touch(made) is TouchState.UNKNOWN
    assert made.motion == ""
    made.tared(finger.tare())
    feed(made, finger.frames(1.0))
    assert touch(made) is TouchState.UNTOUCHED
    finger.press(300.0)
    seen = feed(made, finger.frames(3.0))
    assert TouchState.MOVING in seen
    assert touch(made) is TouchState.HELD
    assert "it is held, or has to be tared again" in made.message
    finger.press(0.0)
    feed(made, finger.frames(1.0))
    assert touch(made) is TouchState.UNTOUCHED
    assert made.message == ""


def test_drift_is_measured_and_the_worst_electrode_named() -> None:
    made, finger = condition(), fakes.Finger()
    made.tared(finger.tare())
    finger.offset[:] = 6.0
    finger.offset[6] = 14.0
    feed(made, finger.frames(2.0))
    gauges = made.gauges()
    assert gauges["tare_drift_counts"] == pytest.approx(14.0, abs=2.5)
    assert gauges["tare_age_s"] == pytest.approx(1.99, abs=0.011)
    assert made.message == "E7 has drifted from the tare: tare again"
    assert not made.wants_tare, "not unless the rules say so"


def test_a_tare_ages_while_no_frame_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    made, finger = condition(), fakes.Finger()
    tare = finger.tare()
    now_s = 1e-9 * tare.stamp.monotonic_ns + 30.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    made.tared(replace(tare, stamp=replace(tare.stamp, clock_id=CLOCK_ID)))
    assert made.gauges()["tare_age_s"] == pytest.approx(30.0)
    now_s += 29.0
    assert made.gauges()["tare_age_s"] == pytest.approx(59.0)


def test_it_tares_again_when_untouched_for_long_enough() -> None:
    made, finger = condition(RetareRules(after_s=3.0)), fakes.Finger()
    made.tared(finger.tare())
    finger.offset[:] = 20.0
    feed(made, finger.frames(2.0))
    assert not made.wants_tare
    feed(made, finger.frames(3.0))
    assert made.wants_tare
    finger.levels = finger.levels + finger.offset
    finger.offset[:] = 0.0
    made.tared(finger.tare())
    assert not made.wants_tare


def test_it_does_not_tare_again_while_it_is_held() -> None:
    """The trap: a stand that presses is as still as nothing."""
    made, finger = condition(RetareRules(after_s=1.0)), fakes.Finger()
    made.tared(finger.tare())
    feed(made, finger.frames(1.0))
    finger.press(80.0)
    for _ in range(1000):
        made.add(finger.frame())
        assert not made.wants_tare
    assert touch(made) is TouchState.HELD
    assert made.motion == ""


def test_it_does_not_tare_again_with_a_broken_channel() -> None:
    made, finger = condition(RetareRules(after_s=1.0)), fakes.Finger()
    made.tared(finger.tare())
    finger.offset[:] = 20.0
    finger.fixed = {6: 3000}
    feed(made, finger.frames(4.0))
    assert [fault.kind for fault in made.faults] == [FaultKind.STUCK]
    assert touch(made) is TouchState.UNTOUCHED
    assert not made.wants_tare


def test_a_dead_electrode_is_dead_only_where_nothing_presses() -> None:
    made, finger = condition(), fakes.Finger()
    made.tared(finger.tare())
    finger.press(300.0)
    finger.fixed = {6: 0}
    feed(made, finger.frames(3.0))
    assert {fault.kind for fault in made.faults} == {FaultKind.SATURATED}
    assert not made.has_wrong_channel
    finger.press(0.0)
    feed(made, finger.frames(3.0))
    assert {fault.kind for fault in made.faults} == {FaultKind.DEAD}
    assert made.has_wrong_channel
    assert made.message == "E7 dead"


def test_warm_up_is_told() -> None:
    made, finger = condition(), fakes.Finger()
    made.tared(finger.tare())
    for frame in finger.frames(20.0):
        finger.tdc += 0.01  # 60 counts a minute
        made.add(frame)
    assert made.warm_up.warming
    assert made.gauges()["warm_up"] == 1.0
    assert made.gauges()["tdc_slope_counts_per_min"] == pytest.approx(60.0, abs=5.0)
    assert "warming up, so the baseline drifts" in made.message


def test_opened_again_it_waits_for_new_frames() -> None:
    made, finger = condition(), fakes.Finger()
    made.tared(finger.tare())
    feed(made, finger.frames(1.0))
    made.begin()
    assert touch(made) is TouchState.MOVING
    feed(made, finger.frames(0.4))
    assert touch(made) is TouchState.MOVING
    feed(made, finger.frames(0.4))
    assert touch(made) is TouchState.UNTOUCHED


@pytest.fixture(scope="module")
def capture(shared_data: Path) -> list[ElectrodeFrame]:
    """A real BioTac: 6.5 s untouched, then held by a hand, from frame 2000 on released."""
    path = shared_data / "syntouch_btd_raw" / "data.btd.gz"
    if not path.is_file():
        pytest.skip("the public BTD capture is not beside the project")
    with make_device("text_log", {"path": path}) as device:
        made = Pipeline(device.info, tare="query")
        made.begin(device.identity, FileClock(device.identity.serial, None))
        out: list[DueMessage] = []
        while got := device.read(1.0):
            out += pushed(made, got, 0)
    return [item.message for item in out if isinstance(item.message, ElectrodeFrame)]


def test_a_hand_that_holds_a_real_sensor_is_seen(capture: list[ElectrodeFrame]) -> None:
    made = condition()
    states = []
    collector: TareCollector | None = TareCollector(50)
    for frame in capture:
        made.add(frame)
        tare = collector.add(frame) if collector is not None else None
        if tare is not None:
            made.tared(tare)
            collector = None
        states.append(made.level.touch)
    assert set(states[120:640]) == {TouchState.UNTOUCHED}
    assert TouchState.UNTOUCHED not in states[720:1990]
    assert states[-1] is TouchState.UNTOUCHED
    assert made.channels.counters == dict.fromkeys(made.channels.counters, 0)
    assert made.gauges()["tare_drift_counts"] < 40.0


def test_a_real_sensor_is_not_tared_while_a_hand_holds_it(capture: list[ElectrodeFrame]) -> None:
    tared, collector = [], TareCollector(50)
    for k, frame in enumerate(capture):
        try:
            if collector.add(frame) is not None:
                tared.append(k)
        except DeviceError:
            continue
    assert not [k for k in tared if 700 <= k < 2010]
    assert len([k for k in tared if k < 650]) == 13, "every window of the untouched sensor"


@pytest.mark.parametrize(
    ("idle", "pressed"),
    [
        ("finger1_idle_finger2_electrodes_raw", "finger2_electrodes_raw"),
        ("finger2_idle_finger1_electrodes_raw", "finger1_electrodes_raw"),
    ],
)
def test_real_sensors_idle_and_pressed(shared_data: Path, idle: str, pressed: str) -> None:
    path = shared_data / "lasa_force_calibration" / "force_calibration.npz"
    if not path.is_file():
        pytest.skip("the public force calibration is not beside the project")
    data = np.load(path)
    untouched, held = data[idle], data[pressed]
    finger = fakes.Finger(3)
    finger.levels = untouched[:50].mean(axis=0)
    made = condition(RetareRules(after_s=10.0))
    made.tared(finger.tare())
    assert feed(made, _play(finger, untouched[50:6000])) - {TouchState.MOVING} == {
        TouchState.UNTOUCHED
    }
    assert touch(made) is TouchState.UNTOUCHED
    assert made.wants_tare
    finger.levels = data[pressed.split("_")[0] + "_baseline_mean"].astype(np.float64)
    made = condition(RetareRules(after_s=1.0))
    made.tared(finger.tare())
    assert TouchState.UNTOUCHED not in feed(made, _play(finger, held[:6000]))
    assert not any(made.channels.counters.values())


def _play(finger: Any, electrodes: np.ndarray) -> Iterable[ElectrodeFrame]:
    """Recorded electrodes; the other channels, which were not recorded, are at rest."""
    for row in electrodes:
        finger.fixed = dict(enumerate(row.tolist()))
        yield finger.frame()
