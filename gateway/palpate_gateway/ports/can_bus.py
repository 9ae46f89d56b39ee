"""A CAN bus by python-can: SocketCAN, a serial adapter, multicast, a log.

Messages are read in batches, since a BioTac sends 4400 of them a second. Where the bus is a socket
they are read from it directly: python-can needs three times as much processor time, and loses
messages when other threads are busy (see ``datagrams``).
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from palpate.errors import ConfigError, DeviceError, DeviceLost
from palpate.process import require
from palpate_gateway.clock.wall_clock import KernelStamps
from palpate_gateway.ports.can_frames import (
    BUS_OFF,
    CanFrame,
    CanFrames,
    FrameKind,
    MulticastReader,
    Reader,
    from_message,
    from_socketcan,
)
from palpate_gateway.ports.datagrams import BATCH, Datagrams, available
from palpate_gateway.ports.multicast import open_can
from palpate_gateway.ports.port import silent

_BUFFER = 4 << 20
"""Size of the system's receive buffer [bytes]: its default of 0.2 MB is full after 60 ms of three
BioTacs."""

_BY_ITSELF = "it is opened again by itself"

_BAD_MOST = 100
"""So many lines in a row that cannot be read are no damage of the line."""


class CanBatch(NamedTuple):
    """Data frames, and their times of arrival by the host's monotonic clock [ns].

    Attributes:
        frames: N frames in order of arrival.
        arrival_ns: int64, shape ``(N,)``.
    """

    frames: CanFrames
    arrival_ns: npt.NDArray[np.int64]

    def messages(self) -> Iterator[tuple[int, bytes, int]]:
        """Identifier, data and time of arrival [ns] of each."""
        frames = self.frames
        rows = zip(frames.data, frames.size.tolist(), strict=True)
        data = [row[:size].tobytes() for row, size in rows]
        return zip(frames.can_id.tolist(), data, self.arrival_ns.tolist(), strict=True)


def check_bitrate(interface: str, bitrate: int) -> None:
    """Refuse a bit rate, other than 0, that would be ignored.

    Args:
        interface: Kind of bus as python-can names it.
        bitrate: [bit/s].

    Raises:
        ValueError: The system sets the rate of such a bus, not palpate.
    """
    if bitrate and interface == "socketcan":
        raise ValueError(
            "bitrate: the system sets that of a socketcan bus (ip link set can0 type can "
            f"bitrate {bitrate} restart-ms 100): leave it out"
        )


class CanBus:
    """One bus; opening or closing it twice is harmless.

    Args:
        interface: Kind of bus as python-can names it, e.g. ``socketcan``.
        channel: E.g. ``can0``.
        bitrate: [bit/s]; 0 = as the bus is set up. See ``check_bitrate``.
        options: More of python-can's options, and ``listen``; see ``open_can``.
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
        self._bad_in_a_row = 0
        self.counters: dict[str, int] = dict.fromkeys(
            ("error_frames", "other_frames", "bad_lines"), 0
        )

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
            self._bus = open_can(self._arguments)
        except (can.CanInterfaceNotImplementedError, TypeError, ValueError) as error:
            raise ConfigError(
                f"{self.name}: {error}",
                remedy="see python-can's list of interfaces and their options",
            ) from error
        except Exception as error:  # drivers raise whatever their library does
            raise DeviceError(
                f"{self.name}: cannot join the bus: {error}",
                remedy="bring it up (ip link set can0 up type can bitrate 1000000 restart-ms 100), "
                "check its name",
            ) from error

        self._stamps, self._end, self._bad_in_a_row = KernelStamps(), None, 0
        self._direct = self._find_socket()

    def _find_socket(self) -> tuple[Datagrams, Reader] | None:
        """The bus's socket, with a larger buffer, and its reader; None = python-can must read."""
        kind = self._arguments["interface"]
        known = kind in ("socketcan", "udp_multicast")
        if not known or self._arguments.get("fd") or not available():
            return None
        descriptor = self._bus.fileno()
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as same:
            same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        return Datagrams(descriptor), from_socketcan if kind == "socketcan" else MulticastReader()

    def close(self) -> None:
        """Leave the bus; never raises."""
        bus, self._bus = self._bus, None
        direct, self._direct = self._direct, None
        if direct is not None:
            direct[0].close()
        if bus is not None:
            # The driver of an unplugged adapter may raise anything; the bus is closed all the same.
            with contextlib.suppress(Exception):
                bus.shutdown()

    def read(self, timeout_s: float, *, gather_s: float = 0.0) -> CanBatch:
        """At least one data frame, and those that arrived with it.

        Args:
            timeout_s: How long to wait for the first [s].
            gather_s: Wait for so long first [s]; meanwhile the system buffers what arrives.

        Raises:
            DeviceTimeout: None came.
            DeviceLost: The bus is gone, or off after too many errors.
        """
        self._opened()
        if self._end is not None:
            raise self._end
        if gather_s:
            time.sleep(gather_s)
        until = time.monotonic() + timeout_s
        while True:
            try:
                frames, arrivals_ns = self._frames(max(0.0, until - time.monotonic()))
            except DeviceLost:
                raise
            except (OSError, ValueError) as error:
                raise self._lost(str(error)) from error
            kept = frames.kind == FrameKind.DATA
            if not kept.all():
                self._note(frames)
                frames, arrivals_ns = frames.those(kept), arrivals_ns[kept]
            if len(arrivals_ns):
                return CanBatch(frames, arrivals_ns)
            if self._end is not None:
                raise self._end
            if time.monotonic() >= until:
                raise silent(self.name, timeout_s)

    def _frames(self, wait_s: float) -> CanBatch:
        """Frames of any kind that have arrived; may be none."""
        if self._direct is None:
            return self._frames_by_python_can(wait_s)
        datagrams, reader = self._direct
        ready, _, _ = select.select([datagrams], [], [], wait_s)
        if not ready:
            return CanBatch(CanFrames.of([]), np.zeros(0, np.int64))
        batch = datagrams.take()
        now_ns = time.monotonic_ns()
        return CanBatch(reader(batch), self._stamps.monotonic_of_all(batch.stamp_ns, now_ns))

    def _frames_by_python_can(self, wait_s: float) -> CanBatch:
        frames: list[CanFrame] = []
        arrivals_ns: list[int] = []
        while len(frames) < BATCH:
            try:
                message = self._bus.recv(0.0 if frames else wait_s)
            except (IndexError, ValueError):
                # python-can's slcan cannot read a damaged line; the next one may be good.
                self.counters["bad_lines"] += 1
                self._bad_in_a_row += 1
                if self._bad_in_a_row >= _BAD_MOST:
                    self._end = self._lost("its driver cannot read what comes")
                break
            except Exception as error:  # drivers raise whatever their library does
                if not frames:
                    raise self._lost(str(error)) from error
                # The frames before the error are delivered first.
                self._end = self._lost(str(error))
                break
            if message is None:
                break
            self._bad_in_a_row = 0
            now_ns = time.monotonic_ns()
            arrivals_ns.append(self._stamps.monotonic_ns(message.timestamp, now_ns))
            frames.append(from_message(message))
        return CanBatch(CanFrames.of(frames), np.array(arrivals_ns, np.int64))

    def _note(self, frames: CanFrames) -> None:
        """Count frames that hold no data."""
        errors = frames.kind == FrameKind.ERROR
        self.counters["other_frames"] += int((frames.kind == FrameKind.OTHER).sum())
        self.counters["error_frames"] += int(errors.sum())
        if (frames.can_id[errors] & BUS_OFF).any() or (errors.any() and self._is_off()):
            # Reported once, then the bus stays silent: it must be opened again.
            self._end = self._lost("it is off after too many errors (bus off)", self._back_on())

    def _back_on(self) -> str:
        """What brings the bus back: Linux leaves it off unless it was set up with a restart."""
        if self._arguments["interface"] != "socketcan":
            return _BY_ITSELF
        channel = self._arguments["channel"]
        return (
            f"it comes back by itself only if it was set up with restart-ms; else: ip link set "
            f"{channel} down; ip link set {channel} up"
        )

    def _is_off(self) -> bool:
        with contextlib.suppress(NotImplementedError):
            return bool(self._bus.state is self._can.BusState.ERROR)
        return False

    def write(self, can_id: int, data: bytes) -> None:
        """Send a data frame with a standard identifier.

        Raises:
            DeviceLost: The bus is gone, or accepts nothing.
        """
        bus = self._opened()
        message = self._can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        try:
            bus.send(message, timeout=0.2)
        except Exception as error:  # drivers raise whatever their library does
            raise self._lost(str(error)) from error

    def _opened(self) -> Any:
        if self._bus is None:
            raise DeviceError(f"{self.name} is not open", remedy="call open() first")
        return self._bus

    def _lost(self, why: str, then: str = _BY_ITSELF) -> DeviceLost:
        return DeviceLost(
            f"CAN bus {self.name} is gone: {why}",
            remedy=f"check adapter, wiring and the terminators at both ends; {then}",
        )
