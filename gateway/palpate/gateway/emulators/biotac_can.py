"""SynTouch's CAN interface in software: a frame for each sampled channel (reference 2.1, 1.3, 1.4).

Written from the page's byte tables: 80 is PAC, 83 PDC, 85 TAC, 86 TDC, A2 to C7 are E1 to E19; a
word is data[11:5] and parity, data[4:0], two zeros and parity; every byte has an odd number of
ones.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from palpate.gateway.emulators.emulator import Emulator
from palpate.protos.extras import require

COMMANDS = bytes.fromhex("A2A4A7A8ABADAEB0B3B5B6B9BABCBFC1C2C4C7838586")
"""Sampling commands of E1..E19, PDC, TAC, TDC in the order of a frame."""

PAC_COMMAND = 0x80

CountSource = Callable[[float, int], Sequence[int]]
"""Counts of E1..E19, PDC, TAC, TDC and PAC at a time [s] of a finger (from 0), 23 numbers."""


def idle_counts(t: float, finger: int) -> Sequence[int]:
    """An untouched finger: every channel another number, the PAC alive."""
    pac = 2040 + round(t * 4400.0) % 5
    return [*(2000 + 50 * k + finger for k in range(19)), 2600 + finger, 2045, 1914, pac]


class BiotacCanEmulator(Emulator):
    """Up to three BioTacs at one CAN interface.

    Args:
        interface: python-can's kind of bus.
        channel: Which bus.
        fingers: Words in each frame, 1..3.
        counts: What the fingers measure.
        can_id: Identifier of the frames.
        slot_rate_hz: Frames each second.
        pac_first: Whether a sampling round begins with PAC.
        options: More of python-can's options.
    """

    faults: ClassVar[frozenset[str]] = frozenset(
        {"parity", "absent", "error_word", "lost", "repeated", "silence", "foreign", "short"}
        | {"saturated", "stuck", "restart", "unplug"}
    )

    def __init__(
        self,
        interface: str,
        channel: str,
        *,
        fingers: int = 3,
        counts: CountSource = idle_counts,
        can_id: int = 0x001,
        slot_rate_hz: float = 4400.0,
        pac_first: bool = False,
        options: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(slot_rate_hz)
        self._arguments = {**(options or {}), "interface": interface, "channel": channel}
        self._fingers, self._counts, self._can_id = fingers, counts, can_id
        self._order = _order(pac_first=pac_first)
        self._can: Any = None
        self._bus: Any = None
        self.frames = 0
        """Rounds of 44 slots that were sent whole."""

    @property
    def address(self) -> str:
        """Interface and channel."""
        return f"{self._arguments['interface']}:{self._arguments['channel']}"

    def _listen(self) -> None:
        self._can = require("can", extra="gateway")
        self._bus = self._can.Bus(**self._arguments)

    def _hang_up(self) -> None:
        self._bus.shutdown()

    def _serve(self) -> None:
        slot, began = 0, time.monotonic()
        while not self._stop.is_set():
            # Slots that are due go out together: no clock of a PC wakes a thread 4400 times.
            due = int((time.monotonic() - began) * self.rate_hz)
            if self.faulty("restart"):
                slot, began, due = 0, time.monotonic(), 0
            if due - slot > self.rate_hz:  # the process was stopped for more than a second
                began += (due - slot) / self.rate_hz
                due = slot
            while slot < due:
                self._send(slot)
                slot += 1
            self._stop.wait(1e-3)

    def _send(self, slot: int) -> None:
        place = slot % len(self._order)
        command, index = self._order[place]
        words = b"".join(
            self._word(slot / self.rate_hz, finger, index) for finger in range(self._fingers)
        )
        if self.faulty("silence") or self.faulty("unplug") or self.faulty("lost"):
            return
        data = bytes([command]) + words
        if self.faulty("short"):
            data = data[:-1]
        if self.faulty("foreign"):
            self._put(self._can_id, b"\x12\x34")
        self._put(self._can_id, data)
        if self.faulty("repeated"):
            self._put(self._can_id, data)
        self.sent += 1
        self.frames += place == len(self._order) - 1

    def _word(self, t: float, finger: int, index: int) -> bytes:
        value = self._counts(0.0 if self.faulty("stuck") else t, finger)[index]
        if self.faulty("saturated"):
            value = 4095
        first = _odd((value >> 5) << 1)
        second = _odd((value & 0x1F) << 3)
        if finger == 0 and self.faulty("parity"):
            first ^= 0x10
        if finger == self._fingers - 1 and self.faulty("absent"):
            return b"\x00\x00"
        if finger == 0 and self.faulty("error_word"):
            return b"\xa5\x2d"  # too little sampling delay
        return bytes([first, second])

    def _put(self, can_id: int, data: bytes) -> None:
        message = self._can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        self._bus.send(message)


def _odd(upper: int) -> int:
    """A byte with an odd number of ones: the lowest bit makes it so."""
    return upper | (bin(upper).count("1") + 1) % 2


def _order(*, pac_first: bool) -> list[tuple[int, int]]:
    """Command and place among the counts of each slot of a round."""
    order = []
    for index, command in enumerate(COMMANDS):
        pair = [(command, index), (PAC_COMMAND, len(COMMANDS))]
        order += pair[::-1] if pac_first else pair
    return order


def run_until(stop: threading.Event, emulator: Emulator) -> None:
    """Serve until told to stop."""
    with emulator:
        stop.wait()
