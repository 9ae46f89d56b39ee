"""Faults on demand: each shows as on a real finger, is counted, and is the same every time."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import ConfigError, DeviceLost, DeviceTimeout
from palpate_gateway.device import Device
from palpate_gateway.drivers import make_device
from palpate_gateway.protocols.channels import ALL_VALID
from palpate_gateway.readings import ElectrodeReading, PoseReading, Reading, WrenchReading

fakes: Any = importlib.import_module("tape_fakes")

FRAMES = 300
AT, END = 100, 150
"""The faults of these tests last from this frame up to this one."""

WINDOW = {"at_s": 1.0, "for_s": 0.5}


class Runs:
    """Plays of one finger, with faults and without."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def device(self, *faults: dict[str, Any], **options: Any) -> Device:
        given = {"tape": str(self.path), "realtime": False, "frames": FRAMES, "seed": 3}
        return make_device("virtual", {**given, "faults": list(faults), **options})

    def play(self, *faults: dict[str, Any], **options: Any) -> tuple[list[Reading], dict[str, int]]:
        readings: list[Reading] = []
        with self.device(*faults, **options) as device:
            while got := device.read(10.0):
                readings += got
            return readings, dict(device.counters)


@pytest.fixture
def runs(tape_path: Callable[..., Path]) -> Runs:
    return Runs(tape_path())


def frames(readings: list[Reading]) -> list[ElectrodeReading]:
    return [r for r in readings if isinstance(r, ElectrodeReading)]


def until_lost(device: Device, readings: list[Reading]) -> None:
    """Read for ever."""
    while got := device.read(1.0):
        readings += got


def counts(readings: list[Reading]) -> Any:
    return np.array([r.electrodes for r in frames(readings)], int)


def check_only_in_window(faulty: list[Reading], plain: list[Reading], electrode: int) -> None:
    """Nothing but this electrode (0-based), and it only from AT to END, differs."""
    changed = counts(faulty) != counts(plain)
    assert not changed[:AT].any()
    assert not changed[END:].any()
    assert not np.delete(changed, electrode, axis=1).any()
    others = [
        (repr(a), repr(b))
        for a, b in zip(faulty, plain, strict=True)
        if not isinstance(a, ElectrodeReading)
    ]
    assert all(a == b for a, b in others)


@pytest.mark.parametrize(("kind", "value"), [("saturated", 4095), ("dead", 0)])
def test_ends_of_the_converter(runs: Runs, kind: str, value: int) -> None:
    plain, before = runs.play()
    faulty, counters = runs.play({"kind": kind, **WINDOW, "electrode": 7})
    assert (counts(faulty)[AT:END, 6] == value).all()
    check_only_in_window(faulty, plain, 6)
    assert all(r.validity == ALL_VALID for r in frames(faulty))  # the wire does not show it
    assert counters[f"fault_{kind}_frames"] == 50
    assert counters["saturated_samples"] == before["saturated_samples"] + 50


def test_stuck_electrode_repeats_what_it_read(runs: Runs) -> None:
    plain, _ = runs.play()
    faulty, counters = runs.play({"kind": "stuck", **WINDOW, "electrode": 19})
    held = counts(plain)[AT, 18]
    assert (counts(faulty)[AT:END, 18] == held).all()
    assert (counts(plain)[AT:END, 18] != held).any()
    check_only_in_window(faulty, plain, 18)
    assert counters["fault_stuck_frames"] == 50


def test_invalid_channel_has_its_bit_clear_and_a_wrong_bit(runs: Runs) -> None:
    plain, _ = runs.play()
    faulty, counters = runs.play({"kind": "invalid", **WINDOW, "electrode": 3})
    validity = np.array([r.validity for r in frames(faulty)])
    assert (validity[AT:END] == ALL_VALID & ~(1 << 2)).all()
    assert (np.delete(validity, slice(AT, END)) == ALL_VALID).all()
    flipped = counts(faulty)[AT:END, 2] ^ counts(plain)[AT:END, 2]
    assert all(int(bits).bit_count() == 1 for bits in flipped)
    assert flipped.max() < 4096
    check_only_in_window(faulty, plain, 2)
    assert counters["parity_errors"] == counters["fault_invalid_frames"] == 50
    _, counters = runs.play({"kind": "invalid", **WINDOW})
    assert counters["parity_errors"] == 50 * 19


def test_noise_burst(runs: Runs) -> None:
    plain, _ = runs.play()
    faulty, _ = runs.play({"kind": "noise", **WINDOW, "electrode": 1, "value": 30.0})
    more = (counts(faulty) - counts(plain))[AT:END, 0]
    assert 20 < more.std() < 40
    assert abs(more.mean()) < 20
    check_only_in_window(faulty, plain, 0)


def test_jump_of_the_baseline_stays(runs: Runs) -> None:
    plain, _ = runs.play()
    faulty, counters = runs.play({"kind": "jump", "at_s": 1.0, "value": -200.0})
    more = counts(faulty) - counts(plain)
    assert (more[:AT] == 0).all()
    assert (more[AT:] == -200).all()
    assert counters["fault_jump_frames"] == FRAMES - AT
    # The converter ends at 4095 all the same.
    faulty, _ = runs.play({"kind": "jump", "at_s": 1.0, "value": 4000.0})
    assert (counts(faulty)[AT:] == 4095).all()


def test_lost_frames_leave_a_gap_that_the_next_one_tells(runs: Runs) -> None:
    plain, _ = runs.play()
    faulty, counters = runs.play({"kind": "lost", **WINDOW})
    ticks = [r.tick for r in frames(faulty)]
    assert ticks == [*range(AT), *range(END, FRAMES)]
    assert [r.missed_before for r in frames(faulty) if r.missed_before] == [50]
    assert frames(faulty)[AT].missed_before == 50
    assert np.array_equal(counts(faulty), np.delete(counts(plain), slice(AT, END), axis=0))
    # The force/torque sensor and the robot are other devices: they go on.
    for kind in (WrenchReading, PoseReading):
        assert [repr(r) for r in faulty if isinstance(r, kind)] == [
            repr(r) for r in plain if isinstance(r, kind)
        ]
    assert counters["missing_frames"] == counters["fault_lost_frames"] == 50
    assert counters["frames"] == FRAMES - 50
    assert counters["samples"] == counters["frames"] * 44


def test_a_share_of_frames_is_lost(runs: Runs) -> None:
    some, counters = runs.play({"kind": "lost", "at_s": 0.0, "value": 0.3})
    assert 60 < counters["fault_lost_frames"] < 120
    told = sum(r.missed_before for r in frames(some))
    assert told == counters["missing_frames"]
    assert len(frames(some)) + told == frames(some)[-1].tick + 1
    assert max(r.missed_before for r in frames(some)) < 12


def test_silence_times_out_and_then_tells_what_was_missed(runs: Runs) -> None:
    readings: list[Reading] = []
    with runs.device({"kind": "silence", **WINDOW}) as device:
        timeouts = 0
        while True:
            try:
                got = device.read(0.12)
            except DeviceTimeout:
                timeouts += 1
                continue
            if not got:
                break
            readings += got
        assert timeouts == 4  # half a second in reads of 0.12 s
        assert device.counters["fault_silence_frames"] == 50
        assert device.counters["missing_frames"] == 50
    poses = [r.tick for r in readings if isinstance(r, PoseReading)]
    assert poses == [r.tick for r in frames(readings)]  # nothing at all came meanwhile
    assert [r.tick for r in frames(readings)] == [*range(AT), *range(END, FRAMES)]
    assert frames(readings)[AT].missed_before == 50


def test_silence_for_ever_never_returns_nothing(runs: Runs) -> None:
    with runs.device({"kind": "silence", "at_s": 0.0}, frames=0) as device:
        for _ in range(20):
            with pytest.raises(DeviceTimeout):
                device.read(0.5)


def test_live_silence_times_out_by_the_clock(tape_path: Callable[..., Path]) -> None:
    options = {
        "tape": str(tape_path()),
        "rate_hz": 500,
        "faults": [{"kind": "silence", "at_s": 0.02, "for_s": 0.2}],
    }
    with make_device("virtual", options) as device:
        for k in range(10):
            assert frames(device.read(5.0))[0].tick == k
        with pytest.raises(DeviceTimeout):
            device.read(0.01)
        first = frames(device.read(5.0))[0]
        assert (first.tick, first.missed_before) == (110, 100)


def test_restart_counts_from_zero_again_and_the_play_goes_on(runs: Runs) -> None:
    plain, _ = runs.play()
    device = runs.device({"kind": "restart", **WINDOW})
    device.open()
    serial = device.identity.serial
    readings: list[Reading] = []
    with pytest.raises(DeviceLost, match="restarted -> open it again"):
        until_lost(device, readings)
    with pytest.raises(DeviceLost):
        device.read(1.0)
    assert device.counters["fault_restart_frames"] == 1
    assert [r.tick for r in frames(readings)] == list(range(AT))
    device.close()
    device.open()
    assert device.identity.serial == serial
    assert device.counters["frames"] == device.counters["fault_restart_frames"] == 0
    after: list[Reading] = []
    while got := device.read(1.0):
        after += got
    assert [r.tick for r in frames(after)] == list(range(FRAMES - END))
    assert frames(after)[7].time_s == pytest.approx(0.07)
    assert not any(r.missed_before for r in frames(after))
    assert np.array_equal(counts(after), counts(plain)[END:])
    # Any later opening begins anew, and with it the fault.
    device.close()
    device.open()
    assert np.array_equal(counts(device.read(1.0)), counts(plain)[:1])
    with pytest.raises(DeviceLost):
        until_lost(device, [])


def test_a_finger_that_restarts_cannot_be_opened_while_it_is_away(runs: Runs) -> None:
    away = {"kind": "restart", "at_s": 0.02, "for_s": 30.0}
    device = runs.device(away, realtime=True, untouched_s=60)
    with device, pytest.raises(DeviceLost):
        until_lost(device, [])
    for _ in range(2):
        with pytest.raises(DeviceLost, match="restarted"):
            device.open()
        assert not device.is_open


def test_faults_add_up_and_are_the_same_every_time(runs: Runs) -> None:
    faults = [
        {"kind": "noise", "at_s": 0.5},
        {"kind": "invalid", "at_s": 0.8, "for_s": 0.4},
        {"kind": "lost", "at_s": 0.6, "value": 0.5},
        {"kind": "dead", "at_s": 1.0, "electrode": 4},
    ]
    first, again = runs.play(*faults), runs.play(*faults)
    assert [repr(r) for r in first[0]] == [repr(r) for r in again[0]]
    assert first[1] == again[1]
    late = [r for r in frames(first[0]) if r.tick >= 100]
    assert all(r.electrodes[3] == 0 for r in late)
    other, _ = runs.play(*faults, seed=4)
    assert [repr(r) for r in first[0]] != [repr(r) for r in other]


def test_the_formula_has_faults_too() -> None:
    options = {
        "model": "formula",
        "realtime": False,
        "frames": 20,
        "faults": [{"kind": "dead", "at_s": 0.1}],
    }
    with make_device("virtual", options) as device:
        readings: list[Reading] = []
        while got := device.read(1.0):
            readings += got
    assert not counts(readings)[10:].any()
    assert counts(readings)[:10].all()


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"kind": "stuk", "at_s": 0}, "'stuck'"),
        ({"kind": "dead"}, "at_s.*missing"),
        ({"kind": "dead", "at_s": 0, "electrode": 20}, "electrode"),
        ({"kind": "dead", "at_s": 0, "electrode": 0}, "electrode"),
        ({"kind": "lost", "at_s": 0, "electrode": 3}, "concerns the whole device"),
        ({"kind": "dead", "at_s": 0, "value": 3}, "'dead' has no value"),
        ({"kind": "lost", "at_s": 0, "value": 1.5}, "a share, 0 to 1"),
        ({"kind": "noise", "at_s": 0, "value": -1.0}, "not negative"),
        ({"kind": "noise", "at_s": -1}, "at_s"),
        ({"kind": "noise", "at_s": 1, "at": 2}, "unknown key 'faults.0.at'"),
    ],
)
def test_wrong_faults_are_told(fault: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_device("virtual", {"model": "formula", "faults": [fault]})
