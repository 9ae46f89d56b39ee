"""What a finger says, and what it has counted, where nothing good comes from it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from palpate.errors import DeviceError, DeviceTimeout
from palpate_gateway.biotac import finger
from palpate_gateway.biotac.can_fingers import BiotacCan, CanOptions
from palpate_gateway.biotac.slot_link import SlotSource
from palpate_gateway.biotac.slots import LineSlots
from palpate_gateway.protocols import channels as ch
from palpate_gateway.protocols.spi import WordKind

ROUND = ch.SEQUENCES["biotac_e1_first"]


class Line(SlotSource):
    """A line of one finger whose words are of these kinds, a frame each; then it is silent.

    Args:
        kinds: Kind of the words of each frame.
        counts: Name of a counter that rises at each read.
        opens: Whether it can be opened.
    """

    slot_period_s = 1.0 / ch.SLOT_RATE_HZ

    def __init__(
        self, kinds: Sequence[WordKind] = (), counts: str = "", *, opens: bool = True
    ) -> None:
        self.kinds = list(kinds)
        self._counts, self._opens = counts, opens
        self._frame = self._reads = 0

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
        if not self.kinds:
            time.sleep(0.005)
            raise DeviceTimeout("silent", remedy="")
        kind, k, size = self.kinds.pop(0), self._frame, len(ROUND)
        self._frame += 1
        places = np.arange(size)
        return LineSlots(
            size,
            np.array(ROUND),
            np.full((size, 1), 2000, np.uint16),
            np.full((size, 1), kind, np.uint8),
            np.zeros(size, int),
            np.full(size, k),
            places,
            (size * k + places) * self.slot_period_s,
        )


def finger_on(line: Line) -> BiotacCan:
    device = BiotacCan(CanOptions())
    device._line = lambda: (id(line), 0, line, 1)  # type: ignore[method-assign]
    return device


class TestSilentFinger:
    @pytest.fixture(autouse=True)
    def _short(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(finger, "_FIRST_S", 0.2)

    def test_what_came_instead_of_slots_is_told_and_stays_counted(self) -> None:
        device = finger_on(Line(counts="short_slots"))
        with pytest.raises(DeviceError, match=r"no reading came.*short_slots.*device's page"):
            device.open()
        assert device.counters["short_slots"] > 0

    def test_true_silence_names_power_and_wiring(self) -> None:
        with pytest.raises(DeviceError, match=r"no reading came within 0\.2 s -> check power"):
            finger_on(Line()).open()

    def test_bad_words_are_not_told_as_silence(self) -> None:
        device = finger_on(Line([WordKind.DEVICE_ERROR] * 5, counts="device_error_unknown"))
        with pytest.raises(DeviceError, match="slots come, but no word of this finger is good"):
            device.open()
        assert device.counters["device_error_unknown"] > 0

    def test_line_that_cannot_be_opened_keeps_its_counters(self) -> None:
        device = finger_on(Line(counts="error_frames", opens=False))
        with pytest.raises(DeviceError, match="nobody is there"):
            device.open()
        assert device.counters["error_frames"] == 1

    def test_counters_stay_when_the_finger_is_closed(self) -> None:
        device = finger_on(Line([WordKind.GOOD] * 3, counts="parity_errors"))
        device.open()
        device.read(1.0)
        while not device.counters["parity_errors"]:
            time.sleep(0.005)
        device.close()
        assert device.counters["parity_errors"] > 0
