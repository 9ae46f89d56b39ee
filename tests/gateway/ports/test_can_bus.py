"""CAN buses of python-can, one asked and one read directly: batches, silence, errors, bus off."""

from __future__ import annotations

import itertools
import socket
import time
from collections.abc import Iterator
from typing import Any, NamedTuple
from unittest.mock import ANY

import pytest

from palpate.errors import ConfigError, DeviceError, DeviceLost, DeviceTimeout
from palpate_gateway.ports import can_bus
from palpate_gateway.ports.can_bus import CanBus
from palpate_gateway.ports.can_frames import BUS_OFF
from palpate_gateway.ports.datagrams import BATCH

can = pytest.importorskip("can")


@pytest.fixture(params=["virtual", "udp_multicast"])
def where(request: pytest.FixtureRequest) -> dict[str, Any]:
    if request.param == "virtual":
        return {"interface": "virtual", "channel": request.node.name}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        return {
            "interface": "udp_multicast",
            "channel": "239.74.163.77",
            "port": free.getsockname()[1],
        }


@pytest.fixture
def sender(where: dict[str, Any], bus: CanBus) -> Iterator[Any]:
    opened = can.Bus(**where)
    yield opened
    opened.shutdown()


@pytest.fixture
def bus(where: dict[str, Any]) -> Iterator[CanBus]:
    options = {"port": where["port"]} if "port" in where else {}
    with_name = CanBus(where["interface"], where["channel"], options=options)
    with_name.open()
    yield with_name
    with_name.close()


class Message(NamedTuple):
    can_id: int
    data: bytes
    arrival_ns: int


def read(bus: CanBus, count: int, **how: float) -> list[Message]:
    out: list[Message] = []
    deadline = time.monotonic() + 20.0
    while len(out) < count:
        assert time.monotonic() < deadline
        out += itertools.starmap(Message, bus.read(1.0, **how).messages())
    return out


def wait_for_stamps(sender: Any, bus: CanBus) -> None:
    """Linux stamps at reading until it has switched its stamping on, some time after opening."""
    for _ in range(1000):
        sender.send(can.Message(arbitration_id=0, is_extended_id=False))
        sent_ns = time.monotonic_ns()
        time.sleep(0.003)
        if read(bus, 1)[0].arrival_ns <= sent_ns + 1_000_000:
            return
    raise AssertionError("the kernel stamps nothing")


def test_frames_come_in_order_in_batches(sender: Any, bus: CanBus) -> None:
    wait_for_stamps(sender, bus)
    began = time.monotonic_ns()
    for k in range(BATCH + 10):
        sender.send(can.Message(arbitration_id=k % 7, data=[k % 256], is_extended_id=False))
    first = read(bus, 1, gather_s=0.02)
    assert len(first) > 1
    got = first + read(bus, BATCH + 10 - len(first))
    assert [m.data[0] for m in got] == [k % 256 for k in range(BATCH + 10)]
    assert [m.can_id for m in got[:8]] == [0, 1, 2, 3, 4, 5, 6, 0]
    arrivals = [m.arrival_ns for m in got]
    assert arrivals == sorted(arrivals)
    # The stamps are the wall clock's, and of the virtual bus rounded to a float's microsecond.
    assert began - 1_000_000 <= arrivals[0] <= arrivals[-1] <= time.monotonic_ns()


def test_frames_that_wait_keep_the_time_of_their_coming(sender: Any, bus: CanBus) -> None:
    wait_for_stamps(sender, bus)
    sender.send(can.Message(arbitration_id=1, data=b"1", is_extended_id=False))
    sent_ns = time.monotonic_ns()
    time.sleep(0.1)
    (message,) = read(bus, 1)
    assert message.arrival_ns < sent_ns + 50_000_000


def test_silence_is_a_timeout(bus: CanBus) -> None:
    with pytest.raises(DeviceTimeout, match=r"nothing came within 0\.01 s"):
        bus.read(0.01)


def test_what_is_no_data_frame_is_counted(sender: Any, bus: CanBus) -> None:
    sender.send(can.Message(arbitration_id=1, is_remote_frame=True, is_extended_id=False))
    sender.send(can.Message(is_error_frame=True))
    sender.send(can.Message(arbitration_id=5, data=b"\x01", is_extended_id=False))
    assert [m.can_id for m in read(bus, 1)] == [5]
    assert bus.counters == {"error_frames": 1, "other_frames": 1, "bad_lines": 0}


def test_only_noise_is_silence(sender: Any, bus: CanBus) -> None:
    sender.send(can.Message(is_error_frame=True))
    with pytest.raises(DeviceTimeout):
        bus.read(0.05)


def test_bus_off_is_told_after_what_came_before_it(sender: Any, bus: CanBus) -> None:
    sender.send(can.Message(arbitration_id=5, data=b"\x01", is_extended_id=False))
    sender.send(can.Message(arbitration_id=BUS_OFF, is_error_frame=True, is_extended_id=False))
    assert [m.can_id for m in read(bus, 1, gather_s=0.02)] == [5]
    for _ in range(2):
        with pytest.raises(DeviceLost, match="bus off"):
            bus.read(1.0)
    bus.close()
    bus.open()
    assert bus.counters["error_frames"] == 0
    sender.send(can.Message(arbitration_id=6, data=b"\x01", is_extended_id=False))
    assert [m.can_id for m in read(bus, 1)] == [6]


@pytest.mark.parametrize(
    ("interface", "remedy"),
    [("socketcan", "restart-ms.*ip link set can3 down; ip link set can3 up"), ("slcan", "itself$")],
)
def test_bus_off_says_what_brings_it_back(
    monkeypatch: pytest.MonkeyPatch, interface: str, remedy: str
) -> None:
    where = {"interface": "virtual", "channel": "off"}
    monkeypatch.setattr(can_bus, "available", lambda: False)
    monkeypatch.setattr(can_bus, "open_can", lambda _: can.Bus(**where))
    bus = CanBus(interface, "can3")
    bus.open()
    with can.Bus(**where) as sender:
        sender.send(can.Message(arbitration_id=BUS_OFF, is_error_frame=True, is_extended_id=False))
        with pytest.raises(DeviceLost, match=f"bus off.*{remedy}"):
            bus.read(1.0)
    bus.close()


def test_bus_off_by_the_state_of_the_interface(
    sender: Any, bus: CanBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = type(bus._bus)
    monkeypatch.setattr(kind, "state", property(lambda _: can.BusState.ERROR))
    sender.send(can.Message(is_error_frame=True))
    with pytest.raises(DeviceLost, match="bus off"):
        bus.read(1.0)


def test_a_bus_that_breaks_is_told(bus: CanBus, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise OSError(19, "No such device")

    monkeypatch.setattr(type(bus._bus), "recv", broken)
    if bus._direct is not None:
        monkeypatch.setattr(bus._direct[0], "take", broken)
        bus.write(1, b"")  # what is its own comes back
    with pytest.raises(DeviceLost, match="No such device"):
        bus.read(1.0)


class DriverError(Exception):
    """No error of python-can, nor of the system."""


def test_whatever_a_driver_raises_loses_the_bus_only(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **more: object) -> None:
        raise DriverError("library is unwell")

    bus = CanBus("virtual", "whatever")
    bus.open()
    monkeypatch.setattr(type(bus._bus), "recv", broken)
    monkeypatch.setattr(type(bus._bus), "send", broken)
    with pytest.raises(DeviceLost, match="library is unwell"):
        bus.read(0.1)
    with pytest.raises(DeviceLost, match="library is unwell"):
        bus.write(1, b"")
    bus.close()
    monkeypatch.setattr(can_bus, "open_can", broken)
    with pytest.raises(DeviceError, match="cannot join the bus: library is unwell"):
        bus.open()


def test_a_damaged_line_of_a_serial_adapter_is_counted_and_reading_goes_on() -> None:
    bus = CanBus("slcan", "loop://", options={"sleep_after_open": 0})
    bus.open()
    adapter = bus._bus.serialPortOrig
    adapter.reset_input_buffer()
    damaged = (b"t1\r", b"t12\r", b"T0000\r", b"t0G1101\r")
    for line in damaged:
        adapter.write(line)
        adapter.write(b"t0051AB\r")
        assert read(bus, 1) == [Message(5, b"\xab", ANY)]
    bus.close()
    assert bus.counters["bad_lines"] == len(damaged)


def test_whatever_else_comes_over_the_network_is_counted(
    where: dict[str, Any], bus: CanBus
) -> None:
    if "port" not in where:
        pytest.skip("nothing else can come over a virtual bus")
    junk = [
        b"",
        b"\xc1",
        b"\x80",
        b"\x81\xa4data\xc0",
        bytes(512),
        bytes(2000),
        b"\xdf\xff\xff\xff\xff",
    ]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        for one in junk:
            link.sendto(one, (where["channel"], where["port"]))
    with can.Bus(**where) as sender:
        sender.send(can.Message(arbitration_id=5, data=b"\x01", is_extended_id=False))
        assert [m.can_id for m in read(bus, 1, gather_s=0.02)] == [5]
    assert bus.counters["other_frames"] == len(junk)


def test_sends(sender: Any, bus: CanBus) -> None:
    bus.write(0x64, bytes(8))
    message = sender.recv(1.0)
    assert (message.arbitration_id, bytes(message.data)) == (0x64, bytes(8))
    assert not message.is_extended_id


def test_closed_and_closed_again(bus: CanBus) -> None:
    bus.close()
    bus.close()
    with pytest.raises(DeviceError, match="not open"):
        bus.read(0.1)


def test_an_unknown_interface_is_named() -> None:
    with pytest.raises(ConfigError, match="teletype:can0"):
        CanBus("teletype", "can0").open()


def test_a_bus_that_is_not_there_says_what_to_do() -> None:
    with pytest.raises(DeviceError, match=r"socketcan:nocan0: cannot join.*-> bring it up"):
        CanBus("socketcan", "nocan0").open()


def test_two_senders_of_one_bus_are_told_apart(where: dict[str, Any], bus: CanBus) -> None:
    with can.Bus(**where) as one, can.Bus(**where) as other:
        for k in range(20):
            one.send(can.Message(arbitration_id=1, data=bytes([k] * 7), is_extended_id=False))
            if k % 3 == 0:
                other.send(can.Message(arbitration_id=2, data=bytes([k] * 2), is_extended_id=False))
        got = read(bus, 27)
    assert sorted(m.data for m in got if m.can_id == 1) == [bytes([k] * 7) for k in range(20)]
    assert sorted(m.data for m in got if m.can_id == 2) == [bytes([k] * 2) for k in range(0, 20, 3)]


def test_a_29_bit_identifier_is_not_the_11_bit_one_of_the_same_number(
    sender: Any, bus: CanBus
) -> None:
    for k in range(6):
        extended = k % 2 == 1
        sender.send(can.Message(arbitration_id=5, data=bytes([k]), is_extended_id=extended))
    assert [(m.can_id, m.data[0]) for m in read(bus, 3, gather_s=0.02)] == [(5, 0), (5, 2), (5, 4)]
    assert bus.counters["other_frames"] == 3
