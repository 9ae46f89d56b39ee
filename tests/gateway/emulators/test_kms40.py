"""The KMS 40 in software answers as hardware reference 3.1 says."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import BinaryIO

import pytest

from palpate_gateway.emulators.kms40 import Kms40Emulator

WRENCH = (1.5, -0.25, 1.0, 0.02, -0.01, 0.005)
LINE = b"F={1.5000,-0.2500,1.0000,0.0200,-0.0100,0.0050}"


@contextmanager
def talk(emulator: Kms40Emulator) -> Iterator[tuple[socket.socket, BinaryIO]]:
    """A connection and its lines."""
    host, _, port = emulator.address.partition(":")
    with (
        socket.create_connection((host, int(port)), timeout=10.0) as link,
        link.makefile("rb") as lines,
    ):
        yield link, lines


@pytest.fixture
def emulator() -> Iterator[Kms40Emulator]:
    with Kms40Emulator(lambda t: WRENCH) as running:
        yield running


@pytest.mark.parametrize(
    ("request_line", "reply"),
    [
        ("ID()", 'ID="KMS 40"'),
        ("SN()", "SN=310042"),
        ("V()", 'V="1.2.0"'),
        ("VL(0)", "VL=0"),
        ("LMASK({1,1,1,1,1,1})", "LMASK={1,1,1,1,1,1}"),
        ("LDIV(2)", "LDIV=2"),
        ("TARE(1)", "TARE=1"),
        ("TARE(0)", "TARE=0"),
        ("FLT(3)", "FLT=3"),
        ("FLAGS()", "FLAGS=3"),
        ("T()", "T=31.5"),
        ("L0()", "L0"),
        ("NONSENSE()", "ERROR(14)"),
        ("hello", "ERROR(15)"),
        ("ID(1)", "ERROR(12)"),
        ("LDIV()", "LDIV=1"),
        ("LMASK({1,1,1})", "ERROR(13)"),
        ("LDIV(0)", "ERROR(24)"),
        ("LDIV(1,2)", "ERROR(24)"),
        ("LDIV(x)", "ERROR(15)"),
    ],
)
def test_one_line_for_one_line(request_line: str, reply: str) -> None:
    assert Kms40Emulator().answer(request_line) == reply


def test_flags_tell_tare_filter_overrange() -> None:
    emulator = Kms40Emulator(lambda t: (0.0, 0.0, -130.0, 0.0, 0.0, 3.5))
    assert emulator.answer("FLAGS()") == f"FLAGS={0b11 | 1 << 22 | 1 << 25}"
    emulator.answer("TARE(1)")
    emulator.answer("FLT(1)")
    assert emulator.answer("FLAGS()") == f"FLAGS={0b1111 | 1 << 22 | 1 << 25}"
    assert emulator.answer("F()").startswith("F={0.0000,0.0000,0.0000,")


def test_a_mask_chooses_axes_and_the_stamp_is_optional() -> None:
    emulator = Kms40Emulator(lambda t: WRENCH, stamped=False)
    assert emulator.answer("F()").encode() == LINE
    emulator.answer("LMASK({0,0,1,0,0,0})")
    assert emulator.answer("F()") == "F={1.0000}"


def test_streams_until_told_to_stop(emulator: Kms40Emulator) -> None:
    with talk(emulator) as (link, lines):
        link.sendall(b"LDIV(2)\nL1()\n")
        assert lines.readline() == b"LDIV=2\n"
        assert lines.readline() == b"L1\n"
        stamps = []
        for _ in range(5):
            values, _, stamp = lines.readline().rpartition(b",")
            assert values == LINE
            stamps.append(int(stamp))
        # Every second sample of 500 a second, in a clock of milliseconds.
        assert [b - a for a, b in pairwise(stamps)] == [4] * 4
        link.sendall(b"TARE(1)\n")
        assert next(line for line in lines if not line.startswith(b"F=")) == b"ERROR(4)\n"
        link.sendall(b"L0()\n")
        assert next(line for line in lines if not line.startswith(b"F=")) == b"L0\n"
        assert not emulator.streaming


def test_it_streams_on_to_the_next_client(emulator: Kms40Emulator) -> None:
    with talk(emulator) as (link, lines):
        link.sendall(b"L1()\n")
        assert lines.readline() == b"L1\n"
    with talk(emulator) as (_, lines):
        assert lines.readline().startswith(LINE)


@pytest.mark.parametrize(
    ("fault", "seen"),
    [
        ("cut", lambda line: line.startswith(LINE[:20]) and line.count(b"F") == 2),
        ("junk", lambda line: not line.startswith(b"F=")),
        ("nan", lambda line: line == b"F={nan,nan,nan,nan,nan,nan}\n"),
    ],
)
def test_bad_lines(emulator: Kms40Emulator, fault: str, seen: Callable[[bytes], bool]) -> None:
    with talk(emulator) as (link, lines):
        link.sendall(b"L1()\n")
        emulator.inject(fault)
        assert any(seen(line) for line in lines)
        # A line of junk may go on behind its line end, up to the next good one.
        assert any(line.startswith(LINE) for line in lines)


def test_a_restart_resets_the_connection_and_all_that_was_set(emulator: Kms40Emulator) -> None:
    with talk(emulator) as (link, lines):
        link.sendall(b"LDIV(7)\nL1()\n")
        assert lines.readline() == b"LDIV=7\n"
        emulator.inject("restart")
        with pytest.raises(ConnectionResetError):
            lines.read()
    assert not emulator.streaming
    assert emulator.divider == 1


def test_unplugged_it_comes_back_at_its_address(emulator: Kms40Emulator) -> None:
    with talk(emulator) as (link, lines):
        link.sendall(b"T()\n")
        assert lines.readline() == b"T=31.5\n"
        emulator.inject("unplug", 0.2)
        assert lines.readline() == b""
    deadline = time.monotonic() + 20.0
    while True:
        try:
            with talk(emulator) as (link, lines):
                link.sendall(b"T()\n")
                if lines.readline() == b"T=31.5\n":
                    return
        except ConnectionError:
            assert time.monotonic() < deadline


def test_silence_stopped_overload_and_error(emulator: Kms40Emulator) -> None:
    with talk(emulator) as (link, lines):
        emulator.inject("silence")
        link.sendall(b"ID()\n")  # is not heard
        deadline = time.monotonic() + 20.0
        while "silence" in emulator._until:
            assert time.monotonic() < deadline
            time.sleep(0.005)
        emulator.inject("overload")
        link.sendall(b"FLAGS()\n")
        assert lines.readline() == b"FLAGS=%d\n" % (0b11 | 1 << 22)
        emulator.inject("error")
        link.sendall(b"FLAGS()\n")
        assert lines.readline() == b"FLAGS=%d\n" % (0b10 | 1 << 26)
        link.sendall(b"L1()\n")
        assert lines.readline() == b"L1\n"
        emulator.inject("stopped")
        while emulator.streaming:
            assert time.monotonic() < deadline
            time.sleep(0.005)
        link.sendall(b"FLAGS()\n")
        assert next(line for line in lines if not line.startswith(b"F=")) == b"FLAGS=3\n"
