"""CAN frames as a socket delivers them: Linux' own, and those of python-can's multicast bus."""

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
"""Class of an error frame: the interface has left the bus (linux/can/error.h)."""

DATA_MAX = 8
"""Bytes of a classic CAN frame."""

_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000
_STANDARD_MASK, _ERROR_MASK = 0x7FF, 0x1FFFFFFF

# struct can_frame of Linux.
_FRAME = np.dtype([("word", "=u4"), ("size", "u1"), ("pad", "u1", 3), ("data", "u1", DATA_MAX)])


class FrameKind(IntEnum):
    """Kinds of frames."""

    DATA = 0
    ERROR = 1
    OTHER = 2
    """A remote frame, CAN FD, a 29-bit identifier, or no CAN frame at all.

    No device of ours sends 29-bit identifiers, and one of them may equal an 11-bit one.
    """


class CanFrame(NamedTuple):
    """A frame: kind, identifier (of an error frame its classes) and data."""

    kind: FrameKind
    can_id: int
    data: bytes


NOTHING = CanFrame(FrameKind.OTHER, 0, b"")


@dataclass(frozen=True, slots=True)
class CanFrames:
    """Frames in order of arrival, as arrays of shape ``(N,)``; data ``(N, 8)``.

    Attributes:
        kind: ``FrameKind`` numbers, uint8.
        can_id: Identifiers, int64.
        size: Bytes of data, int64.
        data: Data, padded with zeros, uint8.
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


def from_socketcan(batch: DatagramBatch) -> CanFrames:
    """Frames of Linux' CAN sockets."""
    fields = np.ascontiguousarray(batch.data[:, : _FRAME.itemsize]).view(_FRAME)[:, 0]
    word = fields["word"]
    kind = np.full(len(batch), FrameKind.DATA, np.uint8)
    kind[(word & _ERROR) != 0] = FrameKind.ERROR
    other = (batch.size != _FRAME.itemsize) | (fields["size"] > DATA_MAX)
    no_error = (word & _ERROR) == 0
    kind[other | no_error & ((word & (_REMOTE | _EXTENDED)) != 0)] = FrameKind.OTHER
    can_id = word & np.where(no_error, np.uint32(_STANDARD_MASK), np.uint32(_ERROR_MASK))
    size = np.where(other, 0, fields["size"]).astype(np.int64)
    data = fields["data"] * (np.arange(DATA_MAX) < size[:, None])
    return CanFrames(kind, can_id.astype(np.int64), size, data.astype(np.uint8))


class MulticastReader:
    """Reads datagrams of python-can's ``udp_multicast`` bus: a map in msgpack.

    Unpacking each takes longer than all that follows. A sender's frames differ only in time and
    data, at fixed offsets; one that otherwise equals the last unpacked one is read by offset.

    Raises:
        MissingExtraError: msgpack is not installed.
    """

    def __init__(self) -> None:
        self._unpack: Callable[[bytes], Any] = require("msgpack", extra="gateway").unpackb
        self._like: CanFrame = NOTHING
        self._raw = np.zeros(0, np.uint8)
        self._same = np.zeros(0, np.bool_)  # whether each byte must be the same
        self._at = 0  # offset of the data

    def __call__(self, batch: DatagramBatch) -> CanFrames:
        """Frames of datagrams."""
        alike = self._alike(batch)
        if not alike.all():
            first = int(np.argmin(alike))
            self._learn(batch.data[first, : batch.size[first]].tobytes())
            alike = self._alike(batch)
        if alike.all():
            size = len(self._like.data)
            data = np.zeros((len(batch), DATA_MAX), np.uint8)
            data[:, :size] = batch.data[:, self._at : self._at + size]
            count = len(batch)
            return CanFrames(
                np.full(count, self._like.kind, np.uint8),
                np.full(count, self._like.can_id, np.int64),
                np.full(count, size, np.int64),
                data,
            )
        sizes = batch.size.tolist()
        rows = zip(batch.data, sizes, strict=True)
        return CanFrames.of([self._one(row[:size].tobytes()) for row, size in rows])

    def _alike(self, batch: DatagramBatch) -> npt.NDArray[np.bool_]:
        """Which datagrams differ from the learnt one in time and data only."""
        length = len(self._raw)
        if not length:
            return np.zeros(len(batch), np.bool_)
        differs = (batch.data[:, :length] != self._raw) & self._same
        alike: npt.NDArray[np.bool_] = (batch.size == length) & ~differs.any(axis=1)
        return alike

    def _learn(self, raw: bytes) -> None:
        """Learn the offsets of time and data from one datagram.

        To prove them, both fields are changed and the datagram is unpacked again.
        """
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
            fields = self._unpack(raw)
            can_id, data = fields["arbitration_id"], fields["data"]
            if fields["is_error_frame"]:
                return CanFrame(FrameKind.ERROR, int(can_id), bytes(data or b"")[:DATA_MAX])
            if fields["is_remote_frame"] or fields["is_fd"] or fields["is_extended_id"]:
                return NOTHING
            if type(can_id) is int and type(data) is bytes and len(data) <= DATA_MAX:
                return CanFrame(FrameKind.DATA, can_id & _STANDARD_MASK, data)
        # Any host may send anything to the group; msgpack alone has six kinds of errors for that.
        except Exception:
            return NOTHING
        return NOTHING


def from_message(message: Any) -> CanFrame:
    """A message of python-can, from any bus."""
    data = bytes(message.data)
    if message.is_error_frame:
        return CanFrame(FrameKind.ERROR, message.arbitration_id, data[:DATA_MAX])
    if message.is_remote_frame or message.is_fd or message.is_extended_id:
        return NOTHING
    if len(data) > DATA_MAX:
        return NOTHING
    return CanFrame(FrameKind.DATA, message.arbitration_id, data)
