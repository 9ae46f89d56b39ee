"""The device's end of a serial line: a pseudo terminal behind a name that survives unplugging.

A pseudo terminal has no speed, but it knows which one the host has set; a host with another one
reads noise and is not heard, as on a wire.
"""

from __future__ import annotations

import contextlib
import os
import random
import select
import shutil
import tempfile
import termios
import time
import tty
from pathlib import Path

_AT_ONCE = 4096

_SPEEDS = {
    getattr(termios, name): int(name[1:])
    for name in dir(termios)
    if name.startswith("B") and name[1:].isdigit()
}
"""Speeds [bit/s] by the code that a terminal's settings hold."""


def speeds() -> list[int]:
    """Speeds that a line can have [bit/s]."""
    return sorted(set(_SPEEDS.values()) - {0})


class SerialLine:
    """A line to one host.

    Args:
        baud: The device's speed [bit/s].
        path: Name of the line; "" = one in a new folder that goes with the line.
    """

    def __init__(self, baud: int, path: str = "") -> None:
        self.baud = baud
        self.path = path
        self.overrun = 0
        """Bytes that the host was too slow to take; a wire would have lost them too."""
        self._folder = ""
        self._device = self._host = -1
        self._noise = random.Random(baud)

    @property
    def plugged(self) -> bool:
        """Whether a host can open the line."""
        return self._device >= 0

    def plug(self) -> None:
        """Make the line, or do nothing if it is there."""
        if self.plugged:
            return
        if not self.path:
            self._folder = tempfile.mkdtemp(prefix="palpate-line-")
            self.path = str(Path(self._folder) / "tty")
        self._device, self._host = os.openpty()
        # The host's end stays open here as well: else its settings are lost and reading fails.
        tty.setraw(self._device)
        tty.setraw(self._host)
        os.set_blocking(self._device, False)
        Path(self.path).unlink(missing_ok=True)
        Path(self.path).symlink_to(os.ttyname(self._host))

    def unplug(self) -> None:
        """Take the line away, as by pulling an adapter; the name stays reserved."""
        if self.plugged:
            Path(self.path).unlink(missing_ok=True)
            os.close(self._device)
            os.close(self._host)
            self._device = self._host = -1

    def keep_plugged(self, plugged: bool) -> None:
        """Plug or unplug where it is not so."""
        if plugged:
            self.plug()
        else:
            self.unplug()

    def close(self) -> None:
        """Unplug for good."""
        self.unplug()
        if self._folder:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = self.path = ""

    def read(self, timeout_s: float) -> bytes:
        """What the host sent; nothing if nothing came, or at another speed."""
        if not self.plugged:
            time.sleep(timeout_s)
            return b""
        ready, _, _ = select.select([self._device], [], [], timeout_s)
        data = b""
        if ready:
            with contextlib.suppress(OSError):
                data = os.read(self._device, _AT_ONCE)
        return data if self._same_speed() else b""

    def write(self, data: bytes | bytearray) -> None:
        """Send to the host, if there is one; noise if its speed is another."""
        if not self.plugged:
            return
        if not self._same_speed():
            data = self._noise.randbytes(len(data))
        try:
            taken = os.write(self._device, data)
        except OSError:
            taken = 0
        self.overrun += len(data) - taken

    def _same_speed(self) -> bool:
        set_by_host = _SPEEDS.get(termios.tcgetattr(self._host)[5])
        # 38400 is what a new terminal has before any host has opened it.
        return set_by_host in (self.baud, 38400)
