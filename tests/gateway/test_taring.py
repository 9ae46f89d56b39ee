"""When a sensor is tared: at the start, on request, and again by itself."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import pytest
from tests.gateway.pipelines import finished, pushed

from palpate.errors import DeviceError
from palpate.messages import NO_TARE, ElectrodeFrame, Origin, SensorType, Tare
from palpate_gateway.clock.stamps import DueMessage, FileClock, LiveClock
from palpate_gateway.condition.condition import RetareRules, TouchState
from palpate_gateway.device import DeviceIdentity, DeviceInfo
from palpate_gateway.readings import ElectrodeReading
from palpate_gateway.service.pipeline import Pipeline
from palpate_gateway.tare import TareCollector

fakes: Any = importlib.import_module("condition_fakes")
IDENTITY = DeviceIdentity("BT1", 1 / 4400)


def pipeline(*, live: bool = True, **options: Any) -> Pipeline:
    info = DeviceInfo("test", SensorType.BIOTAC, "test", 100.0, live, not live, Origin.LIVE)
    made = Pipeline(info, **options)
    made.begin(IDENTITY, LiveClock() if live else FileClock("BT1", None))
    return made


def push(made: Pipeline, frames: Iterable[ElectrodeFrame]) -> list[DueMessage]:
    """Readings that hold what the frames do."""
    out: list[DueMessage] = []
    for frame in frames:
        reading = ElectrodeReading(
            tick=frame.stamp.device_tick,
            time_s=frame.stamp.monotonic_ns * 1e-9,
            missed_before=0,
            electrodes=frame.electrodes,
            pdc=frame.pdc,
            pac=frame.pac,
            tac=frame.tac,
            tdc=frame.tdc,
            validity=frame.validity,
        )
        out += pushed(made, [reading], frame.stamp.monotonic_ns)
    return out


def tares(out: list[DueMessage]) -> list[Tare]:
    return [item.message for item in out if isinstance(item.message, Tare)]


def test_a_request_that_is_refused_is_told_to_who_asked_while_a_tare_is_in_force() -> None:
    made, finger = pipeline(), fakes.Finger()
    push(made, finger.frames(1.0))
    assert made.ledger.current_id != NO_TARE
    finger.pac_noise = 22.0
    asked = made.ask_tare(0)
    push(made, finger.frames(1.0))
    with pytest.raises(DeviceError, match="PAC varies"):
        asked.result(0.0)
    assert made.tare_error is None
    assert made.counters["tares_refused"] == 1


def test_still_waits_for_pac_to_be_quiet() -> None:
    """A hand that holds the finger: its electrodes are quiet enough, its pulse is not."""
    made, finger = pipeline(), fakes.Finger()
    finger.pac_noise = 22.0
    assert tares(push(made, finger.frames(3.0))) == []
    assert "cannot tare BT1: PAC varies by 22 counts" in str(made.tare_error)
    assert made.counters["tares_refused"] == 6
    finger.pac_noise = 4.0
    (tare,) = tares(push(made, finger.frames(1.0)))
    assert tare.pac == pytest.approx(2040.0, abs=0.5)
    assert made.tare_error is None
    assert made.condition is not None
    push(made, finger.frames(1.0))
    assert made.condition.gauges()["tare_drift_counts"] < 5.0


def test_first_looks_at_the_electrodes_only() -> None:
    made, finger = pipeline(tare="first"), fakes.Finger()
    finger.pac_noise = 22.0
    assert len(tares(push(made, finger.frames(0.5)))) == 1


def test_query_waits_to_be_asked() -> None:
    made, finger = pipeline(tare="query"), fakes.Finger()
    out = push(made, finger.frames(2.0))
    assert tares(out) == []
    assert len(out) == 200
    future = made.ask_tare(0)
    assert tares(push(made, finger.frames(0.5))) == [future.result(timeout=0)]


def test_a_recording_that_is_not_to_be_tared_is_not_held_back() -> None:
    made, finger = pipeline(live=False, tare="query"), fakes.Finger()
    out = push(made, finger.frames(0.1))
    assert [item.message.tare_id for item in out] == [NO_TARE] * 10  # type: ignore[union-attr]


def test_a_recording_does_not_wait_for_pac() -> None:
    made, finger = pipeline(live=False), fakes.Finger()
    finger.pac_noise = 22.0
    (tare,) = tares(push(made, finger.frames(0.5)))
    assert made.ledger.current_id == tare.tare_id


def test_a_request_is_refused_while_a_hand_holds_it() -> None:
    made, finger = pipeline(), fakes.Finger()
    finger.pac_noise = 22.0
    future = made.ask_tare(0)
    push(made, finger.frames(0.5))
    with pytest.raises(DeviceError, match=r"PAC varies by 22 .*take everything off the finger"):
        future.result(timeout=0)


def test_drift_is_tared_away_if_that_is_allowed() -> None:
    made = pipeline(retare=RetareRules(after_s=2.0, drift_counts=10.0))
    finger = fakes.Finger()
    (first,) = tares(push(made, finger.frames(1.0)))
    finger.offset[:] = 15.0
    out = push(made, finger.frames(4.0))
    (again,) = tares(out)
    assert made.counters["retares"] == 1
    assert (again.electrodes - first.electrodes).mean() == pytest.approx(15.0, abs=1.0)
    ids = [i.message.tare_id for i in out if isinstance(i.message, ElectrodeFrame)]
    assert ids[0] == first.tare_id
    assert ids[-1] == again.tare_id


def test_drift_is_not_tared_away_unless_that_is_allowed() -> None:
    made, finger = pipeline(), fakes.Finger()
    push(made, finger.frames(1.0))
    finger.offset[:] = 40.0
    assert tares(push(made, finger.frames(10.0))) == []
    assert made.counters["retares"] == 0


def test_a_press_that_stays_is_never_tared_away() -> None:
    made, finger = pipeline(retare=RetareRules(after_s=1.0)), fakes.Finger()
    push(made, finger.frames(1.0))
    finger.press(120.0)
    assert tares(push(made, finger.frames(15.0))) == []


@pytest.mark.parametrize("at", [0, 10, 30, 48])
@pytest.mark.parametrize("frames", [10, 50])
def test_a_press_while_it_is_tared_again_is_not_tared_away(at: int, frames: int) -> None:
    """So many frames after the attempt began it is pressed, and held."""
    made = pipeline(retare=RetareRules(after_s=2.0), tare_frames=frames)
    finger = fakes.Finger()
    push(made, finger.frames(1.0))
    finger.offset[:] = 15.0
    while not made.counters["retares"]:
        push(made, [finger.frame()])
    before = tares(push(made, finger.frames(at * 0.01)))
    finger.press(600.0)
    assert tares(push(made, finger.frames(10.0))) == []
    assert made.counters["retares"] == 1
    assert made.tare_error is None, "nobody asked for it"
    finger.press(0.0)
    finger.offset[:] = 15.0 if not before else 30.0
    (again,) = tares(push(made, finger.frames(5.0)))
    assert (again.electrodes - finger.levels).mean() == pytest.approx(finger.offset.mean(), abs=2.0)


def test_a_request_in_the_middle_of_a_hold_is_refused_unless_it_insists() -> None:
    made, finger = pipeline(), fakes.Finger()
    push(made, finger.frames(1.0))
    finger.press(600.0)
    push(made, finger.frames(2.0))
    asked = made.ask_tare(0)
    assert tares(push(made, finger.frames(1.0))) == []
    with pytest.raises(
        DeviceError,
        match=r"still, but E\d+ is \d+ counts from where it last rested, and PDC 600.*--anyway",
    ):
        asked.result(timeout=0)
    asked = made.ask_tare(0, anyway=True)
    assert tares(push(made, finger.frames(1.0))) == [asked.result(timeout=0)]
    assert made.condition is not None
    push(made, finger.frames(1.0))
    assert made.condition.level.touch is TouchState.UNTOUCHED


def test_a_request_just_after_a_press_is_refused_as_well() -> None:
    """Before the condition itself has seen that it is held."""
    made, finger = pipeline(), fakes.Finger()
    push(made, finger.frames(1.0))
    finger.press(600.0)
    asked = made.ask_tare(2)
    push(made, finger.frames(0.02))
    with pytest.raises(DeviceError, match="still, but E"):
        asked.result(timeout=0)


def test_another_finger_is_not_held_because_it_rests_elsewhere() -> None:
    made, finger = pipeline(tare="query"), fakes.Finger()
    made.ask_tare(0)
    push(made, finger.frames(1.0))
    made.begin(DeviceIdentity("BT2", 1 / 4400), LiveClock())
    finger.press(600.0)  # its level, at rest
    push(made, finger.frames(1.0))
    assert made.condition is not None
    assert made.condition.level.touch is TouchState.UNKNOWN
    assert "tare_age_s" not in made.condition.gauges()
    asked = made.ask_tare(0)
    assert tares(push(made, finger.frames(1.0))) == [asked.result(timeout=0)]


def test_a_sensor_with_one_sample_of_pac_a_frame_can_be_tared() -> None:
    """As one polled by a PIC32 board."""
    made, finger = pipeline(), fakes.Finger()
    finger.invalid = fakes.LAYOUT.all_valid >> 23 << 23
    (tare,) = tares(push(made, finger.frames(0.5)))
    assert tare.frames_averaged == 50
    assert tare.pac == pytest.approx(2040.0, abs=2.0)


def bits_of(channel: str) -> int:
    layout = fakes.LAYOUT
    pac = layout.all_valid >> layout.first_pac_bit << layout.first_pac_bit
    return int({"PAC": pac, "TAC": 1 << layout.tac_bit, "TDC": 1 << layout.tdc_bit}[channel])


@pytest.mark.parametrize("channel", ["PAC", "TAC", "TDC"])
def test_a_channel_that_the_driver_never_fills_is_no_fault_and_no_hindrance(channel: str) -> None:
    """As a driver of ROS that was written for the electrodes."""
    info = DeviceInfo("test", SensorType.BIOTAC, "test", 100.0, True, False, Origin.LIVE)
    made, finger = Pipeline(info, tare="query"), fakes.Finger()
    made.begin(replace(IDENTITY, unfilled=frozenset({channel})), LiveClock())
    finger.invalid = bits_of(channel)
    asked = made.ask_tare(0)
    push(made, finger.frames(3.0))
    tare = asked.result(timeout=0)
    unknown = {name for name in ("pdc", "pac", "tac", "tdc") if getattr(tare, name) == 0.0}
    assert unknown == {channel.lower()}
    assert made.condition is not None
    assert made.condition.faults == ()


def test_a_sensor_without_pdc_cannot_be_tared() -> None:
    finger, collector = fakes.Finger(), TareCollector(5)
    finger.invalid = 1 << fakes.LAYOUT.pdc_bit
    for _ in range(4):
        assert collector.add(finger.frame()) is None
    with pytest.raises(DeviceError, match="cannot tare BT1: PDC invalid"):
        collector.add(finger.frame())


def test_a_tare_leaves_out_invalid_samples() -> None:
    finger, collector = fakes.Finger(), TareCollector(10)
    made = []
    for k in range(10):
        frame = finger.frame()
        if k % 2:  # what a parity error leaves
            valid = frame.validity & ~bits_of("TAC") & ~bits_of("TDC")
            frame = replace(frame, tac=4095, tdc=0, validity=valid)
        else:
            good = frame
        made.append(collector.add(frame))
    assert made[-1] is not None
    assert (made[-1].tac, made[-1].tdc) == pytest.approx((good.tac, good.tdc), abs=5.0)


def test_a_biotac_sp_is_tared_by_its_24_electrodes() -> None:
    collector, finger = TareCollector(5), fakes.Finger(kind=SensorType.BIOTAC_SP)
    made = [collector.add(finger.frame()) for _ in range(5)]
    assert made[-1] is not None
    assert made[-1].electrodes.shape == (24,)


def test_the_end_of_a_recording_leaves_a_cancelled_request_alone() -> None:
    """Whoever asked gave up; the sensor's thread must not fail on the answer."""
    made = pipeline(live=False, tare="query")
    given_up, waiting = made.ask_tare(50), made.ask_tare(50)
    given_up.cancel()
    finished(made)
    with pytest.raises(DeviceError, match="the recording has ended"):
        waiting.result(0)
