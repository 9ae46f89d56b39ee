"""What a finger says, and what it has counted, where nothing good comes from it."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
import pytest

from palpate.errors import DeviceError, DeviceLost, DeviceTimeout
from palpate_gateway.biotac import finger
from palpate_gateway.biotac.can_fingers import BiotacCan, CanOptions
from palpate_gateway.biotac.slot_link import SlotSource
from palpate_gateway.biotac.slots import LineSlots
from palpate_gateway.protocols import channels as ch
from palpate_gateway.protocols.spi import WordKind
from palpate_gateway.readings import ElectrodeReading

ROUND = ch.SEQUENCES["biotac_e1_first"]


class SlotLine(SlotSource):
    """A line of one finger.

    Args:
        always: Kind of all words; None = it is silent.
        counts: Name of a counter that rises at each read.
        opens: Whether it can be opened.
    """

    slot_period_s = 1.0 / ch.SLOT_RATE_HZ

    def __init__(
        self, always: WordKind | None = None, counts: str = "", *, opens: bool = True
    ) -> None:
        self.always = always
        self.once: list[WordKind] = []
        """Kinds of the next frames, before those of always."""
        self.frames = 0
        self._counts, self._opens = counts, opens
        self._reads = 0

    def open(self) -> None:
        self._reads += 1
        if not self._opens:
            raise DeviceError("nobody is there", remedy="")

    def close(self) -> None:
        pass

    def serial(self, finger: int) -> str:
        return ""

    def counters(self, finger: int) -> Mapping[str, int]:
        return {self._counts: self._reads} if self._counts else {}

    def read(self, timeout_s: float) -> LineSlots:
        self._reads += 1
        if not self.once:
            time.sleep(0.005)
        kind = self.once.pop(0) if self.once else self.always
        if kind is None:
            raise DeviceTimeout("silent", remedy="")
        k, size = self.frames, len(ROUND)
        self.frames += 1
        places = np.arange(size)
        return LineSlots(
            size,
            np.array(ROUND),
            np.full((size, 1), 2000, np.uint16),
            np.full((size, 1), kind, np.uint8),
            np.zeros(size, int),
            np.full(size, k),
            places,
            (size * k + places).astype(np.float64) * self.slot_period_s,
        )


def finger_on(line: SlotLine) -> BiotacCan:
    device = BiotacCan(CanOptions())
    device._line = lambda: (id(line), 0, line, 1)  # type: ignore[method-assign]
    return device


class TestSilentFinger:
    @pytest.fixture(autouse=True)
    def _short(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(finger, "_FIRST_S", 0.2)

    def test_what_came_instead_of_slots_is_told_and_stays_counted(self) -> None:
        device = finger_on(SlotLine(counts="short_slots"))
        with pytest.raises(DeviceError, match=r"no reading came.*short_slots.*device's page"):
            device.open()
        assert device.counters["short_slots"] > 0

    def test_true_silence_names_power_and_wiring(self) -> None:
        with pytest.raises(DeviceError, match=r"no reading came within 0\.2 s -> check power"):
            finger_on(SlotLine()).open()

    def test_bad_words_are_not_told_as_silence(self) -> None:
        device = finger_on(SlotLine(WordKind.DEVICE_ERROR, counts="device_error_unknown"))
        with pytest.raises(DeviceError, match="slots come, but no word of this finger is good"):
            device.open()
        assert device.counters["device_error_unknown"] > 0

    def test_line_that_cannot_be_opened_keeps_its_counters(self) -> None:
        device = finger_on(SlotLine(counts="error_frames", opens=False))
        with pytest.raises(DeviceError, match="nobody is there"):
            device.open()
        assert device.counters["error_frames"] == 1

    def test_counters_stay_when_the_finger_is_closed(self) -> None:
        device = finger_on(SlotLine(WordKind.GOOD, counts="parity_errors"))
        device.open()
        device.read(1.0)
        while not device.counters["parity_errors"]:
            time.sleep(0.005)
        device.close()
        assert device.counters["parity_errors"] > 0

    def test_frames_before_the_plug_is_pulled_are_delivered(self) -> None:
        line = SlotLine(WordKind.GOOD)
        readings: list[ElectrodeReading] = []
        with finger_on(line) as device:
            line.always = None
            time.sleep(0.05)  # what was under way has come
            good = line.frames + 5
            line.once, line.always = [WordKind.GOOD] * 5, WordKind.ABSENT
            while line.frames < good + 4:
                time.sleep(0.005)
            with pytest.raises(DeviceLost, match="no finger answers"):  # noqa: PT012
                while len(readings) < 100:
                    readings += device.read(0.1)  # type: ignore[arg-type]
        frame_s = len(ROUND) * line.slot_period_s
        assert (good - 1) * frame_s <= readings[-1].time_s < good * frame_s
        assert not any(reading.missed_before for reading in readings)
