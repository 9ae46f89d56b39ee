"""Faults of the force/torque emulators as bytes on the wire, where no other file looks at them."""

from __future__ import annotations

import re
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pytest
import scipy.stats

from palpate_gateway.emulators.bota import BotaEmulator
from palpate_gateway.emulators.emulator import Emulator, HostTimed, no_load, slow_press
from palpate_gateway.emulators.kms40 import Kms40Emulator
from palpate_gateway.emulators.lines import crc16_x25
from palpate_gateway.emulators.rdt import RdtEmulator
from palpate_gateway.emulators.robotous import RobotousCanEmulator, RobotousSerialEmulator

serial = pytest.importorskip("serial")
can = pytest.importorskip("can")

PATIENCE_S = 20.0
UNITS_HZ = 40.0
NEAR = 0.03


class HostClock(HostTimed):
    """Fx is the host's time, in units of 25 ms, below 100."""

    def __call__(self, t: float) -> tuple[float, ...]:
        return ((t + self.lead_s) * UNITS_HZ % 100.0, *5 * (0.0,))


class Sample(NamedTuple):
    """What one sample says: Fx [N], and its time [s] where it has one."""

    fx: float
    time_s: float


def apart(a: Sample, b: Sample) -> float:
    """How far Fx went on, from -50 to 50."""
    return (b.fx - a.fx + 50.0) % 100.0 - 50.0


class Line:
    """Reads samples one by one."""

    def __init__(self, take: Callable[[], Sample | None]) -> None:
        self.take = take
        self._last: Sample | None = None

    def samples(self, count: int) -> list[Sample]:
        got: list[Sample] = []
        deadline = time.monotonic() + PATIENCE_S
        while len(got) < count:
            assert time.monotonic() < deadline
            sample = self.take()
            if sample is not None:
                got.append(sample)
                self._last = sample
        return got

    def until_step(self, wanted: Callable[[float], bool]) -> None:
        """Read until two samples are so far apart, from the last one that was read on."""
        assert self._last is not None
        before = self._last
        deadline = time.monotonic() + PATIENCE_S
        while True:
            assert time.monotonic() < deadline
            after = self.samples(1)[0]
            if wanted(apart(before, after)):
                return
            before = after


@contextmanager
def kms40(**options: Any) -> Iterator[tuple[Emulator, Line, float]]:
    with Kms40Emulator(HostClock(), **options) as emulator:
        host, _, port = emulator.address.partition(":")
        with (
            socket.create_connection((host, int(port)), timeout=PATIENCE_S) as link,
            link.makefile("rb") as lines,
        ):
            link.sendall(b"L1()\n")
            assert lines.readline() == b"L1\n"

            def take() -> Sample | None:
                match = re.fullmatch(rb"F=\{([\d.]+)(?:,0\.0000){5}\},(\d+)\n", lines.readline())
                return match and Sample(float(match[1]), int(match[2]) * 1e-3)

            yield emulator, Line(take), 0.08


@contextmanager
def bota(**options: Any) -> Iterator[tuple[Emulator, Line, float]]:
    with BotaEmulator(HostClock(), **options) as emulator:
        with serial.Serial(emulator.address, 460800, timeout=PATIENCE_S) as line:
            assert line.read_until(b"App Init\r\n").endswith(b"Init\r\n")

            came = b""

            def take() -> Sample | None:
                nonlocal came
                came += line.read(37 - len(came))
                if (
                    came[:1] != b"\xaa"
                    or crc16_x25(came[1:35]) != struct.unpack("<H", came[35:])[0]
                ):
                    came = came[1:]
                    return None
                fields, came = struct.unpack("<H6fIf", came[1:35]), b""
                return Sample(fields[1], fields[7] * 1e-6)

            yield emulator, Line(take), 0.4


@contextmanager
def robotous_serial(**options: Any) -> Iterator[tuple[Emulator, Line, float]]:
    with RobotousSerialEmulator(HostClock(), **options) as emulator:
        with serial.Serial(emulator.address, 115200, timeout=PATIENCE_S) as line:
            line.write(bytes.fromhex("55 0B 00 00 00 00 00 00 00 0B AA"))

            came = b""

            def take() -> Sample | None:
                nonlocal came
                came += line.read(19 - len(came))
                if (came[0], came[18], came[17]) != (0x55, 0xAA, sum(came[1:17]) % 256):
                    came = came[1:]
                    return None
                fx, came = struct.unpack(">h", came[2:4])[0] / 50, b""
                return Sample(fx, 0.0)

            yield emulator, Line(take), 0.2


@contextmanager
def robotous_can(**options: Any) -> Iterator[tuple[Emulator, Line, float]]:
    channel = f"wrench-faults-{time.monotonic_ns()}"
    with (
        can.Bus(interface="virtual", channel=channel) as bus,
        RobotousCanEmulator(HostClock(), channel=channel, **options) as emulator,
    ):
        start = can.Message(arbitration_id=0x64, data=b"\x0b" + bytes(7), is_extended_id=False)
        bus.send(start)

        def take() -> Sample | None:
            first = bus.recv(PATIENCE_S)
            if first.arbitration_id != 1 or first.dlc != 8 or first.is_error_frame:
                return None
            if bus.recv(PATIENCE_S).arbitration_id != 2:
                return None
            return Sample(struct.unpack(">h", first.data[1:3])[0] / 50, 0.0)

        line = Line(take)
        line.bus, line.start = bus, start  # type: ignore[attr-defined]
        yield emulator, line, 0.2


LINES = [kms40, bota, robotous_serial, robotous_can]
every_line = pytest.mark.parametrize("open_line", LINES, ids=lambda one: one.__name__)


@every_line
def test_sound_samples_follow_each_other(open_line: Any) -> None:
    with open_line() as (_, line, step):
        got = line.samples(50)[2:]
    assert [apart(a, b) for a, b in pairwise(got)] == pytest.approx(47 * [step], abs=NEAR)


@every_line
def test_lost_and_repeated(open_line: Any) -> None:
    with open_line() as (emulator, line, step):
        line.samples(3)
        emulator.inject("lost")
        line.until_step(lambda told: abs(told - 2 * step) < NEAR)
        emulator.inject("repeated")
        line.until_step(lambda told: abs(told) < NEAR / 10)


@every_line
def test_stuck(open_line: Any) -> None:
    with open_line() as (emulator, line, _):
        line.samples(3)
        emulator.inject("stuck", 1000.0)
        line.until_step(lambda told: abs(told) < NEAR / 10)
        got = line.samples(10)
        assert all(abs(apart(got[0], one)) < NEAR / 10 for one in got)
        emulator.end("stuck")
        line.until_step(lambda told: told > NEAR)


@every_line
def test_silence(open_line: Any) -> None:
    with open_line() as (emulator, line, step):
        line.samples(3)
        emulator.inject("silence", 1000.0)
        sent = -1
        while sent != emulator.sent:
            sent = emulator.sent
            time.sleep(0.2)
        emulator.end("silence")
        line.until_step(lambda told: told > 10 * step)


@every_line
@pytest.mark.parametrize("fault", ["crc", "cut", "junk"])
def test_spoilt_samples(open_line: Any, fault: str) -> None:
    with open_line() as (emulator, line, _):
        if fault not in emulator.faults:
            pytest.skip("this line has no such fault")
        line.samples(3)
        emulator.inject(fault)
        deadline = time.monotonic() + PATIENCE_S
        while line.take() is not None:
            assert time.monotonic() < deadline
        line.samples(10)


@pytest.mark.parametrize("ppm", [50_000.0, -50_000.0])
@every_line
def test_clock_drift(open_line: Any, ppm: float) -> None:
    """Fx is the host's time; the samples, or their own time, run faster or slower."""
    with open_line(drift_ppm=ppm) as (emulator, line, step):
        emulator.inject("clock_drift", 1000.0)
        line.samples(20)
        got = line.samples(101)
    host_s = np.cumsum([0.0, *(apart(a, b) / UNITS_HZ for a, b in pairwise(got))])
    told_s = [one.time_s if got[0].time_s else k * step / UNITS_HZ for k, one in enumerate(got)]
    # The median of all slopes: a busy machine holds a sample up now and then.
    slope = scipy.stats.theilslopes(told_s, host_s).slope
    assert slope == pytest.approx(1.0 + ppm * 1e-6, abs=2e-3)


def test_rdt_stuck_silence_and_a_slow_clock() -> None:
    with (
        RdtEmulator("netft", HostClock(), drift_ppm=-50_000.0) as emulator,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link,
    ):
        host, _, port = emulator.address.partition(":")
        link.settimeout(PATIENCE_S)
        link.connect((host, int(port)))
        link.send(bytes.fromhex("1234000200000000"))

        def take() -> tuple[int, ...]:
            return struct.unpack(">IIIiiiiii", link.recv(2048))

        take()
        emulator.inject("stuck", 1000.0)
        deadline = time.monotonic() + PATIENCE_S
        while len({take()[3] for _ in range(10)}) > 1:
            assert time.monotonic() < deadline
        emulator.end("stuck")
        while len({take()[3] for _ in range(10)}) < 10:
            assert time.monotonic() < deadline
        before = take()[0]
        emulator.inject("silence", 0.1)
        while (now := take()[0]) - before < 50:
            assert time.monotonic() < deadline
            before = now
        emulator.inject("clock_drift", 1000.0)
        for _ in range(20):
            take()
        got = [take() for _ in range(101)]
    assert got[-1][0] - got[0][0] == 100
    assert got[-1][1] - got[0][1] == pytest.approx(700 * 0.95, abs=1.0)


@pytest.mark.parametrize("fault", ["busoff", "unplug"])
def test_robotous_off_the_bus(fault: str) -> None:
    with robotous_can() as (emulator, line, _):
        bus, start = line.bus, line.start  # type: ignore[attr-defined]
        line.samples(3)
        emulator.inject(fault, 1000.0)
        told = []
        while (message := bus.recv(0.3)) is not None:
            told.append(message)
        bus.send(start)
        assert bus.recv(0.2) is None
        emulator.end(fault)
        if fault == "busoff":
            # One error frame of class 0x40 was the last that came; 0x100 is the first.
            assert [one.arbitration_id for one in told if one.is_error_frame] == [0x40]
            assert told[-1].is_error_frame
            first = bus.recv(PATIENCE_S)
            assert (first.is_error_frame, first.arbitration_id) == (True, 0x100)
        else:
            assert bus.recv(0.2) is None
            bus.send(start)
        line.samples(3)


def test_sources_without_a_twin() -> None:
    assert not any(no_load(1.0))
    assert slow_press(2.5)[2] == 4.0
