"""A serial line by pyserial: UART, USB-CDC, a pseudo terminal, TCP or an RFC 2217 server."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import select
import termios
import time
from typing import Any

from palpate.errors import DeviceError, DeviceLost
from palpate.process import require
from palpate_gateway.ports.port import Port, silent

_AT_ONCE = 65536
"""Most bytes of one read."""

_TAKEN_S = 1.0
"""Longest time in which the device must take what is written [s]; requests are a few bytes."""

_WAIT_S = 5e-3
"""Time of one wait for a byte where the system cannot tell that one came [s]: an RFC 2217 server
is asked for all of its settings again whenever the time changes."""

_POLL_S = 5e-4
"""Time between two looks at what has not left yet [s]: the system does not tell its end."""

_REMEDIES = {
    errno.ENOENT: "plug it in, or name another port (palpate gateway list shows what is there)",
    errno.EACCES: "join the group that may use it (dialout, see the udev rules), or start as root",
    errno.EBUSY: "another program has it open: end that one",
    errno.EAGAIN: "another program has it open: end that one",
}


class SerialPort(Port):
    """A serial line, for this process alone.

    Args:
        name: Device file or pyserial URL, e.g. ``/dev/serial/by-id/usb-...`` (which stays the same
            when plugs change places), ``socket://host:port`` or ``rfc2217://host:port``.
        baud: Rate [bit/s]; nominal on USB-CDC.
        rts_cts: Hardware flow control.
    """

    def __init__(self, name: str, baud: int, *, rts_cts: bool = False) -> None:
        self.name = name
        self._baud, self._rts_cts = baud, rts_cts
        self._line: Any = None
        self._file = self._selectable = False
        self._stuck = False
        self._broken: tuple[type[Exception], ...] = (OSError, termios.error)

    def open(self) -> None:
        """See ``Port``."""
        if self._line is not None:
            return
        serial = require("serial", extra="gateway")
        # Unplugging raises any of these (pyserial issues 341, 331, 86).
        self._broken = (serial.SerialException, OSError, termios.error, TypeError)
        options: dict[str, Any] = {"baudrate": self._baud, "timeout": 0, "rtscts": self._rts_cts}
        if "://" not in self.name:
            options["exclusive"] = True
        try:
            line = serial.serial_for_url(self.name, **options)
        except (serial.SerialException, OSError, termios.error, ValueError) as error:
            number = getattr(error, "errno", None) or 0
            raise DeviceError(
                f"{self.name}: cannot be opened: {error}",
                remedy=_REMEDIES.get(number, "check its name, and that nothing else has it open"),
            ) from error
        # Otherwise USB adapters hold bytes back for 16 ms; not every kind of line has this mode.
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            line.set_low_latency_mode(True)
        self._line, self._stuck = line, False
        self._file = os.name == "posix" and "://" not in self.name
        try:
            line.fileno()
            self._selectable = True
        except io.UnsupportedOperation:
            self._selectable = False
            line.timeout = _WAIT_S

    def close(self) -> None:
        """See ``Port``."""
        line, self._line = self._line, None
        if line is not None:
            with contextlib.suppress(*self._broken):
                line.close()

    def read(self, timeout_s: float) -> bytes:
        """See ``Port``."""
        line = self._opened()
        try:
            data = self._take(line, timeout_s)
        except self._broken as error:
            if isinstance(error, DeviceError):
                raise
            raise self._lost(error) from error
        if not data:
            raise silent(self.name, timeout_s)
        return data

    def _take(self, line: Any, timeout_s: float) -> bytes:
        """Bytes that have arrived, at least one; none if none came in time."""
        if self._selectable:
            # The timeout stays 0: pyserial configures the whole line again whenever it changes.
            ready, _, _ = select.select([line], [], [], timeout_s)
            return bytes(line.read(_AT_ONCE)) if ready else b""
        until = time.monotonic() + timeout_s
        while True:
            data = bytes(line.read(min(max(line.in_waiting, 1), _AT_ONCE)))
            if data or time.monotonic() >= until:
                return data

    def write(self, data: bytes) -> None:
        """See ``Port``."""
        line = self._opened()
        try:
            if self._file:
                self._give(line, memoryview(data))
            else:
                line.write(data)
                line.flush()
        except self._broken as error:
            if isinstance(error, DeviceError):
                raise
            raise self._lost(error) from error

    def _give(self, line: Any, data: memoryview) -> None:
        """Write to a device file, and wait until all has left it.

        Neither ``write`` nor ``flush`` of pyserial ends while the other side takes nothing.
        """
        until = time.monotonic() + (0.0 if self._stuck else _TAKEN_S)
        while data or line.out_waiting:
            left_s = until - time.monotonic()
            if left_s <= 0.0:
                # Else the system would wait for half a minute when the file is closed.
                line.reset_output_buffer()
                self._stuck = True
                raise DeviceLost(
                    f"{self.name}: it takes no bytes for {_TAKEN_S:g} s",
                    remedy="check its power, and RTS/CTS; it is opened again by itself",
                )
            if not data:
                time.sleep(_POLL_S)
                continue
            _, ready, _ = select.select([], [line], [], left_s)
            with contextlib.suppress(BlockingIOError):
                data = data[os.write(line.fileno(), data) :] if ready else data

    def _opened(self) -> Any:
        if self._line is None:
            raise DeviceError(f"{self.name} is not open", remedy="call open() first")
        return self._line

    def _lost(self, error: BaseException) -> DeviceLost:
        return DeviceLost(
            f"{self.name} is gone: {error}",
            remedy="plug it in again; it is opened again by itself",
        )
