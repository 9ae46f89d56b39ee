"""A CAN bus by python-can, whatever carries it: SocketCAN, a serial adapter, multicast, a log.

Messages come in batches, since a BioTac sends 4400 of them a second. Where the bus is a socket they
are taken from it directly; python-can's own reading costs three times as much, and loses them when
other threads are busy (see ``datagrams``).
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from typing import Any, NamedTuple

from palpate.gateway.ports.can_frames import (
    BUS_OFF,
    CanFrame,
    FrameKind,
    Reader,
    from_message,
    from_socketcan,
    multicast_reader,
)
from palpate.gateway.ports.datagrams import BATCH, NO_STAMP, Datagrams, available
from palpate.gateway.ports.port import silent
from palpate.gateway.timing.kernel_stamps import KernelStamps
from palpate.protos.errors import ConfigError, DeviceError, DeviceLost
from palpate.protos.extras import require

_BUFFER = 4 << 20
"""What the system shall keep while this process does not read [bytes]: its usual 0.2 MB are full
after 60 ms of three BioTacs."""


class CanMessage(NamedTuple):
    """One data frame: identifier, data, and when it came by the host's monotonic clock [ns].

    That is the kernel's time of reception where the bus tells one.
    """

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
        self._direct: tuple[Datagrams, Reader] | None = None
        self._stamps = KernelStamps()
        self._end: DeviceLost | None = None
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

        self._stamps, self._end = KernelStamps(), None
        self._direct = self._find_socket()

    def _find_socket(self) -> tuple[Datagrams, Reader] | None:
        """The bus's socket with a larger buffer, and how to read it; None if it must be asked."""
        readers = {"socketcan": lambda: from_socketcan, "udp_multicast": multicast_reader}
        reader = readers.get(str(self._arguments["interface"]))
        if reader is None or self._arguments.get("fd") or not available():
            return None
        descriptor = self._bus.fileno()
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as same:
            same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        return Datagrams(descriptor), reader()

    def close(self) -> None:
        """Leave the bus; never raises."""
        bus, self._bus = self._bus, None
        direct, self._direct = self._direct, None
        if direct is not None:
            direct[0].close()
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
        self._opened()
        if self._end is not None:
            raise self._end
        until = time.monotonic() + timeout_s
        while True:
            try:
                frames = self._frames(max(0.0, until - time.monotonic()), gather_s)
            except (self._can.CanError, OSError, ValueError) as error:
                raise self._lost(str(error)) from error
            out = [
                CanMessage(frame.can_id, frame.data, arrival_ns)
                for frame, arrival_ns in frames
                if frame.kind is FrameKind.DATA or self._note(frame)
            ]
            if out:
                return out
            if self._end is not None:
                raise self._end
            if time.monotonic() >= until:
                raise silent(self.name, timeout_s)

    def _frames(self, wait_s: float, gather_s: float) -> list[tuple[CanFrame, int]]:
        """Frames of any kind that came, with their times of arrival; none if none came."""
        if self._direct is None:
            return self._asked(wait_s, gather_s)
        datagrams, reader = self._direct
        ready, _, _ = select.select([datagrams], [], [], wait_s)
        if not ready:
            return []
        if gather_s:
            time.sleep(gather_s)
        raw, stamps_ns = datagrams.take()
        now_ns = time.monotonic_ns()
        of = self._stamps.monotonic_of_ns
        return [
            (reader(one), now_ns if stamp_ns == NO_STAMP else of(stamp_ns, now_ns))
            for one, stamp_ns in zip(raw, stamps_ns.tolist(), strict=True)
        ]

    def _asked(self, wait_s: float, gather_s: float) -> list[tuple[CanFrame, int]]:
        out: list[tuple[CanFrame, int]] = []
        while len(out) < BATCH:
            try:
                message = self._bus.recv(0.0 if out else wait_s)
            except (self._can.CanError, OSError, ValueError) as error:
                if not out:
                    raise
                # What came before it is delivered first.
                self._end = self._lost(str(error))
                return out
            if message is None:
                break
            now_ns = time.monotonic_ns()
            arrival_ns = self._stamps.monotonic_ns(message.timestamp, now_ns)
            out.append((from_message(message), arrival_ns))
            if gather_s and len(out) == 1:
                time.sleep(gather_s)
        return out

    def _note(self, frame: CanFrame) -> bool:
        """Count a frame that holds no data; False."""
        if frame.kind is not FrameKind.ERROR:
            self.counters["other_frames"] += 1
            return False
        self.counters["error_frames"] += 1
        if frame.can_id & BUS_OFF or self._is_off():
            # It says so once and is then silent for ever: it must be opened again.
            self._end = self._lost("it is off after too many errors (bus off)")
        return False

    def _is_off(self) -> bool:
        with contextlib.suppress(NotImplementedError):
            return bool(self._bus.state is self._can.BusState.ERROR)
        return False

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
