"""A CAN bus by python-can; its bus over UDP stays on this host unless told otherwise.

python-can itself listens on every address of the host, and its messages travel into the network.
"""

from __future__ import annotations

import socket
import struct
from typing import Any

from palpate.config import is_loopback
from palpate.errors import ConfigError
from palpate.process import require

MULTICAST = "udp_multicast"
"""python-can's name of its bus over UDP."""

LOOPBACK = "127.0.0.1"

_LOOPBACK_LINK = "lo"
_TIMESTAMPS_NS = 35
"""SO_TIMESTAMPNS, which Python does not name."""


def open_can(arguments: dict[str, Any]) -> Any:
    """A bus of python-can, by its arguments.

    One of the kind ``udp_multicast`` may have the argument ``listen``: the address of the network
    that it joins, of an IPv6 group the name of its link; without it only this host hears it.

    Raises:
        ConfigError: There is no such address or link.
        MissingExtraError: python-can is not installed.
        Exception: Those of python-can, e.g. ``CanError``, ``OSError``, ``TypeError``.
    """
    can: Any = require("can", extra="gateway")
    if arguments.get("interface") != MULTICAST:
        return can.Bus(**arguments)
    more = {key: value for key, value in arguments.items() if key != "interface"}
    listen = str(more.pop("listen", LOOPBACK))
    listen = LOOPBACK if listen == "localhost" else listen
    module: Any = require("can.interfaces.udp_multicast.bus", extra="gateway")
    group_class: Any = module.GeneralPurposeUdpMulticastBus
    local = is_loopback(listen) or listen == _LOOPBACK_LINK

    class Group(group_class):  # type: ignore[misc]
        """Joins the group at one address only, and hears nothing but the group."""

        def _create_socket(self, address_family: socket.AddressFamily) -> socket.socket:
            made = _joined(address_family, self.group, self.port, self.hop_limit, listen)
            self.timestamp_nanosecond = True
            return made

    class Bus(module.UdpMulticastBus):  # type: ignore[misc]
        """python-can's own bus with another socket."""

        def __init__(
            self, channel: str, port: int = 43113, hop_limit: int = 0 if local else 1, **more: Any
        ) -> None:
            fd = more.pop("fd", True)
            can.BusABC.__init__(self, channel, **more)
            self._multicast = Group(channel, port, hop_limit)
            self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20

    require("msgpack", extra="gateway")
    return Bus(**more)


def _joined(family: int, group: str, port: int, hops: int, listen: str) -> socket.socket:
    made = socket.socket(family, socket.SOCK_DGRAM)
    try:
        for option in (socket.SO_REUSEADDR, socket.SO_REUSEPORT, _TIMESTAMPS_NS):
            made.setsockopt(socket.SOL_SOCKET, option, 1)
        if family == socket.AF_INET:
            address = socket.inet_aton(_checked(listen))
            made.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, hops)
            made.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, address)
            made.bind((group, port))  # not to "": only what is sent to the group is heard
            membership = socket.inet_aton(group) + address
            made.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        else:
            link = _link(listen)
            made.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, hops)
            made.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, link)
            made.bind((group, port, 0, link))
            membership = socket.inet_pton(family, group) + struct.pack("@I", link)
            made.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, membership)
    except BaseException:
        made.close()
        raise
    return made


def _checked(listen: str) -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            socket.inet_aton(listen)
            probe.bind((listen, 0))
        except OSError as error:
            raise ConfigError(
                f"listen = {listen!r} is no IPv4 address of this host",
                remedy="give one of `ip address`, or leave it out: only this host hears the bus",
            ) from error
    return listen


def _link(listen: str) -> int:
    name = _LOOPBACK_LINK if is_loopback(listen) else listen
    try:
        return socket.if_nametoindex(name)
    except OSError as error:
        raise ConfigError(
            f"listen = {listen!r} is no network link of this host",
            remedy="of an IPv6 group, give the name of a link (`ip link`), e.g. eth0",
        ) from error
