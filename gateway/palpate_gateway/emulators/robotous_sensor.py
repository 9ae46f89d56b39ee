"""A Robotous RFT in software, whatever its line (hardware reference 3.5).

What the page leaves open is decided here: requests that the page does not name, and requests with
a wrong sum, get no answer; settings other than speed and identifiers return to their defaults at a
restart; request 4 and the reply to 5 carry the three identifiers in D2, D3 and D4.
"""

from __future__ import annotations

import random
import time
from abc import abstractmethod
from collections.abc import Sequence

from palpate_gateway.emulators.emulator import Emulator, Pace, WrenchSource, slow_press, tell_lead

FORCE_DIVISOR = 50.0
"""Counts per N, all models."""

TORQUE_DIVISORS = {
    **dict.fromkeys(("RFT40-SA01", "RFT44-SB01", "RFT60-HA01", "RFT64-SB01", "RFT76-HA01"), 2000.0),
    **dict.fromkeys(("RFT80-6A01", "RFT82-HA02"), 1000.0),
}
"""Counts per N m."""

_RATES_HZ = (200, 10, 20, 50, 100, 200, 333, 500, 1000)
BAUDS = (115200, 921600, 460800, 230400, 115200, 57600)
"""Speeds [bit/s] by their code."""

MOST_HZ = {921600: 1000, 460800: 500, 230400: 500, 115200: 333, 57600: 200}
"""Highest rate by speed."""

_OK, _OUT_OF_RANGE = b"\x01", b"\x00\x02"
_FX_OVERLOADED = 0b100000
_NO_LOAD: Sequence[float] = (0.0,) * 6
_IDLE_S = 0.02


class Robotous(Emulator):
    """What both kinds of line share: the requests, the settings, the samples.

    Faults that both have; of its line it has more:

    * ``lost``: samples do not come; there is no number by which that could be seen;
    * ``repeated``: each comes twice; ``cut``: its second half is missing; ``junk``: noise comes;
    * ``silence``: no sample comes, and requests are answered;
    * ``restart``: it is silent until it is asked again, and knows no zero;
    * ``overload``: the bit of Fx is set, and counted;
    * ``stuck``: samples repeat what was felt when it began;
    * ``clock_drift``: samples come at another rate.

    Args:
        source: The load.
        model: One of ``TORQUE_DIVISORS``, which is also what it answers.
        serial: Its serial number.
        drift_ppm: How much too fast it samples while its clock drifts [1e-6].
    """

    def __init__(
        self,
        source: WrenchSource = slow_press,
        model: str = "RFT64-SB01",
        serial: str = "RFT-1",
        drift_ppm: float = 200.0,
    ) -> None:
        super().__init__(_RATES_HZ[0])
        self._source, self._model, self._serial = source, model, serial
        self._scale = 3 * (FORCE_DIVISOR,) + 3 * (TORQUE_DIVISORS[model],)
        self._time_s, self._drift = 0.0, drift_ppm * 1e-6
        self._away = False
        self._random = random.Random(5)
        self.ids = self._new_ids = (0x64, 0x01, 0x02)
        """CAN identifiers: of requests, of the first and of the second half of answers."""
        self.baud_code = 0
        self._most_hz = 1000
        self._power_up()

    def _power_up(self) -> None:
        """The state after power came; silent until asked."""
        self.running = False
        self.filter_code = (0, 0)
        self.ids = self._new_ids
        self._bias = _NO_LOAD
        self._overloads = [0] * 6
        self._set_rate(0)

    def _set_rate(self, code: int) -> None:
        self.rate_code, self.rate_hz = code, float(_RATES_HZ[code])
        self._pace = Pace(self.rate_hz, self._stop)

    def _serve(self) -> None:
        while not self._stop.is_set():
            self._pace.fast = self._drift if self.faulty("clock_drift") else 0.0
            due_s = self._pace.wait() if self.running else time.monotonic()
            requests = self._requests(0.0 if self.running else _IDLE_S)
            if self.faulty("restart"):
                self._power_up()
                continue
            for request in requests:
                self._answer(request)
            self._time_s += 1.0 / self.rate_hz if self.running else _IDLE_S
            tell_lead(self._source, due_s - self._time_s)
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
            self._pace = Pace(self.rate_hz, self._stop)
        elif command == 17:
            self._bias = self._source(self._time_s) if value == 1 else _NO_LOAD
        else:
            told = self._told(command)
            if command in (4, 6, 8, 15):
                told = _OK if self._set(command, value, more, request[3]) else _OUT_OF_RANGE
            if told is not None:
                self._send(bytes([command]) + told[:15].ljust(15, b"\0"))

    def _told(self, command: int) -> bytes | None:
        """The answer to a request that only asks."""
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
        """Take a setting; whether it is in its range."""
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
        felt = self._source(self.held(self._time_s))
        loads = zip(felt, self._bias, self._scale, strict=True)
        counts = [round((load - bias) * scale) for load, bias, scale in loads]
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
        self._send(data)
        self.sent += 1
        if self.faulty("repeated"):
            self._send(data)

    @abstractmethod
    def _requests(self, timeout_s: float) -> list[bytes]:
        """D1..D8 of the requests that came."""

    @abstractmethod
    def _send(self, data: bytes) -> None:
        """Send D1..D16."""

    @abstractmethod
    def _spoil(self, fault: str, data: bytes) -> None:
        """Send what a fault makes of D1..D16, or before them."""
