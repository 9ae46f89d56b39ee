"""Sensors that speak RDT in software (hardware reference 3.2, 3.3).

ATI Net F/T, ATI Axia (Schunk FTN), OnRobot HEX. Requests and records are datagrams. The value of a
count is on a web page of the device, except for the HEX, whose scale is fixed.
"""

from __future__ import annotations

import contextlib
import random
import socket
import struct
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
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


@dataclass(frozen=True, slots=True)
class RdtProductTraits:
    """Differences between the products.

    Attributes:
        name: Name on its web page.
        rate_hz: Records each second by default [Hz].
        counter_hz: Rate of the internal counter [Hz].
        starts: Commands that start the stream.
        overload: Status bits of an exceeded range.
        error: Status bits of a sensor that cannot measure.
        has_page: Whether it has a web page.
    """

    name: str
    rate_hz: float
    counter_hz: float
    starts: tuple[int, ...]
    overload: int
    error: int
    has_page: bool = True


_ANY_ERROR = 1 << 31
_STOP, _START_ONE, _START, _START_MANY = 0x0000, 0x0001, 0x0002, 0x0003
_RESET_LATCH, _BIAS, _FILTER, _PERIOD = 0x0041, 0x0042, 0x0081, 0x0082
_HEADER = 0x1234
_REQUEST = struct.Struct(">HHI")
_RECORD = struct.Struct(">IIIiiiiii")
_MOST_REQUESTS = 64

_PRODUCTS = {
    "netft": RdtProductTraits(
        "Net F/T",
        rate_hz=1000.0,
        counter_hz=7000.0,
        starts=(_START, _START_MANY),
        overload=_ANY_ERROR | 1 << 17,
        error=_ANY_ERROR | 1 << 28,
    ),
    "axia": RdtProductTraits(
        "Ethernet Axia",
        rate_hz=1000.0,
        counter_hz=7912.0,
        starts=(_START_ONE, _START, _START_MANY),
        overload=_ANY_ERROR | 1 << 30,
        error=_ANY_ERROR | 1 << 2,
    ),
    "hex": RdtProductTraits(
        "HEX",
        rate_hz=100.0,
        counter_hz=1000.0,
        starts=(_START,),
        overload=1 << 6,
        error=1 << 10,
        has_page=False,
    ),
}

LATCHED = _ANY_ERROR | 1 << 16
"""Status of a Net F/T of which a threshold was passed once; the data is good."""


def page(product: str, counts_per: tuple[float, float], units: tuple[str, str]) -> bytes:
    """The device's web page, with the tags that the reference has."""
    tags = {
        "prodname": product,
        "cfgcpf": f"{counts_per[0]:.10g}",
        "cfgcpt": f"{counts_per[1]:.10g}",
        "scfgfu": units[0],
        "scfgtu": units[1],
    }
    inside = "\n".join(f"<{tag}>{value}</{tag}>" for tag, value in tags.items())
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<netft>\n{inside}\n</netft>\n'.encode()


class WebPage:
    """The web server of a device: one page at one path. Opened again, it keeps its port."""

    def __init__(self, host: str, port: int, path: str) -> None:
        self.port = port
        self.content: bytes | None = None
        """The page; None = there is no such page (404)."""
        self._host, self._path = host, path
        self._server: ThreadingHTTPServer | None = None

    def open(self) -> None:
        """Start to serve."""
        server = ThreadingHTTPServer((self._host, self.port), self._handler())
        self._server, self.port = server, server.server_address[1]
        threading.Thread(
            target=server.serve_forever, args=(0.02,), name=self._path, daemon=True
        ).start()

    def close(self) -> None:
        """Stop serving; a second call does nothing."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        page = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path != page._path or page.content is None:
                    self.send_error(404)
                    return
                self.send_response(200)
                self.send_header("Content-Type", "text/xml")
                self.end_headers()
                with contextlib.suppress(OSError):  # A reader with a size limit closes early.
                    self.wfile.write(page.content)

            def log_message(self, format: str, *args: object) -> None:
                """No access log."""

        return Handler


def record(rdt_sequence: int, ft_sequence: int, status: int, counts: Sequence[int]) -> bytes:
    """Bytes of one record."""
    return _RECORD.pack(
        rdt_sequence & 0xFFFFFFFF, ft_sequence & 0xFFFFFFFF, status & 0xFFFFFFFF, *counts
    )


class RdtEmulator(Emulator):
    """A sensor that streams to the client of the last start request.

    Faults:

    * ``lost``: records and their numbers are missing; ``repeated``: each datagram comes twice;
      ``late``: every other record is sent after the next one;
    * ``cut``: datagrams lack their second half; ``junk``: datagrams of odd lengths before them;
    * ``silence``: nothing comes, and requests are ignored; ``deaf``: requests are ignored;
    * ``restart``: the stream stops, zero and counter are reset;
    * ``unplug``: no device is at its address; the stream continues afterwards;
    * ``overload``, ``error``: bits of the status are set, for ``error`` with all loads zero;
      ``latched``: the status of a threshold that was passed, until it is reset;
    * ``stuck``: records repeat the load from its begin;
    * ``clock_drift``: the internal counter runs at another speed than the records.

    Args:
        product: ``netft``, ``axia`` or ``hex``.
        counter_hz: Rate of the internal counter; 0 = the product's.
        counts_per: Counts per force unit and per torque unit; the HEX has its own.
        units: Force and torque unit on the page, each with its value [N] and [N m].
        together: Records in a datagram when the start request asks for several.
        first_counter: The internal counter at power-up.
    """

    faults: ClassVar = FAULTS["rdt"]

    def __init__(
        self,
        product: str = "netft",
        source: WrenchSource = slow_press,
        *,
        rate_hz: float = 0.0,
        counter_hz: float = 0.0,
        host: str = "127.0.0.1",
        port: int = 0,
        http_port: int = 0,
        counts_per: tuple[float, float] = (1e6, 1e6),
        units: tuple[tuple[str, float], tuple[str, float]] = (("N", 1.0), ("Nm", 1.0)),
        together: int = 10,
        first_counter: int = 0,
        drift_ppm: float = 200.0,
    ) -> None:
        self._product = _PRODUCTS[product]
        super().__init__(rate_hz or self._product.rate_hz)
        self._counter_hz = counter_hz or self._product.counter_hz
        self._source, self._together, self._first_counter = source, together, first_counter
        self._host, self._port, self._drift = host, port, drift_ppm * 1e-6
        self.page = WebPage(host, http_port, "/netftapi2.xml")
        if self._product.has_page:
            self.page.content = page(self._product.name, counts_per, (units[0][0], units[1][0]))
            force, torque = counts_per[0] / units[0][1], counts_per[1] / units[1][1]
        else:
            force, torque = 10_000.0, 100_000.0
        self._counts_per_si = np.array([force] * 3 + [torque] * 3)
        self.requests: list[tuple[int, int]] = []
        """The last requests: command and count."""
        self._random = random.Random(1)
        self._first_rate_hz = self.rate_hz
        self._socket: socket.socket | None = None
        self._elapsed_s = 0.0
        self._power_up()

    @property
    def address(self) -> str:
        """``host:port`` for datagrams."""
        return f"{self._host}:{self._port}"

    def _power_up(self) -> None:
        self.filter = 4
        self._set_rate(self._first_rate_hz)
        self._counter_s = 0.0
        self._client: tuple[str, int] | None = None
        self._left: int | None = None
        self._at_once = 1
        self._sequence = 0
        self._bias = np.zeros(6)
        self._packet: list[bytes] = []
        self._held: bytes | None = None
        self._status = 0

    def _set_rate(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self._ticker = SampleTicker(rate_hz, self._stop)

    def _listen(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((self._host, self._port))
        self._socket.setblocking(False)
        self._port = self._socket.getsockname()[1]
        self.page.open()

    def _hang_up(self) -> None:
        self.page.close()
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _serve(self) -> None:
        self._set_rate(self.rate_hz)
        began_s = time.monotonic()
        while not self._stop.is_set():
            due_s = self._ticker.wait()
            step_s = 1.0 / self.rate_hz
            behind_s = time.monotonic() - began_s - self._elapsed_s
            if behind_s > 0.6:
                # This process was suspended; a device's clock would have continued.
                step_s = behind_s
            self._elapsed_s += step_s
            set_lead(self._source, due_s - self._elapsed_s)
            self._counter_s += step_s * (1.0 + self._drift * self.faulty("clock_drift"))
            if self.faulty("restart"):
                self._power_up()
            if self.faulty("unplug"):
                self._hang_up()
                continue
            if self._socket is None:
                self._listen()
            assert self._socket is not None
            with contextlib.suppress(OSError):  # E.g. the client's port is closed.
                self._take_requests(self._socket)
            with contextlib.suppress(OSError):
                self._stream(self._socket)

    def _take_requests(self, link: socket.socket) -> None:
        while True:
            data, client = link.recvfrom(2048)
            if self.faulty("deaf") or self.faulty("silence") or len(data) != _REQUEST.size:
                continue
            header, command, count = _REQUEST.unpack(data)
            if header == _HEADER:
                self.requests = [*self.requests, (command, count)][-_MOST_REQUESTS:]
                self._obey(command, count, client)

    def _obey(self, command: int, count: int, client: tuple[str, int]) -> None:
        if command in self._product.starts:
            self._client, self._left = client, count or None
            self._at_once = self._together if command == _START_MANY else 1
            self._sequence, self._packet, self._held = 0, [], None
        elif command == _STOP:
            self._client = None
        elif command == _BIAS:
            set_it = self._product.has_page or count == 0xFF
            self._bias = self._load() if set_it else np.zeros(6)
        elif command == _RESET_LATCH:
            self._status = 0
        elif not self._product.has_page and command == _FILTER and count <= 6:
            self.filter = count
        elif not self._product.has_page and command == _PERIOD and count <= 255:
            if count == 0:
                self._client = None
                return
            self._set_rate(1000.0 / count)

    def _stream(self, link: socket.socket) -> None:
        if self._client is None:
            return
        self._sequence += 1
        whole = self._record()
        if self._left is not None:
            self._left -= 1
        ends, client = self._left == 0, self._client
        if ends:
            self._client = None
        if self.faulty("silence") or self.faulty("lost"):
            return
        if self.faulty("junk"):
            link.sendto(self._random.randbytes(self._random.choice((1, 8, 35, 37, 100))), client)
        if self._held is None and not ends and self.faulty("late"):
            # Kept until the next record has been sent.
            self._held = whole
            return
        self._packet.append(whole)
        if len(self._packet) < self._at_once and not ends:
            return
        packet, self._packet = b"".join(self._packet), []
        if self.faulty("cut"):
            link.sendto(packet[: len(packet) // 2 - 1], client)
            return
        link.sendto(packet, client)
        self.sent += len(packet) // _RECORD.size
        if self.faulty("repeated"):
            link.sendto(packet, client)
        if self._held is not None:
            link.sendto(self._held, client)
            self.sent += 1
            self._held = None

    def _record(self) -> bytes:
        if self.faulty("latched"):
            self._status = LATCHED
        status, values = self._status, self._load() - self._bias
        if self.faulty("overload"):
            status |= self._product.overload
        if self.faulty("error"):
            # Without its transducer or its supply it measures nothing.
            status, values = status | self._product.error, np.zeros(6)
        counts = np.clip(np.rint(values * self._counts_per_si), -(2**31), 2**31 - 1)
        ticks = self._first_counter + round(self._counter_s * self._counter_hz)
        return record(self._sequence, ticks, status, [int(count) for count in counts])

    def _load(self) -> np.ndarray:
        return np.asarray(self._source(self.held(self._elapsed_s)), np.float64)
