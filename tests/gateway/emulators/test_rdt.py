"""The RDT sensors in software answer as hardware reference 3.2 and 3.3 say."""

from __future__ import annotations

import socket
import struct
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import pytest

from palpate_gateway.emulators.rdt import LATCHED, RdtEmulator, record

START = bytes.fromhex("1234000200000000")
BIAS = bytes.fromhex("1234004200000000")
STOP = bytes.fromhex("1234000000000000")

WRENCH = (1.5, -0.25, 1.0, 0.02, -0.01, 0.005)
COUNTS = (1_500_000, -250_000, 1_000_000, 20_000, -10_000, 5_000)
VECTOR = bytes.fromhex("0000000100001B58000000000016E360FFFC2F70000F424000004E20FFFFD8F000001388")


@contextmanager
def client(emulator: RdtEmulator) -> Iterator[socket.socket]:
    host, _, port = emulator.address.partition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.settimeout(10.0)
        link.connect((host, int(port)))
        yield link


@contextmanager
def running(product: str = "netft", **options: Any) -> Iterator[tuple[RdtEmulator, socket.socket]]:
    with (
        RdtEmulator(product, lambda t: WRENCH, **options) as emulator,
        client(emulator) as link,
    ):
        yield emulator, link


def fields(data: bytes) -> tuple[int, ...]:
    return struct.unpack(">IIIiiiiii", data)


def take(link: socket.socket, count: int) -> list[tuple[int, ...]]:
    return [fields(link.recv(2048)) for _ in range(count)]


def quiet(link: socket.socket) -> bool:
    """Nothing comes any more, after what was under way."""
    link.settimeout(0.3)
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline:
        try:
            link.recv(2048)
        except TimeoutError:
            return True
    return False


def page(emulator: RdtEmulator, path: str = "/netftapi2.xml") -> bytes:
    url = f"http://127.0.0.1:{emulator.page.port}{path}"
    with urllib.request.urlopen(url, timeout=10.0) as reply:
        data: bytes = reply.read()
        return data


def test_the_vector_of_the_page() -> None:
    assert record(1, 7000, 0, COUNTS) == VECTOR


def test_the_first_record_on_the_wire() -> None:
    with running(first_counter=7000) as (_, link):
        link.send(START)
        data = link.recv(2048)
    assert data[:4] == VECTOR[:4]
    assert data[8:] == VECTOR[8:]


def test_sequence_from_one_for_each_request_and_the_internal_counter_goes_on() -> None:
    with running(rate_hz=500.0) as (_, link):
        link.send(START)
        first = take(link, 3)
        assert [r[0] for r in first] == [1, 2, 3]
        assert [b[1] - a[1] for a, b in pairwise(first)] == [14, 14]
        link.send(START)
        again = fields(link.recv(2048))
        while again[0] != 1:
            again = fields(link.recv(2048))
        assert again[1] > first[-1][1]
        link.send(STOP)
        assert quiet(link)


def test_as_many_as_asked_for() -> None:
    with running() as (_, link):
        link.send(struct.pack(">HHI", 0x1234, 2, 3))
        assert [r[0] for r in take(link, 3)] == [1, 2, 3]
        assert quiet(link)


def test_several_in_a_datagram() -> None:
    with running("axia", together=4) as (_, link):
        link.send(struct.pack(">HHI", 0x1234, 3, 6))
        sizes = [len(link.recv(2048)) for _ in range(2)]
        assert sizes == [4 * 36, 2 * 36]


@pytest.mark.parametrize(
    "data",
    [b"", START[:7], START + b"\0", b"\x12\x35" + START[2:], bytes.fromhex("1234000100000000")],
)
def test_what_is_no_request_is_not_answered(data: bytes) -> None:
    with running() as (_, link):
        link.send(data)
        assert quiet(link)


def test_bias_is_the_present_load() -> None:
    with running() as (_, link):
        link.send(BIAS)
        link.send(START)
        assert take(link, 2)[1][3:] == (0,) * 6


def test_page_and_its_units() -> None:
    units = (("lbf", 4.4482216), ("N-mm", 1e-3))
    with running(counts_per=(2000.0, 50.0), units=units) as (emulator, link):
        text = page(emulator).decode()
        for tag in (
            "<prodname>Net F/T</prodname>",
            "<cfgcpf>2000</cfgcpf>",
            "<cfgcpt>50</cfgcpt>",
            "<scfgfu>lbf</scfgfu>",
            "<scfgtu>N-mm</scfgtu>",
        ):
            assert tag in text
        with pytest.raises(urllib.error.HTTPError, match="404"):
            page(emulator, "/other")
        link.send(START)
        counts = take(link, 1)[0][3:]
    assert counts[0] == round(1.5 / 4.4482216 * 2000)
    assert counts[3] == round(0.02 / 1e-3 * 50)


def test_hex_scale_period_filter_zero() -> None:
    with running("hex") as (emulator, link):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            page(emulator)
        for command, count in ((0x82, 2), (0x81, 6), (0x42, 0xFF), (0x42, 0), (2, 0)):
            link.send(struct.pack(">HHI", 0x1234, command, count))
        records = take(link, 3)
        assert emulator.rate_hz == 500.0
        assert emulator.filter == 6
        assert records[2][3:] == (15_000, -2_500, 10_000, 2_000, -1_000, 500)
        assert records[2][1] - records[1][1] == 2
        link.send(struct.pack(">HHI", 0x1234, 0x42, 0xFF))
        while link.recv(2048)[12:] != bytes(24):
            pass
        link.send(struct.pack(">HHI", 0x1234, 0x82, 0))
        assert quiet(link)


@pytest.mark.parametrize(
    ("product", "fault", "status"),
    [
        ("netft", "overload", 0x80020000),
        ("netft", "error", 0x90000000),
        ("netft", "latched", 0x80010000),
        ("axia", "overload", 0xC0000000),
        ("axia", "error", 0x80000004),
        ("hex", "overload", 1 << 6),
        ("hex", "error", 1 << 10),
    ],
)
def test_status(product: str, fault: str, status: int) -> None:
    with running(product) as (emulator, link):
        link.send(START)
        emulator.inject(fault)
        seen = take(link, 1)[0]
        while not seen[2]:
            seen = take(link, 1)[0]
        assert seen[2] == status
        if fault == "latched":
            assert take(link, 1)[0][2] == LATCHED
            link.send(bytes.fromhex("1234004100000000"))
        while take(link, 1)[0][2]:
            pass


def test_lost_repeated_late() -> None:
    with running() as (emulator, link):
        link.send(START)
        for fault, step in (("lost", [2]), ("repeated", [0]), ("late", [2, -1, 2])):
            last, steps = take(link, 1)[0][0], [1]
            emulator.inject(fault)
            while set(steps) == {1} or steps[-len(step) :] != step:
                now = take(link, 1)[0][0]
                steps.append(now - last)
                last = now
                assert len(steps) < 1000


def test_late_for_a_while_is_every_other_record_and_loses_none() -> None:
    with running() as (emulator, link):
        emulator.inject("late", 60.0)
        link.send(struct.pack(">HHI", 0x1234, 2, 9))
        assert [r[0] for r in take(link, 9)] == [2, 1, 4, 3, 6, 5, 8, 7, 9]
        assert quiet(link)
    assert emulator.sent == 9


@pytest.mark.parametrize("fault", ["cut", "junk"])
def test_datagrams_of_a_wrong_length(fault: str) -> None:
    with running() as (emulator, link):
        link.send(START)
        emulator.inject(fault)
        while len(link.recv(2048)) == 36:
            pass
        assert fields(link.recv(2048))[3:] == COUNTS


def test_a_restart_forgets_stream_counter_and_bias() -> None:
    with running(rate_hz=500.0) as (emulator, link):
        link.send(BIAS)
        link.send(START)
        before = take(link, 20)[-1]
        emulator.inject("restart")
        assert quiet(link)
        emulator.inject("restart")
        deadline = time.monotonic() + 20.0
        while "restart" in emulator._until:
            assert time.monotonic() < deadline
            time.sleep(0.002)
        link.send(START)
        after = take(link, 1)[0]
        assert after[0] == 1
        assert before[3:] == (0,) * 6
        assert after[3:] == COUNTS


def test_deaf_once_then_it_hears() -> None:
    with running() as (emulator, link):
        emulator.inject("deaf")
        link.send(START)
        assert quiet(link)
        assert emulator.requests == []
        link.send(START)
        link.settimeout(10.0)
        assert take(link, 1)[0][0] == 1
        assert emulator.requests == [(2, 0)]


def test_unplugged_it_refuses_and_comes_back_at_its_address() -> None:
    with running() as (emulator, link):
        link.send(START)
        emulator.inject("unplug", 0.5)
        deadline = time.monotonic() + 20.0
        refused = False
        while not refused:
            assert time.monotonic() < deadline
            time.sleep(0.01)
            try:
                link.send(STOP)
            except ConnectionRefusedError:
                refused = True
        while time.monotonic() < deadline:
            try:
                assert b"netft" in page(emulator)
                link.send(START)
                link.settimeout(1.0)
                if link.recv(2048):
                    return
            except (OSError, urllib.error.URLError):
                time.sleep(0.05)
        raise AssertionError("it did not come back")


@pytest.mark.parametrize(("drift", "ticks"), [(False, 99_000), (True, 99_020)])
def test_a_drifting_clock_is_200_ppm_fast(drift: bool, ticks: int) -> None:
    with running(counter_hz=1e6) as (emulator, link):
        if drift:
            emulator.inject("clock_drift", 1000.0)
        link.send(START)
        records = take(link, 100)
    assert records[-1][1] - records[0][1] == pytest.approx(ticks, abs=1.0)
