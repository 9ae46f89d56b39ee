"""Devices on the network: a TCP stream, datagrams over UDP, and a page of a device's web server.

Times of arrival come from the kernel: this process may have been asleep or busy.
"""

from __future__ import annotations

import contextlib
import http.client
import select
import socket
import struct
import sys
import time
import urllib.request
from abc import abstractmethod
from functools import partial
from typing import Any, NamedTuple

from palpate.errors import DeviceError, DeviceLost
from palpate_gateway.clock.wall_clock import KernelStamps
from palpate_gateway.ports.port import Port, silent

CONNECT_S = 0.5
"""Longest time to connect [s]. The system repeats an unanswered request only after a second; a new
attempt is faster when the device is switched on."""

_WRITE_S = 2.0

_AT_ONCE = 65536
_RECEIVE_BUFFER = 1 << 20
"""Holds the datagrams of a second at 7 kHz, so that a pause of this process loses none."""

_STAMP = getattr(socket, "SO_TIMESTAMPNS", 35)
"""Option by which Linux adds the wall time of reception; also the type of that control message."""
_TIMESPEC = struct.Struct("@ll")
_STAMP_SPACE = 64

_PAGE_REMEDY = "open this address in a browser: check address, cable and that the device has power"


_STAMPING_S = 0.2
"""Longest wait for the kernel to stamp at arrival [s]; a few milliseconds as a rule."""

_PROBE_S = 1e-3


class ReceivedBytes(NamedTuple):
    """Bytes, and when the last of them arrived, by the host's monotonic clock [ns]."""

    data: bytes
    arrival_ns: int


class _SocketPort(Port):
    """TCP and UDP alike: opening, reading with the time of arrival, writing."""

    def __init__(self, host: str, port: int) -> None:
        self.name = f"{host}:{port}"
        self._address = (host, port)
        self._socket: socket.socket | None = None
        self._stamps: KernelStamps | None = None

    def open(self) -> None:
        """See ``Port``."""
        if self._socket is None:
            try:
                self._socket = self._connect()
                self._ask_for_stamps(self._socket)
            except OSError as error:
                raise DeviceError(
                    f"{self.name}: no connection: {error}",
                    remedy="check address, port, cable and that the device has power; it serves "
                    "one client at a time",
                ) from error

    @abstractmethod
    def _connect(self) -> socket.socket: ...

    def _ask_for_stamps(self, link: socket.socket) -> None:
        self._stamps = None
        if sys.platform.startswith("linux"):
            with contextlib.suppress(OSError):
                link.setsockopt(socket.SOL_SOCKET, _STAMP, 1)
                _wait_for_stamping()
                self._stamps = KernelStamps()

    def close(self) -> None:
        """See ``Port``."""
        link, self._socket = self._socket, None
        if link is not None:
            with contextlib.suppress(OSError):
                link.close()

    def read(self, timeout_s: float) -> bytes:
        """See ``Port``; of UDP one datagram."""
        return self.receive(timeout_s).data

    def receive(self, timeout_s: float) -> ReceivedBytes:
        """As ``read``, with the time of arrival."""
        link = self._opened()
        try:
            ready, _, _ = select.select([link], [], [], timeout_s)
            if not ready:
                raise silent(self.name, timeout_s)
            received = self._take(link)
        except DeviceError:
            raise
        except (OSError, ValueError) as error:
            raise self._lost(str(error)) from error
        if not received.data and link.type == socket.SOCK_STREAM:
            raise self._lost("the device closed the connection")
        return received

    def _take(self, link: socket.socket) -> ReceivedBytes:
        if self._stamps is None:
            return ReceivedBytes(link.recv(_AT_ONCE), time.monotonic_ns())
        data, extras, _, _ = link.recvmsg(_AT_ONCE, _STAMP_SPACE)
        arrival_ns = time.monotonic_ns()
        for level, kind, value in extras:
            if level == socket.SOL_SOCKET and kind == _STAMP and len(value) == _TIMESPEC.size:
                seconds, rest_ns = _TIMESPEC.unpack(value)
                stamp_ns = seconds * 1_000_000_000 + rest_ns
                return ReceivedBytes(data, self._stamps.monotonic_of_ns(stamp_ns, arrival_ns))
        return ReceivedBytes(data, arrival_ns)

    def write(self, data: bytes) -> None:
        """See ``Port``."""
        link = self._opened()
        try:
            link.sendall(data)
        except OSError as error:
            raise self._lost(str(error)) from error

    def _opened(self) -> socket.socket:
        if self._socket is None:
            raise DeviceError(f"{self.name} is not open", remedy="call open() first")
        return self._socket

    def _lost(self, why: str) -> DeviceLost:
        return DeviceLost(
            f"{self.name} is gone: {why}",
            remedy="check its address, cable and power; it is opened again by itself",
        )


def _wait_for_stamping() -> None:
    """Wait until the kernel stamps datagrams when they arrive.

    It switches stamping on a little after the first socket of the host has asked for it. Until then
    it stamps when a datagram is read, so that an early one may bear a later time than its
    successor. A datagram that this function sends to itself shows which of both holds.
    """
    until_s = time.monotonic() + _STAMPING_S
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, _STAMP, 1)
        probe.bind(("127.0.0.1", 0))
        probe.connect(probe.getsockname())
        probe.settimeout(_STAMPING_S)
        while time.monotonic() < until_s:
            probe.send(b"?")
            time.sleep(_PROBE_S)
            read_ns = time.time_ns()
            _, extras, _, _ = probe.recvmsg(1, _STAMP_SPACE)
            stamps = [_TIMESPEC.unpack(value) for _, kind, value in extras if kind == _STAMP]
            if stamps and 1_000_000_000 * stamps[0][0] + stamps[0][1] < read_ns:
                return


class TcpPort(_SocketPort):
    """A TCP connection to a device."""

    def _connect(self) -> socket.socket:
        link = socket.create_connection(self._address, timeout=CONNECT_S)
        link.settimeout(_WRITE_S)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return link


class UdpPort(_SocketPort):
    """Datagrams to and from one device; the system drops those of others."""

    def _connect(self) -> socket.socket:
        link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            link.connect(self._address)
        except OSError:
            link.close()
            raise
        return link


class _Deadline(socket.socket):
    """A connection whose reads all end at one time: a timeout begins anew with every byte."""

    until = 0.0

    def recv_into(self, *args: Any, **kwargs: Any) -> int:
        left_s = self.until - time.monotonic()
        if left_s <= 0.0:  # 0 would mean not to block
            raise TimeoutError("timed out")
        self.settimeout(left_s)
        return super().recv_into(*args, **kwargs)


class _PageConnection(http.client.HTTPConnection):
    def __init__(self, *args: Any, until: float, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._until = until

    def connect(self) -> None:
        super().connect()
        self.sock = _Deadline(fileno=self.sock.detach())
        self.sock.until = self._until


class _PageHandler(urllib.request.HTTPHandler):
    def __init__(self, until: float) -> None:
        super().__init__()
        self._until = until

    def http_open(self, req: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(partial(_PageConnection, until=self._until), req)


def read_page(url: str, *, timeout_s: float, most_bytes: int) -> bytes:
    """The content of a page.

    Args:
        url: Its address.
        timeout_s: Longest time to connect, and longest time for all of it [s].
        most_bytes: A longer page is refused.

    Raises:
        DeviceError: There is no such page, or it is too long, or takes too long.
    """
    until = time.monotonic() + timeout_s
    # No proxy: a sensor is in the local network.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), _PageHandler(until))
    page = bytearray()
    try:
        with opener.open(url, timeout=timeout_s) as reply:
            while piece := reply.read1(_AT_ONCE):
                page += piece
                if len(page) > most_bytes:
                    raise DeviceError(
                        f"{url}: more than {most_bytes} bytes",
                        remedy="this is no sensor's page; check the address",
                    )
    except DeviceError:
        raise
    except TimeoutError as error:
        raise DeviceError(f"{url}: not read within {timeout_s:g} s", remedy=_PAGE_REMEDY) from error
    except (OSError, ValueError, http.client.HTTPException) as error:
        raise DeviceError(f"{url}: {error}", remedy=_PAGE_REMEDY) from error
    return bytes(page)
