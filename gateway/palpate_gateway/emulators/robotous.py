"""A Robotous RFT in software, on a serial line or on CAN (hardware reference 3.5).

Choices where the page leaves something open: requests that the page does not name, and requests
with a wrong sum, get no answer; at a restart all settings but speed and identifiers return to their
defaults; request 4 and the reply to 5 carry the three identifiers in D2, D3 and D4.
"""

from __future__ import annotations

import random
import time
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

from palpate.errors import ConfigError
from palpate.process import require
from palpate_gateway.emulators import FAULTS
from palpate_gateway.emulators.emulator import (
    Emulator,
    SampleTicker,
    WrenchSource,
    set_lead,
    slow_press,
)
from palpate_gateway.emulators.lines import (
    BUS_OFF,
    RESTARTED,
    SerialEmulator,
    SerialLine,
    error_frame,
)
from palpate_gateway.ports.multicast import open_can

FORCE_DIVISOR = 50.0
"""Counts per N, all models."""

TORQUE_DIVISORS = {
    **dict.fromkeys(("RFT40-SA01", "RFT44-SB01", "RFT60-HA01", "RFT64-SB01", "RFT76-HA01"), 2000.0),
    **dict.fromkeys(("RFT80-6A01", "RFT82-HA02"), 1000.0),
}
"""Counts per N m."""

_RATES_HZ = (200, 10, 20, 50, 100, 200, 333, 500, 1000)
BAUDS = (115200, 921600, 460800, 230400, 115200, 57600)
"""Speeds [bit/s]; a request gives the index."""

MOST_HZ = {921600: 1000, 460800: 500, 230400: 500, 115200: 333, 57600: 200}
"""Highest rate [Hz] by speed [bit/s]."""

_OK, _OUT_OF_RANGE = b"\x01", b"\x00\x02"
_FX_OVERLOADED = 0b100000
_NO_LOAD: Sequence[float] = (0.0,) * 6
_IDLE_S = 0.02


class RobotousEmulator(Emulator):
    """What both kinds of line share: requests, settings and samples.

    Faults on both kinds of line:

    * ``lost``: samples are missing; no sequence number shows it;
    * ``repeated``: each sample comes twice; ``cut``: each lacks its second half; ``junk``: noise
      before each;
    * ``silence``: no sample comes, but requests are answered;
    * ``restart``: it is silent until the next start request, and its zero is gone;
    * ``overload``: the bit of Fx is set, and counted;
    * ``stuck``: samples repeat the load from its begin;
    * ``clock_drift``: samples come at another rate.
    """

    def __init__(
        self,
        source: WrenchSource = slow_press,
        model: str = "RFT64-SB01",
        serial: str = "RFT-1",
        drift_ppm: float = 200.0,
    ) -> None:
        super().__init__(_RATES_HZ[0])
        if not serial.isascii():
            raise ConfigError(
                f"serial {serial!r} has a letter that is not ASCII",
                remedy="choose another: an RFT sends up to 15 letters of ASCII",
            )
        self._source, self._model, self._serial = source, model, serial
        self._scale = 3 * (FORCE_DIVISOR,) + 3 * (TORQUE_DIVISORS[model],)
        self._time_s, self._drift = 0.0, drift_ppm * 1e-6
        self._away = False
        self._random = random.Random(5)
        self.ids = self._new_ids = (0x64, 0x01, 0x02)
        """CAN identifiers of requests, and of the first and second half of answers."""
        self.baud_code = 0
        self._most_hz = 1000
        self._power_up()

    def _power_up(self) -> None:
        """The state at power-up: silent until a request."""
        self.running = False
        self.filter_code = (0, 0)
        self.ids = self._new_ids
        self._bias = _NO_LOAD
        self._overloads = [0] * 6
        self._set_rate(0)

    def _set_rate(self, code: int) -> None:
        self.rate_code, self.rate_hz = code, float(_RATES_HZ[code])
        self._ticker = SampleTicker(self.rate_hz, self._stop)

    def _serve(self) -> None:
        while not self._stop.is_set():
            self._ticker.fast = self._drift if self.faulty("clock_drift") else 0.0
            due_s = self._ticker.wait() if self.running else time.monotonic()
            requests = self._requests(0.0 if self.running else _IDLE_S)
            if self.faulty("restart"):
                self._power_up()
                continue
            for request in requests:
                self._answer(request)
            self._time_s += 1.0 / self.rate_hz if self.running else _IDLE_S
            set_lead(self._source, due_s - self._time_s)
            if self.running:
                self._sample()

    def _answer(self, request: bytes) -> None:
        command, value, more = request[0], request[1], request[2]
        if self.running and command not in (12, 16, 17):
            return
        if command == 10:
            self._send(self._data(command))
        elif command in (11, 12):
            self.running = command == 11
            self._ticker = SampleTicker(self.rate_hz, self._stop)
        elif command == 17:
            self._bias = self._source(self._time_s) if value == 1 else _NO_LOAD
        else:
            answer = self._reply(command)
            if command in (4, 6, 8, 15):
                answer = _OK if self._set(command, value, more, request[3]) else _OUT_OF_RANGE
            if answer is not None:
                self._send(bytes([command]) + answer[:15].ljust(15, b"\0"))

    def _reply(self, command: int) -> bytes | None:
        """The answer to a request that changes nothing; None = no answer."""
        return {
            1: self._model.encode("ascii"),
            2: self._serial.encode("ascii"),
            3: b"1.7",
            5: bytes(self.ids),
            7: bytes([self.baud_code]),
            9: bytes(self.filter_code),
            16: bytes([self.rate_code]),
            18: bytes(min(count, 255) for count in self._overloads),
        }.get(command)

    def _set(self, command: int, value: int, more: int, most: int) -> bool:
        """Apply a setting; False if it is out of range."""
        if command == 4 and value and more and most:
            self._new_ids = (value, more, most)
        elif command == 6 and value < len(BAUDS):
            self.baud_code = value
        elif command == 8 and value <= 1 and value <= more <= 14:
            self.filter_code = (value, more)
        elif command == 15 and value < len(_RATES_HZ) and _RATES_HZ[value] <= self._most_hz:
            self._set_rate(value)
        else:
            return False
        return True

    def _data(self, command: int) -> bytes:
        """D1..D16 of a data frame."""
        status = _FX_OVERLOADED if self.faulty("overload") else 0
        self._overloads[0] += status == _FX_OVERLOADED
        load = self._source(self.held(self._time_s))
        axes = zip(load, self._bias, self._scale, strict=True)
        counts = [round((value - bias) * scale) for value, bias, scale in axes]
        limited = [min(max(count, -0x8000), 0x7FFF) for count in counts]
        fields = b"".join(count.to_bytes(2, "big", signed=True) for count in limited)
        return bytes([command]) + fields + bytes([status, 0, 0])

    def _sample(self) -> None:
        data = self._data(11)
        if self._away or self.faulty("silence") or self.faulty("lost"):
            return
        if self.faulty("junk"):
            self._spoil("junk", data)
        for fault in ("cut", "crc"):
            if fault in self.faults and self.faulty(fault):
                self._spoil(fault, data)
                return
        self.sent += self._send(data)
        if self.faulty("repeated"):
            self._send(data)

    @abstractmethod
    def _requests(self, timeout_s: float) -> list[bytes]:
        """D1..D8 of the received requests."""

    @abstractmethod
    def _send(self, data: bytes) -> bool:
        """Send D1..D16; whether they went out whole."""

    @abstractmethod
    def _spoil(self, fault: str, data: bytes) -> None:
        """Send D1..D16 with a fault, or the noise before them."""


class RobotousSerialEmulator(SerialEmulator, RobotousEmulator):
    """An RFT with a UART.

    More faults: ``crc``: one bit of each frame is wrong; ``unplug``: the line is gone, while the
    sensor continues.
    """

    faults: ClassVar = FAULTS["robotous"]

    def __init__(
        self, source: WrenchSource = slow_press, baud: int = 115200, path: str = "", **more: Any
    ) -> None:
        self._line = SerialLine(baud, path)
        self._came = b""
        super().__init__(source, **more)
        self.baud_code = BAUDS.index(baud)
        self._power_up()

    def _power_up(self) -> None:
        super()._power_up()
        self._came = b""
        self._line.baud = BAUDS[self.baud_code]
        self._most_hz = MOST_HZ[self._line.baud]

    def _requests(self, timeout_s: float) -> list[bytes]:
        self._line.keep_plugged(not self.faulty("unplug"))
        self._came += self._line.read(timeout_s)
        out = []
        # A request has 11 bytes: 55, D1 to D8, sum, AA. Bytes outside a valid one are skipped.
        while len(self._came) >= 11:
            frame, length = self._came[:11], 1
            if frame[0] == 0x55 and frame[10] == 0xAA and frame[9] == sum(frame[1:9]) % 256:
                out.append(frame[1:9])
                length = 11
            self._came = self._came[length:]
        return out

    def _send(self, data: bytes) -> bool:
        return self._line.write(b"\x55" + data + bytes([sum(data) % 256]) + b"\xaa")

    def _spoil(self, fault: str, data: bytes) -> None:
        if fault == "junk":
            self._line.write(self._random.randbytes(self._random.randint(1, 40)))
            return
        frame = bytearray(b"\x55" + data + bytes([sum(data) % 256]) + b"\xaa")
        if fault == "crc":
            frame[self._random.randint(2, 13)] ^= 1 << self._random.randint(0, 7)
        self._line.write(frame if fault == "crc" else frame[:9])


class RobotousCanEmulator(RobotousEmulator):
    """An RFT on CAN.

    More faults: ``busoff``: an error frame says that the controller is off the bus, then nothing is
    sent or received; at the end another one says that the controller was restarted, while the
    sensor has continued; ``unplug``: line and supply are gone, and it is silent until a start
    request.
    """

    faults: ClassVar = FAULTS["robotous on CAN"]

    def __init__(
        self,
        source: WrenchSource = slow_press,
        *,
        interface: str = "virtual",
        channel: str = "robotous",
        options: dict[str, Any] | None = None,
        **more: Any,
    ) -> None:
        super().__init__(source, **more)
        self._off = False
        self._where = {**(options or {}), "interface": interface, "channel": channel}
        self._can: Any = require("can", extra="gateway")
        self._bus: Any = None

    @property
    def address(self) -> str:
        """Kind of bus and its name."""
        return f"{self._where['interface']}:{self._where['channel']}"

    def _listen(self) -> None:
        self._bus = open_can(self._where)

    def _hang_up(self) -> None:
        self._bus.shutdown()

    def _requests(self, timeout_s: float) -> list[bytes]:
        off, self._off = self._off, self.faulty("busoff")
        if off != self._off:
            self._bus.send(error_frame(self._can, BUS_OFF if self._off else RESTARTED))
        unplugged = self.faulty("unplug")
        if unplugged:
            self._power_up()
        self._away = self._off or unplugged
        out = []
        message = self._bus.recv(timeout_s)
        while message is not None:
            if self._away:
                pass
            elif message.arbitration_id == self.ids[0] and len(message.data) == 8:
                out.append(bytes(message.data))
            message = self._bus.recv(0.0)
        return out

    def _send(self, data: bytes) -> bool:
        self._put(self.ids[1], data[:8])
        self._put(self.ids[2], data[8:])
        return True

    def _spoil(self, fault: str, data: bytes) -> None:
        if fault == "junk":
            # A frame of another device, and one of a wrong length with our identifier.
            self._put(self._random.randint(0x100, 0x7FF), self._random.randbytes(8))
            self._put(self.ids[1], self._random.randbytes(self._random.randint(0, 7)))
        else:
            self._put(self.ids[1], data[:8])

    def _put(self, can_id: int, data: bytes) -> None:
        message = self._can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        self._bus.send(message)
