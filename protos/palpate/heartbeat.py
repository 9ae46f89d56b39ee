"""The heartbeat of a process: the loop that does its work beats at every turn, others watch it.

A timer thread would beat on while that loop hangs, so only the loop itself calls ``beat``. Who
started the process names the watch in its environment: palpate's own supervisor a small file of
shared memory, systemd a socket (sd_notify(3)). Without either a beat does nothing.
"""

from __future__ import annotations

import math
import mmap
import os
import socket
import struct
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

FILE_VARIABLE: Final = "_PALPATE_HEARTBEAT"
"""Environment variable with the path of the file."""

LIMIT_S: Final = 5.0
"""A process that has not beaten for so long hangs, unless its last beat asked for more time [s]."""

START_S: Final = 90.0
"""Time from its start to the first beat [s]: longer than opening a session may take."""

_PID, _BEATEN, _ALLOWED = range(3)
_LAYOUT = struct.Struct("=3q")
_NOTIFY_NS = 1_000_000_000
_SYSTEMD = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")


@dataclass(frozen=True, slots=True)
class Pulse:
    """What a heartbeat's file says.

    Attributes:
        pid: Process that has beaten.
        beaten_ns: When it did so last, by the host's monotonic clock [ns].
        allowed_ns: Time that it may take to the next beat [ns].
    """

    pid: int
    beaten_ns: int
    allowed_ns: int


def read_pulse(file: Path) -> Pulse | None:
    """The last beat in a file; None before the first one."""
    try:
        content = file.read_bytes()
    except FileNotFoundError:
        return None
    if len(content) < _LAYOUT.size:
        return None
    pulse = Pulse(*_LAYOUT.unpack_from(content))
    return pulse if pulse.beaten_ns else None


def without_watch(environment: Mapping[str, str]) -> dict[str, str]:
    """An environment for children, whose beats must not count as those of this process."""
    return {k: v for k, v in environment.items() if k not in (*_SYSTEMD, FILE_VARIABLE)}


class ServiceManager:
    """systemd, as a process that it has started talks to it; does nothing without systemd.

    A datagram that finds no room is left out: the next one says the same.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        found = os.environ if environment is None else environment
        name = found.get("NOTIFY_SOCKET", "")
        self._address = "\0" + name[1:] if name.startswith("@") else name
        self._ready = False
        self._due_ns = 0
        self._within_s = LIMIT_S
        # The variables of the watchdog may be meant for the parent of this process.
        watched = found.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self._limit_us = int(found.get("WATCHDOG_USEC", "0")) if watched else 0
        self._period_ns = min(_NOTIFY_NS, self._limit_us * 250 or _NOTIFY_NS)
        self._socket = None
        if name:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    def alive(self, now_ns: int, *, within_s: float = LIMIT_S) -> None:
        """Say that this process serves, and is alive; sent at most a few times a second.

        ``within_s`` is how long the next call may take [s]; more than was said before is sent at
        once.
        """
        if self._socket is None or (now_ns < self._due_ns and within_s <= self._within_s):
            return
        lines = [] if self._ready else ["READY=1"]
        if self._limit_us:
            lines += [f"WATCHDOG_USEC={max(self._limit_us, round(within_s * 1e6))}", "WATCHDOG=1"]
        if not lines or self.say(*lines):
            self._ready = True
            self._within_s = within_s
            self._due_ns = now_ns + self._period_ns

    def say(self, *lines: str) -> bool:
        """Send assignments such as ``STATUS=6 processes run``; whether they were sent."""
        if self._socket is None:
            return False
        try:
            self._socket.sendto("\n".join(lines).encode(), self._address)
        except OSError:
            return False
        return True


class Heartbeat:
    """The heartbeat of this process: in a file, to systemd, to both or to none."""

    def __init__(self, file: Path | None, manager: ServiceManager) -> None:
        self._manager = manager
        self._words: memoryview | None = None
        if file is not None:
            with open(os.open(file, os.O_RDWR | os.O_CREAT, 0o600), "r+b") as stream:
                # Zeros: a process before this one may have used the file, and its beat must not
                # count. Written, because a hole in a full memory would be found by a signal later.
                stream.write(bytes(mmap.PAGESIZE))
                stream.flush()
                self._words = memoryview(mmap.mmap(stream.fileno(), mmap.PAGESIZE)).cast("q")
            self._words[_PID] = os.getpid()

    def beat(self, within_s: float = LIMIT_S) -> None:
        """Show that the loop has made a turn; the next takes ``within_s`` at most [s]."""
        now_ns = time.monotonic_ns()
        if self._words is not None:
            self._words[_ALLOWED] = int(within_s * 1e9)
            self._words[_BEATEN] = now_ns
        self._manager.alive(now_ns, within_s=within_s)


_STOOD_STILL_S: Final = 1.0


class Turns:
    """The turns of one of several threads: the loop that beats for all of them looks at each."""

    def __init__(self) -> None:
        self._due_s = self._within_s = math.inf
        self._looked_s = time.monotonic()

    def next(self, within_s: float) -> None:
        """The thread has made a turn; the next takes ``within_s`` at most [s]."""
        self._within_s = within_s
        self._due_s = time.monotonic() + within_s

    def are_late(self) -> bool:
        """Whether the thread hangs; one that has not begun, or has ended, does not.

        To be asked at every turn of the loop. If that stood still itself, so did the thread, whose
        turn then begins again.
        """
        now_s = time.monotonic()
        paused = now_s - self._looked_s > _STOOD_STILL_S
        self._looked_s = now_s
        if paused:
            self._due_s = now_s + self._within_s
        return now_s > self._due_s


_of_this_process: Heartbeat | None = None


def beat(within_s: float = LIMIT_S) -> None:
    """The working loop of this process has made a turn; the next takes ``within_s`` at most [s]."""
    global _of_this_process
    if _of_this_process is None:
        file = os.environ.get(FILE_VARIABLE)
        _of_this_process = Heartbeat(None if file is None else Path(file), ServiceManager())
    _of_this_process.beat(within_s)
