"""TCP and UDP ports against servers on loopback."""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Iterator

import pytest

from palpate.errors import DeviceError, DeviceLost, DeviceTimeout
from palpate_gateway.ports.port import settle
from palpate_gateway.ports.sockets import TcpPort, UdpPort


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening


@pytest.fixture
def peer() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        yield bound


def test_a_stream_goes_both_ways_and_its_end_is_told(server: socket.socket) -> None:
    with TcpPort("127.0.0.1", server.getsockname()[1]) as port:
        device, _ = server.accept()
        with device:
            device.sendall(b"F={1}\n")
            assert port.read(1.0) == b"F={1}\n"
            port.write(b"L1()\n")
            assert device.recv(100) == b"L1()\n"
            with pytest.raises(DeviceTimeout):
                port.read(0.01)
        with pytest.raises(DeviceLost, match="the device closed the connection"):
            port.read(1.0)


def test_nobody_there_says_what_to_do(server: socket.socket) -> None:
    number = server.getsockname()[1]
    server.close()
    with pytest.raises(DeviceError, match=r"no connection.*-> check address, port, cable"):
        TcpPort("127.0.0.1", number).open()


def test_datagrams_stay_whole_and_strangers_are_not_heard(peer: socket.socket) -> None:
    with UdpPort("127.0.0.1", peer.getsockname()[1]) as port:
        port.write(b"start")
        data, host = peer.recvfrom(100)
        assert data == b"start"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(b"stranger", host)
        peer.sendto(b"one", host)
        peer.sendto(b"", host)
        peer.sendto(b"two", host)
        assert [port.read(1.0) for _ in range(3)] == [b"one", b"", b"two"]


def test_a_device_that_refuses_datagrams_is_lost(peer: socket.socket) -> None:
    number = peer.getsockname()[1]
    peer.close()
    with UdpPort("127.0.0.1", number) as port:
        port.write(b"start")
        with pytest.raises(DeviceLost, match="refused"):
            port.read(1.0)


def test_a_closed_port_says_so() -> None:
    port = UdpPort("127.0.0.1", 9)
    port.close()
    with pytest.raises(DeviceError, match="not open"):
        port.read(0.1)


def test_input_can_be_thrown_away(server: socket.socket) -> None:
    with TcpPort("127.0.0.1", server.getsockname()[1]) as port:
        device, _ = server.accept()
        with device:
            device.sendall(b"old data")
            assert port.read(1.0)[:1] == b"o"
            device.sendall(b"more")
            first = port.read(1.0)
            assert settle(port, quiet_s=0.0, longest_s=1.0) + len(first) == 4


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the kernel's stamps are Linux'")
def test_what_waited_has_the_time_at_which_the_kernel_received_it(
    peer: socket.socket, server: socket.socket
) -> None:
    with (
        UdpPort("127.0.0.1", peer.getsockname()[1]) as udp,
        TcpPort("127.0.0.1", server.getsockname()[1]) as tcp,
    ):
        udp.write(b"start")
        _, host = peer.recvfrom(100)
        device, _ = server.accept()
        with device:
            before_ns = time.monotonic_ns()
            peer.sendto(b"one", host)
            device.sendall(b"two")
            time.sleep(0.02)
            read_ns = time.monotonic_ns()
            for port, data in ((udp, b"one"), (tcp, b"two")):
                received = port.receive(1.0)
                assert received.data == data
                # Not more exactly than the two clocks can be read together.
                assert before_ns - 1e6 < received.arrival_ns < read_ns


def test_without_the_kernels_stamps_the_time_of_reading_counts(
    peer: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", "elsewhere")
    with UdpPort("127.0.0.1", peer.getsockname()[1]) as port:
        port.write(b"start")
        _, host = peer.recvfrom(100)
        peer.sendto(b"one", host)
        before_ns = time.monotonic_ns()
        received = port.receive(1.0)
        assert received.data == b"one"
        assert before_ns <= received.arrival_ns <= time.monotonic_ns()
