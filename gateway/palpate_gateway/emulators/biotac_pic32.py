"""The PIC32 board that polls one BioTac, in software, on a serial line (hardware reference 2.2).

Choices where the page leaves something open: the firmware with the electrodes first sends them
before pac, pdc, tac and tdc; a stopped run ends with the all-zero record; letters that the page
does not explain, and lines of more than one letter, get no answer; the core timer also runs between
runs.
"""

from __future__ import annotations

import random
import struct
import time
from typing import ClassVar

from palpate_gateway.emulators import FAULTS
from palpate_gateway.emulators.biotac_slots import CountSource, idle_counts
from palpate_gateway.emulators.emulator import SampleTicker, set_lead
from palpate_gateway.emulators.lines import SerialEmulator, SerialLine

TICK_HZ = 40e6
"""Rate of the core timer, half of the processor's [Hz]."""

RECORD_BYTES = 58
"""Length of a record of a run [bytes]."""

_IDLE_S = 0.02
_LONGEST_LINE = 64


class BiotacPic32Emulator(SerialEmulator):
    """The board, its BioTac and its load cell.

    Its format has neither a checksum nor a sequence number, and the board drops the parity of the
    words. So a wrong bit below 4096 cannot be detected, and there is no such fault. The faults are:

    * ``cut``: each record lacks its end;
    * ``junk``: up to 57 bytes before each record;
    * ``high_bits``: one channel of each record is above 4095;
    * ``lost``: records are sampled, but missing;
    * ``repeated``: each record comes twice;
    * ``end``: the board ends the run by itself, with the all-zero record;
    * ``silence``: nothing comes, while the clock continues;
    * ``unplug``: the line is gone, while the run continues;
    * ``restart``: the board stops the run, and its clock starts again;
    * ``saturated``: all channels are 4095; ``absent``: all are 0, as without a finger;
    * ``stuck``: all channels repeat their counts from its begin;
    * ``clock_drift``: the core timer runs at another speed.

    Args:
        ticks: Its core timer at the start.
        load_g: Load cell and reference [g].
    """

    faults: ClassVar = FAULTS["biotac-pic32"]

    def __init__(
        self,
        *,
        counts: CountSource = idle_counts,
        electrodes_first: bool = False,
        baud: int = 230400,
        path: str = "",
        rate_hz: float = 100.0,
        ticks: int = 0,
        load_g: tuple[int, int] = (0, 0),
        drift_ppm: float = 200.0,
    ) -> None:
        super().__init__(rate_hz)
        self._counts, self._electrodes_first = counts, electrodes_first
        self._line = SerialLine(baud, path)
        self._load_g, self._drift = load_g, drift_ppm * 1e-6
        self._random = random.Random(32)
        self._boot()
        self._ticks = float(ticks)

    def _boot(self) -> None:
        self.running = False
        self._came = b""
        self._ticks = self._time_s = 0.0

    def _serve(self) -> None:
        ticker = SampleTicker(self.rate_hz, self._stop)
        while not self._stop.is_set():
            self._line.keep_plugged(not self.faulty("unplug"))
            if self.faulty("restart"):
                self._boot()
            due_s = time.monotonic()
            if self.running:
                due_s = ticker.wait()
                self._pass_time(1.0 / self.rate_hz)
            set_lead(self._counts, due_s - self._time_s)
            self._came += self._line.read(0.0 if self.running else _IDLE_S)
            *lines, rest = self._came.split(b"\n")
            self._came = rest[-_LONGEST_LINE:]
            was_running = self.running
            for line in lines:
                self._obey(line)
            if not was_running:
                self._pass_time(_IDLE_S)
                ticker = SampleTicker(self.rate_hz, self._stop)
            elif self.running:
                self._sample()

    def _pass_time(self, time_s: float) -> None:
        self._time_s += time_s
        drift = self._drift if self.faulty("clock_drift") else 0.0
        self._ticks += time_s * TICK_HZ * (1.0 + drift)

    def _obey(self, line: bytes) -> None:
        if line == b"b":
            self._line.write(self._channels())
        elif line == b"l":
            self._line.write(struct.pack("<i", self._load_g[0]))
        elif line == b"r":
            self.running = True
        elif line == b"q" and self.running:
            self._end()

    def _end(self) -> None:
        self.running = False
        self._line.write(bytes(RECORD_BYTES))

    def _channels(self) -> bytes:
        """The 46 bytes of all channels."""
        values = list(self._counts(self.held(self._time_s), 0))
        if self.faulty("saturated"):
            values = [4095] * len(values)
        if self.faulty("absent"):
            values = [0] * len(values)
        electrodes, (pdc, tac, tdc, pac) = values[:19], values[19:]
        rest = [pac, pdc, tac, tdc]
        record = [*electrodes, *rest] if self._electrodes_first else [*rest, *electrodes]
        return struct.pack("<23H", *record)

    def _sample(self) -> None:
        record = bytearray(struct.pack("<I", round(self._ticks) % 2**32))
        record += self._channels() + struct.pack("<2i", *self._load_g)
        if self.faulty("end"):
            self._end()
            return
        if self.faulty("silence") or self.faulty("lost"):
            return
        if self.faulty("junk"):
            self._line.write(self._random.randbytes(self._random.randint(1, 57)))
        if self.faulty("cut"):
            self._line.write(record[: self._random.randint(1, RECORD_BYTES - 1)])
            return
        if self.faulty("high_bits"):
            # A bit in the upper byte of a channel that no 12-bit count has.
            record[5 + 2 * self._random.randrange(23)] |= 0x40
            self._line.write(record)
            return
        self.sent += self._line.write(record)
        if self.faulty("repeated"):
            self._line.write(record)
