"""The PIC32 emulator against the record of hardware reference 2.2."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from palpate_gateway.emulators.biotac_pic32 import BiotacPic32Emulator

serial = pytest.importorskip("serial")

PATIENCE_S = 20.0
COUNTS = [*range(101, 120), 1200, 1300, 1400, 2040]
"""E1..E19, PDC, TAC, TDC, PAC."""

CHANNELS = bytes.fromhex(
    "F807 B004 1405 7805"  # pac 2040, pdc 1200, tac 1300, tdc 1400
    "6500 6600 6700 6800 6900 6A00 6B00 6C00 6D00 6E00"
    "6F00 7000 7100 7200 7300 7400 7500 7600 7700"
)
LOADS = bytes.fromhex("78000000 89FFFFFF")  # 120 g and -119 g

Emulate = Callable[..., tuple[BiotacPic32Emulator, Any]]


@pytest.fixture
def emulate() -> Iterator[Emulate]:
    running: list[tuple[BiotacPic32Emulator, Any]] = []

    def start(*faults: str, **options: Any) -> tuple[BiotacPic32Emulator, Any]:
        given = {"counts": lambda _t, _finger: COUNTS, "load_g": (120, -119), **options}
        emulator = BiotacPic32Emulator(**given)
        for fault in faults:
            emulator.inject(fault, 1000.0)
        emulator.start()
        line = serial.Serial(emulator.address, 230400, timeout=PATIENCE_S)
        running.append((emulator, line))
        return emulator, line

    yield start
    for emulator, line in running:
        line.close()
        emulator.stop()


def record(line: Any) -> bytes:
    got = line.read(58)
    assert len(got) == 58
    return bytes(got)


def tick(got: bytes) -> int:
    return int(struct.unpack_from("<I", got)[0])


def test_all_channels_once(emulate: Emulate) -> None:
    _, line = emulate()
    line.write(b"b\n")
    assert line.read(46) == CHANNELS
    line.write(b"l\n")
    assert line.read(4) == LOADS[:4]
    line.timeout = 0.2
    assert line.read(1) == b""


def test_the_older_firmware_sends_the_electrodes_first(emulate: Emulate) -> None:
    _, line = emulate(electrodes_first=True)
    line.write(b"b\n")
    assert line.read(46) == CHANNELS[8:] + CHANNELS[:8]


def test_a_run_is_a_stream_of_records_and_ends_with_zeros(emulate: Emulate) -> None:
    _, line = emulate(ticks=2**32 - 10_000_000)
    line.write(b"r\n")
    got = [record(line) for _ in range(30)]
    assert {one[4:] for one in got} == {CHANNELS + LOADS}
    # 25 ns a tick, 100 Hz, and it wraps.
    assert [(tick(b) - tick(a)) % 2**32 for a, b in pairwise(got)] == 29 * [400_000]
    assert tick(got[-1]) < 2**31
    line.write(b"q\n")
    while (last := record(line)) != bytes(58):
        assert last[4:] == CHANNELS + LOADS
    line.timeout = 0.2
    assert line.read(1) == b""


def test_what_the_page_does_not_name_gets_no_answer(emulate: Emulate) -> None:
    _, line = emulate()
    line.write(b"x\nbb\nq\nb")
    line.timeout = 0.3
    assert line.read(1) == b""
    line.write(b"\n")
    line.timeout = PATIENCE_S
    assert line.read(46) == CHANNELS


def test_another_speed_is_not_heard(emulate: Emulate) -> None:
    _, line = emulate()
    line.baudrate = 115200
    line.write(b"b\n")
    line.timeout = 0.3
    assert CHANNELS not in line.read(46)


@pytest.mark.parametrize(
    ("fault", "value"), [("saturated", 4095), ("absent", 0)], ids=["saturated", "absent"]
)
def test_all_channels_at_an_end(emulate: Emulate, fault: str, value: int) -> None:
    emulator, line = emulate(fault)
    line.write(b"r\n")
    assert struct.unpack_from("<23H", record(line), 4) == 23 * (value,)
    emulator.end(fault)
    deadline = time.monotonic() + PATIENCE_S
    while record(line)[4:50] != CHANNELS:
        assert time.monotonic() < deadline


def test_stuck(emulate: Emulate) -> None:
    emulator, line = emulate(counts=lambda t, _: [round(t * 100) % 4096] * 23)
    line.write(b"r\n")
    assert len({record(line)[4:50] for _ in range(5)}) == 5
    emulator.inject("stuck", 1000.0)
    deadline = time.monotonic() + PATIENCE_S
    while len({record(line)[4:50] for _ in range(5)}) > 1:
        assert time.monotonic() < deadline


def test_a_number_above_4095(emulate: Emulate) -> None:
    _, line = emulate("high_bits")
    line.write(b"r\n")
    values = struct.unpack_from("<23H", record(line), 4)
    assert sum(value > 4095 for value in values) == 1


@pytest.mark.parametrize("fault", ["cut", "junk"])
def test_records_out_of_step(emulate: Emulate, fault: str) -> None:
    emulator, line = emulate()
    line.write(b"r\n")
    record(line)
    emulator.inject(fault)
    deadline = time.monotonic() + PATIENCE_S
    while (got := record(line))[4:] == CHANNELS + LOADS:
        assert time.monotonic() < deadline
    # Nothing tells where a record begins: only what is known to be in it.
    rest = got + line.read(116)
    at = rest.find(CHANNELS)
    assert at % 58 != 4


@pytest.mark.parametrize("fault", ["lost", "repeated"])
def test_gaps_and_repetitions_show_in_the_ticks(emulate: Emulate, fault: str) -> None:
    emulator, line = emulate()
    line.write(b"r\n")
    ticks = [tick(record(line))]
    emulator.inject(fault)
    wanted = 800_000 if fault == "lost" else 0
    deadline = time.monotonic() + PATIENCE_S
    while wanted not in (steps := [b - a for a, b in pairwise(ticks)]):
        assert time.monotonic() < deadline
        ticks.append(tick(record(line)))
    assert set(steps) <= {400_000, wanted}


def test_the_ticks_go_on_in_silence(emulate: Emulate) -> None:
    emulator, line = emulate()
    line.write(b"r\n")
    ticks = [tick(record(line))]
    emulator.inject("silence", 0.2)
    deadline = time.monotonic() + PATIENCE_S
    while max([b - a for a, b in pairwise(ticks)], default=0) < 10 * 400_000:
        assert time.monotonic() < deadline
        ticks.append(tick(record(line)))
    assert all((b - a) % 400_000 == 0 for a, b in pairwise(ticks))


def test_a_run_may_end_by_itself(emulate: Emulate) -> None:
    emulator, line = emulate()
    line.write(b"r\n")
    record(line)
    emulator.inject("end")
    while record(line) != bytes(58):
        pass
    line.timeout = 0.2
    assert line.read(1) == b""


def test_a_restart_ends_the_run_and_begins_its_clock_anew(emulate: Emulate) -> None:
    emulator, line = emulate(ticks=4_000_000_000)
    line.write(b"r\n")
    assert tick(record(line)) >= 4_000_000_000
    emulator.inject("restart", 1000.0)
    line.timeout = 0.3
    while line.read(58):
        pass
    emulator.end("restart")
    line.timeout = PATIENCE_S
    line.write(b"r\n")
    assert tick(record(line)) < 4_000_000_000


def test_unplugged_the_line_is_gone_and_the_run_goes_on(emulate: Emulate) -> None:
    emulator, line = emulate()
    line.write(b"r\n")
    before = tick(record(line))
    path = Path(emulator.address)
    emulator.inject("unplug", 1000.0)
    deadline = time.monotonic() + PATIENCE_S
    while path.is_symlink():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    emulator.end("unplug")
    while not path.is_symlink():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    with serial.Serial(str(path), 230400, timeout=PATIENCE_S) as again:
        got = again.read(3 * 58)
    at = got.find(CHANNELS)
    assert at >= 4
    assert tick(got[at - 4 :]) > before


@pytest.mark.parametrize("ppm", [500.0, -500.0])
def test_a_clock_that_drifts(emulate: Emulate, ppm: float) -> None:
    _, line = emulate("clock_drift", drift_ppm=ppm)
    line.write(b"r\n")
    ticks = [tick(record(line)) for _ in range(6)]
    assert ticks[5] - ticks[0] == pytest.approx(5 * 400_000 * (1.0 + ppm * 1e-6), abs=5)
