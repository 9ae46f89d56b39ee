"""The CAN emulator against the byte tables of hardware reference 1.3 to 1.7 and 2.1."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import pytest

from palpate_gateway.emulators.biotac_can import BiotacCanEmulator
from palpate_gateway.emulators.biotac_slots import idle_counts, press_counts, round_of, word

can = pytest.importorskip("can")

PATIENCE_S = 20.0
COMMANDS: dict[int | str, int] = {
    **dict(enumerate(bytes.fromhex("A2A4A7A8ABADAEB0B3B5B6B9BABCBFC1C2C4C7C8CBCDCED0"), start=1)),
    "PDC": 0x83,
    "TAC": 0x85,
    "TDC": 0x86,
}
WORDS = {
    0: "0101",
    1: "0108",
    31: "01F8",
    32: "0201",
    1024: "4001",
    2040: "7FC1",
    2648: "A4C1",
    4095: "FEF8",
}


def round_of_page(electrodes: int, *, pac_first: bool) -> bytes:
    """Commands of one round, from the page's two tables."""
    out = []
    for channel in [*range(1, electrodes + 1), "PDC", "TAC", "TDC"]:
        pair = [COMMANDS[channel], 0x80]
        out += pair[::-1] if pac_first else pair
    return bytes(out)


def all_at(value: int) -> Callable[[float, int], Sequence[int]]:
    return lambda _t, _finger: [value] * 23


class Wire:
    """A bus that is listened to from before the emulator starts."""

    def __init__(self, channel: str) -> None:
        self.bus = can.Bus(interface="virtual", channel=channel)

    def next(self) -> Any:
        message = self.bus.recv(PATIENCE_S)
        assert message is not None
        return message

    def data(self, count: int) -> list[bytes]:
        """The next frames that are no error frames."""
        out: list[bytes] = []
        while len(out) < count:
            message = self.next()
            if not message.is_error_frame:
                out.append(bytes(message.data))
        return out

    def until(self, true: Callable[[Any], bool]) -> Any:
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            message = self.next()
            if true(message):
                return message
        raise AssertionError("no such frame")


Emulate = Callable[..., BiotacCanEmulator]


@pytest.fixture
def wire(request: pytest.FixtureRequest) -> Iterator[Wire]:
    made = Wire(request.node.name)
    yield made
    made.bus.shutdown()


@pytest.fixture
def emulate(request: pytest.FixtureRequest, wire: Wire) -> Iterator[Emulate]:
    running: list[BiotacCanEmulator] = []

    def start(*faults: str, **options: Any) -> BiotacCanEmulator:
        emulator = BiotacCanEmulator("virtual", request.node.name, **options)
        for fault in faults:
            emulator.inject(fault, 1000.0)
        emulator.start()
        running.append(emulator)
        return emulator

    yield start
    for emulator in running:
        emulator.stop()


@pytest.mark.parametrize(("value", "told"), WORDS.items())
def test_words_are_those_of_the_page(value: int, told: str) -> None:
    assert word(value) == bytes.fromhex(told)
    assert all(byte.bit_count() % 2 == 1 for byte in word(value))


def test_the_vector_of_the_page(emulate: Emulate, wire: Wire) -> None:
    emulate(counts=all_at(2040))
    message = wire.until(lambda one: one.data[0] == 0x80)
    assert bytes(message.data) == bytes.fromhex("80 7FC1 7FC1 7FC1")
    assert (message.arbitration_id, message.is_extended_id, message.dlc) == (0x001, False, 7)


@pytest.mark.parametrize("pac_first", [False, True])
@pytest.mark.parametrize(("electrodes", "slots"), [(19, 44), (24, 54)])
def test_rounds_are_those_of_the_page(
    emulate: Emulate, wire: Wire, electrodes: int, slots: int, pac_first: bool
) -> None:
    right = round_of_page(electrodes, pac_first=pac_first)
    assert len(right) == slots
    assert bytes(command for command, _ in round_of(electrodes, pac_first=pac_first)) == right
    emulate(electrodes=electrodes, pac_first=pac_first, can_id=0x123)
    assert bytes(data[0] for data in wire.data(3 * slots)) == 3 * right


def test_each_finger_has_its_words_in_each_frame(emulate: Emulate, wire: Wire) -> None:
    emulate(fingers=2)
    first = wire.data(44)
    for k in range(19):
        assert first[2 * k] == bytes([COMMANDS[k + 1]]) + b"".join(
            word(idle_counts(0.0, finger)[k]) for finger in range(2)
        )
    assert [data[1:] for data in first[38::2]] == [
        word(2600) + word(2601),
        word(2045) + word(2045),
        word(1914) + word(1914),
    ]


def test_the_electrodes_of_an_sp_that_the_source_lacks_follow_others(
    emulate: Emulate, wire: Wire
) -> None:
    emulate(fingers=1, electrodes=24)
    told = {data[0]: data[1:] for data in wire.data(54)}
    idle = idle_counts(0.0, 0)
    for electrode, like in ((20, 17), (21, 7), (22, 8), (23, 9), (24, 10)):
        assert told[COMMANDS[electrode]] == word(idle[like - 1] + 40)


def test_a_press_lowers_electrodes_and_raises_pressure() -> None:
    rest, pressed = press_counts(0.0, 0), press_counts(2.5, 0)
    assert all(a > b for a, b in zip(rest[:19], pressed[:19], strict=True))
    assert rest[19] < pressed[19] < 4096


FAULTS = [
    ("parity", "80 6FC1 7FC1 7FC1"),
    ("absent", "80 7FC1 7FC1 0000"),
    ("error_word", "80 A52D 7FC1 7FC1"),
    ("saturated", "80 FEF8 FEF8 FEF8"),
    ("short", "80 7FC1 7FC1 7F"),
]


@pytest.mark.parametrize(("fault", "told"), FAULTS)
def test_faults_of_words_while_they_last(
    emulate: Emulate, wire: Wire, fault: str, told: str
) -> None:
    emulator = emulate(fault, counts=all_at(2040))
    got = [data for data in wire.data(88) if data[0] == 0x80]
    assert set(got) == {bytes.fromhex(told)}
    emulator.end(fault)
    wire.until(lambda one: bytes(one.data) == bytes.fromhex("80 7FC1 7FC1 7FC1"))


def test_a_fault_once_is_had_once(emulate: Emulate, wire: Wire) -> None:
    emulator = emulate(counts=all_at(2040))
    wire.data(10)
    emulator.inject("parity")
    wire.until(lambda one: one.data[1] == 0x6F)
    assert all(data[1] == 0x7F for data in wire.data(50))


def test_a_stuck_finger_repeats_what_it_measured(emulate: Emulate, wire: Wire) -> None:
    emulator = emulate(counts=lambda t, _: [round(t * 4400) % 4096] * 23, fingers=1)
    assert len({data[1:] for data in wire.data(50)}) == 50
    emulator.inject("stuck", 1000.0)
    deadline = time.monotonic() + PATIENCE_S
    while len({data[1:] for data in wire.data(50)}) > 1:
        assert time.monotonic() < deadline
    emulator.end("stuck")
    while len({data[1:] for data in wire.data(50)}) < 50:
        assert time.monotonic() < deadline


def commands(wire: Wire, count: int) -> bytes:
    return bytes(data[0] for data in wire.data(count))


def test_lost_slots_are_missing_in_the_order(emulate: Emulate, wire: Wire) -> None:
    emulator = emulate()
    before = commands(wire, 44)
    emulator.inject("lost")
    deadline = time.monotonic() + PATIENCE_S
    while commands(wire, 44) == before:
        assert time.monotonic() < deadline


def test_repeated_and_foreign_frames(emulate: Emulate, wire: Wire) -> None:
    emulator = emulate("repeated")
    got = wire.data(88)
    assert got[::2] == got[1::2]
    emulator.inject("foreign", 1000.0)
    emulator.end("repeated")
    deadline = time.monotonic() + PATIENCE_S
    while True:
        assert time.monotonic() < deadline
        foreign = [data == b"\x12\x34" for data in wire.data(88)]
        if foreign in (44 * [True, False], 44 * [False, True]):
            return


@pytest.mark.parametrize("fault", ["silence", "unplug", "restart", "busoff"])
def test_nothing_comes_while_it_is_away(emulate: Emulate, wire: Wire, fault: str) -> None:
    emulator = emulate(fault)
    deadline = time.monotonic() + PATIENCE_S
    told: Any = wire.next() if fault == "busoff" else None
    assert wire.bus.recv(0.3) is None
    emulator.end(fault)
    first = wire.next()
    if fault == "busoff":
        # linux/can/error.h: 0x40 bus off, 0x100 restarted.
        assert (told.is_error_frame, told.arbitration_id, told.dlc) == (True, 0x040, 8)
        assert (first.is_error_frame, first.arbitration_id) == (True, 0x100)
        first = wire.next()
    if fault in ("unplug", "restart"):
        assert first.data[0] == 0xA2  # a round begins anew
    while emulator.sent < 3 * 44:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_slots_that_lack_a_byte_are_not_counted_as_sent(emulate: Emulate, wire: Wire) -> None:
    emulator = emulate("short")
    wire.data(88)
    assert emulator.sent == 0


def test_the_sampling_goes_on_in_silence(emulate: Emulate, wire: Wire) -> None:
    emulator = emulate(counts=lambda t, _: [round(t * 4400) % 4096] * 23, fingers=1)
    heard = wire.data(44)
    emulator.inject("silence", 0.05)

    def value(data: bytes) -> int:
        return (data[1] >> 1) * 32 + (data[2] >> 3)

    deadline = time.monotonic() + PATIENCE_S
    steps = [0]
    while max(steps) < 150:  # the silence may fall between two looks
        assert time.monotonic() < deadline
        heard = [heard[-1], *wire.data(100)]
        steps += [(b - a) % 4096 for a, b in pairwise(map(value, heard))]
    # What was heard before and after was heard slot for slot.
    assert steps.count(1) >= len(steps) - 2


def test_bus_errors_come_among_the_frames(emulate: Emulate, wire: Wire) -> None:
    emulate("bus_error")
    got = [wire.next() for _ in range(88)]
    assert {one.arbitration_id for one in got[::2]} == {0x080}
    assert all(one.is_error_frame for one in got[::2])
    assert not any(one.is_error_frame for one in got[1::2])


@pytest.mark.parametrize("ppm", [50_000.0, -50_000.0])
def test_a_clock_that_drifts_changes_the_rate(emulate: Emulate, wire: Wire, ppm: float) -> None:
    """The fingers are sampled at true times, so their own time tells the rate."""
    emulate("clock_drift", drift_ppm=ppm, counts=lambda t, _: [round(t * 1e4) % 4096] * 23)
    values = [(data[1] >> 1) * 32 + (data[2] >> 3) for data in wire.data(1501)]
    took_s = sum((b - a) % 4096 for a, b in pairwise(values)) / 1e4
    assert took_s == pytest.approx(1500 / 4400 / (1.0 + ppm * 1e-6), abs=1e-3)


def test_error_frames_travel_between_processes(request: pytest.FixtureRequest) -> None:
    pytest.importorskip("msgpack", reason="palpate[gateway] is not installed")
    where = {"interface": "udp_multicast", "channel": "239.74.163.77", "port": 43977}
    with can.Bus(**where) as bus:
        options = {"port": 43977}
        emulator = BiotacCanEmulator("udp_multicast", "239.74.163.77", options=options)
        emulator.inject("busoff", 1000.0)
        with emulator:
            message = bus.recv(PATIENCE_S)
    assert message.is_error_frame
    assert message.arbitration_id == 0x040


def test_only_its_own_faults(emulate: Emulate) -> None:
    emulator = emulate()
    for ask in (emulator.inject, emulator.end):
        with pytest.raises(ValueError, match="fault 'crc' is none of absent, bus_error, busoff"):
            ask("crc")
    with pytest.raises(ValueError, match="electrodes 20 is neither 19 nor 24"):
        emulate(electrodes=20)
