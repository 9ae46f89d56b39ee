"""A serial line over the network: TCP, and RFC 2217 by pyserial's own server."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from palpate.errors import DeviceLost, DeviceTimeout
from palpate_gateway.ports.serial_port import SerialPort

serial = pytest.importorskip("serial")
rfc2217 = pytest.importorskip("serial.rfc2217")

SENT = bytes(range(256)) * 2


class SerialServer:
    """The far end of a line.

    Args:
        scheme: ``socket`` or ``rfc2217``.
    """

    def __init__(self, scheme: str) -> None:
        self.taken = b""
        """Bytes that the client has sent."""
        self.asked = 0
        """Bytes of the client's requests and settings."""
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.name = f"{scheme}://127.0.0.1:{self._listener.getsockname()[1]}"
        self._plain = scheme == "socket"
        self._escape: Callable[[bytes], Iterator[bytes]] = lambda data: iter([data])
        self._client: socket.socket | None = None
        self._joined = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            client, _ = self._listener.accept()
            self._client = client
            taking: Callable[[bytes], Iterator[bytes]] = lambda data: iter([data])  # noqa: E731
            if not self._plain:
                manager = rfc2217.PortManager(serial.serial_for_url("loop://"), self)
                taking, self._escape = manager.filter, manager.escape
            self._joined.set()
            while data := client.recv(65536):
                taken = b"".join(taking(data))
                self.taken += taken
                self.asked += len(data) - len(taken)

    def write(self, data: bytes) -> None:
        """What the manager has to say."""
        assert self._client is not None
        self._client.sendall(data)

    def send(self, data: bytes) -> None:
        """As if the device had sent it."""
        assert self._joined.wait(10.0)
        self.write(b"".join(self._escape(data)))

    def wait_for(self, taken: bytes) -> None:
        """Until the client's bytes are these."""
        until = time.monotonic() + 10.0
        while self.taken != taken and time.monotonic() < until:
            time.sleep(1e-3)
        assert self.taken == taken

    def close(self) -> None:
        """The server is gone."""
        for end in (self._client, self._listener):
            if end is not None:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
                end.close()
        self._thread.join()


@pytest.fixture(params=["socket", "rfc2217"])
def server(request: pytest.FixtureRequest) -> Iterator[SerialServer]:
    made = SerialServer(request.param)
    yield made
    made.close()


def read_all(port: SerialPort, count: int) -> bytes:
    got = b""
    while len(got) < count:
        got += port.read(10.0)
    return got


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")
class TestSerialServers:
    def test_bytes_go_both_ways(self, server: SerialServer) -> None:
        with SerialPort(server.name, 230400) as port:
            server.send(SENT)
            assert read_all(port, len(SENT)) == SENT
            port.write(SENT)
            server.wait_for(SENT)

    def test_reading_and_waiting_ask_nothing_of_the_server(self, server: SerialServer) -> None:
        with SerialPort(server.name, 230400) as port:
            port.write(b"x")
            server.wait_for(b"x")
            before = server.asked
            for _ in range(3):
                with pytest.raises(DeviceTimeout, match=r"nothing came within 0\.02 s"):
                    port.read(0.02)
                server.send(b"abc")
                assert read_all(port, 3) == b"abc"
            port.write(b"y")
            server.wait_for(b"xy")
            assert server.asked == before

    def test_server_that_goes_is_told(self, server: SerialServer) -> None:
        with SerialPort(server.name, 230400) as port:
            server.send(b"x")
            assert read_all(port, 1) == b"x"
            server.close()
            with pytest.raises(DeviceLost, match="is gone"):
                port.read(10.0)


def test_all_that_waits_at_a_socket_is_one_read() -> None:
    server = SerialServer("socket")
    with SerialPort(server.name, 230400) as port:
        port.write(b"x")
        while not server.taken:
            pass
        server.send(SENT)
        assert port.read(10.0) == SENT
    server.close()
