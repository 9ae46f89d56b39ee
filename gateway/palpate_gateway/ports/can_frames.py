"""CAN frames as they lie in a socket: Linux' own, and those of python-can's multicast bus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from palpate.process import require
from palpate_gateway.ports.datagrams import DatagramBatch

BUS_OFF = 0x40
"""Class of an error frame that says that the interface has left the bus (linux/can/error.h)."""

DATA_MAX = 8
"""Bytes of a classic CAN frame."""

_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000
_STANDARD_MASK, _EXTENDED_MASK = 0x7FF, 0x1FFFFFFF

# struct can_frame of Linux.
_FRAME = np.dtype([("word", "=u4"), ("size", "u1"), ("pad", "u1", 3), ("data", "u1", DATA_MAX)])


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


@dataclass(frozen=True, slots=True)
class CanFrames:
    """Frames in order of their coming, as arrays of shape ``(N,)``; data ``(N, 8)``.

    Attributes:
        kind: ``FrameKind`` numbers, uint8.
        can_id: Identifiers, int64.
        size: Bytes of data, int64.
        data: Data with zeros behind them, uint8.
    """

    kind: npt.NDArray[np.uint8]
    can_id: npt.NDArray[np.int64]
    size: npt.NDArray[np.int64]
    data: npt.NDArray[np.uint8]

    @classmethod
    def of(cls, frames: Sequence[CanFrame]) -> CanFrames:
        """Single frames as arrays."""
        data = b"".join(frame.data.ljust(DATA_MAX, b"\0") for frame in frames)
        return cls(
            np.array([frame.kind for frame in frames], np.uint8),
            np.array([frame.can_id for frame in frames], np.int64),
            np.array([len(frame.data) for frame in frames], np.int64),
            np.frombuffer(data, np.uint8).reshape(-1, DATA_MAX),
        )

    def those(self, kept: npt.NDArray[np.bool_]) -> CanFrames:
        """Some of them."""
        return CanFrames(self.kind[kept], self.can_id[kept], self.size[kept], self.data[kept])


Reader = Callable[[DatagramBatch], CanFrames]


def from_socketcan(waiting: DatagramBatch) -> CanFrames:
    """Frames of Linux' CAN sockets."""
    told = np.ascontiguousarray(waiting.data[:, : _FRAME.itemsize]).view(_FRAME)[:, 0]
    word = told["word"]
    kind = np.full(len(waiting), FrameKind.DATA, np.uint8)
    kind[(word & _ERROR) != 0] = FrameKind.ERROR
    other = (waiting.size != _FRAME.itemsize) | (told["size"] > DATA_MAX)
    kind[other | ((word & (_REMOTE | _ERROR)) == _REMOTE)] = FrameKind.OTHER
    short = (word & (_EXTENDED | _ERROR)) == 0
    can_id = word & np.where(short, np.uint32(_STANDARD_MASK), np.uint32(_EXTENDED_MASK))
    size = np.where(other, 0, told["size"]).astype(np.int64)
    data = told["data"] * (np.arange(DATA_MAX) < size[:, None])
    return CanFrames(kind, can_id.astype(np.int64), size, data.astype(np.uint8))


class MulticastReader:
    """Reads what python-can's ``udp_multicast`` bus sends: a map in msgpack.

    To unpack each takes longer than all that follows. A sender's frames differ in their time and
    data only, at the same places: what equals the last unpacked one elsewhere need not be unpacked.

    Raises:
        MissingExtraError: msgpack is not installed.
    """

    def __init__(self) -> None:
        self._unpack: Callable[[bytes], Any] = require("msgpack", extra="gateway").unpackb
        self._like: CanFrame = NOTHING
        self._raw = np.zeros(0, np.uint8)
        self._same = np.zeros(0, np.bool_)  # of each byte, whether it must be the same
        self._at = 0  # where data begin

    def __call__(self, waiting: DatagramBatch) -> CanFrames:
        """Frames of datagrams."""
        alike = self._alike(waiting)
        if not alike.all():
            first = int(np.argmin(alike))
            self._learn(waiting.data[first, : waiting.size[first]].tobytes())
            alike = self._alike(waiting)
        if alike.all():
            size = len(self._like.data)
            data = np.zeros((len(waiting), DATA_MAX), np.uint8)
            data[:, :size] = waiting.data[:, self._at : self._at + size]
            count = len(waiting)
            return CanFrames(
                np.full(count, self._like.kind, np.uint8),
                np.full(count, self._like.can_id, np.int64),
                np.full(count, size, np.int64),
                data,
            )
        sizes = waiting.size.tolist()
        rows = zip(waiting.data, sizes, strict=True)
        return CanFrames.of([self._one(row[:size].tobytes()) for row, size in rows])

    def _alike(self, waiting: DatagramBatch) -> npt.NDArray[np.bool_]:
        """Which are like the one that was learnt."""
        length = len(self._raw)
        if not length:
            return np.zeros(len(waiting), np.bool_)
        differs = (waiting.data[:, :length] != self._raw) & self._same
        alike: npt.NDArray[np.bool_] = (waiting.size == length) & ~differs.any(axis=1)
        return alike

    def _learn(self, raw: bytes) -> None:
        """Take one for what others are like, if it is shown where its time and data stand."""
        frame = self._one(raw)
        size = len(frame.data)
        at = raw.find(b"\xa4data\xc4" + bytes([size])) + len(b"\xa4data\xc4n")
        time_at = raw.find(b"\xa9timestamp\xcb") + len(b"\xa9timestamp\xcb")
        may_differ = np.zeros(len(raw), np.bool_)
        may_differ[at : at + size] = may_differ[time_at : time_at + 8] = True
        other = np.frombuffer(raw, np.uint8) ^ np.where(may_differ, np.uint8(0x55), np.uint8(0))
        shown = self._one(other.tobytes())
        turned = bytes(byte ^ 0x55 for byte in frame.data)
        self._raw = np.zeros(0, np.uint8)
        if frame.kind is FrameKind.DATA and shown == frame._replace(data=turned):
            self._raw, self._same = np.frombuffer(raw, np.uint8), ~may_differ
            self._like, self._at = frame, at

    def _one(self, raw: bytes) -> CanFrame:
        try:
            told = self._unpack(raw)
            can_id, data = told["arbitration_id"], told["data"]
            if told["is_error_frame"]:
                return CanFrame(FrameKind.ERROR, int(can_id), bytes(data or b"")[:DATA_MAX])
            if told["is_remote_frame"] or told["is_fd"]:
                return NOTHING
            if type(can_id) is int and type(data) is bytes and len(data) <= DATA_MAX:
                return CanFrame(FrameKind.DATA, can_id & _EXTENDED_MASK, data)
        # Anybody may send to the group, anything: msgpack alone has six kinds of errors for it.
        except Exception:
            return NOTHING
        return NOTHING


def from_message(message: Any) -> CanFrame:
    """A message of python-can, whatever bus it came by."""
    data = bytes(message.data)
    if message.is_error_frame:
        return CanFrame(FrameKind.ERROR, message.arbitration_id, data[:DATA_MAX])
    if message.is_remote_frame or message.is_fd or len(data) > DATA_MAX:
        return NOTHING
    return CanFrame(FrameKind.DATA, message.arbitration_id, data)
