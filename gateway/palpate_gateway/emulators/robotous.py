"""A Robotous RFT in software, on a serial line or on CAN (hardware reference 3.5)."""

from __future__ import annotations

from typing import Any, ClassVar

from palpate.extras import require
from palpate_gateway.emulators.can_errors import BUS_OFF, RESTARTED, error_frame
from palpate_gateway.emulators.emulator import WrenchSource, slow_press
from palpate_gateway.emulators.robotous_sensor import BAUDS, MOST_HZ, TORQUE_DIVISORS, Robotous
from palpate_gateway.emulators.serial_line import SerialLine

__all__ = ["TORQUE_DIVISORS", "Robotous", "RobotousCan", "RobotousSerial"]


class RobotousSerial(Robotous):
    """An RFT with a UART.

    Besides the faults of every ``Robotous``: ``crc``, one bit of each frame is wrong, and
    ``unplug``, the line is gone while the sensor goes on.

    Args:
        source: The load.
        baud: Its speed [bit/s].
        path: Name of the line; "" = a new one.
        more: Model, serial number, drift.
    """

    faults: ClassVar[frozenset[str]] = frozenset(
        "crc cut junk lost repeated silence restart unplug overload stuck clock_drift".split()
    )

    def __init__(
        self, source: WrenchSource = slow_press, baud: int = 115200, path: str = "", **more: Any
    ) -> None:
        self._line = SerialLine(baud, path)
        self._came = b""
        super().__init__(source, **more)
        self.baud_code = BAUDS.index(baud)
        self._power_up()

    @property
    def address(self) -> str:
        """The line's name."""
        return self._line.path

    def _listen(self) -> None:
        self._line.plug()

    def _hang_up(self) -> None:
        self._line.close()

    def _power_up(self) -> None:
        super()._power_up()
        self._came = b""
        self._line.baud = BAUDS[self.baud_code]
        self._most_hz = MOST_HZ[self._line.baud]

    def _requests(self, timeout_s: float) -> list[bytes]:
        self._line.keep_plugged(not self.faulty("unplug"))
        self._came += self._line.read(timeout_s)
        out = []
        while len(self._came) >= 11:
            frame, length = self._came[:11], 1
            if frame[0] == 0x55 and frame[10] == 0xAA and frame[9] == sum(frame[1:9]) % 256:
                out.append(frame[1:9])
                length = 11
            self._came = self._came[length:]
        return out

    def _send(self, data: bytes) -> None:
        self._line.write(b"\x55" + data + bytes([sum(data) % 256]) + b"\xaa")

    def _spoil(self, fault: str, data: bytes) -> None:
        if fault == "junk":
            self._line.write(self._random.randbytes(self._random.randint(1, 40)))
            return
        frame = bytearray(b"\x55" + data + bytes([sum(data) % 256]) + b"\xaa")
        if fault == "crc":
            frame[self._random.randint(2, 13)] ^= 1 << self._random.randint(0, 7)
        self._line.write(frame if fault == "crc" else frame[:9])


class RobotousCan(Robotous):
    """An RFT on CAN.

    Besides the faults of every ``Robotous``: ``busoff``, an error frame says that the controller is
    off the bus, then nothing is heard or said, and at the end another says that it was started
    again, and the sensor has gone on; ``unplug``: the same without a word, but its supply is gone,
    too, and it has to be asked again.

    Args:
        source: The load.
        interface: python-can's kind of bus.
        channel: The bus.
        more: Model, serial number, drift.
    """

    faults: ClassVar[frozenset[str]] = frozenset(
        "cut junk lost repeated silence restart unplug overload stuck clock_drift busoff".split()
    )

    def __init__(
        self,
        source: WrenchSource = slow_press,
        *,
        interface: str = "virtual",
        channel: str = "robotous",
        **more: Any,
    ) -> None:
        super().__init__(source, **more)
        self._off = False
        self._where = {"interface": interface, "channel": channel}
        self._can: Any = require("can", extra="gateway")
        self._bus: Any = None

    @property
    def address(self) -> str:
        """Kind of bus and its name."""
        return ":".join(self._where.values())

    def _listen(self) -> None:
        self._bus = self._can.Bus(**self._where)

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

    def _send(self, data: bytes) -> None:
        self._put(self.ids[1], data[:8])
        self._put(self.ids[2], data[8:])

    def _spoil(self, fault: str, data: bytes) -> None:
        if fault == "junk":
            # Frames of others, and one of a wrong length with an identifier of ours.
            self._put(self._random.randint(0x100, 0x7FF), self._random.randbytes(8))
            self._put(self.ids[1], self._random.randbytes(self._random.randint(0, 7)))
        else:
            self._put(self.ids[1], data[:8])

    def _put(self, can_id: int, data: bytes) -> None:
        message = self._can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        self._bus.send(message)
