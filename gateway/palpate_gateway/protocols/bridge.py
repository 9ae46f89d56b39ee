"""Packets of a microcontroller bridge (format D, hardware reference 2.6): this project's own.

A packet is a header, a body and CRC-16/X-25 over both, all little-endian, stuffed by COBS and ended
by 0. The slots travel verbatim, as in format A, so that parity, error words and absence stay
visible to the host. Firmware should send one zero before its first packet.

    header   u8 version, u8 type, u8 source, u8 flags, u16 sequence, u32 device time [us]
    HELLO    u8 fingers n, u16 slots per second, u8 slots per frame, n x (16 B serial, 4 B firmware)
    SLOTS    u8 count k, u8 fingers n, k x (command byte, n x 2 bytes)
    STATUS   u8 fingers n, n x u32 parity errors, u32 error words, u32 overruns
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

from palpate_gateway.protocols.can_slots import FINGERS_MAX
from palpate_gateway.protocols.framing import CobsPacket, PacketSplitter, crc16_x25
from palpate_gateway.protocols.spi import printable_prefix

VERSION = 1

SLOTS_MAX = 255
"""Most slots of a packet, by the size of its count; 22 to 44 are usual."""

_HEADER = struct.Struct("<BBBBHI")
_HELLO = struct.Struct("<BHB")
_FINGER = struct.Struct("<16s4s")
_SLOTS = struct.Struct("<BB")
_CRC = struct.Struct("<H")
_LONGEST = _HEADER.size + _SLOTS.size + SLOTS_MAX * (1 + 2 * FINGERS_MAX) + _CRC.size


class BridgePacketType(IntEnum):
    """Kinds of packets."""

    HELLO = 1
    SLOTS = 2
    STATUS = 3


@dataclass(frozen=True, slots=True)
class BridgeHeader:
    """Head of every packet.

    Attributes:
        source: Id of the bridge, 0..255.
        flags: Not used yet, 0..255.
        sequence: Number of the packet modulo 65536, counted for each source over all types.
        device_time_us: Time of the first slot, or of sending where there is none, modulo 2**32.
    """

    source: int
    flags: int
    sequence: int
    device_time_us: int


@dataclass(frozen=True, slots=True)
class BridgeFinger:
    """Identity of a finger: serial (up to 16 ASCII) and firmware (up to 4); empty if unknown."""

    serial: str
    firmware: str


@dataclass(frozen=True, slots=True)
class BridgeHello:
    """What the bridge sends about itself at start and every few seconds.

    Attributes:
        slot_rate_hz: Slots per second, 0..65535.
        slots_per_frame: Slots after which the sequence begins again, 0..255.
        fingers: The fingers in order of the ports, 1..5.
    """

    slot_rate_hz: int
    slots_per_frame: int
    fingers: tuple[BridgeFinger, ...]


@dataclass(frozen=True, slots=True)
class BridgeSlots:
    """Consecutive slots.

    Attributes:
        fingers: Words in each slot, 1..5.
        payloads: Command byte and words as clocked from SPI; ``can_slots.SlotDecoder`` reads them.
    """

    fingers: int
    payloads: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class BridgeStatus:
    """Counters of the bridge since its start, each modulo 2**32.

    Attributes:
        parity_errors: Words of wrong parity of each finger, 1..5 fingers.
        error_words: Error words of all fingers.
        overruns: Packets or slots that the bridge had to drop.
    """

    parity_errors: tuple[int, ...]
    error_words: int
    overruns: int


BridgeBody = BridgeHello | BridgeSlots | BridgeStatus


@dataclass(frozen=True, slots=True)
class BridgeRecord:
    """One good packet.

    Attributes:
        header: Its header, raw.
        body: Its body.
        lost_before: Packets of this source that are missing directly before this one.
        epoch: Number of the start of this source; times of two epochs do not compare.
        time_us: Unwrapped device time of this epoch [us].
    """

    header: BridgeHeader
    body: BridgeBody
    lost_before: int
    epoch: int
    time_us: int


def decode_body(kind: int, data: bytes) -> BridgeBody | None:
    """The body of a packet; None if its type is unknown or its length or count of fingers wrong."""
    if kind == BridgePacketType.SLOTS and len(data) >= _SLOTS.size:
        slots, count = _SLOTS.unpack_from(data)
        size = 1 + 2 * count
        if not 1 <= count <= FINGERS_MAX or len(data) != _SLOTS.size + slots * size:
            return None
        starts = range(_SLOTS.size, len(data), size)
        return BridgeSlots(count, tuple(data[at : at + size] for at in starts))
    if kind == BridgePacketType.HELLO and len(data) >= _HELLO.size:
        count, rate_hz, slots = _HELLO.unpack_from(data)
        if not 1 <= count <= FINGERS_MAX or len(data) != _HELLO.size + count * _FINGER.size:
            return None
        names = _FINGER.iter_unpack(data[_HELLO.size :])
        fingers = tuple(BridgeFinger(printable_prefix(a), printable_prefix(b)) for a, b in names)
        return BridgeHello(rate_hz, slots, fingers)
    if kind == BridgePacketType.STATUS and data:
        count = data[0]
        if not 1 <= count <= FINGERS_MAX or len(data) != 1 + 4 * (count + 2):
            return None
        *parity_errors, error_words, overruns = struct.unpack_from(f"<{count + 2}I", data, 1)
        return BridgeStatus(tuple(parity_errors), error_words, overruns)
    return None


class BridgeDecoder:
    """Good packets out of a stream, and the number of packets missing between them.

    Bytes of the returned packets, ``counters["junk_bytes"]`` and ``pending`` add up to all bytes
    fed.
    """

    def __init__(self) -> None:
        self._splitter = PacketSplitter(_LONGEST)
        self._tracks: dict[int, BridgePacketTrack] = {}
        self._epochs: dict[int, int] = {}
        self.counters = self._splitter.counters
        self.counters |= dict.fromkeys(
            ("packets", "short_packets", "crc_errors", "unknown_versions", "unknown_types"), 0
        )
        self.counters |= dict.fromkeys(
            ("bad_bodies", "lost_packets", "repeated_packets", "restarts"), 0
        )

    @property
    def pending(self) -> int:
        """Bytes of the packet that has begun."""
        return self._splitter.pending

    def feed(self, data: bytes) -> list[BridgeRecord]:
        """Take bytes as they come; return the packets that are now whole."""
        records = []
        for packet in self._splitter.feed(data):
            record = self._record(packet)
            if record is None:
                self.counters["junk_bytes"] += packet.wire_bytes
            else:
                records.append(record)
        self.counters["packets"] += len(records)
        return records

    def _record(self, packet: CobsPacket) -> BridgeRecord | None:
        data = packet.data[: -_CRC.size]
        flaw = ""
        if len(data) < _HEADER.size:
            flaw = "short_packets"
        elif _CRC.pack(crc16_x25(data)) != packet.data[-_CRC.size :]:
            flaw = "crc_errors"
        if flaw:
            self.counters[flaw] += not packet.first
            return None
        version, kind, source, flags, sequence, time_us = _HEADER.unpack_from(data)
        if version != VERSION:
            self.counters["unknown_versions"] += 1
            return None
        header = BridgeHeader(source, flags, sequence, time_us)
        body = decode_body(kind, data[_HEADER.size :])
        lost = self._follow(header, hello=kind == BridgePacketType.HELLO)
        if lost is None:
            self.counters["repeated_packets"] += 1
            return None
        self.counters["lost_packets"] += lost
        if body is None:
            known = kind in BridgePacketType.__members__.values()
            self.counters["bad_bodies" if known else "unknown_types"] += 1
            return None
        time_us = self._tracks[source].time_us
        return BridgeRecord(header, body, lost, self._epochs[source], time_us)

    def _follow(self, header: BridgeHeader, *, hello: bool) -> int | None:
        """How many packets are missing before this one; None if it is a repetition."""
        sequence, time_us = header.sequence, header.device_time_us
        track = self._tracks.get(header.source)
        if track is not None and not track.has_restarted(sequence, time_us, hello=hello):
            return track.follow(sequence, time_us)
        self.counters["restarts"] += track is not None
        self._tracks[header.source] = BridgePacketTrack(sequence, time_us)
        self._epochs[header.source] = self._epochs.get(header.source, -1) + 1
        return 0


_SEQUENCES = 1 << 16
_TIMES = 1 << 32

_LATE_US = 1_000_000
"""By how much slots sent after a HELLO may have been sampled before it [us]."""

_SILENT_US = 10_000_000
"""Longest time between two packets [us]: a line that is silent for so long is opened again."""


@dataclass(slots=True)
class BridgePacketTrack:
    """Number and time of the last packet of a bridge since it started.

    Attributes:
        sequence: Number of its last packet, modulo 65536.
        time_us: Device time of that packet, unwrapped [us].
    """

    sequence: int
    time_us: int

    def has_restarted(self, sequence: int, time_us: int, *, hello: bool) -> bool:
        """Whether the bridge has restarted before the next packet.

        Then the time goes back in a HELLO, or together with the packet number, or by more than
        slots can be late; or it jumps forwards.
        """
        step = _signed(sequence - self.sequence, _SEQUENCES)
        elapsed_us = _signed(time_us - self.time_us, _TIMES)
        if elapsed_us < 0 and (hello or step < 0 or elapsed_us < -_LATE_US):
            return True
        # After more than 36 minutes the time of a restarted bridge looks like one that has wrapped,
        # mostly by far too much; and the first HELLO after a start has number 0, which is then out
        # of sequence.
        if elapsed_us > _SILENT_US:
            return True
        return hello and sequence == 0 and step != 1 and time_us < self.time_us % _TIMES

    def follow(self, sequence: int, time_us: int) -> int | None:
        """Advance to the next packet, by its number modulo 65536 and its time modulo 2**32 [us].

        Returns how many packets are missing before it; None if it repeats the last.
        """
        lost = (sequence - self.sequence - 1) % _SEQUENCES
        if lost == _SEQUENCES - 1:
            return None
        self.sequence = sequence
        self.time_us += _signed(time_us - self.time_us, _TIMES)
        return lost


def _signed(difference: int, modulus: int) -> int:
    """The difference of two counters that wrap, by the shorter way around."""
    half = modulus // 2
    return (difference + half) % modulus - half
