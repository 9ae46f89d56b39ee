"""A Weiss Robotics KMS 40 in software: lines of text over TCP (hardware reference 3.1).

Where the page says "echo", the reply is ``NAME=value``, and ``NAME()`` asks for the setting: the
source RL of the reference reads them so.
"""

from __future__ import annotations

import contextlib
import random
import re
import select
import socket
import struct
from typing import ClassVar

import numpy as np

from palpate_gateway.emulators import FAULTS
from palpate_gateway.emulators.emulator import (
    Emulator,
    SampleTicker,
    WrenchSource,
    set_lead,
    slow_press,
)

_CALL = re.compile(r"([A-Z][A-Z0-9]*)\((.*)\)")
_AT_ONCE = 4096
_LONGEST_LINE = 1024

_UNKNOWN_COMMAND, _FORMAT, _UNEXPECTED, _TOO_FEW, _INVALID = 14, 15, 12, 13, 24
_ALREADY_RUNNING = 4

_CALIBRATED, _STABLE, _TARE_ON, _FILTER_ON, _RUNNING = 0, 1, 2, 3, 4
_OVERRANGE, _CALIBRATION_FAULT = 20, 26

_RANGE = np.array([120.0] * 3 + [3.0] * 3)
"""Measuring range [N] and [N m]."""


class Kms40Emulator(Emulator):
    """Serves one client at a time; as in the device, settings outlive a connection.

    Faults:

    * ``cut``: each line lacks its second half and its line end; ``junk``: noise before each line;
    * ``lost``: lines are missing; ``repeated``: each comes twice;
    * ``nan``: the values are not numbers; ``stuck``: they repeat the load from its begin;
    * ``silence``: neither samples nor answers come; ``stopped``: it stops streaming until a
      request;
    * ``restart``: the connection is reset, and all settings return to their defaults;
    * ``unplug``: no device is at its address;
    * ``overload``, ``error``: a flag is set, for the range of Fz or for a fault of the calibration;
    * ``clock_drift``: its clock, and with it the sampling, runs at another speed.

    Args:
        stamped: Whether data lines end with the device's time.
    """

    faults: ClassVar = FAULTS["kms40"]

    def __init__(
        self,
        source: WrenchSource = slow_press,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        serial: int = 310042,
        stamped: bool = True,
        drift_ppm: float = 200.0,
    ) -> None:
        super().__init__(rate_hz=500.0)
        self._source, self._serial, self._stamped = source, serial, stamped
        self._host, self._port, self._drift = host, port, drift_ppm * 1e-6
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None
        self._incoming = b""
        self._random = random.Random(1)
        self._ticks = 0
        self._power_up()

    @property
    def address(self) -> str:
        """``host:port``."""
        return f"{self._host}:{self._port}"

    @property
    def divider(self) -> int:
        """Every n-th sample is sent."""
        return self._settings["LDIV"][0]

    def _power_up(self) -> None:
        self.streaming = False
        self._settings = {"VL": [1], "LDIV": [1], "FLT": [0], "TARE": [0], "LMASK": [1] * 6}
        self._tare: np.ndarray | None = None

    def _listen(self) -> None:
        self._server = socket.create_server((self._host, self._port))
        self._server.setblocking(False)
        self._port = self._server.getsockname()[1]

    def _hang_up(self) -> None:
        self._drop_client()
        if self._server is not None:
            self._server.close()
            self._server = None

    def _drop_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
        self._incoming = b""

    def _serve(self) -> None:
        ticker = SampleTicker(self.rate_hz, self._stop)
        while not self._stop.is_set():
            ticker.fast = self._drift if self.faulty("clock_drift") else 0.0
            due_s = ticker.wait()
            self._ticks += 1
            set_lead(self._source, due_s - self._ticks / self.rate_hz)
            if self.faulty("restart"):
                self._restart()
            if self.faulty("unplug"):
                self._hang_up()
                continue
            if self._server is None:
                self._listen()
            if self.faulty("stopped"):
                self.streaming = False
            with contextlib.suppress(OSError):  # A lost client is noticed at the next tick.
                self._serve_client()

    def _restart(self) -> None:
        """Lose power: reset the connection and forget all settings."""
        if self._client is not None:
            # Linger time 0 makes close() send RST instead of FIN, as after a loss of power.
            self._client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._power_up()
        self._drop_client()

    def _serve_client(self) -> None:
        if self._client is None:
            self._accept()
        if self._client is None:
            return
        try:
            self._take_requests(self._client)
            if self._client is not None and self.streaming and self._ticks % self.divider == 0:
                self._stream(self._client)
        except OSError:
            self._drop_client()
            raise

    def _accept(self) -> None:
        assert self._server is not None
        with contextlib.suppress(BlockingIOError):
            self._client, _ = self._server.accept()
            self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._client.settimeout(1.0)

    def _take_requests(self, client: socket.socket) -> None:
        if not select.select([client], [], [], 0.0)[0]:
            return
        data = client.recv(_AT_ONCE)
        if not data:
            self._drop_client()
            return
        if self.faulty("silence"):
            return
        *lines, self._incoming = (self._incoming + data).split(b"\n")
        self._incoming = self._incoming[-_LONGEST_LINE:]
        for line in lines:
            client.sendall(self.answer(line.decode("latin-1").strip()).encode("ascii") + b"\n")

    def _stream(self, client: socket.socket) -> None:
        if self.faulty("silence") or self.faulty("lost"):
            return
        line = self._data_line().encode("ascii")
        if self.faulty("cut"):
            client.sendall(line[: len(line) // 2])
            return
        if self.faulty("junk"):
            client.sendall(self._random.randbytes(self._random.randint(1, 60)))
        if self.faulty("nan"):
            client.sendall(b"F={nan,nan,nan,nan,nan,nan}\n")
            return
        client.sendall(line + b"\n")
        self.sent += 1
        if self.faulty("repeated"):
            client.sendall(line + b"\n")

    def answer(self, line: str) -> str:
        """The reply to one request, both without line ends."""
        call = _CALL.fullmatch(line)
        if call is None:
            return _error(_FORMAT)
        name, inside = call[1], call[2].strip()
        if inside.startswith("{") and inside.endswith("}"):
            inside = inside[1:-1]
        arguments = [part.strip() for part in inside.split(",")] if inside else []
        if name in self._settings:
            return self._set(name, arguments)
        if arguments:
            return _error(_UNEXPECTED)
        return self._ask(name)

    def _ask(self, name: str) -> str:
        if name in ("L0", "L1"):
            self.streaming = name == "L1"
            return name
        if name == "F":
            return self._data_line()
        values = {
            "ID": '"KMS 40"',
            "SN": str(self._serial),
            "V": '"1.2.0"',
            "CALDATE": "1406851200,31536000",
            "CALMATRIX": "{" + ",".join(str(int(k % 7 == 0)) for k in range(36)) + "}",
            "T": "31.5",
            "FLAGS": str(self._flags()),
        }
        return f"{name}={values[name]}" if name in values else _error(_UNKNOWN_COMMAND)

    def _set(self, name: str, arguments: list[str]) -> str:
        try:
            numbers = [int(part) for part in arguments]
        except ValueError:
            return _error(_FORMAT)
        size = 6 if name == "LMASK" else 1
        if 0 < len(numbers) < size:
            return _error(_TOO_FEW)
        most, least = 1 if name in ("LMASK", "TARE") else 255, int(name == "LDIV")
        if len(numbers) > size or not all(least <= n <= most for n in numbers):
            return _error(_INVALID)
        if name == "TARE" and numbers:
            # The page advises to stop the stream first; this emulator requires it.
            if self.streaming:
                return _error(_ALREADY_RUNNING)
            self._tare = self._load() if numbers[0] else None
        if numbers:
            self._settings[name] = numbers
        values = ",".join(map(str, self._settings[name]))
        return f"{name}={{{values}}}" if name == "LMASK" else f"{name}={values}"

    def _load(self) -> np.ndarray:
        return np.asarray(self._source(self.held(self._ticks / self.rate_hz)), np.float64)

    def _data_line(self) -> str:
        values = self._load() - (0.0 if self._tare is None else self._tare)
        chosen = [
            f"{value:.4f}" for value, on in zip(values, self._settings["LMASK"], strict=True) if on
        ]
        stamp = f",{self._ticks * 2}" if self._stamped else ""
        return "F={" + ",".join(chosen) + "}" + stamp

    def _flags(self) -> int:
        bits = {_CALIBRATED, _STABLE}
        if self._tare is not None:
            bits.add(_TARE_ON)
        if self._settings["FLT"] != [0]:
            bits.add(_FILTER_ON)
        if self.streaming:
            bits.add(_RUNNING)
        bits.update(int(axis) + _OVERRANGE for axis in np.flatnonzero(abs(self._load()) > _RANGE))
        if self.faulty("overload"):
            bits.add(_OVERRANGE + 2)
        if self.faulty("error"):
            bits = bits - {_CALIBRATED} | {_CALIBRATION_FAULT}
        return sum(1 << bit for bit in bits)


def _error(code: int) -> str:
    return f"ERROR({code})"
