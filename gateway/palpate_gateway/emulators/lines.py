"""Lines of emulated devices: a serial line as a pseudo terminal, its checksum, CAN error frames.

A pseudo terminal has no speed, but it knows the speed that the host has set: at another speed the
host reads noise and its requests are lost, as on a wire.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import random
import select
import shutil
import socket
import tempfile
import termios
import time
import tty
from pathlib import Path
from typing import Any

from palpate.errors import ConfigError
from palpate_gateway.emulators.emulator import Emulator

BUS_ERROR, BUS_OFF, RESTARTED = 0x080, 0x040, 0x100
"""Classes of CAN error frames: bits of the identifier (linux/can/error.h)."""

_log = logging.getLogger(__name__)

_AT_ONCE = 4096
_TERMINALS = "/dev/pts/"

_SPEEDS = {
    getattr(termios, name): int(name[1:])
    for name in dir(termios)
    if name.startswith("B") and name[1:].isdigit()
}
"""Speeds [bit/s] by their codes in the settings of a terminal."""


def _crc_of_byte(byte: int) -> int:
    """Remainder of one byte, bit by bit: lowest bit first, polynomial 1021 reflected."""
    for _ in range(8):
        byte = byte >> 1 ^ (0x8408 if byte & 1 else 0)
    return byte


_CRC_OF_BYTE = [_crc_of_byte(byte) for byte in range(256)]


def speeds() -> list[int]:
    """Speeds that a line can have [bit/s]."""
    return sorted(set(_SPEEDS.values()) - {0})


def reserve(path: str | Path) -> socket.socket:
    """Reserve the name of a line, until the socket that is returned is closed.

    Whoever ends loses its reservations, so that the name which a killed emulator left can be used
    again, and that of a running one cannot. A link that leads to a pseudo terminal counts as one
    that a killed emulator left, whoever made it.

    Raises:
        ConfigError: An emulator that runs has the name, or something else than a line is there.
    """
    path = Path(path)
    if path.is_symlink():
        target = os.readlink(path)
        if not target.startswith(_TERMINALS):
            raise ConfigError(
                f"{path} is a link to {target}, not the name of a line", remedy="choose another"
            )
    elif path.exists():
        raise ConfigError(f"{path}: a file of this name is there", remedy="choose another")
    whole = os.path.join(os.path.realpath(path.parent), path.name)
    guard = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        # An abstract socket: it is no file, and its name is that of one process at a time.
        guard.bind(f"\0palpate-line-{hashlib.sha256(os.fsencode(whole)).hexdigest()}")
    except OSError as error:
        guard.close()
        raise ConfigError(
            f"{path} is the line of another emulator, which runs",
            remedy="end that one, or choose another name",
        ) from error
    return guard


class SerialLine:
    """A line to one host.

    Args:
        baud: The device's speed [bit/s].
        path: Name of the line; "" = one in a new folder, which is removed with the line.
    """

    def __init__(self, baud: int, path: str = "") -> None:
        self.baud = baud
        self.path = path
        self.overrun = 0
        """Bytes that the host was too slow to read; a wire would lose them too."""
        self._folder = ""
        self._device = self._host = -1
        self._reserved: socket.socket | None = None
        self._told = False
        self._noise = random.Random(baud)

    @property
    def plugged(self) -> bool:
        """Whether a host can open the line."""
        return self._device >= 0

    def plug(self) -> None:
        """Make the line, or do nothing if it is there.

        Raises:
            ConfigError: Its name cannot be had, see ``reserve``; or something else took the name of
                a line that was unplugged.
        """
        if self.plugged:
            return
        if not self.path:
            self._folder = tempfile.mkdtemp(prefix="palpate-line-")
            self.path = str(Path(self._folder) / "tty")
        if self._reserved is None:
            self._reserved = reserve(self.path)
            if Path(self.path).is_symlink():
                Path(self.path).unlink()
        device, host = os.openpty()
        # The host's end stays open here as well, or its settings would be lost and reads would
        # fail.
        tty.setraw(device)
        tty.setraw(host)
        os.set_blocking(device, False)
        try:
            Path(self.path).symlink_to(os.ttyname(host))
        except OSError as error:
            os.close(device)
            os.close(host)
            raise ConfigError(
                f"{self.path} cannot be made: {error.strerror or error}",
                remedy="move what is there, or choose another name",
            ) from error
        self._device, self._host = device, host

    def unplug(self) -> None:
        """Remove the line, as if its adapter were pulled; the name stays reserved."""
        if self.plugged:
            with contextlib.suppress(OSError):  # somebody may have removed or replaced it
                if os.readlink(self.path) == os.ttyname(self._host):
                    Path(self.path).unlink()
            os.close(self._device)
            os.close(self._host)
            self._device = self._host = -1

    def keep_plugged(self, plugged: bool) -> None:
        """Plug or unplug the line, if it is not in this state yet.

        It stays unplugged, which is logged once, while its name cannot be had.
        """
        if not plugged:
            self.unplug()
            return
        try:
            self.plug()
            self._told = False
        except ConfigError as error:
            if not self._told:
                _log.warning("%s", error)
            self._told = True

    def close(self) -> None:
        """Unplug for good."""
        self.unplug()
        if self._reserved is not None:
            self._reserved.close()
            self._reserved = None
        if self._folder:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = self.path = ""

    def read(self, timeout_s: float) -> bytes:
        """Bytes from the host; none if none came, or if its speed is another one."""
        if not self.plugged:
            time.sleep(timeout_s)
            return b""
        ready, _, _ = select.select([self._device], [], [], timeout_s)
        data = b""
        if ready:
            with contextlib.suppress(OSError):
                data = os.read(self._device, _AT_ONCE)
        return data if self._same_speed() else b""

    def write(self, data: bytes | bytearray) -> bool:
        """Send to the host, if the line is plugged; noise if the host's speed is another one.

        Returns:
            Whether the host can read all of it.
        """
        if not self.plugged:
            return False
        heard = self._same_speed()
        if not heard:
            data = self._noise.randbytes(len(data))
        try:
            taken = os.write(self._device, data)
        except OSError:
            taken = 0
        self.overrun += len(data) - taken
        return heard and taken == len(data)

    def _same_speed(self) -> bool:
        set_by_host = _SPEEDS.get(termios.tcgetattr(self._host)[5])
        # 38400 is the speed of a new terminal before a host has opened it.
        return set_by_host in (self.baud, 38400)


class SerialEmulator(Emulator):
    """An emulator on a serial line."""

    _line: SerialLine

    @property
    def address(self) -> str:
        """Name of the line."""
        return self._line.path

    def _listen(self) -> None:
        self._line.plug()

    def _hang_up(self) -> None:
        self._line.close()


def crc16_x25(data: bytes | bytearray) -> int:
    """CRC-16/X-25, computed apart from the decoders' own; "123456789" gives 906E."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC_OF_BYTE[(crc ^ byte) & 0xFF]
    return crc ^ 0xFFFF


def error_frame(can: Any, kind: int) -> Any:
    """An error frame as SocketCAN hands it to the listeners of a controller.

    Error frames never travel on a real bus: the receiver's own controller makes them. python-can's
    buses in software carry them like any frame.
    """
    return can.Message(
        arbitration_id=kind, is_error_frame=True, is_extended_id=False, data=bytes(8)
    )
