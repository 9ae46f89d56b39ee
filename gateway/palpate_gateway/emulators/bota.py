"""A Bota SensONE or Rokubi in software, on a serial line (hardware reference 3.6).

Choices where the page leaves something open: a command of known length ends by itself, another one
by an end of line or a pause; a refused command is answered with result 1 (``r,0,f,1``); offsets are
added to the wrench; a new speed holds from the next start, which forgets what was not saved.
"""

from __future__ import annotations

import math
import random
import re
import struct
import time
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from palpate_gateway.emulators import FAULTS
from palpate_gateway.emulators.emulator import SampleTicker, WrenchSource, set_lead, slow_press
from palpate_gateway.emulators.lines import SerialEmulator, SerialLine, crc16_x25

BAUDS = (9600, 57600, 115200, 230400, 460800)
"""Speeds [bit/s]; a command gives the index."""

SINCS = (51, 64, 128, 205, 256, 512)
"""Lengths of the sinc filter."""

_SINC_PERIOD_US = 19.53125
_IDLE_S = 0.02
_STATUS = {"late": 1, "overload": 2, "error": 4, "raw": 8}
_COMMAND = re.compile(
    rb"\s*(?:([CRslwI#])|([cf]),(\d+),(\d+),(\d+),(\d)|([bm]\d?)((?:,[^,\s]+){6})\s)\s*"
)


@dataclass(frozen=True)
class BotaSettings:
    """Settings that the commands change.

    Attributes:
        compensated: Temperature compensation.
        calibrated: The wrench is in N and N m; else raw.
        csv: Text instead of frames.
        baud: Speed from the next start on [bit/s].
        sinc: Length of the filter, which makes the rate.
        offsets: Added to the wrench.
    """

    compensated: bool = False
    calibrated: bool = True
    csv: bool = False
    baud: int = 460800
    sinc: int = 512
    offsets: tuple[float, ...] = (0.0,) * 6


class BotaEmulator(SerialEmulator):
    """The sensor.

    Faults:

    * ``crc``: one bit of each frame is wrong; ``cut``: each frame lacks its end; ``junk``: noise
      before each frame; ``lost``: frames are missing; ``repeated``: each frame comes twice;
    * ``silence``: nothing comes, while its clock continues;
    * ``restart``: it boots, sends its boot text, and its clock starts from 0;
    * ``unplug``: the line is gone, while the sensor continues;
    * ``late``, ``overload``, ``error``, ``raw``: a bit of the status is set; with the last two the
      values are wrong;
    * ``nan``: Fz is not a number; ``stuck``: frames repeat the load from its begin;
    * ``clock_drift``: its clock runs at another speed than its converter.

    Args:
        runs_after_boot: Whether it streams after a start without a request.
        boot_s: Duration of a start [s].
        clock_us: Its clock at the first sample [us].
    """

    faults: ClassVar = FAULTS["bota"]

    def __init__(
        self,
        source: WrenchSource = slow_press,
        *,
        baud: int = 460800,
        path: str = "",
        runs_after_boot: bool = True,
        boot_s: float = 0.05,
        clock_us: int = 0,
        drift_ppm: float = 200.0,
    ) -> None:
        super().__init__(1e6 / (_SINC_PERIOD_US * 512))
        self._source, self._drift = source, drift_ppm * 1e-6
        self._line = SerialLine(baud, path)
        self._runs_after_boot, self._boot_s = runs_after_boot, boot_s
        self._random = random.Random(6)
        self._saved = BotaSettings(baud=baud)
        self._time_s = 0.0
        self._boot()
        self._clock_us = float(clock_us)

    def _boot(self) -> None:
        self.mode: Literal["boot", "wait", "config", "run"] = "boot"
        self._ready_s = time.monotonic() + self._boot_s
        self._came = b""
        self._clock_us = 0.0
        self._line.baud = self._saved.baud
        self._apply(self._saved)

    def _apply(self, settings: BotaSettings) -> None:
        self.settings = settings
        self.rate_hz = 1e6 / (_SINC_PERIOD_US * settings.sinc)
        self._ticker = SampleTicker(self.rate_hz, self._stop)

    def _serve(self) -> None:
        while not self._stop.is_set():
            self._line.keep_plugged(not self.faulty("unplug"))
            if self.faulty("restart"):
                self._boot()
            due_s = self._ticker.wait() if self.mode == "run" else 0.0
            data = self._line.read(0.0 if self.mode == "run" else _IDLE_S)
            if self.mode == "boot":
                self._end_boot()
            elif self.mode == "config":
                self._configure(data)
            elif b"C" in data:
                self.mode, self._came = "config", b""
                self._say("r,0,C,0")
            elif self.mode == "run":
                self._sample(due_s)

    def _end_boot(self) -> None:
        if time.monotonic() >= self._ready_s:
            self._say("App Init")
            self.mode = "run" if self._runs_after_boot else "wait"
            self._apply(self._saved)

    def _say(self, text: str) -> None:
        self._line.write(f"{text}\r\n".encode("ascii"))

    def _configure(self, data: bytes) -> None:
        self._came += data
        if not data and self._came:
            self._came += b"\n"  # a pause ends a command
        while self.mode == "config" and (match := _COMMAND.match(self._came)):
            self._came = self._came[match.end() :]
            one, many, *numbers, listing, values = match.groups()
            if one:
                self._obey(one.decode())
            elif many:
                good = self._set(many.decode(), [int(number) for number in numbers])
                self._say(f"r,0,{many.decode()},{0 if good else 1}")
            else:
                self._take(listing.decode(), values.decode())
        if not data and self._came:
            self._say(f"r,0,{chr(self._came[0])},1")
            self._came = b""

    def _obey(self, command: str) -> None:
        if command in "I#":
            self._boot()
            return
        if command == "s":
            self._saved = self.settings
        elif command == "l":
            self._apply(self._saved)
        elif command == "w":
            self._say(repr(self.settings))
        self._say(f"r,0,{command},0")
        if command == "R":
            self.mode = "run"
            self._ticker = SampleTicker(self.rate_hz, self._stop)

    def _set(self, command: str, numbers: list[int]) -> bool:
        """Apply the four numbers of ``c`` or ``f``; False if one is out of range."""
        first, second, third, fourth = numbers
        if command == "f" and first in SINCS and max(second, third, fourth) <= 1:
            self._apply(replace(self.settings, sinc=first))
        elif command == "c" and max(first, second, third) <= 1 and fourth < len(BAUDS):
            compensated, calibrated, csv = bool(first), bool(second), bool(third)
            now = BotaSettings(compensated, calibrated, csv, BAUDS[fourth])
            self._apply(replace(now, sinc=self.settings.sinc, offsets=self.settings.offsets))
        else:
            return False
        return True

    def _take(self, command: str, values: str) -> None:
        """Apply offsets; a row of the matrix is accepted and has no effect."""
        try:
            numbers = tuple(float(value) for value in values.split(",")[1:])
        except ValueError:
            self._say(f"r,0,{command},1")
            return
        if command == "b":
            self.settings = replace(self.settings, offsets=numbers)
        self._say(f"r,0,{command},0")

    def _sample(self, due_s: float) -> None:
        period_us = 1e6 / self.rate_hz
        self._time_s += period_us * 1e-6
        set_lead(self._source, due_s - self._time_s)
        self._clock_us += period_us * (1.0 + self._drift if self.faulty("clock_drift") else 1.0)
        frame = self._frame()
        if self.faulty("silence") or self.faulty("lost"):
            return
        if self.faulty("junk"):
            self._line.write(self._random.randbytes(self._random.randint(1, 60)))
        if self.faulty("cut"):
            self._line.write(frame[: self._random.randint(1, len(frame) - 1)])
        elif self.faulty("crc"):
            wrong = bytearray(frame)
            wrong[self._random.randint(1, 34)] ^= 1 << self._random.randint(0, 7)
            self._line.write(wrong)
        else:
            self.sent += self._line.write(frame)
            if self.faulty("repeated"):
                self._line.write(frame)

    def _frame(self) -> bytes:
        """The present sample as a frame, or as a line of text."""
        load = self._source(self.held(self._time_s))
        values = [a + b for a, b in zip(load, self.settings.offsets, strict=True)]
        status = sum(bit for name, bit in _STATUS.items() if self.faulty(name))
        if not self.settings.calibrated:
            status |= _STATUS["raw"]
        if status & (_STATUS["error"] | _STATUS["raw"]):
            values = [1000.0 * value + 777.0 for value in values]
        if self.faulty("nan"):
            values[2] = math.nan
        ticks = round(self._clock_us) % 2**32
        if self.settings.csv:
            return (",".join(f"{value:.6f}" for value in values) + f",{ticks},25.5\r\n").encode()
        body = struct.pack("<H6fIf", status, *values, ticks, 25.5)
        return b"\xaa" + body + struct.pack("<H", crc16_x25(body))
