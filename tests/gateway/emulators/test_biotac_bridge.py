"""The bridge emulator against the byte table of the format (hardware reference 2.6)."""

from __future__ import annotations

import importlib
import struct
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from palpate_gateway.emulators.biotac_bridge import BiotacBridgeEmulator, stuffed
from palpate_gateway.emulators.biotac_slots import idle_counts, word
from palpate_gateway.emulators.lines import crc16_x25

serial = pytest.importorskip("serial")
wires: Any = importlib.import_module("bridge_wire")

# One finger, all channels at 2040, a sequence and a clock of our own.
HELLO_BYTES = bytes.fromhex(
    "01 01 07 00 3412 0403020101 3011 2C42542D454D552D310000000000000000 303230333A19"
)
SLOTS_BYTES = bytes.fromhex(
    "01 02 07 00 3512 04030201"
    "16 01"
    "A27FC1 807FC1 A47FC1 807FC1 A77FC1 807FC1 A87FC1 807FC1 AB7FC1 807FC1 AD7FC1 807FC1"
    "AE7FC1 807FC1 B07FC1 807FC1 B37FC1 807FC1 B57FC1 807FC1 B67FC1 807FC1"
)


Emulate = Callable[..., tuple[BiotacBridgeEmulator, Any]]


@pytest.fixture
def emulate() -> Iterator[Emulate]:
    running: list[tuple[BiotacBridgeEmulator, Any]] = []

    def start(*faults: str, **options: Any) -> tuple[BiotacBridgeEmulator, Any]:
        emulator = BiotacBridgeEmulator(**options)
        emulator._line.plug()
        wire = wires.Wire(emulator.address)  # listens before the first byte comes
        for fault in faults:
            emulator.inject(fault, 1000.0)
        emulator.start()
        running.append((emulator, wire))
        return running[-1]

    yield start
    for emulator, wire in running:
        wire.line.close()
        emulator.stop()


def test_the_sum_and_the_stuffing_are_those_of_the_page() -> None:
    assert crc16_x25(b"123456789") == 0x906E
    assert stuffed(b"\x11\x00\x22") == bytes.fromhex("02 11 02 22 00")
    assert stuffed(b"") == b"\x01\x00"
    for length in (1, 253, 254, 255, 300, 508, 600):
        for data in (bytes(length), bytes(range(256)) * 3, bytes([7]) * length):
            assert 0 not in stuffed(data)[:-1]
            assert wires.unstuffed(stuffed(data)[:-1]) == data


def test_it_begins_with_a_hello_byte_for_byte(emulate: Emulate) -> None:
    _, wire = emulate(
        fingers=1,
        counts=lambda _t, _finger: [2040] * 23,
        source=7,
        slots_per_packet=22,
        sequence=0x1234,
        clock_us=0x01020304,
    )
    assert wire.raw() == b""  # a delimiter ends whatever was before
    assert wires.unstuffed(wire.raw()) == HELLO_BYTES
    told = wires.unstuffed(wire.raw())
    assert told[:-2] == SLOTS_BYTES
    assert told[-2:] == crc16_x25(SLOTS_BYTES).to_bytes(2, "little")


def test_packets_follow_each_other_in_number_time_and_round(emulate: Emulate) -> None:
    _, wire = emulate(sequence=65534, clock_us=2**32 - 10_000, slots_per_packet=30, hello_s=0.02)
    got = [packet for packet in (wire.packet() for _ in range(12)) if packet is not None]
    assert {packet.kind for packet in got} == {wires.HELLO, wires.SLOTS}
    assert [b.sequence for b in got] == [(65534 + k) % 2**16 for k in range(len(got))]
    parts = [packet for packet in got if packet.kind == wires.SLOTS]
    steps = [(b.time_us - a.time_us) % 2**32 for a, b in pairwise(parts)]
    assert all(abs(step - 30e6 / 4400) <= 1.0 for step in steps)
    commands = bytes(slot[0] for packet in parts for slot in wires.slots(packet))
    assert commands[:44] == commands[44:88]
    assert commands[:6].hex() == "a280a480a780"


def test_words_of_three_fingers_and_an_sp(emulate: Emulate) -> None:
    _, wire = emulate(electrodes=24)
    hello = next(iter(wire.packets(1, wires.HELLO)))
    assert hello.body[:4] == bytes.fromhex("03 3011 36")  # 54 slots
    told = {slot[0]: slot[1:] for packet in wire.packets(2) for slot in wires.slots(packet)}
    for finger in range(3):
        idle = idle_counts(0.0, finger)
        assert told[0xA2][2 * finger : 2 * finger + 2] == word(idle[0])
        assert told[0x83][2 * finger : 2 * finger + 2] == word(idle[19])
        assert told[0xD0][2 * finger : 2 * finger + 2] == word(idle[9] + 40)


def status(packet: Any) -> tuple[int, ...]:
    fingers = packet.body[0]
    return struct.unpack(f"<{fingers + 2}I", packet.body[1:])


@pytest.mark.parametrize(
    ("fault", "told", "counted"),
    [
        ("parity", "6FC1 7FC1", 0),
        ("error_word", "A52D 7FC1", 2),
        ("absent", "7FC1 0000", None),
        ("saturated", "FEF8 FEF8", None),
    ],
)
def test_faults_of_words_and_their_status(
    emulate: Emulate, fault: str, told: str, counted: int | None
) -> None:
    emulator, wire = emulate(
        fault, fingers=2, counts=lambda _t, _finger: [2040] * 23, status_s=0.02
    )
    assert {slot[1:] for slot in wires.slots(wire.packets(1)[0])} == {bytes.fromhex(told)}
    numbers = status(wire.packets(2, wires.STATUS)[1])
    assert len(numbers) == 4
    assert [k for k, number in enumerate(numbers) if number] == (
        [] if counted is None else [counted]
    )
    emulator.end(fault)
    deadline = time.monotonic() + wires.PATIENCE_S
    while {slot[1:].hex() for slot in wires.slots(wire.packets(1)[0])} != {"7fc17fc1"}:
        assert time.monotonic() < deadline


def test_stuck_fingers_repeat_what_they_measured(emulate: Emulate) -> None:
    _, wire = emulate("stuck", counts=lambda t, _: [round(t * 4400) % 4096] * 23)
    assert len({slot[1:] for packet in wire.packets(3) for slot in wires.slots(packet)}) == 1


def test_wrong_sums(emulate: Emulate) -> None:
    _, wire = emulate("crc")
    assert wire.raw() == b""
    kinds = [packet and packet.kind for packet in (wire.packet() for _ in range(20))]
    assert kinds[0] == wires.HELLO
    assert kinds[1:].count(None) == 19


def test_cut_packets_take_the_next_with_them(emulate: Emulate) -> None:
    emulator, wire = emulate(hello_s=1000.0, status_s=1000.0)
    first = wire.packets(3)[-1]
    emulator.inject("cut")
    while (packet := wire.packet()) is not None:
        first = packet
    after = wire.packets(1)[0]
    assert after.sequence - first.sequence == 3


def test_junk_comes_between_packets(emulate: Emulate) -> None:
    _, wire = emulate("junk", hello_s=1000.0, status_s=1000.0)
    got = [wire.packet() for _ in range(30)]
    assert got.count(None) >= 14
    numbers = [packet.sequence for packet in got if packet is not None]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


@pytest.mark.parametrize("fault", ["lost", "overrun"])
def test_lost_packets_have_had_their_numbers(emulate: Emulate, fault: str) -> None:
    emulator, wire = emulate(hello_s=1000.0, status_s=0.02)
    numbers = [wire.packets(3)[-1].sequence]
    emulator.inject(fault)
    overruns = 0
    deadline = time.monotonic() + wires.PATIENCE_S
    while numbers[-1] - numbers[0] < 40:
        assert time.monotonic() < deadline
        packet = wire.packet()
        assert packet is not None
        numbers.append(packet.sequence)
        if packet.kind == wires.STATUS:
            overruns = status(packet)[-1]
    assert [b - a for a, b in pairwise(numbers)].count(2) == 1
    assert (overruns > 0) is (fault == "overrun")


def test_repeated_packets(emulate: Emulate) -> None:
    _, wire = emulate("repeated", hello_s=1000.0, status_s=1000.0)
    got = wire.packets(20)
    assert got[::2] == got[1::2]


def test_numbers_and_times_go_on_in_silence(emulate: Emulate) -> None:
    emulator, wire = emulate(hello_s=1000.0, status_s=1000.0)
    before = wire.packets(3)[-1]
    emulator.inject("silence", 0.2)
    after = before
    while after.sequence - before.sequence < 10:
        before, after = after, wire.packets(1)[0]
    lost = after.sequence - before.sequence
    assert after.time_us - before.time_us == pytest.approx(lost * 10_000, abs=1)


def test_unplugged_the_line_is_gone_and_comes_back(emulate: Emulate) -> None:
    emulator, wire = emulate()
    last = wire.packets(3)[-1]
    path = Path(emulator.address)
    emulator.inject("unplug", 1000.0)
    deadline = time.monotonic() + wires.PATIENCE_S
    while path.is_symlink():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    with pytest.raises((serial.SerialException, OSError, TypeError)):
        wire.line.read(100_000)
    emulator.end("unplug")
    while not path.is_symlink():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    again = wires.Wire(str(path))
    try:
        packet = again.packets(1)[0]
    finally:
        again.line.close()
    assert packet.sequence > last.sequence
    assert packet.time_us > last.time_us


def test_a_restart_begins_with_everything(emulate: Emulate) -> None:
    emulator, wire = emulate(clock_us=10**9, sequence=1000)
    wire.packets(3)
    emulator.inject("restart")
    deadline = time.monotonic() + wires.PATIENCE_S
    packet = None
    while packet is None or packet.time_us >= 10**9:
        assert time.monotonic() < deadline
        packet = wire.packet()
    assert (packet.kind, packet.sequence, packet.time_us) == (wires.HELLO, 0, 0)
    assert wires.slots(wire.packets(1)[0])[0][0] == 0xA2


@pytest.mark.parametrize("ppm", [20_000.0, -20_000.0])
def test_a_clock_that_drifts(emulate: Emulate, ppm: float) -> None:
    """The fingers are sampled at true times; the bridge's clock counts its own."""
    _, wire = emulate(
        "clock_drift", drift_ppm=ppm, fingers=1, counts=lambda t, _: [round(t * 4000) % 4096] * 23
    )
    got = wire.packets(41)
    values = [(wires.slots(one)[0][1] >> 1) * 32 + (wires.slots(one)[0][2] >> 3) for one in got]
    true_s = sum((b - a) % 4096 for a, b in pairwise(values)) / 4000
    told_s = (got[-1].time_us - got[0].time_us) * 1e-6
    assert told_s == pytest.approx(0.4, abs=1e-5)
    assert told_s / true_s == pytest.approx(1.0 + ppm * 1e-6, abs=2e-3)
