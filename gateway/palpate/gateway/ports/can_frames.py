"""CAN frames as they lie in a socket: Linux' own, and those of python-can's multicast bus."""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

from palpate.protos.extras import require

BUS_OFF = 0x40
"""Class of an error frame that says that the interface has left the bus (linux/can/error.h)."""

_FRAME = struct.Struct("=IB3x8s")
_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000
_STANDARD_MASK, _EXTENDED_MASK = 0x7FF, 0x1FFFFFFF


class FrameKind(IntEnum):
    """What a frame is."""

    DATA = 0
    ERROR = 1
    OTHER = 2
    """Remote, of CAN FD, or nothing of CAN at all."""


class CanFrame(NamedTuple):
    """A frame: kind, identifier (of an error frame its classes) and data."""

    kind: FrameKind
    can_id: int
    data: bytes


NOTHING = CanFrame(FrameKind.OTHER, 0, b"")

Reader = Callable[[bytes], CanFrame]


def from_socketcan(raw: bytes) -> CanFrame:
    """A ``struct can_frame`` of Linux."""
    if len(raw) != _FRAME.size:
        return NOTHING
    word, size, data = _FRAME.unpack(raw)
    if size > 8:
        return NOTHING
    if word & _ERROR:
        return CanFrame(FrameKind.ERROR, word & _EXTENDED_MASK, data[:size])
    if word & _REMOTE:
        return NOTHING
    can_id = word & (_EXTENDED_MASK if word & _EXTENDED else _STANDARD_MASK)
    return CanFrame(FrameKind.DATA, can_id, data[:size])


def multicast_reader() -> Reader:
    """A function that reads what python-can's ``udp_multicast`` bus sends: a map in msgpack.

    Raises:
        MissingExtraError: msgpack is not installed.
    """
    unpack: Callable[[bytes], Any] = require("msgpack", extra="gateway").unpackb

    def from_multicast(raw: bytes) -> CanFrame:
        try:
            told = unpack(raw)
            can_id, data = told["arbitration_id"], told["data"]
            if told["is_error_frame"]:
                return CanFrame(FrameKind.ERROR, int(can_id), bytes(data or b""))
            if told["is_remote_frame"] or told["is_fd"]:
                return NOTHING
            if type(can_id) is int and type(data) is bytes and len(data) <= 8:
                return CanFrame(FrameKind.DATA, can_id, data)
        # Anybody may send to the group, anything: msgpack alone has six kinds of errors for it.
        except Exception:
            return NOTHING
        return NOTHING

    return from_multicast


def from_message(message: Any) -> CanFrame:
    """A message of python-can, whatever bus it came by."""
    if message.is_error_frame:
        return CanFrame(FrameKind.ERROR, message.arbitration_id, bytes(message.data))
    if message.is_remote_frame or message.is_fd:
        return NOTHING
    return CanFrame(FrameKind.DATA, message.arbitration_id, bytes(message.data))
