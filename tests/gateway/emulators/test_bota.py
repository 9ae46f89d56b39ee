"""The Bota emulator against the byte tables of hardware reference 3.6."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from typing import Any

import pytest

from palpate_gateway.emulators.bota import SINCS, BotaEmulator
from palpate_gateway.emulators.lines import crc16_x25

serial = pytest.importorskip("serial")

LOAD = (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
VECTOR = bytes.fromhex(
    "AA 0000 0000803F 00000040 00004040 CDCCCC3D CDCC4C3E 9A99993E 40E20100 0000CC41 7235"
)


@pytest.fixture
def sensor() -> Iterator[BotaEmulator]:
    # The first sample has the time of the vector, 123456 us.
    with BotaEmulator(lambda _: LOAD, clock_us=123456 - 10000) as emulator:
        yield emulator


@pytest.fixture
def line(sensor: BotaEmulator) -> Iterator[Any]:
    with serial.Serial(sensor.address, 460800, timeout=5.0) as opened:
        yield opened


def until(line: Any, text: bytes) -> None:
    assert line.read_until(text).endswith(text)


def config(line: Any) -> None:
    line.write(b"C")
    until(line, b"r,0,C,0")


def frame(line: Any) -> tuple[Any, ...]:
    """The next whole frame."""
    got = line.read(2 * len(VECTOR))
    for at in range(len(VECTOR)):
        body = got[at + 1 : at + 35]
        if got[at] == 0xAA and crc16_x25(body).to_bytes(2, "little") == got[at + 35 : at + 37]:
            return struct.unpack("<H6fIf", body)
    raise AssertionError(got.hex())


def test_the_sum_is_that_of_the_vector() -> None:
    assert crc16_x25(b"123456789") == 0x906E
    assert crc16_x25(VECTOR[1:35]).to_bytes(2, "little") == VECTOR[35:]


def test_it_boots_and_streams_the_vector(line: Any) -> None:
    until(line, b"App Init\r\n")
    assert line.read(37) == VECTOR


def test_the_dialogue_of_the_page(line: Any, sensor: BotaEmulator) -> None:
    until(line, b"App Init")
    config(line)
    for command in (b"c,0,1,0,4", b"f,51,0,0,1", b"b,1,2,3,0,0,0\n", b"m0,1,0,0,0,0,0\n"):
        line.write(command)
        until(line, b"r,0,%s,0" % command.partition(b",")[0])
    line.write(b"R")
    until(line, b"r,0,R,0\r\n")
    status, *wrench, _ticks, warmth = frame(line)
    assert (status, warmth) == (0, 25.5)
    assert wrench[:3] == [2.0, 4.0, 6.0]
    assert sensor.rate_hz == pytest.approx(1003.92, abs=0.01)


@pytest.mark.parametrize("sinc", SINCS)
def test_rates_are_those_of_the_page(line: Any, sensor: BotaEmulator, sinc: int) -> None:
    until(line, b"App Init")
    config(line)
    line.write(b"f,%d,0,0,1" % sinc)
    until(line, b"r,0,f,0")
    line.write(b"R")
    until(line, b"r,0,R,0\r\n")
    first, second = line.read(37), line.read(37)
    times = [struct.unpack("<I", part[27:31])[0] for part in (first, second)]
    assert times[1] - times[0] == pytest.approx(19.53125 * sinc, abs=1.0)


@pytest.mark.parametrize("command", [b"f,50,0,0,1", b"c,0,2,0,4", b"c,0,1,0,5", b"b,1,x,3,0,0,0\n"])
def test_what_is_out_of_range_is_refused(line: Any, command: bytes) -> None:
    until(line, b"App Init")
    config(line)
    line.write(command)
    until(line, b"r,0,%s,1" % command[:1])
    line.write(b"zzz")
    until(line, b"r,0,z,1")


def test_settings_are_lost_unless_saved(line: Any, sensor: BotaEmulator) -> None:
    until(line, b"App Init")
    for reset, rate_hz in ((b"#", 100.0), (b"sI", 200.0)):
        config(line)
        line.write(b"f,256,0,0,1" + reset)
        until(line, b"App Init")
        assert round(sensor.rate_hz) == rate_hz


def test_another_speed_is_noise(sensor: BotaEmulator) -> None:
    with serial.Serial(sensor.address, 230400, timeout=0.3) as line:
        line.write(b"C")
        got = line.read(1000)
    assert b"r,0,C,0" not in got
    assert got.count(VECTOR[:1] + VECTOR[1:27]) == 0
    assert sensor.mode != "config"


def test_raw_samples_say_so(line: Any) -> None:
    until(line, b"App Init")
    config(line)
    line.write(b"c,0,0,0,4R")
    until(line, b"r,0,R,0\r\n")
    assert frame(line)[0] == 0b1000


@pytest.mark.parametrize(
    ("fault", "status"), [("late", 1), ("overload", 2), ("error", 4), ("raw", 8)]
)
def test_status_bits(line: Any, sensor: BotaEmulator, fault: str, status: int) -> None:
    until(line, b"App Init")
    sensor.inject(fault, 10.0)
    line.read(74)
    assert frame(line)[0] == status


def test_a_sample_may_be_no_number(line: Any, sensor: BotaEmulator) -> None:
    until(line, b"App Init")
    sensor.inject("nan", 10.0)
    line.read(74)
    assert math.isnan(frame(line)[3])


def test_a_clock_that_runs_fast(line: Any, sensor: BotaEmulator) -> None:
    until(line, b"App Init\r\n")
    sensor.inject("clock_drift", 60.0)
    times = [frame(line)[7] for _ in range(21)]
    # Every second frame of 10 ms.
    assert times[20] - times[0] == pytest.approx(400_000 * 1.0002, abs=8.0)


def test_a_restart_begins_again(line: Any, sensor: BotaEmulator) -> None:
    until(line, b"App Init\r\n")
    line.read(37)
    sensor.inject("restart", 0.1)
    until(line, b"App Init\r\n")
    assert frame(line)[7] < 30_000


def test_it_may_wait_to_be_asked() -> None:
    with (
        BotaEmulator(lambda _: LOAD, runs_after_boot=False) as sensor,
        serial.Serial(sensor.address, 460800, timeout=5.0) as line,
    ):
        until(line, b"App Init\r\n")
        line.timeout = 0.1
        assert line.read(1) == b""
        config(line)
