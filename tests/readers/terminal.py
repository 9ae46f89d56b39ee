"""A terminal as a reader has it: an interactive bash behind a pseudo-terminal, and its screen."""

from __future__ import annotations

import codecs
import contextlib
import fcntl
import os
import pty
import re
import signal
import struct
import subprocess
import termios
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from palpate.process import Closing

ROWS, COLUMNS = 40, 120
_DONE = re.compile(r"\x1e(\d+)\x1e")
"""The prompt: exit code of the last command."""
_ANSI = re.compile(
    r"\x1b(?:\[[0-9;?]*[ -/]*[@-~]|\][^\x07\x1b]*(?:\x07|\x1b\\)|[()][A-Z0-9]|[=>78])"
)
_PIECE = re.compile(rf"{_ANSI.pattern}|\n|\r|[^\x1b\r\n]+")
_UP = re.compile(r"\x1b\[(\d*)A")
_ASKS = re.compile(r"(?:: |\]: ?|\? )$")
"""How a line ends that waits for an answer."""
_LOOK_S = 0.05
_PATIENCE_S = 60.0
_QUIET_S = 1.0
"""So long nothing more comes when a program waits for an answer."""


class Unexpected(AssertionError):
    """A command did not do what its page says."""


def plain(shown: str) -> str:
    """Text as it stands on the screen in the end: no colours, no lines that were drawn over."""
    lines, row = [""], 0
    for piece in _PIECE.findall(_DONE.sub("", shown)):
        if piece == "\n":
            row += 1
            lines += [""] * (row + 1 - len(lines))
        elif piece == "\r" or piece.endswith("\x1b[2K"):
            lines[row] = lines[row] + "\r"  # what comes now is written over it
        elif up := _UP.fullmatch(piece):
            row = max(0, row - int(up[1] or 1))
        elif not piece.startswith("\x1b"):
            lines[row] = (lines[row] if not lines[row].endswith("\r") else "") + piece
    return "\n".join(line.rstrip("\r").rstrip() for line in lines)


class Network:
    """A network of its own, so that the ports of a page are free; needs root, else the host's.

    ``prefix`` is what a command line begins with to be in it.
    """

    def __init__(self) -> None:
        self.prefix: tuple[str, ...] = ()
        self._holder: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Network:
        if os.geteuid() == 0:
            setup = (
                "ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo && echo up && "
                "exec sleep infinity"
            )
            self._holder = subprocess.Popen(
                ["unshare", "--net", "sh", "-c", setup], stdout=subprocess.PIPE
            )
            assert self._holder.stdout is not None
            if self._holder.stdout.readline() != b"up\n":
                raise RuntimeError("no network of its own: unshare --net failed")
            self.prefix = ("nsenter", f"--net=/proc/{self._holder.pid}/ns/net")
        return self

    def __exit__(self, *_: object) -> None:
        if self._holder is not None:
            self._holder.kill()
            self._holder.wait()


class Terminal(Closing):
    """An interactive bash; its commands and all that they print are kept in ``shown``."""

    def __init__(
        self, folder: Path, environment: Mapping[str, str], prefix: Sequence[str] = ()
    ) -> None:
        command = [*prefix, "bash", "--noprofile", "--norc", "--noediting", "-i"]
        self.shown = ""
        self._read = 0
        self._closed = False
        variables = {
            **environment,
            "PS1": "$ ",
            "TERM": "xterm-256color",
            "PROMPT_COMMAND": r'printf "\036%d\036" "$?"',
        }
        self.pid, self._master = pty.fork()
        if self.pid == 0:
            os.chdir(folder)
            os.execvpe(command[0], command, variables)
        fcntl.ioctl(self._master, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        self._reader = threading.Thread(target=self._follow, daemon=True)
        self._reader.start()
        self._until_prompt(60.0)

    def _follow(self) -> None:
        decoder = codecs.getincrementaldecoder("utf-8")("replace")
        while True:
            try:
                came = os.read(self._master, 65536)
            except OSError:
                return
            if not came:
                return
            self.shown += decoder.decode(came)

    @property
    def folder(self) -> Path:
        """Where it is now."""
        return Path(os.readlink(f"/proc/{self.pid}/cwd"))

    def run(self, line: str, *, answers: Sequence[str] = (), timeout_s: float) -> tuple[int, str]:
        """Exit code and output of a command.

        Raises:
            Unexpected: It does not end in time, or asks what no answer is given to.
        """
        self._send(line)
        return self._until_prompt(timeout_s, answers)

    def start(self, line: str, until: str, *, answers: Sequence[str] = (), timeout_s: float) -> str:
        """Run a command that goes on, until it has printed a text.

        Raises:
            Unexpected: It ends before that, or does not print it in time.
        """
        self._send(line)
        left = list(answers)
        deadline = time.monotonic() + timeout_s
        while until not in plain(new := self.shown[self._read :]).partition("\n")[2]:
            if _DONE.search(new):
                raise Unexpected(f"$ {line}\nended\n{plain(new)}")
            self._answer(left)
            self._wait(deadline, line)
        if left:
            raise Unexpected(f"$ {line}\nnever asked for {left}\n{plain(new)}")
        return plain(new)

    def interrupt(self, timeout_s: float) -> tuple[int, str]:
        """Ctrl-C; exit code of what ran, and what it still said."""
        self._read = len(self.shown)
        os.write(self._master, b"\x03")
        return self._until_prompt(timeout_s)

    def close(self) -> None:
        """Ctrl-C for what runs in it, and close the window; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(Unexpected, OSError):
            self.interrupt(_PATIENCE_S)
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGHUP)
        until = time.monotonic() + _PATIENCE_S
        while not os.waitpid(self.pid, os.WNOHANG)[0]:
            if time.monotonic() > until:
                os.kill(self.pid, signal.SIGKILL)
            time.sleep(_LOOK_S)
        os.close(self._master)  # what is still there is hung up by the kernel

    def _send(self, line: str) -> None:
        self._read = len(self.shown)
        os.write(self._master, line.encode() + b"\n")

    def _wait(self, deadline: float, line: str) -> None:
        if time.monotonic() > deadline:
            raise Unexpected(f"{line}: not in time\n{plain(self.shown[self._read :])}")
        time.sleep(_LOOK_S)

    def _until_prompt(self, timeout_s: float, answers: Sequence[str] = ()) -> tuple[int, str]:
        left = list(answers)
        deadline = time.monotonic() + timeout_s
        while (done := _DONE.search(self.shown, self._read)) is None:
            self._answer(left)
            self._wait(deadline, "the command")
        said = plain(self.shown[self._read : done.start()])
        if left:
            raise Unexpected(f"never asked for {left}\n{said}")
        return int(done[1]), said

    def _answer(self, left: list[str]) -> None:
        """Type the next answer if the program waits for one."""
        length = len(self.shown)
        if not _ASKS.search(_ANSI.sub("", self.shown[self._read :])):
            return
        time.sleep(_QUIET_S)
        if len(self.shown) != length or _DONE.search(self.shown, self._read):
            return
        if not left:
            said = plain(self.shown[self._read :])
            raise Unexpected(f"it asks, and the page does not say what to answer\n{said}")
        answer = left.pop(0)
        os.write(self._master, answer.encode() + b"\n")
        while len(self.shown) == length:
            time.sleep(_LOOK_S)
