"""The Robotous emulator against the byte tables of hardware reference 3.5."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from palpate_gateway.emulators.robotous import RobotousCanEmulator, RobotousSerialEmulator

serial = pytest.importorskip("serial")
can = pytest.importorskip("can")

LOAD = (10.0, -5.0, 20.0, 0.1, -0.05, 0.025)
START = bytes.fromhex("55 0B 00 00 00 00 00 00 00 0B AA")
STOP = bytes.fromhex("55 0C 00 00 00 00 00 00 00 0C AA")
BIAS = bytes.fromhex("55 11 01 00 00 00 00 00 00 12 AA")
RATE_200 = bytes.fromhex("55 0F 05 00 00 00 00 00 00 14 AA")
DATA = bytes.fromhex("55 0B 01F4 FF06 03E8 00C8 FF9C 0032 00 00 00 85 AA")


def request(*values: int) -> bytes:
    body = bytes(values).ljust(8, b"\0")
    return b"\x55" + body + bytes([sum(body) % 256]) + b"\xaa"


def answer(*values: int) -> bytes:
    body = bytes(values).ljust(16, b"\0")
    return b"\x55" + body + bytes([sum(body) % 256]) + b"\xaa"


@pytest.fixture
def sensor() -> Iterator[RobotousSerialEmulator]:
    with RobotousSerialEmulator(lambda _: LOAD) as emulator:
        yield emulator


@pytest.fixture
def line(sensor: RobotousSerialEmulator) -> Iterator[Any]:
    with serial.Serial(sensor.address, 115200, timeout=5.0) as opened:
        yield opened


def ask(line: Any, data: bytes) -> bytes:
    line.write(data)
    return bytes(line.read(19))


def quiet(line: Any) -> bool:
    line.timeout = 0.1
    count = len(line.read(100))
    line.timeout = 5.0
    return count == 0


def test_it_is_silent_until_started_and_streams_the_vector(line: Any) -> None:
    assert quiet(line)
    assert ask(line, START) == DATA
    assert line.read(38) == DATA * 2
    line.write(STOP)
    time.sleep(0.05)
    line.reset_input_buffer()
    assert quiet(line)


def test_one_sample_has_its_own_id(line: Any) -> None:
    told = ask(line, request(10))
    assert (told[1], told[2:17]) == (0x0A, DATA[2:17])


def test_it_tells_who_it_is(line: Any) -> None:
    assert ask(line, request(1)) == answer(1, *b"RFT64-SB01")
    assert ask(line, request(2)) == answer(2, *b"RFT-1")
    assert ask(line, request(3)) == answer(3, *b"1.7")
    assert ask(line, request(5)) == answer(5, 0x64, 1, 2)


def test_settings_are_taken_within_their_ranges(line: Any, sensor: RobotousSerialEmulator) -> None:
    assert ask(line, RATE_200) == answer(15, 1)
    assert ask(line, request(16)) == answer(16, 5)
    assert ask(line, request(15, 9)) == answer(15, 0, 2)
    # 500 Hz needs 230400 bit/s.
    assert ask(line, request(15, 7)) == answer(15, 0, 2)
    assert ask(line, request(8, 1, 14)) == answer(8, 1)
    assert ask(line, request(9)) == answer(9, 1, 14)
    assert ask(line, request(8, 1, 15)) == answer(8, 0, 2)
    assert ask(line, request(6, 6)) == answer(6, 0, 2)
    assert ask(line, request(7)) == answer(7, 0)
    assert sensor.rate_hz == 200.0


def test_bias_is_set_and_cleared_without_an_answer(line: Any) -> None:
    line.write(BIAS)
    assert quiet(line)
    assert ask(line, request(10))[2:14] == bytes(12)
    line.write(request(17, 0))
    assert ask(line, request(10))[2:17] == DATA[2:17]


def test_overload_is_told_and_counted(line: Any, sensor: RobotousSerialEmulator) -> None:
    sensor.inject("overload")
    assert ask(line, request(10))[14] == 0b100000
    assert ask(line, request(18)) == answer(18, 1)


def test_while_it_streams_it_hears_stop_bias_and_rate_only(line: Any) -> None:
    line.write(START + request(1) + request(8, 1, 1) + request(16))
    got = line.read(19 * 12)
    told = {got[k] for k in range(1, len(got), 19)}
    assert told == {0x0B, 0x10}


def test_a_wrong_sum_is_not_heard(line: Any) -> None:
    line.write(START[:-2] + b"\x0c\xaa")
    assert quiet(line)
    assert ask(line, b"\x55\x00" + request(16)) == answer(16, 0)


def test_speed_changes_at_the_restart_and_another_speed_is_noise(
    line: Any, sensor: RobotousSerialEmulator
) -> None:
    assert ask(line, request(6, 1)) == answer(6, 1)
    assert ask(line, request(16)) == answer(16, 0)
    sensor.inject("restart")
    time.sleep(0.1)
    line.write(request(16))
    assert quiet(line)
    line.baudrate = 921600
    assert ask(line, request(15, 8)) == answer(15, 1)


def test_a_restart_ends_the_stream_and_forgets_the_bias(
    line: Any, sensor: RobotousSerialEmulator
) -> None:
    line.write(BIAS + START)
    assert line.read(19)[2:14] == bytes(12)
    sensor.inject("restart")
    time.sleep(0.1)
    line.reset_input_buffer()
    assert quiet(line)
    assert ask(line, START) == DATA


def test_unplugging_takes_the_line_away_and_gives_it_back(
    line: Any, sensor: RobotousSerialEmulator
) -> None:
    sensor.inject("unplug", 0.2)
    with pytest.raises((serial.SerialException, OSError)):
        line.read(100)
    deadline = time.monotonic() + 20.0
    while not Path(sensor.address).exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    with serial.Serial(sensor.address, 115200, timeout=5.0) as again:
        assert ask(again, request(16)) == answer(16, 0)


@pytest.fixture
def bus(request: pytest.FixtureRequest) -> Iterator[Any]:
    with can.Bus(interface="virtual", channel=request.node.name) as opened:
        yield opened


@pytest.fixture
def on_can(request: pytest.FixtureRequest, bus: Any) -> Iterator[RobotousCanEmulator]:
    with RobotousCanEmulator(lambda _: LOAD, channel=request.node.name) as emulator:
        yield emulator


def put(bus: Any, *values: int) -> None:
    data = bytes(values).ljust(8, b"\0")
    bus.send(can.Message(arbitration_id=0x64, data=data, is_extended_id=False))


def halves(bus: Any) -> list[tuple[int, bytes]]:
    pair = [bus.recv(5.0), bus.recv(5.0)]
    return [(m.arbitration_id, bytes(m.data)) for m in pair]


def test_on_can_an_answer_has_two_halves(bus: Any, on_can: RobotousCanEmulator) -> None:
    put(bus, 1)
    assert halves(bus) == [(1, b"\x01RFT64-S"), (2, b"B01\0\0\0\0\0")]
    put(bus, 15, 8)
    assert halves(bus) == [(1, bytes([15, 1, 0, 0, 0, 0, 0, 0])), (2, bytes(8))]
    put(bus, 11)
    assert halves(bus) == [(1, DATA[1:9]), (2, DATA[9:17])]
    put(bus, 12)


def test_identifiers_change_at_the_restart(bus: Any, on_can: RobotousCanEmulator) -> None:
    put(bus, 4, 0x65, 3, 4)
    assert halves(bus)[0] == (1, bytes([4, 1, 0, 0, 0, 0, 0, 0]))
    on_can.inject("restart")
    time.sleep(0.1)
    bus.send(
        can.Message(arbitration_id=0x65, data=bytes([5]).ljust(8, b"\0"), is_extended_id=False)
    )
    assert halves(bus)[0] == (3, bytes([5, 0x65, 3, 4, 0, 0, 0, 0]))


def test_bus_off_is_an_error_frame(bus: Any, on_can: RobotousCanEmulator) -> None:
    put(bus, 11)
    halves(bus)
    on_can.inject("busoff")
    assert any(bus.recv(5.0).is_error_frame for _ in range(20))
