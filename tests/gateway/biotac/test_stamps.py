"""From slots on the bus to the stamp of their frame: which instant it is, and how far off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import DeviceError, DeviceTimeout
from palpate.messages import BIOTAC_LAYOUT
from palpate_gateway.biotac.can_fingers import CanOptions, CanSource
from palpate_gateway.biotac.frames import FrameAssembler
from palpate_gateway.clock.stamps import LiveClock
from palpate_gateway.emulators.biotac_slots import SlotBlocks, idle_counts, round_of
from palpate_gateway.ports.can_bus import CanBatch
from palpate_gateway.ports.can_frames import CanFrames

SLOT_S = 1.0 / 4400.0
START_S = 100.0


class LateBus:
    """A bus whose frames are sampled on a grid and read some time later, several at once.

    Args:
        seconds: How long it sends [s].
        fast_ppm: How much faster its slots come than they are said to.
        lost: Numbers of frames that never come.
    """

    def __init__(self, seconds: float, fast_ppm: float = 0.0, lost: tuple[int, ...] = ()) -> None:
        random = np.random.default_rng(7)
        count = round(seconds / SLOT_S)
        self.sampled_s = START_S + np.arange(count) * SLOT_S * (1.0 - 1e-6 * fast_ppm)
        read_s = np.ceil((self.sampled_s + random.exponential(0.3e-3, count)) / 2e-3) * 2e-3
        self.read_s = np.maximum.accumulate(read_s)
        payloads = SlotBlocks(idle_counts, 3, round_of()).block(0, count, 0.0, SLOT_S)
        kept = [k for k in range(count) if k not in lost]
        data = b"".join(payloads[k].ljust(8, b"\0") for k in kept)
        self._data = np.frombuffer(data, np.uint8).reshape(-1, 8)
        self._sizes = np.array([len(payloads[k]) for k in kept])
        self._arrivals_ns = (self.read_s[kept] * 1e9).round().astype(np.int64)
        self._at = 0
        self.counters: dict[str, int] = {}
        self.name = "a late bus"

    def open(self) -> None:
        """It is."""

    def close(self) -> None:
        """It needs not be."""

    def read(self, timeout_s: float, *, gather_s: float = 0.0) -> CanBatch:
        """All that came with the next one."""
        if self._at >= len(self._sizes):
            raise DeviceTimeout("the end", remedy="")
        end = int(np.searchsorted(self._arrivals_ns, self._arrivals_ns[self._at], "right"))
        cut, self._at = slice(self._at, end), end
        ones = np.ones(cut.stop - cut.start, np.int64)
        kind = np.zeros(len(ones), np.uint8)
        frames = CanFrames(kind, ones, self._sizes[cut], self._data[cut])
        return CanBatch(frames, self._arrivals_ns[cut])


def stamps_of(bus: LateBus, monkeypatch: pytest.MonkeyPatch) -> tuple[np.ndarray, LiveClock]:
    """Host times of the frames of its first finger [s]."""
    source = CanSource(CanOptions(interface="virtual", can_id=1, sequence="biotac_e1_first"))
    monkeypatch.setattr(source, "_bus", bus)
    out: list[float] = []
    assembler, clock = FrameAssembler(source.slot_period_s), LiveClock()
    while True:
        try:
            slots = source.read(0.0)
        except DeviceTimeout:
            return np.array(out), clock
        if slots is None:
            continue
        for reading in assembler.push(slots.of(0)):
            observed = source.observed
            assert observed is not None
            reading = replace(reading, observed=observed)
            times = clock.map(reading.time_s, observed.arrival_ns, reading.observed)
            assert times.monotonic_ns <= observed.arrival_ns
            out.append(1e-9 * times.monotonic_ns)


@pytest.mark.parametrize("fast_ppm", [0.0, 120.0, -400.0, 5000.0])
def test_a_frame_is_stamped_with_the_instant_of_its_first_slot(
    fast_ppm: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = LateBus(12.0, fast_ppm)
    stamps_s, clock = stamps_of(bus, monkeypatch)
    first_slots_s = bus.sampled_s[::44]
    assert len(first_slots_s) - len(stamps_s) <= 2
    error_s = stamps_s - first_slots_s[: len(stamps_s)]
    # Frames are read up to 2 ms late, never early; their end comes 9.8 ms after the stamp.
    assert np.abs(error_s[600:]).max() < 0.2e-3
    gauges = clock.gauges()
    assert gauges["clock_drift_ppm"] == pytest.approx(fast_ppm, abs=20.0)
    assert 9e-3 < gauges["clock_delay_p50_s"] < 13e-3


@pytest.mark.parametrize("fast_ppm", [-110_000.0, -45_000.0, 45_000.0])
def test_no_slot_is_delivered_while_the_rate_is_wrong(
    fast_ppm: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = CanSource(CanOptions(interface="virtual"))
    monkeypatch.setattr(wrong, "_bus", LateBus(4.0, fast_ppm))
    come_hz = 1.0 / (SLOT_S * (1.0 - 1e-6 * fast_ppm))
    with pytest.raises(DeviceError, match=r"slots come each second, not 4400.*set slot_rate_hz"):
        wrong.open()
    right = CanSource(CanOptions(interface="virtual", slot_rate_hz=round(come_hz)))
    monkeypatch.setattr(right, "_bus", LateBus(4.0, fast_ppm))
    right.open()
    first = None
    while first is None:
        first = right.read(0.0)
    assert (first.position[0], right.counters(0)["lost_frames"]) == (0, 0)


def test_a_lost_first_slot_does_not_move_the_stamp(monkeypatch: pytest.MonkeyPatch) -> None:
    # Of frames 50, 60, 70: E1; E1 and PAC; E1 to E3.
    lost = (50 * 44, 60 * 44, 60 * 44 + 1, *range(70 * 44, 70 * 44 + 6))
    bus = LateBus(2.0, lost=lost)
    stamps_s, _ = stamps_of(bus, monkeypatch)
    steps_s = np.diff(stamps_s[20:])
    assert len(stamps_s) >= 2.0 / (44 * SLOT_S) - 2
    np.testing.assert_allclose(steps_s, BIOTAC_LAYOUT.slots * SLOT_S, atol=0.05e-3)
