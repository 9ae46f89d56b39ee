"""The contract of a port that carries bytes.

Rules of ``read``, the same for serial lines and sockets:

* at least one byte, as soon as one has arrived;
* ``DeviceTimeout`` if nothing came in time: try again;
* ``DeviceLost`` if the port is gone: close it and open it again.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from typing import Self

from palpate.errors import DeviceTimeout


class Port(ABC):
    """A way to a device. Opening or closing it twice is harmless; a closed one can be reopened.

    Attributes:
        name: Its name for people, e.g. ``/dev/ttyUSB0`` or ``192.168.1.30:1000``.
    """

    name: str

    @abstractmethod
    def open(self) -> None:
        """Connect, or do nothing if connected.

        Raises:
            DeviceError: It cannot be opened; says why and what to do.
            MissingExtraError: It needs a package that is not installed.
        """

    @abstractmethod
    def close(self) -> None:
        """Disconnect, or do nothing if not connected; never raises."""

    @abstractmethod
    def read(self, timeout_s: float) -> bytes:
        """Bytes that have arrived; see the rules at the top of this file.

        Args:
            timeout_s: How long to wait for the first byte [s].
        """

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send all of it.

        Raises:
            DeviceLost: The port is gone.
        """

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()


def silent(name: str, timeout_s: float) -> DeviceTimeout:
    """The error of a port on which nothing came."""
    return DeviceTimeout(
        f"{name}: nothing came within {timeout_s:.3g} s",
        remedy="check power and cable; reading goes on by itself",
    )


def settle(port: Port, quiet_s: float, longest_s: float) -> int:
    """Throw away input until the line is quiet; returns the number of bytes.

    Args:
        port: Open.
        quiet_s: The line is quiet when nothing came for this long [s].
        longest_s: Give up after this long [s].

    Raises:
        DeviceLost: The port is gone.
    """
    count, until = 0, time.monotonic() + longest_s
    while time.monotonic() < until:
        try:
            count += len(port.read(quiet_s))
        except DeviceTimeout:
            return count
    return count
