"""A microcontroller bridge in software, on a serial line (format D, hardware reference 2.6).

Written from the page and the byte table of the format, with a COBS and a CRC of its own. Choices
where these leave something open: one sequence counts the packets of all types; a HELLO and a STATUS
carry the time of the next slot; packets that are not sent are counted.
"""

from __future__ import annotations

import random
import struct
import time
from collections.abc import Sequence
from typing import ClassVar

from palpate_gateway.emulators import FAULTS
from palpate_gateway.emulators.biotac_slots import (
    ELECTRODES,
    WORD_FAULTS,
    CountSource,
    SlotBlocks,
    idle_counts,
    round_of,
)
from palpate_gateway.emulators.emulator import set_lead
from palpate_gateway.emulators.lines import SerialEmulator, SerialLine, crc16_x25

HELLO, SLOTS, STATUS = 1, 2, 3
"""Types of packets."""

SLOTS_PER_PACKET = (22, 44)
"""Fewest and most slots of a packet: 5 to 10 ms."""

_VERSION = 1
_TICK_S = 1e-3
_STOPPED_S = 1.0


class BiotacBridgeEmulator(SerialEmulator):
    """The bridge and its fingers.

    Faults of words: see ``SlotBlocks.with_faults``; ``parity`` and ``error_word`` are also counted
    in the next STATUS. Faults of packets with slots, and of the line:

    * ``crc``: one bit of each packet is wrong;
    * ``cut``: each packet lacks its end, which also spoils the next one;
    * ``junk``: noise before each packet;
    * ``lost``: packets are missing; ``overrun``: so, too, and the next STATUS counts their slots;
    * ``repeated``: each packet comes twice;
    * ``silence``: nothing comes, while the sampling continues;
    * ``unplug``: the line is gone, while numbers and times continue;
    * ``restart``: nothing comes, then numbers, time and round start again, with a HELLO;
    * ``clock_drift``: its clock, and with it the sampling, runs at another speed.

    Args:
        serials: Serial numbers of the fingers; () = ``BT-EMU-1`` and so on.
        source: Source id.
        hello_s: Time between two HELLOs [s].
        status_s: Time between two STATUSes [s].
        sequence: Number of the first packet after the start.
        clock_us: Its clock at the start [us].
    """

    faults: ClassVar = FAULTS["biotac-bridge"]

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
        electrodes: int = ELECTRODES,
        hello_s: float = 0.5,
        status_s: float = 1.0,
        sequence: int = 0,
        clock_us: int = 0,
        drift_ppm: float = 200.0,
    ) -> None:
        super().__init__(slot_rate_hz)
        fewest, most = SLOTS_PER_PACKET
        if not fewest <= slots_per_packet <= most:
            raise ValueError(f"slots_per_packet {slots_per_packet} is not in {fewest}..{most}")
        self._fingers, self._counts, self._source = fingers, counts, source
        self._serials = serials or [f"BT-EMU-{finger + 1}" for finger in range(fingers)]
        self._line = SerialLine(baud, path)
        order = round_of(electrodes, pac_first=pac_first)
        self._round, self._slots = len(order), SlotBlocks(counts, fingers, order)
        self._together = slots_per_packet
        self._hello_slots = max(1, round(hello_s * slot_rate_hz))
        self._status_slots = max(1, round(status_s * slot_rate_hz))
        self._drift = drift_ppm * 1e-6
        self._random = random.Random(4)
        self._began_s = self._due_s = 0.0
        self._boot()
        self._sequence, self._clock_us = sequence, float(clock_us)

    def _boot(self) -> None:
        self._slot = self._sequence = 0
        self._clock_us = 0.0
        self.parity_errors = [0] * self._fingers
        self.error_words = self.overruns = 0
        self._next_hello, self._next_status = 0, self._status_slots

    def _serve(self) -> None:
        # ``_due_s`` is the time at which the next slot is sampled.
        self._began_s = self._due_s = time.monotonic()
        set_lead(self._counts, self._began_s)
        starts = True
        while not self._stop.is_set():
            self._line.keep_plugged(not self.faulty("unplug"))
            now_s = time.monotonic()
            if self.faulty("restart"):
                self._boot()
                self._due_s, starts = now_s, True
                self._stop.wait(_TICK_S)
                continue
            if starts:
                self._line.write(b"\0")  # ends any noise of the start
                starts = False
            drift = self._drift if self.faulty("clock_drift") else 0.0
            step_s = 1.0 / (self.rate_hz * (1.0 + drift))
            if now_s - self._due_s > _STOPPED_S:  # this process stood still
                self._due_s = now_s
            # A packet is sent once its last slot has been sampled, not at its first one.
            while now_s - self._due_s >= self._together * step_s and not self._stop.is_set():
                self._announce()
                self._sample(step_s)
            self._stop.wait(_TICK_S)

    def _announce(self) -> None:
        """Send the HELLO and the STATUS that are due."""
        if self._slot >= self._next_hello:
            self._next_hello = self._slot + self._hello_slots
            body = struct.pack("<BHB", self._fingers, round(self.rate_hz), self._round)
            for serial in self._serials:
                body += struct.pack("<16s4s", serial.encode("ascii"), b"0203")
            self._tell(HELLO, body)
        if self._slot >= self._next_status:
            self._next_status = self._slot + self._status_slots
            numbers = (*self.parity_errors, self.error_words, self.overruns)
            self._tell(STATUS, struct.pack(f"<B{len(numbers)}I", self._fingers, *numbers))

    def _tell(self, kind: int, body: bytes) -> None:
        packet = self._packet(kind, body)
        if not self.faulty("silence"):
            self._line.write(stuffed(packet))

    def _sample(self, step_s: float) -> None:
        time_s = self._due_s - self._began_s
        payloads = self._slots.block(self._slot, self._together, time_s, step_s)
        if not self.sound:
            for k in range(self._together):
                wrong = {fault for fault in WORD_FAULTS if self.faulty(fault)}
                if wrong:
                    self._count(wrong)
                    at_s = time_s + k * step_s
                    payloads[k] = self._slots.with_faults(self._slot + k, at_s, wrong)
        body = bytes([self._together, self._fingers]) + b"".join(payloads)
        self._send(self._packet(SLOTS, body))
        self._slot += self._together
        self._due_s += self._together * step_s
        self._clock_us += 1e6 * self._together / self.rate_hz

    def _count(self, wrong: set[str]) -> None:
        """Count wrong words as the bridge sees them."""
        if "absent" in wrong and self._fingers == 1:
            return
        if "error_word" in wrong:
            self.error_words += 1
        elif "parity" in wrong:
            self.parity_errors[0] += 1

    def _packet(self, kind: int, body: bytes) -> bytes:
        sequence, self._sequence = self._sequence, (self._sequence + 1) % 2**16
        ticks = round(self._clock_us) % 2**32
        packet = struct.pack("<4BHI", _VERSION, kind, self._source, 0, sequence, ticks) + body
        return packet + struct.pack("<H", crc16_x25(packet))

    def _send(self, packet: bytes) -> None:
        """Send a packet with slots."""
        wire = stuffed(packet)
        if not self.sound:
            if self.faulty("silence") or self.faulty("lost"):
                return
            if self.faulty("overrun"):
                self.overruns += self._together
                return
            if self.faulty("crc"):
                wrong = bytearray(packet)
                wrong[self._random.randrange(len(wrong))] ^= 1 << self._random.randrange(8)
                self._line.write(stuffed(bytes(wrong)))
                return
            if self.faulty("cut"):
                self._line.write(wire[: self._random.randrange(1, len(packet))])
                return
            if self.faulty("junk"):
                noise = self._random.randbytes(self._random.randint(1, 60))
                self._line.write(noise + b"\0")
            if self.faulty("repeated"):
                self._line.write(wire)
        before = self._line.overrun
        if self._line.write(wire):
            self.sent += self._together
        elif self._line.overrun > before:
            self.overruns += self._together


def stuffed(packet: bytes) -> bytes:
    """A packet in COBS, with its end.

    Each run of bytes without a zero is preceded by its length plus one; the longest run is 254.
    """
    out = bytearray()
    for run in packet.split(b"\0"):
        rest = run
        while len(rest) >= 254:
            out += b"\xff" + rest[:254]
            rest = rest[254:]
        out += bytes([len(rest) + 1]) + rest
    return bytes(out) + b"\0"
