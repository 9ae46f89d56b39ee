"""Emulated drivers of ROS: the times that their messages claim, and faults of a whole message."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from palpate.ros.layouts import BIOTAC_HAND, decode, time_of
from palpate_gateway.emulators.ros import RosHandEmulator, RosWrenchEmulator
from palpate_gateway.protocols.ros_hands import decode_hand

PATIENCE_S = 20.0
STALL_S = 0.7
"""Longer than what the loop catches up [s]."""


class NotedTimes(RosWrenchEmulator):
    """Notes its own time [s] and the header's [ns] of each message; its process stalls once."""

    def __init__(self, stalls_at: int, **options: float) -> None:
        super().__init__(rate_hz=100.0, **options)  # type: ignore[arg-type]
        self.noted: list[tuple[float, int]] = []
        self._stalls_at = stalls_at
        self.enough = threading.Event()

    def _message(self, t: float, time_ns: int) -> bytes:
        self.noted.append((t, time_ns))
        if len(self.noted) == self._stalls_at:
            time.sleep(STALL_S)
        if len(self.noted) == 20:
            self.enough.set()
        return super()._message(t, time_ns)


def test_the_headers_clock_goes_on_while_its_process_gets_no_time() -> None:
    with NotedTimes(stalls_at=5) as emulator:
        assert emulator.enough.wait(PATIENCE_S)
    own_s, header_ns = np.array(emulator.noted).T
    assert np.diff(own_s).max() > STALL_S / 2
    np.testing.assert_allclose(np.diff(header_ns) * 1e-9, np.diff(own_s), atol=1e-6)


def test_a_clock_that_drifts_is_that_of_loop_and_header() -> None:
    emulator = NotedTimes(stalls_at=0, drift_ppm=100_000.0)
    emulator.inject("clock_drift", 60.0)
    with emulator:
        assert emulator.enough.wait(PATIENCE_S)
    own_s, header_ns = np.array(emulator.noted).T
    np.testing.assert_allclose(np.diff(header_ns) * 1e-9, 1.1 * np.diff(own_s), atol=1e-6)


def test_channels_are_what_was_there_at_the_times_that_they_claim() -> None:
    def clock(t: float, finger: int) -> list[int]:
        return [round(t * 1e5) % 4096] * 23

    emulator = RosHandEmulator(clock, whole_frames=True)
    message = decode(emulator._message(0.03, 30_000_000), BIOTAC_HAND)
    times, (finger,) = message.bt_time, message.bt_data
    start_ns = time_of(times.frame_start_time)
    for value, offset_ns in (
        (finger.electrode_data, times.electrode_ns_offset),
        (finger.pac_data, times.pac_ns_offset),
        (finger.pdc_data, times.pdc_ns_offset),
        (finger.tac_data, times.tac_ns_offset),
        (finger.tdc_data, times.tdc_ns_offset),
    ):
        claimed = (start_ns + np.asarray(offset_ns, np.float64)) * 1e-9 * 1e5
        np.testing.assert_allclose(np.asarray(value, np.float64), claimed, atol=0.51)


@pytest.mark.parametrize("fingers", [1, 3])
def test_a_hand_that_saturates_once_does_so_in_every_finger_of_one_message(fingers: int) -> None:
    emulator = RosHandEmulator(whole_frames=True, fingers=fingers)
    emulator.inject("saturated")
    saturated, after = (decode_hand(emulator._message(t, 10**9), BIOTAC_HAND) for t in (1.0, 1.01))
    assert [finger and set(finger.slow) for finger in saturated.fingers] == [{4095}] * fingers
    assert not any(finger and 4095 in finger.slow for finger in after.fingers)


@pytest.mark.parametrize(("fault", "whole"), [("", 1), ("cut", 0), ("lost", 0), ("repeated", 1)])
def test_a_message_counts_as_sent_if_it_is_whole_and_only_once(fault: str, whole: int) -> None:
    emulator = NotedTimes(stalls_at=0)
    if fault:
        emulator.inject(fault, 60.0)
    with emulator:
        deadline = time.monotonic() + PATIENCE_S
        while emulator._sequence < 20:
            assert time.monotonic() < deadline
            time.sleep(0.01)
    assert emulator.sent == whole * emulator._sequence
