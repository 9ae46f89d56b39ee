"""Consistent overhead byte stuffing: packets of any bytes, ended by the byte 0.

A packet is cut before each zero; each piece is sent behind a byte that says how far the next zero
is. No zero is left inside, so a receiver that lost its place finds it at the next zero.


Frames out of a byte stream that may begin anywhere and hold junk.

One search for all serial devices whose frames have a fixed head, a length known from the head and a
check: a head alone is never trusted (hardware reference 4.3), and after a failed check one byte is
dropped, because the true head may stand inside what looked like a frame.


Checksums of the serial devices (hardware reference 2.6, 3.4, 3.5, 3.6).
"""

from __future__ import annotations

import binascii
from collections.abc import Callable, Mapping
from dataclasses import dataclass

DELIMITER = b"\x00"

_LONGEST_PIECE = 254
"""Bytes behind the code 0xFF, the one code that stands for no zero."""


@dataclass(frozen=True, slots=True)
class CobsPacket:
    """One packet as it came out of the stuffing.

    Attributes:
        data: The packet.
        wire_bytes: What it took on the wire, with its delimiter.
        first: It is the first since connecting, so its beginning may be missing: whoever checks a
            checksum drops it without calling it an error.
    """

    data: bytes
    wire_bytes: int
    first: bool


def encode(data: bytes) -> bytes:
    """Stuff a packet; the result has no zero and no delimiter."""
    out = bytearray()
    pieces = data.split(DELIMITER)
    for number, piece in enumerate(pieces):
        while len(piece) >= _LONGEST_PIECE:
            out.append(0xFF)
            out += piece[:_LONGEST_PIECE]
            piece = piece[_LONGEST_PIECE:]
            if not piece and number == len(pieces) - 1:
                return bytes(out)  # the end needs no code of its own
        out.append(len(piece) + 1)
        out += piece
    return bytes(out)


def encode_packet(data: bytes) -> bytes:
    """Stuff a packet and end it with the delimiter."""
    return encode(data) + DELIMITER


def decode(block: bytes) -> bytes | None:
    """The packet in a block without its delimiter; None if a code points beyond the end."""
    if not block or 0 in block:
        return None
    out = bytearray()
    at = 0
    while at < len(block):
        code = block[at]
        end = at + code
        if end > len(block):
            return None
        out += block[at + 1 : end]
        at = end
        if code <= _LONGEST_PIECE and at < len(block):
            out.append(0)
    return bytes(out)


class PacketSplitter:
    """Cuts a stream into packets.

    What comes before the first delimiter may lack its beginning: if it does not decode it is junk,
    but no error. A delimiter that ends nothing is junk too. Bytes counted as junk and the wire
    bytes of the packets, with those ``pending``, are all bytes fed.

    Args:
        max_packet_bytes: Longest packet, unstuffed; longer ones are dropped as they come [bytes].
    """

    def __init__(self, max_packet_bytes: int) -> None:
        if max_packet_bytes < 1:
            raise ValueError(f"longest packet of {max_packet_bytes} bytes is not at least 1")
        self._longest = max_packet_bytes
        # One code for each full piece and one for the rest, which may be empty.
        self._longest_block = max_packet_bytes + max_packet_bytes // _LONGEST_PIECE + 1
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

    def reset(self) -> None:
        """Forget the packet that has begun: the connection is new."""
        self.counters["junk_bytes"] += len(self._block)
        self._block.clear()
        self._dropping = False
        self._first = True

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
        data = decode(block)
        if data is not None and len(data) <= self._longest:
            return CobsPacket(data, len(block) + 1, self._first)
        self.counters["junk_bytes"] += len(block) + 1
        if data is not None:
            self.counters["overlong"] += 1
        elif block and not self._first:
            self.counters["cobs_errors"] += 1
        return None


class FrameFinder:
    """Finds the frames that begin with a known head and pass their check.

    Every byte is accounted for: bytes of returned frames, ``counters["junk_bytes"]``, ``pending``.
    ``counters["failed_checks"]`` counts heads whose frame failed; many of them are chance heads in
    the data that follows one damaged frame.

    Args:
        lengths: Head to length of its whole frame [bytes]. All heads begin with the same byte and
            none begins with another.
        is_good: Whether a whole frame passes its check.
    """

    def __init__(self, lengths: Mapping[bytes, int], is_good: Callable[[bytes], bool]) -> None:
        self._lengths = dict(lengths)
        self._first = next(iter(lengths))[:1]
        if not self._first or any(head[:1] != self._first for head in lengths):
            raise ValueError("the heads do not begin with the same byte")
        self._is_good = is_good
        self._buffer = bytearray()
        self.counters: dict[str, int] = {"junk_bytes": 0, "failed_checks": 0}

    @property
    def pending(self) -> int:
        """Bytes of a frame that has begun; fewer than the longest frame."""
        return len(self._buffer)

    def reset(self) -> None:
        """A new connection: the frame that has begun will not go on, its bytes are junk."""
        self.counters["junk_bytes"] += len(self._buffer)
        self._buffer.clear()

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes as they come; return the frames that are now whole."""
        buffer = self._buffer
        buffer += data
        frames: list[bytes] = []
        at = junk = 0
        while (head := buffer.find(self._first, at)) >= 0:
            junk += head - at
            at = head
            length = self._length_at(at)
            if length > len(buffer) - at:
                break
            frame = bytes(buffer[at : at + length])
            if length and self._is_good(frame):
                frames.append(frame)
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
        return frames

    def _length_at(self, at: int) -> int:
        """Bytes that are needed to go on from here; 0 where no frame begins."""
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


def sum16(data: bytes) -> int:
    """Sum of all bytes modulo 65536."""
    return sum(data) & 0xFFFF
