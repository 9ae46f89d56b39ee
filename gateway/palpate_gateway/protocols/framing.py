"""Frames and packets out of a byte stream, and their checksums.

Two ways to find a frame: COBS packets end with a zero that occurs nowhere inside; other serial
devices send a fixed head, a length known from the head, and a check (hardware reference 4.3).
"""

from __future__ import annotations

import binascii
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from cobs import cobs

DELIMITER = b"\x00"

_LONGEST_RUN = 254
"""COBS puts a code byte before each run of at most so many bytes."""

Record = TypeVar("Record")


@dataclass(frozen=True, slots=True)
class CobsPacket:
    """One packet without its stuffing.

    Attributes:
        data: The packet.
        wire_bytes: Length on the wire, with stuffing and delimiter.
        first: It is the first since connecting, so its beginning may be missing: a wrong checksum
            is then no error.
    """

    data: bytes
    wire_bytes: int
    first: bool


def unstuffed(block: bytes) -> bytes | None:
    """The packet in a block without its delimiter; None if the block is no COBS."""
    if not block:
        return None
    try:
        return bytes(cobs.decode(block))
    except cobs.DecodeError:
        return None


class PacketSplitter:
    """Cuts a stream of COBS packets at the zeros that end them, and removes the stuffing.

    Bytes before the first zero may be the end of a packet: if they do not decode they are junk, but
    no error. A zero that ends nothing is junk too. Bytes counted as junk, the wire bytes of the
    packets and those ``pending`` add up to all bytes fed.

    Args:
        max_packet_bytes: Longest packet without stuffing; longer ones are dropped early [bytes].
    """

    def __init__(self, max_packet_bytes: int) -> None:
        if max_packet_bytes < 1:
            raise ValueError(f"longest packet of {max_packet_bytes} bytes is not at least 1")
        self._longest = max_packet_bytes
        # One code for each full run of 254 bytes, and one for the rest, which may be empty.
        self._longest_block = max_packet_bytes + max_packet_bytes // _LONGEST_RUN + 1
        self._block = bytearray()
        self._dropping = False
        self._first = True
        self.counters: dict[str, int] = {"cobs_errors": 0, "overlong": 0, "junk_bytes": 0}

    @property
    def pending(self) -> int:
        """Bytes of the packet that has begun."""
        return len(self._block)

    def feed(self, data: bytes) -> list[CobsPacket]:
        """Take the next bytes; return the packets that they complete."""
        packets = []
        *ended, rest = bytes(data).split(DELIMITER)
        for part in ended:
            self._hold(part)
            packet = self._end()
            self._first = False
            if packet is not None:
                packets.append(packet)
        self._hold(rest)
        return packets

    def _hold(self, part: bytes) -> None:
        if not self._dropping:
            self._block += part
            if len(self._block) <= self._longest_block:
                return
            self._dropping = True
            self.counters["overlong"] += 1
            self.counters["junk_bytes"] += len(self._block)
            self._block.clear()
        else:
            self.counters["junk_bytes"] += len(part)

    def _end(self) -> CobsPacket | None:
        block = bytes(self._block)
        self._block.clear()
        if self._dropping:
            self._dropping = False
            self.counters["junk_bytes"] += 1
            return None
        data = unstuffed(block)
        if data is not None and len(data) <= self._longest:
            return CobsPacket(data, len(block) + 1, self._first)
        self.counters["junk_bytes"] += len(block) + 1
        if data is not None:
            self.counters["overlong"] += 1
        elif block and not self._first:
            self.counters["cobs_errors"] += 1
        return None


class FrameFinder(Generic[Record]):
    """Finds the frames that begin with a known head and pass their check.

    After a failed check only one byte is dropped, because the true head may stand inside what
    looked like a frame. Every byte is accounted for: bytes of returned frames,
    ``counters["junk_bytes"]``, ``pending``. ``counters["failed_checks"]`` counts heads whose frame
    failed; many of them are heads by chance in the data that follows one damaged frame.

    Args:
        lengths: Head to length of its whole frame [bytes]. All heads begin with the same byte, and
            no head is the beginning of another.
        is_good: Whether a whole frame passes its check.
        read: Makes the record of a good frame.
    """

    def __init__(
        self,
        lengths: Mapping[bytes, int],
        is_good: Callable[[bytes], bool],
        read: Callable[[bytes], Record],
    ) -> None:
        self._lengths = dict(lengths)
        self._first = next(iter(lengths))[:1]
        if not self._first or any(head[:1] != self._first for head in lengths):
            raise ValueError("the heads do not begin with the same byte")
        self._is_good, self._read = is_good, read
        self._buffer = bytearray()
        self.counters: dict[str, int] = {"junk_bytes": 0, "failed_checks": 0}

    @property
    def pending(self) -> int:
        """Bytes of a frame that has begun; fewer than the longest frame."""
        return len(self._buffer)

    def reset(self) -> None:
        """A new connection: the frame that has begun is junk; counters are kept."""
        self.counters["junk_bytes"] += len(self._buffer)
        self._buffer.clear()

    def feed(self, data: bytes) -> list[Record]:
        """Take bytes as they come; return the records of the frames that are now whole."""
        buffer = self._buffer
        buffer += data
        records: list[Record] = []
        at = junk = 0
        while (head := buffer.find(self._first, at)) >= 0:
            junk += head - at
            at = head
            length = self._length_at(at)
            if length > len(buffer) - at:
                break
            frame = bytes(buffer[at : at + length])
            if length and self._is_good(frame):
                records.append(self._read(frame))
                at += length
            else:
                self.counters["failed_checks"] += length > 0
                junk += 1
                at += 1
        else:
            junk += len(buffer) - at
            at = len(buffer)
        del buffer[:at]
        self.counters["junk_bytes"] += junk
        return records

    def _length_at(self, at: int) -> int:
        """Length of the frame or head that begins here; 0 where none does."""
        for head, length in self._lengths.items():
            begun = bytes(self._buffer[at : at + len(head)])
            if begun == head:
                return length
            if begun and head.startswith(begun):  # the buffer ends inside a head
                return len(head)
        return 0


_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
"""Each byte with its bits in reverse."""


def crc16_x25(data: bytes) -> int:
    """CRC-16/X-25: polynomial 0x1021 reflected, initial value FFFF, final xor FFFF.

    The ASCII digits ``123456789`` give 0x906E.
    """
    # The standard library has the same polynomial for bits in the other order.
    crc = binascii.crc_hqx(data.translate(_REVERSED), 0xFFFF)
    return (_REVERSED[crc & 0xFF] << 8 | _REVERSED[crc >> 8]) ^ 0xFFFF


def sum8(data: bytes) -> int:
    """Sum of all bytes modulo 256."""
    return sum(data) & 0xFF
