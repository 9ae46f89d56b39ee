"""A CAN bus by python-can, whatever carries it: SocketCAN, a serial adapter, multicast, a log.

Messages come in batches, since a BioTac sends 4400 of them a second.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from typing import Any, NamedTuple

from palpate.gateway.ports.port import silent
from palpate.protos.errors import ConfigError, DeviceError, DeviceLost
from palpate.protos.extras import require

BATCH = 256
"""Most messages handed over at once."""

_BUFFER = 4 << 20
"""What the system shall keep while this process does not read [bytes]: its usual 0.2 MB are full
after 60 ms of three BioTacs."""


class CanMessage(NamedTuple):
    """One data frame: identifier, data, and when it came by the host's monotonic clock [ns]."""

    can_id: int
    data: bytes
    arrival_ns: int


class CanBus:
    """One bus; opening and closing twice is harmless.

    Args:
        interface: python-can's name of the kind of bus, e.g. ``socketcan``.
        channel: E.g. ``can0``.
        bitrate: [bit/s]; 0 = as the bus is set up.
        options: More of python-can's options.
    """

    def __init__(
        self,
        interface: str,
        channel: str,
        *,
        bitrate: int = 0,
        options: dict[str, Any] | None = None,
    ) -> None:
        self.name = f"{interface}:{channel}"
        self._arguments = {**(options or {}), "interface": interface, "channel": channel}
        if bitrate:
            self._arguments["bitrate"] = bitrate
        self._bus: Any = None
        self._can: Any = None
        self.counters: dict[str, int] = {"error_frames": 0, "other_frames": 0}

    def open(self) -> None:
        """Join the bus, or do nothing if joined.

        Raises:
            ConfigError: python-can knows no such interface or option.
            DeviceError: The bus is not there or not up.
            MissingExtraError: python-can is not installed.
        """
        if self._bus is not None:
            return
        self._can = can = require("can", extra="gateway")
        self.counters = dict.fromkeys(self.counters, 0)
        try:
            self._bus = can.Bus(**self._arguments)
        except (can.CanInterfaceNotImplementedError, TypeError, ValueError) as error:
            raise ConfigError(
                f"{self.name}: {error}",
                remedy="see python-can's list of interfaces and their options",
            ) from error
        except (can.CanError, OSError, ImportError) as error:
            raise DeviceError(
                f"{self.name}: cannot join the bus: {error}",
                remedy="bring it up (ip link set can0 up type can bitrate 1000000), check its name",
            ) from error

        self._enlarge_buffer()

    def _enlarge_buffer(self) -> None:
        """Where the bus is a socket; others keep what they keep."""
        with contextlib.suppress(NotImplementedError, OSError, ValueError, TypeError):
            with socket.socket(fileno=os.dup(self._bus.fileno())) as same:
                same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)

    def close(self) -> None:
        """Leave the bus; never raises."""
        bus, self._bus = self._bus, None
        if bus is not None:
            # Whatever a driver of an unplugged adapter raises: it is closed.
            with contextlib.suppress(Exception):
                bus.shutdown()

    def read(self, timeout_s: float, *, gather_s: float = 0.0) -> list[CanMessage]:
        """At least one data frame, and those that came with it.

        Args:
            timeout_s: How long to wait for the first [s].
            gather_s: How long to wait for more behind it [s]; the bus keeps them meanwhile.

        Raises:
            DeviceTimeout: None came.
            DeviceLost: The bus is gone, or off after too many errors.
        """
        bus = self._opened()
        out: list[CanMessage] = []
        wait_s, until = timeout_s, time.monotonic() + timeout_s
        while len(out) < BATCH:
            try:
                message = bus.recv(wait_s)
            except (self._can.CanError, OSError, ValueError) as error:
                if out:
                    return out
                raise self._lost(str(error)) from error
            if message is None:
                if out:
                    return out
                raise silent(self.name, timeout_s)
            if message.is_error_frame:
                self.counters["error_frames"] += 1
                self._check_on()
            elif message.is_remote_frame or message.is_fd:
                self.counters["other_frames"] += 1
            else:
                stamp = time.monotonic_ns()
                out.append(CanMessage(message.arbitration_id, bytes(message.data), stamp))
            if gather_s and len(out) == 1:
                time.sleep(gather_s)
            wait_s = 0.0 if out else max(0.0, until - time.monotonic())
        return out

    def write(self, can_id: int, data: bytes) -> None:
        """Send a data frame with a standard identifier.

        Raises:
            DeviceLost: The bus is gone, or takes nothing.
        """
        bus = self._opened()
        message = self._can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        try:
            bus.send(message, timeout=0.2)
        except (self._can.CanError, OSError, ValueError) as error:
            raise self._lost(str(error)) from error

    def _check_on(self) -> None:
        """A bus that is off says so once and is then silent for ever: it must be opened again."""
        with contextlib.suppress(NotImplementedError):
            if self._bus.state is self._can.BusState.ERROR:
                raise self._lost("it is off after too many errors (bus off)")

    def _opened(self) -> Any:
        if self._bus is None:
            raise DeviceError(f"{self.name} is not open", remedy="call open() first")
        return self._bus

    def _lost(self, why: str) -> DeviceLost:
        return DeviceLost(
            f"CAN bus {self.name} is gone: {why}",
            remedy="check adapter, wiring and the terminators at both ends; it is opened again by "
            "itself",
        )
