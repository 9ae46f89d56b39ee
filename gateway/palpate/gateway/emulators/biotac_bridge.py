"""A microcontroller bridge in software, on a serial line (format D, hardware reference 2.6).

Written from the page and the byte table of the format, with a COBS and a CRC of its own. What they
leave open is decided here: one sequence counts the packets of all types; a HELLO and a STATUS carry
the time of the next slot; silence and unplugging lose packets that were counted.
"""

from __future__ import annotations

import random
import struct
import time
from collections.abc import Sequence
from typing import ClassVar

from palpate.gateway.emulators.biotac_can import COMMANDS, PAC_COMMAND, CountSource, idle_counts
from palpate.gateway.emulators.emulator import Emulator
from palpate.gateway.emulators.serial_line import SerialLine

HELLO, SLOTS, STATUS = 1, 2, 3
"""Types of packets."""

SLOTS_PER_PACKET = (22, 44)
"""Fewest and most slots of a packet: 5 to 10 ms."""

_VERSION = 1
_DRIFT = 200e-6
_WORD_FAULTS = ("parity", "absent", "error_word", "saturated", "stuck")


class BiotacBridgeEmulator(Emulator):
    """The bridge and its fingers.

    Args:
        fingers: Fingers that it samples.
        counts: What they measure.
        serials: Their serial numbers; () = ``BT-EMU-1`` and so on.
        source: Its source id.
        baud: Its speed [bit/s].
        path: Name of the line; "" = a new one.
        slot_rate_hz: Slots each second.
        slots_per_packet: Slots of a packet, 22..44.
        pac_first: Whether a sampling round begins with PAC.
        hello_s: Time between two HELLOs [s].
        status_s: Time between two STATUSes [s].
        sequence: Number of the first packet after the start.
        clock_us: Its clock at the start [us].
    """

    faults: ClassVar[frozenset[str]] = frozenset(
        "crc cut junk lost repeated silence restart unplug clock_drift".split()
    ) | frozenset(_WORD_FAULTS)

    def __init__(
        self,
        *,
        fingers: int = 3,
        counts: CountSource = idle_counts,
        serials: Sequence[str] = (),
        source: int = 1,
        baud: int = 460800,
        path: str = "",
        slot_rate_hz: float = 4400.0,
        slots_per_packet: int = 44,
        pac_first: bool = False,
        hello_s: float = 2.0,
        status_s: float = 1.0,
        sequence: int = 0,
        clock_us: int = 0,
    ) -> None:
        super().__init__(slot_rate_hz)
        fewest, most = SLOTS_PER_PACKET
        if not fewest <= slots_per_packet <= most:
            raise ValueError(f"slots_per_packet {slots_per_packet} is not in {fewest}..{most}")
        self._fingers, self._counts, self._source = fingers, counts, source
        self._serials = serials or [f"BT-EMU-{finger + 1}" for finger in range(fingers)]
        self._line = SerialLine(baud, path)
        self._order = _order(pac_first=pac_first)
        self._together = slots_per_packet
        self._hello_slots = max(1, round(hello_s * slot_rate_hz))
        self._status_slots = max(1, round(status_s * slot_rate_hz))
        self._random = random.Random(4)
        self.parity_errors = [0] * fingers
        self.error_words = 0
        self._boot()
        self._sequence, self._clock_us = sequence, float(clock_us)

    @property
    def address(self) -> str:
        """The line's name."""
        return self._line.path

    def _boot(self) -> None:
        self._slot = self._sequence = 0
        self._clock_us = 0.0
        self._began_s = time.monotonic()
        self.parity_errors = [0] * self._fingers
        self.error_words = 0
        self._next_hello = 0
        self._next_status = self._status_slots

    def _listen(self) -> None:
        self._line.plug()

    def _hang_up(self) -> None:
        self._line.close()

    def _serve(self) -> None:
        self._began_s = time.monotonic()
        self._line.write(b"\0")  # ends whatever noise the start has made
        while not self._stop.is_set():
            self._line.keep_plugged(not self.faulty("unplug"))
            if self.faulty("restart"):
                self._boot()
                self._line.write(b"\0")
            due = int((time.monotonic() - self._began_s) * self.rate_hz)
            if due - self._slot > self.rate_hz:  # the process was stopped for more than a second
                self._began_s += (due - self._slot) / self.rate_hz
            while self._slot + self._together <= due and not self._stop.is_set():
                self._announce()
                self._sample()
            self._stop.wait(1e-3)

    def _announce(self) -> None:
        """Send what is due besides slots."""
        if self._slot >= self._next_hello:
            self._next_hello = self._slot + self._hello_slots
            body = struct.pack("<BHB", self._fingers, round(self.rate_hz), len(self._order))
            for serial in self._serials:
                body += struct.pack("<16s4s", serial.encode("ascii"), b"0203")
            self._send(HELLO, body)
        if self._slot >= self._next_status:
            self._next_status = self._slot + self._status_slots
            numbers = (*self.parity_errors, self.error_words, self._line.overrun)
            self._send(STATUS, struct.pack(f"<B{len(numbers)}I", self._fingers, *numbers))

    def _sample(self) -> None:
        clock_us = self._clock_us
        body = bytearray([self._together, self._fingers])
        for _ in range(self._together):
            command, index = self._order[self._slot % len(self._order)]
            body.append(command)
            faults = {fault for fault in _WORD_FAULTS if self.faulty(fault)}
            for finger in range(self._fingers):
                body += self._word(finger, index, faults)
            drift = _DRIFT if self.faulty("clock_drift") else 0.0
            self._clock_us += 1e6 / self.rate_hz * (1.0 + drift)
            self._slot += 1
        self._send(SLOTS, bytes(body), clock_us)

    def _word(self, finger: int, index: int, faults: set[str]) -> bytes:
        """What a finger answers. The first has the faults of words, the last may be absent."""
        time_s = 0.0 if "stuck" in faults else self._slot / self.rate_hz
        value = self._counts(time_s, finger)[index]
        if "absent" in faults and finger == self._fingers - 1:
            return b"\x00\x00"
        if "saturated" in faults:
            value = 4095
        first, second = _odd((value >> 5) << 1), _odd((value & 0x1F) << 3)
        if "error_word" in faults and finger == 0:
            self.error_words += 1
            return b"\xa5\x2d"  # too little sampling delay
        if "parity" in faults and finger == 0:
            self.parity_errors[finger] += 1
            first ^= 0x10
        return bytes([first, second])

    def _send(self, kind: int, body: bytes, clock_us: float | None = None) -> None:
        sequence, self._sequence = self._sequence, (self._sequence + 1) % 2**16
        ticks = round(self._clock_us if clock_us is None else clock_us) % 2**32
        packet = struct.pack("<4BHI", _VERSION, kind, self._source, 0, sequence, ticks) + body
        packet += struct.pack("<H", crc16_x25(packet))
        if kind != SLOTS:
            if not self.faulty("silence"):
                self._line.write(stuffed(packet))
            return
        if self.faulty("silence") or self.faulty("lost"):
            return
        if self.faulty("crc"):
            wrong = bytearray(packet)
            wrong[self._random.randrange(len(wrong))] ^= 1 << self._random.randrange(8)
            self._line.write(stuffed(bytes(wrong)))
        elif self.faulty("cut"):
            # Without its end it takes the next packet with it.
            self._line.write(stuffed(packet)[: self._random.randrange(1, len(packet))])
        elif self.faulty("junk"):
            noise = self._random.randbytes(self._random.randint(1, 60)) + b"\0"
            self._line.write(noise + stuffed(packet))
            self.sent += self._together
        else:
            self._line.write(stuffed(packet))
            self.sent += self._together
            if self.faulty("repeated"):
                self._line.write(stuffed(packet))


def _odd(upper: int) -> int:
    """A byte with an odd number of ones: the lowest bit makes it so."""
    return upper | (upper.bit_count() + 1) % 2


def _order(*, pac_first: bool) -> list[tuple[int, int]]:
    """Command and place among the counts of each slot of a round."""
    order = []
    for index, command in enumerate(COMMANDS):
        pair = [(command, index), (PAC_COMMAND, len(COMMANDS))]
        order += pair[::-1] if pac_first else pair
    return order


def stuffed(packet: bytes) -> bytes:
    """A packet by COBS, with its end.

    Each run of bytes without a zero is preceded by its length and one; the longest run is 254.
    """
    out = bytearray()
    for run in packet.split(b"\0"):
        rest = run
        while len(rest) >= 254:
            out += b"\xff" + rest[:254]
            rest = rest[254:]
        out += bytes([len(rest) + 1]) + rest
    return bytes(out) + b"\0"


def crc16_x25(data: bytes) -> int:
    """CRC-16/X-25, bit by bit as it is defined: "123456789" gives 906E."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    return crc ^ 0xFFFF
