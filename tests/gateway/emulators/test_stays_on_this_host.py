"""No emulator can be reached, or heard, from another host, unless its user says so."""

from __future__ import annotations

import ipaddress
import os
import random
import socket
import struct
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from palpate.errors import ConfigError
from palpate_gateway.cli.emulate import COMMANDS
from palpate_gateway.cli.emulate_devices import make_emulated
from palpate_gateway.ports.can_bus import CanBus
from palpate_gateway.ports.multicast import open_can

PATIENCE_S = 20.0

CASES = {
    "robotous on CAN": {"interface": "udp_multicast"},
    **{name: {} for name in COMMANDS},
}


def values_of(name: str, **changes: Any) -> dict[str, Any]:
    """The values of a command's options that nobody gives, and those that are changed."""
    values = {option.name: option.default.default for option in COMMANDS[name].options}
    del values["fault"], values["seconds"]
    return {**values, "play": "idle", **changes}


class Address(NamedTuple):
    """An address that a socket of this process is bound to."""

    inode: int
    host: ipaddress.IPv4Address | ipaddress.IPv6Address
    port: int


def bound() -> set[Address]:
    """Of all IP sockets of this process."""
    mine = set()
    for entry in os.listdir("/proc/self/fd"):
        try:
            target = os.readlink(f"/proc/self/fd/{entry}")
        except OSError:
            continue
        if target.startswith("socket:["):
            mine.add(int(target[8:-1]))
    found = set()
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/net/{table}").read_text(encoding="ascii").splitlines()[1:]:
            columns = line.split()
            if int(columns[9]) in mine:
                host, port = columns[1].split(":")
                words = struct.unpack(f">{len(host) // 8}I", bytes.fromhex(host))
                packed = struct.pack(f"={len(words)}I", *words)
                address = ipaddress.ip_address(packed)
                found.add(Address(int(columns[9]), address, int(port, 16)))
    return found


def option_of(inode: int, level: int, option: int, size: int) -> bytes:
    """An option of the socket of this process with this inode."""
    for entry in os.listdir("/proc/self/fd"):
        try:
            if os.readlink(f"/proc/self/fd/{entry}") != f"socket:[{inode}]":
                continue
        except OSError:
            continue
        with socket.socket(fileno=os.dup(int(entry))) as same:
            return same.getsockopt(level, option, size)
    raise AssertionError(inode)


@pytest.fixture
def others() -> set[Address]:
    """What was bound before."""
    return bound()


@pytest.mark.parametrize("case", sorted(CASES))
def test_an_emulator_serves_this_host_only(case: str, others: set[Address]) -> None:
    pytest.importorskip("can")
    name = case.removesuffix(" on CAN")
    changes: dict[str, Any] = dict(CASES[case])
    port = random.randint(20_000, 30_000)
    if name == "biotac-can":
        changes["bus"] = [f"port={port}"]
    with make_emulated(name, values_of(name, **changes)).emulator:
        addresses = bound() - others
        serial = name in ("bota", "biotac-bridge", "biotac-pic32") or case == "robotous"
        assert bool(addresses) != serial
        for address in addresses:
            if not address.host.is_multicast:
                assert address.host.is_loopback, address
                continue
            hops = option_of(address.inode, socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
            assert hops == b"\0", "its messages leave the host"
            interface = option_of(address.inode, socket.IPPROTO_IP, socket.IP_MULTICAST_IF, 4)
            assert interface == socket.inet_aton("127.0.0.1")


def test_the_drivers_bus_too_and_they_hear_each_other(others: set[Address]) -> None:
    pytest.importorskip("can")
    port = random.randint(20_000, 30_000)
    group = f"239.74.{random.randint(1, 254)}.{random.randint(1, 254)}"
    bus = CanBus("udp_multicast", group, options={"port": port})
    values = values_of("biotac-can", channel=group, bus=[f"port={port}"])
    bus.open()
    try:
        (address,) = bound() - others
        assert (str(address.host), address.port) == (group, port)
        with make_emulated("biotac-can", values).emulator:
            assert len(bus.read(PATIENCE_S).arrival_ns) > 0
    finally:
        bus.close()


@pytest.mark.parametrize("name", ["kms40", "rdt"])
def test_another_address_has_to_be_told(name: str, others: set[Address]) -> None:
    device = make_emulated(name, values_of(name, host="127.0.0.2"))
    with device.emulator:
        assert {str(address.host) for address in bound() - others} == {"127.0.0.2"}
        assert device.sensors()[0][1]["host"] == "127.0.0.2"


def test_a_bus_between_hosts_has_to_be_told() -> None:
    pytest.importorskip("can")
    port = random.randint(20_000, 30_000)
    more = {"listen": "127.0.0.2", "hop_limit": 1}
    values = values_of("biotac-can", bus=[f"port={port}", "hop_limit=1"], listen="127.0.0.2")
    options = make_emulated("biotac-can", values).sensors()[0][1]["bus_options"]
    assert options == {"port": port, **more}
    for wrong in ("no-address", "192.0.2.77"):
        with pytest.raises(ConfigError, match=f"listen = '{wrong}' is no IPv4 address"):
            open_can({"interface": "udp_multicast", "channel": "239.74.163.2", "listen": wrong})
