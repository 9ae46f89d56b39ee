"""The two lines of a Robotous sensor: requests go out, the data bytes of answers come in."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

from palpate_gateway.ports.can_bus import CanBus
from palpate_gateway.ports.serial_port import SerialPort
from palpate_gateway.protocols.robotous import (
    RobotousCanDecoder,
    RobotousSerialDecoder,
    serial_frame,
)

_APART = 0.75
"""Halves that came further apart than this are of two samples [periods]."""


class RobotousLine(ABC):
    """A line to one sensor.

    Attributes:
        name: What a person calls it.
    """

    name: str

    @property
    @abstractmethod
    def counters(self) -> Mapping[str, int]:
        """Events since it was opened last."""

    @abstractmethod
    def open(self) -> None:
        """Connect; errors are those of the port."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect; never raises."""

    @abstractmethod
    def send(self, request: bytes) -> None:
        """Send the data bytes of a request."""

    @abstractmethod
    def read(self, timeout_s: float) -> list[bytes]:
        """Data bytes of the answers that are now whole; may be none, e.g. half a frame.

        Raises:
            DeviceTimeout: Nothing came.
            DeviceLost: The line is gone.
        """


class RobotousSerialLine(RobotousLine):
    """A serial line.

    Args:
        port: Its name.
        baud: Its rate [bit/s].
    """

    def __init__(self, port: str, baud: int) -> None:
        self.name = f"{port} at {baud} bit/s"
        self._port = SerialPort(port, baud)
        self._decoder = RobotousSerialDecoder()

    @property
    def counters(self) -> Mapping[str, int]:
        """See ``RobotousLine``."""
        return self._decoder.counters

    def open(self) -> None:
        """See ``RobotousLine``."""
        self._decoder = RobotousSerialDecoder()
        self._port.open()

    def close(self) -> None:
        """See ``RobotousLine``."""
        self._port.close()

    def send(self, request: bytes) -> None:
        """See ``RobotousLine``."""
        self._port.write(serial_frame(request))

    def read(self, timeout_s: float) -> list[bytes]:
        """See ``RobotousLine``."""
        return self._decoder.feed(self._port.read(timeout_s))


class RobotousCanLine(RobotousLine):
    """A CAN bus, which others may use too.

    Args:
        bus: Closed.
        request_id: Identifier of requests.
        first_id: Identifier of the first half of an answer.
        second_id: Identifier of the second half.
        period_s: Time between two samples [s].
    """

    def __init__(
        self, bus: CanBus, *, request_id: int, first_id: int, second_id: int, period_s: float
    ) -> None:
        self.name = bus.name
        self._bus = bus
        self._request_id, self._ids = request_id, (first_id, second_id)
        self._apart_ns = round(1e9 * _APART * period_s)
        self._first_ns = 0
        self._decoder = RobotousCanDecoder(*self._ids)

    @property
    def counters(self) -> Mapping[str, int]:
        """See ``RobotousLine``."""
        return {**self._decoder.counters, **self._bus.counters}

    def open(self) -> None:
        """See ``RobotousLine``."""
        self._decoder = RobotousCanDecoder(*self._ids)
        self._bus.counters.update(dict.fromkeys(self._bus.counters, 0))
        self._bus.open()

    def close(self) -> None:
        """See ``RobotousLine``."""
        self._bus.close()

    def send(self, request: bytes) -> None:
        """See ``RobotousLine``."""
        self._bus.write(self._request_id, request)

    def read(self, timeout_s: float) -> list[bytes]:
        """See ``RobotousLine``."""
        out = []
        for can_id, data, arrival_ns in self._bus.read(timeout_s).messages():
            # Nothing numbers the samples: only their times show that two halves do not belong.
            if self._decoder.pending and arrival_ns - self._first_ns > self._apart_ns:
                self._decoder.reset()
            if can_id == self._ids[0]:
                self._first_ns = arrival_ns
            out += self._decoder.feed(can_id, data)
        return out
