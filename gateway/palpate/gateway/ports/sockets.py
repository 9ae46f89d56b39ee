"""Devices on the network: a TCP stream, and datagrams over UDP."""

from __future__ import annotations

import contextlib
import select
import socket
from abc import abstractmethod

from palpate.gateway.ports.port import Port, silent
from palpate.protos.errors import DeviceError, DeviceLost

CONNECT_S = 2.0
"""How long a device may take to accept a connection [s]."""

_AT_ONCE = 65536
_RECEIVE_BUFFER = 1 << 20
"""Datagrams of a second at 7 kHz fit: a pause of this process must not lose any."""


class _SocketPort(Port):
    """What both kinds share."""

    def __init__(self, host: str, port: int) -> None:
        self.name = f"{host}:{port}"
        self._address = (host, port)
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """See ``Port``."""
        if self._socket is None:
            try:
                self._socket = self._connect()
            except OSError as error:
                raise DeviceError(
                    f"{self.name}: no connection: {error}",
                    remedy="check address, port, cable and that the device has power; it serves "
                    "one client at a time",
                ) from error

    @abstractmethod
    def _connect(self) -> socket.socket: ...

    def close(self) -> None:
        """See ``Port``."""
        link, self._socket = self._socket, None
        if link is not None:
            with contextlib.suppress(OSError):
                link.close()

    def read(self, timeout_s: float) -> bytes:
        """See ``Port``; of UDP one datagram."""
        link = self._opened()
        try:
            ready, _, _ = select.select([link], [], [], timeout_s)
            if not ready:
                raise silent(self.name, timeout_s)
            data = link.recv(_AT_ONCE)
        except DeviceError:
            raise
        except (OSError, ValueError) as error:
            raise self._lost(str(error)) from error
        if not data and link.type == socket.SOCK_STREAM:
            raise self._lost("the device closed the connection")
        return data

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
            remedy="check its cable and power; it is opened again by itself",
        )


class TcpPort(_SocketPort):
    """A TCP connection to a device."""

    def _connect(self) -> socket.socket:
        link = socket.create_connection(self._address, timeout=CONNECT_S)
        link.settimeout(CONNECT_S)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # A device whose power is cut never closes its connection; the kernel asks after it.
        link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        return link


class UdpPort(_SocketPort):
    """Datagrams to and from one device; those of others are not seen."""

    def _connect(self) -> socket.socket:
        link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            link.connect(self._address)
        except OSError:
            link.close()
            raise
        return link
