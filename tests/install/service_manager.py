"""What systemd does for a unit, as far as palpate can see it: command, environment, notices."""

from __future__ import annotations

import shlex
import socket
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self


@dataclass(frozen=True, slots=True)
class UnitFile:
    """A unit's settings: the values of each, in order."""

    settings: dict[str, list[str]]

    @classmethod
    def read(cls, path: Path) -> UnitFile:
        """Read a unit; a setting that is empty clears the ones before it."""
        settings: dict[str, list[str]] = {}
        for line in path.read_text(encoding="utf-8").splitlines():
            if "=" in line and not line.startswith(("#", "[")):
                key, _, value = line.partition("=")
                settings[key] = [*settings.get(key, []), value] if value else []
        return cls(settings)

    def one(self, key: str, default: str = "") -> str:
        """The last value of a setting."""
        return (self.settings.get(key) or [default])[-1]

    @property
    def command(self) -> list[str]:
        """The words of ``ExecStart``."""
        return shlex.split(self.one("ExecStart"))

    @property
    def environment(self) -> dict[str, str]:
        """Variables of the process."""
        words = [w for line in self.settings.get("Environment", []) for w in shlex.split(line)]
        return dict(word.split("=", 1) for word in words)


@dataclass
class NoticeBoard:
    """Receives what a process says to ``NOTIFY_SOCKET``; use it in a ``with`` block."""

    path: Path
    lines: list[tuple[float, str]] = field(default_factory=list)

    def __enter__(self) -> Self:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(self.path))
        self.path.chmod(0o777)
        self._socket.settimeout(0.2)
        self._open = True
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._open = False
        self._thread.join()
        self._socket.close()
        self.path.unlink()

    def _listen(self) -> None:
        while self._open:
            try:
                text = self._socket.recv(65536).decode()
            except TimeoutError:
                continue
            now_s = time.monotonic()
            self.lines += [(now_s, line) for line in text.splitlines()]

    def since(self, began_s: float, line: str) -> int:
        """How often a line came since a time of the monotonic clock [s]."""
        return sum(1 for at_s, one in list(self.lines) if at_s >= began_s and one == line)

    def wait_for(self, line: str, timeout_s: float, *, began_s: float = 0.0) -> float:
        """Wait until a line has come; how long that took [s]."""
        asked_s = time.monotonic()
        while not self.since(began_s, line):
            if time.monotonic() - asked_s > timeout_s:
                raise TimeoutError(f"{line} did not come within {timeout_s} s: {self.lines[-5:]}")
            time.sleep(0.05)
        return time.monotonic() - asked_s
