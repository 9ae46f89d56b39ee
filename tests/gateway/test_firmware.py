"""The bridge's reference firmware, compiled for this machine, against the host's decoder."""

from __future__ import annotations

import ctypes
import itertools
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from tests.gateway.spi_words import encode_word

from palpate_gateway.protocols.bridge import (
    BridgeDecoder,
    BridgeHello,
    BridgeRecord,
    BridgeSlots,
    BridgeStatus,
)
from palpate_gateway.protocols.channels import SEQUENCES
from palpate_gateway.protocols.spi import channel_of_command

FIRMWARE = Path(__file__).parents[2] / "deploy" / "firmware" / "bridge"

Transfer = ctypes.CFUNCTYPE(ctypes.c_uint8, ctypes.c_void_p, ctypes.c_uint8)
Select = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint8, ctypes.c_uint8)
Micros = ctypes.CFUNCTYPE(ctypes.c_uint32, ctypes.c_void_p)
Write = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(ctypes.c_uint8), ctypes.c_size_t
)


class Port(ctypes.Structure):
    """``struct bridge_port``."""

    _fields_ = (
        ("transfer", Transfer),
        ("select", Select),
        ("micros", Micros),
        ("write", Write),
        ("context", ctypes.c_void_p),
    )


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) on this machine")
    folder = tmp_path_factory.mktemp("bridge")
    (folder / "size.c").write_text(
        '#include "bridge.h"\nconst size_t bridge_size = sizeof(struct bridge);\n'
    )
    flags = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2", "-fPIC"]
    flags += ["-ffreestanding", "-fno-stack-protector", "-nostdlib"]
    if sys.platform == "linux":
        flags.append("-Wl,-z,defs")  # whatever it would need of libc is an error
    sources = [FIRMWARE / "bridge.c", folder / "size.c"]
    built = folder / "bridge.so"
    subprocess.run(
        [compiler, *flags, "-shared", f"-I{FIRMWARE}", *sources, "-o", built], check=True
    )
    return ctypes.CDLL(str(built))


class Board:
    """A microcontroller with fingers on its SPI; time passes as it works."""

    def __init__(self, library: ctypes.CDLL, fingers: int, now_us: int = 0) -> None:
        self.now_us = now_us
        self.sent = bytearray()
        self.full = False
        self.answers: dict[int, bytes] = {}
        """Words of a finger instead of the right ones."""
        self.order: list[int] = []
        """Commands in order of sampling."""
        self._active: list[int] = []
        self._came: list[int] = []
        self._text: dict[int, bytes] = {}
        self._command = 0
        self._library, self._fingers = library, fingers
        size = ctypes.c_size_t.in_dll(library, "bridge_size").value
        self._bridge = ctypes.create_string_buffer(size)
        self._port = Port(
            Transfer(self._transfer),
            Select(self._select),
            Micros(self._micros),
            Write(self._write),
            None,
        )

    def start(self, slots_per_packet: int = 44, rate_hz: int = 4400) -> None:
        self._library.bridge_start(
            self._bridge,
            ctypes.byref(self._port),
            ctypes.c_uint8(7),
            ctypes.c_uint8(self._fingers),
            ctypes.c_uint16(rate_hz),
            ctypes.c_uint8(slots_per_packet),
        )

    def run(self, slots: int) -> None:
        wanted = len(self.order) + slots
        while len(self.order) < wanted:
            self._library.bridge_poll(self._bridge)

    def word(self, finger: int, command: int) -> bytes:
        return encode_word((command * 16 + finger) % 4096)

    def _transfer(self, _: Any, out: int) -> int:
        self.now_us += 2
        self._came.append(out)
        at = len(self._came) - 1
        (finger, *others) = self._active
        if others or at > 1 or self._command == 0:
            return 0
        if finger in self._text:
            text, self._text[finger] = self._text[finger][:1], self._text[finger][1:]
            return text[0] if text else 0
        return self.answers.get(finger, self.word(finger, self._command))[at]

    def _select(self, _: Any, finger: int, active: int) -> None:
        if active:
            self._active.append(finger)
            self._came = []
        elif finger in self._active:
            if self._came:
                self._obey(bytes(self._came), tuple(self._active))
                self._came = []
            self._active.remove(finger)

    def _obey(self, came: bytes, fingers: tuple[int, ...]) -> None:
        if came[0] & 0x80:
            assert len(fingers) == self._fingers, "all fingers sample at once"
            self._command = came[0]
            self._text.clear()
            self.order.append(came[0])
        elif came[0] == 0x61:
            (finger,) = fingers
            self._command = came[0]
            texts = {0x15: b"BT-%d" % finger, 0x13: b"0203"}
            self._text[finger] = texts[came[1]].ljust(16, b"\0")

    def _micros(self, _: Any) -> int:
        self.now_us += 3
        return self.now_us % 2**32

    def _write(self, _: Any, data: Any, count: int) -> int:
        if not self.full:
            self.sent += bytes(data[:count])
        return not self.full


def decoded(board: Board) -> tuple[list[BridgeRecord], dict[str, int]]:
    decoder = BridgeDecoder()
    records = decoder.feed(bytes(board.sent))
    assert decoder.pending == 0
    return records, decoder.counters


@pytest.fixture(params=[1, 3, 5])
def board(library: ctypes.CDLL, request: pytest.FixtureRequest) -> Board:
    # Its microseconds wrap during the test.
    return Board(library, request.param, now_us=2**32 - 500_000)


def slots_of(records: list[BridgeRecord]) -> list[bytes]:
    groups = [one.body for one in records if isinstance(one.body, BridgeSlots)]
    return [payload for group in groups for payload in group.payloads]


def test_every_packet_is_read_without_loss(board: Board) -> None:
    board.start(slots_per_packet=22)
    fingers = board._fingers
    board.run(3 * 4400 - 10)
    records, counters = decoded(board)
    flaws = {name: count for name, count in counters.items() if count and name != "packets"}
    assert flaws == {"junk_bytes": 1}  # the zero at the start
    assert [one.header.sequence for one in records] == list(range(len(records)))
    assert {one.header.source for one in records} == {7}
    hellos = [one.body for one in records if isinstance(one.body, BridgeHello)]
    assert len(hellos) == 6  # twice a second
    assert (hellos[0].slot_rate_hz, hellos[0].slots_per_frame) == (4400, 44)
    told = [(finger.serial, finger.firmware) for finger in hellos[0].fingers]
    assert told == [(f"BT-{finger}", "0203") for finger in range(fingers)]
    payloads = slots_of(records)
    assert len(payloads) == 599 * 22
    for payload, command in zip(payloads, board.order, strict=False):
        words = b"".join(board.word(finger, command) for finger in range(fingers))
        assert payload == bytes([command]) + words
    channels = [channel_of_command(payload[0]) for payload in payloads[:88]]
    assert channels == list(SEQUENCES["biotac_e1_first"]) * 2
    times = [one.time_us for one in records if isinstance(one.body, BridgeSlots)]
    assert all(abs(b - a - 5000) <= 1 for a, b in itertools.pairwise(times))


def test_errors_are_sent_as_they_came_and_counted(board: Board) -> None:
    board.start()
    last = board._fingers - 1
    for word, slots in ((b"\xa5\x2d", 44), (b"\x00\x00", 44), (b"\x7f\xc0", 88)):
        board.answers = {last: word}
        board.run(slots)
    board.answers = {}
    board.run(4400)
    records, counters = decoded(board)
    assert counters["lost_packets"] == 0
    ends = [payload[-2:] for payload in slots_of(records)]
    assert ends[:44] == [b"\xa5\x2d"] * 44
    assert ends[44:88] == [b"\x00\x00"] * 44
    assert ends[88:176] == [b"\x7f\xc0"] * 88
    status = next(one.body for one in records if isinstance(one.body, BridgeStatus))
    assert status.parity_errors == (0,) * last + (88,)
    assert (status.error_words, status.overruns) == (44, 0)


def test_what_the_line_did_not_take_is_a_gap(library: ctypes.CDLL) -> None:
    board = Board(library, 3)
    board.start()
    board.run(440)
    board.full = True
    board.run(88)
    board.full = False
    board.run(4400)
    records, counters = decoded(board)
    assert counters["lost_packets"] == 2
    assert counters["crc_errors"] == counters["cobs_errors"] == 0
    status = next(one.body for one in records if isinstance(one.body, BridgeStatus))
    assert status.overruns == 88


def test_a_stall_drops_slots_and_keeps_the_grid(library: ctypes.CDLL) -> None:
    board = Board(library, 2)
    board.start()
    board.run(44 * 5 + 7)
    board.now_us += 20_000
    board.run(4400)
    records, counters = decoded(board)
    assert counters["lost_packets"] == 1
    groups = [one for one in records if isinstance(one.body, BridgeSlots)]
    for before, after in itertools.pairwise(groups):
        slots = (after.time_us - before.time_us) * 4400 / 1e6
        assert slots == pytest.approx(round(slots), abs=0.01)
        # The frame went on meanwhile: the place in it follows from the time.
        assert isinstance(before.body, BridgeSlots)
        assert isinstance(after.body, BridgeSlots)
        first, place = (channel_of_command(one.body.payloads[0][0]) for one in (before, after))  # type: ignore[union-attr]
        order = SEQUENCES["biotac_e1_first"]
        if first in order[::2]:
            assert order[(order.index(first) + round(slots)) % 44] == place
    status = next(one.body for one in records if isinstance(one.body, BridgeStatus))
    assert 7 + 85 <= status.overruns <= 7 + 90


def test_the_sequence_wraps(library: ctypes.CDLL) -> None:
    board = Board(library, 1)
    board.start(slots_per_packet=1)
    board.run(2**16 + 10)
    records, counters = decoded(board)
    assert counters["lost_packets"] == counters["repeated_packets"] == counters["restarts"] == 0
    numbers = [one.header.sequence for one in records]
    assert numbers == [number % 2**16 for number in range(len(numbers))]
    assert len(numbers) > 2**16
