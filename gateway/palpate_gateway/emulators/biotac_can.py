"""SynTouch's CAN interface in software: a frame for each slot (hardware reference 2.1)."""

from __future__ import annotations

import time
from typing import Any, ClassVar

from palpate.process import require
from palpate_gateway.emulators import FAULTS
from palpate_gateway.emulators.biotac_slots import (
    ELECTRODES,
    WORD_FAULTS,
    CountSource,
    SlotBlocks,
    idle_counts,
    round_of,
)
from palpate_gateway.emulators.emulator import Emulator, set_lead
from palpate_gateway.emulators.lines import BUS_ERROR, BUS_OFF, RESTARTED, error_frame
from palpate_gateway.ports.multicast import open_can

_TICK_S = 1e-3
_BLOCK_SLOTS = 440
_STOPPED_S = 1.0


class BiotacCanEmulator(Emulator):
    """Up to three BioTacs at one CAN interface.

    Faults of words: see ``SlotBlocks.with_faults``. Faults of frames and of the interface:

    * ``lost``: slots are sampled, but their frames are missing;
    * ``repeated``: each frame comes twice;
    * ``short``: each frame lacks its last byte;
    * ``foreign``: before each frame comes one of another device with the same identifier;
    * ``bus_error``: before each frame comes an error frame;
    * ``busoff``: an error frame says that the controller is off the bus, then nothing comes; at the
      end another one says that the controller was restarted, and the frames continue;
    * ``silence``: nothing comes, while the sampling continues;
    * ``unplug``, ``restart``: nothing comes, then a new round begins;
    * ``clock_drift``: slots come at another rate.
    """

    faults: ClassVar = FAULTS["biotac-can"]

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
        electrodes: int = ELECTRODES,
        drift_ppm: float = 200.0,
        options: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(slot_rate_hz)
        self._arguments = {**(options or {}), "interface": interface, "channel": channel}
        self._counts, self._can_id, self._drift = counts, can_id, drift_ppm * 1e-6
        order = round_of(electrodes, pac_first=pac_first)
        self._length, self._slots = 1 + 2 * fingers, SlotBlocks(counts, fingers, order)
        self._can: Any = None
        self._bus: Any = None
        self._message: Any = None
        self._off = False
        # The next slot; the prepared block, the number of its slots that are sent, and the time at
        # which its first slot is sampled.
        self._slot = self._at = 0
        self._block: list[bytes] = []
        self._began_s = self._block_s = 0.0
        self._step_s = 1.0 / slot_rate_hz

    @property
    def address(self) -> str:
        """Interface and channel."""
        return f"{self._arguments['interface']}:{self._arguments['channel']}"

    def _listen(self) -> None:
        self._can = require("can", extra="gateway")
        self._bus = open_can(self._arguments)
        # To make a message costs as much as to send it, so one message serves for all data frames.
        self._message = self._can.Message(arbitration_id=self._can_id, is_extended_id=False)

    def _hang_up(self) -> None:
        self._bus.shutdown()

    def _serve(self) -> None:
        self._began_s = self._block_s = time.monotonic()
        set_lead(self._counts, self._began_s)
        while not self._stop.is_set():
            now_s = time.monotonic()
            if self._off or not self.sound:
                self._change(now_s)
            # Slots that are due are sent together: no PC wakes a thread 4400 times each second.
            due = int((now_s - self._block_s) / self._step_s)
            if (due - self._at) * self._step_s > _STOPPED_S:  # this process stood still
                self._block_s = now_s - self._at * self._step_s
                due = self._at
            while self._at < due:
                if self._at == len(self._block):
                    due -= self._at
                    self._prepare()
                self._send(self._block[self._at])
                self._at += 1
                self._slot += 1
            time.sleep(_TICK_S)  # costs less than to wait for the event

    def _prepare(self) -> None:
        """Prepare the next block of slots."""
        self._block_s += self._at * self._step_s
        drift = self._drift if not self.sound and self.faulty("clock_drift") else 0.0
        self._step_s = 1.0 / (self.rate_hz * (1.0 + drift))
        time_s = self._block_s - self._began_s
        self._block = self._slots.block(self._slot, _BLOCK_SLOTS, time_s, self._step_s)
        self._at = 0

    def _change(self, now_s: float) -> None:
        """Apply the faults of the whole interface."""
        if self.faulty("restart") or self.faulty("unplug"):
            self._slot, self._at, self._block = 0, 0, []
            self._block_s = now_s
        off, self._off = self._off, self.faulty("busoff")
        if off != self._off:
            self._bus.send(error_frame(self._can, BUS_OFF if self._off else RESTARTED))

    def _send(self, data: bytes) -> None:
        if self._off or not self.sound:
            data = self._with_faults(data)
            if not data:
                return
        self._put(data)
        self.sent += len(data) == self._length

    def _with_faults(self, data: bytes) -> bytes:
        """The frame with the present faults; empty = no frame is sent."""
        wrong = {fault for fault in WORD_FAULTS if self.faulty(fault)}
        if wrong:
            time_s = self._block_s - self._began_s + self._at * self._step_s
            data = self._slots.with_faults(self._slot, time_s, wrong)
        if self._off or self.faulty("silence") or self.faulty("lost"):
            return b""
        if self.faulty("short"):
            data = data[:-1]
        if self.faulty("bus_error"):
            self._bus.send(error_frame(self._can, BUS_ERROR))
        if self.faulty("foreign"):
            self._put(b"\x12\x34")
        if self.faulty("repeated"):
            self._put(data)
        return data

    def _put(self, data: bytes) -> None:
        self._message.data, self._message.dlc = data, len(data)
        self._bus.send(self._message)
