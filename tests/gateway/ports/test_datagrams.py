"""Batches of datagrams from a socket, and CAN frames in them."""

from __future__ import annotations

import os
import select
import socket
import struct
import time
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate_gateway.ports.can_frames import (
    BUS_OFF,
    NOTHING,
    CanFrame,
    CanFrames,
    FrameKind,
    MulticastReader,
    from_socketcan,
)
from palpate_gateway.ports.datagrams import (
    BATCH,
    LARGEST,
    NO_STAMP,
    DatagramBatch,
    Datagrams,
    available,
)

pytestmark = pytest.mark.skipif(not available(), reason="needs 64-bit Linux")


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, Datagrams]]:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    datagrams = Datagrams(far.fileno())
    far.close()  # the other end lives on in ``datagrams``
    yield near, datagrams
    datagrams.close()
    near.close()


def told(waiting: DatagramBatch) -> list[bytes]:
    rows = zip(waiting.data, waiting.size.tolist(), strict=True)
    return [row[:size].tobytes() for row, size in rows]


def waiting_of(*datagrams: bytes) -> DatagramBatch:
    data = np.zeros((len(datagrams), LARGEST), np.uint8)
    for row, one in zip(data, datagrams, strict=True):
        row[: len(one)] = np.frombuffer(one, np.uint8)
    sizes = np.array([len(one) for one in datagrams], np.uint32)
    return DatagramBatch(data, sizes, np.full(len(datagrams), NO_STAMP))


def rows(frames: CanFrames) -> list[CanFrame]:
    columns = frames.kind.tolist(), frames.can_id.tolist(), frames.size.tolist(), frames.data
    return [
        CanFrame(FrameKind(kind), can_id, data[:size].tobytes())
        for kind, can_id, size, data in zip(*columns, strict=True)
    ]


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
    assert told(datagrams.take()) == sent
    assert told(datagrams.take()) == []


def test_more_than_a_batch_comes_in_two() -> None:
    near, far = udp_pair()
    with near, far:
        datagrams = Datagrams(far.fileno())
        for k in range(BATCH + 7):
            near.send(struct.pack("<H", k))
        first, rest = told(datagrams.take()), told(datagrams.take())
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
        stamps_ns = datagrams.take().stamp_ns
        datagrams.close()
    first_ns, second_ns = stamps_ns.tolist()
    assert before_ns <= first_ns <= second_ns - 20_000_000
    assert second_ns <= after_ns


def test_without_a_stamp(pair: tuple[socket.socket, Datagrams]) -> None:
    near, datagrams = pair
    near.send(b"1")
    stamps_ns = datagrams.take().stamp_ns
    # Local sockets may or may not be stamped: never anything but a stamp or none.
    assert stamps_ns[0] == NO_STAMP or abs(stamps_ns[0] - time.time_ns()) < 10_000_000_000


def test_what_is_too_large_is_not_cut_but_empty(pair: tuple[socket.socket, Datagrams]) -> None:
    near, datagrams = pair
    for one in (b"before", bytes(513), b"after"):
        near.send(one)
    assert told(datagrams.take()) == [b"before", b"", b"after"]


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
        ("23010000 08 000000 0102030405060708", (FrameKind.DATA, 0x123, "0102030405060708")),
        ("40000020 08 000000 0000000000000000", (FrameKind.ERROR, BUS_OFF, "00" * 8)),
        ("400000A0 08 000000 0000000000000000", (FrameKind.ERROR, BUS_OFF, "00" * 8)),
        ("02000080 08 000000 0102030405060708", None),  # a 29-bit identifier, the same as good's
        ("01000040 02 000000 0000000000000000", None),  # remote
        ("01000000 09 000000 0000000000000000", None),  # no such size
        ("01000000", None),
        ("00" * 72, None),  # CAN FD
    ],
)
def test_frames_of_linux(raw: str, frame: tuple[FrameKind, int, str] | None) -> None:
    good = bytes.fromhex("02000000 01 000000 5500000000000000")
    frames = rows(from_socketcan(waiting_of(good, bytes.fromhex(raw), good)))
    wanted = NOTHING if frame is None else CanFrame(frame[0], frame[1], bytes.fromhex(frame[2]))
    assert frames[0] == frames[2] == CanFrame(FrameKind.DATA, 2, b"\x55")
    assert frames[1].kind is wanted.kind
    if wanted.kind is not FrameKind.OTHER:
        assert frames[1] == wanted


@given(st.lists(st.binary(max_size=80), max_size=5))
def test_any_bytes_are_frames_or_none(raw: list[bytes]) -> None:
    for reader in (from_socketcan, MulticastReader()):
        assert len(rows(reader(waiting_of(*raw)))) == len(raw)


MESSAGES: st.SearchStrategy[dict[str, object]] = st.builds(
    dict,
    timestamp=st.floats(allow_nan=False),
    arbitration_id=st.sampled_from([1, 2, 0x7FF]),
    is_extended_id=st.sampled_from([False] * 9 + [True]),
    is_remote_frame=st.sampled_from([False] * 9 + [True]),
    is_error_frame=st.sampled_from([False] * 9 + [True]),
    # A name that holds what is searched for.
    channel=st.sampled_from([None, "can0", "\u00e9data\x04", b"\xa4data\xc4\x07" + bytes(7)]),
    dlc=st.integers(0, 8),
    data=st.one_of(st.binary(min_size=7, max_size=7), st.binary(max_size=8)),
    is_fd=st.sampled_from([False] * 9 + [True]),
)


@given(st.lists(st.lists(MESSAGES, max_size=6), max_size=4), st.binary(max_size=3))
def test_frames_like_the_last_are_read_as_if_each_were_unpacked(
    batches: list[list[dict[str, object]]], junk: bytes
) -> None:
    pack = pytest.importorskip("msgpack").packb
    learned = MulticastReader()
    for batch in batches:
        raw = [pack(message) for message in batch] + ([junk] if junk else [])
        alone = [rows(MulticastReader()(waiting_of(one)))[0] for one in raw]
        for frame, message in zip(alone, batch, strict=False):
            special = ("is_error_frame", "is_remote_frame", "is_fd", "is_extended_id")
            plain = not any(message[one] for one in special)
            assert (frame.kind is FrameKind.DATA) == plain
            if plain:
                assert (frame.can_id, frame.data) == (message["arbitration_id"], message["data"])
        assert rows(learned(waiting_of(*raw))) == alone
