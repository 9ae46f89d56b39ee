"""Batches of datagrams from a socket, and CAN frames in them."""

from __future__ import annotations

import os
import select
import socket
import struct
import time
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.gateway.ports.can_frames import (
    BUS_OFF,
    NOTHING,
    CanFrame,
    FrameKind,
    from_socketcan,
    multicast_reader,
)
from palpate.gateway.ports.datagrams import BATCH, NO_STAMP, Datagrams, available

pytestmark = pytest.mark.skipif(not available(), reason="needs 64-bit Linux")


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, Datagrams]]:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    datagrams = Datagrams(far.fileno())
    far.close()  # the other end lives on in ``datagrams``
    yield near, datagrams
    datagrams.close()
    near.close()


def udp_pair() -> tuple[socket.socket, socket.socket]:
    far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    far.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    far.bind(("127.0.0.1", 0))
    near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    near.connect(far.getsockname())
    return near, far


def test_what_waits_comes_at_once_and_in_order(pair: tuple[socket.socket, Datagrams]) -> None:
    near, datagrams = pair
    sent = [bytes([k]) * k for k in range(10)]
    for one in sent:
        near.send(one)
    assert datagrams.take()[0] == sent
    got, stamps_ns = datagrams.take()
    assert (got, len(stamps_ns)) == ([], 0)


def test_more_than_a_batch_comes_in_two() -> None:
    near, far = udp_pair()
    with near, far:
        datagrams = Datagrams(far.fileno())
        for k in range(BATCH + 7):
            near.send(struct.pack("<H", k))
        first, rest = datagrams.take()[0], datagrams.take()[0]
        assert (len(first), len(rest)) == (BATCH, 7)
        assert [struct.unpack("<H", one)[0] for one in first + rest] == list(range(BATCH + 7))
        datagrams.close()


def test_the_kernel_says_when_each_came() -> None:
    near, far = udp_pair()
    with near, far:
        datagrams = Datagrams(far.fileno())
        before_ns = time.time_ns()
        near.send(b"1")
        time.sleep(0.02)
        near.send(b"2")
        after_ns = time.time_ns()
        time.sleep(0.02)
        _, stamps_ns = datagrams.take()
        datagrams.close()
    first_ns, second_ns = stamps_ns.tolist()
    assert before_ns <= first_ns <= second_ns - 20_000_000
    assert second_ns <= after_ns


def test_without_a_stamp(pair: tuple[socket.socket, Datagrams]) -> None:
    near, datagrams = pair
    near.send(b"1")
    _, stamps_ns = datagrams.take()
    # Local sockets may or may not be stamped: never anything but a stamp or none.
    assert stamps_ns[0] == NO_STAMP or abs(stamps_ns[0] - time.time_ns()) < 10_000_000_000


def test_what_is_too_large_is_not_cut_but_empty(pair: tuple[socket.socket, Datagrams]) -> None:
    near, datagrams = pair
    for one in (b"before", bytes(513), b"after"):
        near.send(one)
    got, stamps_ns = datagrams.take()
    assert (got, len(stamps_ns)) == ([b"before", b"", b"after"], 3)


def test_the_socket_of_the_other_is_not_closed() -> None:
    near, far = udp_pair()
    with near, far:
        datagrams = Datagrams(far.fileno())
        datagrams.close()
        datagrams.close()
        near.send(b"still there")
        assert far.recv(100) == b"still there"


def test_a_socket_that_is_gone_is_told(pair: tuple[socket.socket, Datagrams]) -> None:
    _, datagrams = pair
    datagrams.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        datagrams.take()
    with pytest.raises(OSError, match="Bad file descriptor"):
        Datagrams(os.open(os.devnull, os.O_RDONLY) + 1000)


def test_it_can_be_waited_for(pair: tuple[socket.socket, Datagrams]) -> None:
    near, datagrams = pair
    assert not select.select([datagrams], [], [], 0.0)[0]
    near.send(b"1")
    assert select.select([datagrams], [], [], 1.0)[0]


@pytest.mark.parametrize(
    ("raw", "frame"),
    [
        # struct can_frame: identifier and flags, size, three bytes of padding, data.
        ("01000000 07 000000 A27FC17FC17FC100", (FrameKind.DATA, 1, "A27FC17FC17FC1")),
        ("FF070000 00 000000 0000000000000000", (FrameKind.DATA, 0x7FF, "")),
        ("23010080 08 000000 0102030405060708", (FrameKind.DATA, 0x123, "0102030405060708")),
        ("40000020 08 000000 0000000000000000", (FrameKind.ERROR, BUS_OFF, "00" * 8)),
        ("01000040 02 000000 0000000000000000", None),  # remote
        ("01000000 09 000000 0000000000000000", None),  # no such size
        ("01000000", None),
        ("00" * 72, None),  # CAN FD
    ],
)
def test_frames_of_linux(raw: str, frame: tuple[FrameKind, int, str] | None) -> None:
    told = from_socketcan(bytes.fromhex(raw))
    wanted = NOTHING if frame is None else CanFrame(frame[0], frame[1], bytes.fromhex(frame[2]))
    assert told == wanted


@given(st.binary(max_size=80))
def test_any_bytes_are_a_frame_or_none(raw: bytes) -> None:
    for reader in (from_socketcan, multicast_reader()):
        frame = reader(raw)
        assert frame.kind is not FrameKind.DATA or len(frame.data) <= 8
