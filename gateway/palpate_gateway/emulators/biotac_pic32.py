"""The PIC32 board that polls one BioTac, in software, on a serial line (hardware reference 2.2).

What the page leaves open is decided here: the firmware with the electrodes first sends them before
pac, pdc, tac and tdc; a stopped run ends with the all-zero record; letters that the page does not
explain, and lines of more than a letter, get no answer; the core timer runs on between runs.
"""

from __future__ import annotations

import random
import struct
import time
from typing import ClassVar

from palpate_gateway.emulators.biotac_slots import CountSource, idle_counts
from palpate_gateway.emulators.emulator import Emulator, Pace, tell_lead
from palpate_gateway.emulators.serial_line import SerialLine

TICK_HZ = 40e6
"""Rate of the core timer, half that of the processor."""

RECORD_BYTES = 58
"""Length of a record of a run."""

_IDLE_S = 0.02
_LONGEST_LINE = 64


class BiotacPic32Emulator(Emulator):
    """The board, its BioTac and its load cell.

    Its format has neither a checksum nor a number, and the words have lost their parity on the
    board: a wrong bit below 4096 cannot be seen by anybody, so there is no such fault. There are:

    * ``cut``: the end of each record is missing;
    * ``junk``: up to 57 bytes come before each;
    * ``high_bits``: a channel of each has a number above 4095;
    * ``lost``: records are sampled and do not come;
    * ``repeated``: each comes twice;
    * ``end``: the board ends the run by itself, with the all-zero record;
    * ``silence``: nothing comes, and the clock goes on;
    * ``unplug``: the line is gone; the run goes on;
    * ``restart``: the board forgets the run, and its clock begins anew;
    * ``saturated``: all channels are 4095; ``absent``: all are 0, as without a finger;
    * ``stuck``: all channels are what they were when it began;
    * ``clock_drift``: the core timer runs at another speed.

    Args:
        counts: What the finger measures.
        electrodes_first: Whether it has the older firmware.
        baud: Its speed [bit/s].
        path: Name of the line; "" = a new one.
        rate_hz: Polls of all channels each second.
        ticks: Its core timer at the start.
        load_g: Load cell and reference [g].
        drift_ppm: How much too fast its clock is while it drifts [1e-6].
    """

    faults: ClassVar[frozenset[str]] = frozenset(
        "cut junk lost repeated silence restart unplug clock_drift".split()
    ) | frozenset({"high_bits", "saturated", "absent", "stuck", "end"})

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

    @property
    def address(self) -> str:
        """The line's name."""
        return self._line.path

    def _boot(self) -> None:
        self.running = False
        self._came = b""
        self._ticks = self._time_s = 0.0

    def _listen(self) -> None:
        self._line.plug()

    def _hang_up(self) -> None:
        self._line.close()

    def _serve(self) -> None:
        pace = Pace(self.rate_hz, self._stop)
        while not self._stop.is_set():
            self._line.keep_plugged(not self.faulty("unplug"))
            if self.faulty("restart"):
                self._boot()
            due_s = time.monotonic()
            if self.running:
                due_s = pace.wait()
                self._pass_time(1.0 / self.rate_hz)
            tell_lead(self._counts, due_s - self._time_s)
            self._came += self._line.read(0.0 if self.running else _IDLE_S)
            *lines, rest = self._came.split(b"\n")
            self._came = rest[-_LONGEST_LINE:]
            was_running = self.running
            for line in lines:
                self._obey(line)
            if not was_running:
                self._pass_time(_IDLE_S)
                pace = Pace(self.rate_hz, self._stop)
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
            # Upper half of a channel's number: a bit that no count of 12 bits has.
            record[5 + 2 * self._random.randrange(23)] |= 0x40
            self._line.write(record)
            return
        self._line.write(record)
        self.sent += 1
        if self.faulty("repeated"):
            self._line.write(record)
