"""Lines that are opened and closed at the same time."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import pytest

from palpate.errors import DeviceError, DeviceTimeout
from palpate_gateway.biotac.slot_link import SlotLink, SlotSource
from palpate_gateway.biotac.slots import LineSlots

LONG_S = 30.0


class Gate(SlotSource):
    """A silent line that opens when it is let, and notes how often it is open."""

    slot_period_s = 1.0

    def __init__(self, *, fails: bool = False) -> None:
        self.asked, self.let = threading.Event(), threading.Event()
        self.opened = self.closed = 0
        self._fails = fails

    def open(self) -> None:
        self.asked.set()
        assert self.let.wait(LONG_S)
        if self._fails:
            raise DeviceError("nobody is there", remedy="")
        self.opened += 1

    def close(self) -> None:
        self.closed += 1

    def read(self, timeout_s: float) -> LineSlots | None:
        threading.Event().wait(0.001)
        raise DeviceTimeout("silent", remedy="")

    def serial(self, finger: int) -> str:
        return ""

    def counters(self, finger: int) -> Mapping[str, int]:
        return {}


@pytest.mark.parametrize("fails", [False, True])
def test_a_line_that_opens_slowly_delays_no_other(fails: bool) -> None:
    slow, quick = Gate(fails=fails), Gate()
    quick.let.set()
    with ThreadPoolExecutor() as pool:
        joining = pool.submit(SlotLink.join, "slow", None, slow, 0)
        try:
            assert slow.asked.wait(LONG_S)
            pool.submit(SlotLink.join, "quick", None, quick, 0).result(LONG_S / 2).leave()
            assert (quick.opened, quick.closed, slow.opened) == (1, 1, 0)
        finally:
            slow.let.set()
        if fails:
            with pytest.raises(DeviceError, match="nobody is there"):
                joining.result()
        else:
            joining.result().leave()


def test_fingers_that_join_one_line_at_once_open_it_once() -> None:
    source = Gate()
    with ThreadPoolExecutor() as pool:
        joining = [pool.submit(SlotLink.join, "one", None, source, k) for k in range(3)]
        source.let.set()
        fingers = [one.result(LONG_S) for one in joining]
        for finger in fingers:
            assert source.closed == 0
            finger.leave()
    assert (source.opened, source.closed) == (1, 1)
