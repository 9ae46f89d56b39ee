"""Who may change what a station serves: whoever can read the station's admin token.

The token is a file that only the user of the station can read. A command carries a message
authentication code made with it, never the token itself, and a number that is used once and holds
for ``CLOCK_S``: a command that somebody has overheard is of no use (docs/adr/0020-models.md).
"""

from __future__ import annotations

import hashlib
import hmac
import math
import os
import secrets
import stat
import tempfile
import threading
import time
from pathlib import Path
from typing import NoReturn

from palpate.codec import MODEL_COMMAND
from palpate.codec.models import NONCE_BYTES
from palpate.errors import ConfigError, ErrorCode, RemoteError
from palpate.messages import ModelCommand, ModelRequest

TOKEN_BYTES = 32

CLOCK_S = 30.0
"""A command holds for so long before and after it was given, by the clock of the service [s]."""

_PURPOSE = b"palpate.v1.ModelRequest\0"
_NONCES_MOST = 1024
_REMEDY = "use the token of the station that runs: palpate model ... --token FILE"


def token_file(state: Path, station: str) -> Path:
    """Where the token of a station is kept."""
    return state / "stations" / station / "admin.token"


def make_token(path: Path) -> bytes:
    """The token in a file, which is made with a new one if absent.

    Raises:
        ConfigError: It cannot be made, or others may read it.
    """
    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            # Written aside and linked: of two processes that start at once, one makes the token.
            handle, aside = tempfile.mkstemp(prefix=".token.", dir=path.parent)  # mode 0600
            try:
                with open(handle, "w", encoding="ascii") as file:
                    file.write(secrets.token_hex(TOKEN_BYTES) + "\n")
                try:
                    os.link(aside, path)
                except FileExistsError:
                    pass
            finally:
                os.unlink(aside)
    except OSError as error:
        raise ConfigError(
            f"admin token {path} cannot be made: {error.strerror or error}",
            remedy="set [models] state to a folder that the station may write in",
        ) from error
    return read_token(path)


def read_token(path: Path) -> bytes:
    """The token in a file.

    Raises:
        ConfigError: There is none, or others than its owner may read or write it.
    """
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
            status = os.fstat(file.fileno())
            text = file.read(4 * TOKEN_BYTES) if stat.S_ISREG(status.st_mode) else b""
    except OSError as error:
        raise ConfigError(
            f"admin token {path} cannot be read: {error.strerror or error}",
            remedy="a station makes it when it starts; give commands as the user of the station",
        ) from error
    # Root may read every file, and is the operator of a station that has a user of its own.
    if status.st_mode & 0o077 or os.geteuid() not in (status.st_uid, 0):
        raise ConfigError(
            f"admin token {path} belongs to another user, or others may read or write it",
            remedy=f"as its owner: chmod 600 {path}, or remove it: the station makes a new one",
        )
    try:
        token = bytes.fromhex(text.decode("ascii").strip())
    except ValueError:
        token = b""
    if len(token) != TOKEN_BYTES:
        raise ConfigError(
            f"{path} is no admin token of {TOKEN_BYTES} bytes in hex",
            remedy="remove it and start the station again: it makes a new one",
        )
    return token


def new_nonce() -> bytes:
    """A number for one command."""
    return secrets.token_bytes(NONCE_BYTES)


def signed(command: ModelCommand, token: bytes) -> ModelRequest:
    """A command with the proof that its sender knows the token.

    Raises:
        WireError: The command breaks the contract.
    """
    payload = MODEL_COMMAND.encode(command)
    return ModelRequest(payload, _mac(payload, token))


def _mac(payload: bytes, token: bytes) -> bytes:
    return hmac.digest(token, _PURPOSE + payload, hashlib.sha256)


class CommandGuard:
    """Lets the commands to one process pass that are meant for it, proven, and new.

    ``token`` None = no command passes. Safe to use from several threads.
    """

    def __init__(self, token: bytes | None, *, station: str, service: str, instance: str) -> None:
        self._token = token
        self._station, self._service, self._instance = station, service, instance
        # Numbers of past commands are forgotten with the process: older commands do not pass. By
        # the monotonic clock: the wall clock may be set back by hours after a start. And by the
        # wall clock while it is set back by little: what was given before would be new again.
        self._began_ns = time.monotonic_ns()
        self._began_wall_ns = time.time_ns()
        self._used: dict[bytes, tuple[int, int]] = {}  # until when, by both clocks [ns]
        self._lock = threading.Lock()

    def admit(self, request: ModelRequest) -> ModelCommand:
        """The command of a request.

        Raises:
            RemoteError: It is refused: ``PERMISSION_DENIED`` says that the caller has not proved
                that it may give it, ``RESOURCE_EXHAUSTED`` that there were too many in a minute.
            WireError: The proof is right, and the command breaks the contract.
        """
        if self._token is None:
            _deny("this process takes no commands: it was started without an admin token")
        if not hmac.compare_digest(_mac(request.command, self._token), request.mac):
            _deny(f"the command is not signed with the admin token of station {self._station!r}")
        command = MODEL_COMMAND.decode(request.command)
        meant = (command.station, command.service, command.instance or self._instance)
        if meant != (self._station, self._service, self._instance):
            _deny(f"the command is for {'/'.join(meant)}, not for this process")
        now_ns = time.time_ns()
        age_s = (now_ns - command.wall_ns) * 1e-9
        began_ns = now_ns - (time.monotonic_ns() - self._began_ns)
        if self._began_wall_ns - now_ns <= CLOCK_S * 1e9:
            began_ns = max(began_ns, self._began_wall_ns)
        if abs(age_s) <= CLOCK_S and command.wall_ns < began_ns:
            wait_s = max(math.ceil((began_ns - now_ns) * 1e-9), 1)
            _deny(
                "the command was given before this process started, by this host's clock, which "
                "perhaps was set back",
                remedy=f"give it again in {wait_s} s",
            )
        if abs(age_s) > CLOCK_S:
            _deny(
                f"the command was given {age_s:.0f} s ago by this host's clock, it holds for "
                f"{CLOCK_S:g} s",
                remedy="give it again; if that does not help, set the clocks of both hosts",
            )
        self._use(command.nonce, now_ns)
        return command

    def _use(self, nonce: bytes, now_ns: int) -> None:
        steady_ns = time.monotonic_ns()
        with self._lock:
            if nonce in self._used:
                _deny("the command was already obeyed", remedy="give a new command")
            # By both: the wall clock may be set forward for a moment.
            for old, (until_ns, until_steady_ns) in list(self._used.items()):
                if until_ns < now_ns and until_steady_ns < steady_ns:
                    del self._used[old]
            if len(self._used) >= _NONCES_MOST:
                raise RemoteError(
                    f"{_NONCES_MOST} commands came within {2 * CLOCK_S:g} s",
                    remedy="give fewer commands",
                    code=ErrorCode.RESOURCE_EXHAUSTED,
                    retry_after_s=CLOCK_S,
                )
            # It could pass once more until its time is over on the latest clock that is accepted.
            holds_ns = round(2 * CLOCK_S * 1e9)
            self._used[nonce] = now_ns + holds_ns, steady_ns + holds_ns


def _deny(problem: str, *, remedy: str = _REMEDY) -> NoReturn:
    raise RemoteError(problem, remedy=remedy, code=ErrorCode.PERMISSION_DENIED)
