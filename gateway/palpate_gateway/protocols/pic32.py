"""The PIC32 bridge's serial records (format B, hardware reference 2.2).

Its stream has neither sync bytes nor a checksum, and its firmware strips the parity of the words.
A lost byte shows only by values that no 12-bit word has; then the stream is useless until
it is stopped, drained and started again.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import StrEnum

from palpate.messages import COUNTS_MAX
from palpate_gateway.protocols.channels import ELECTRODES

BAUD = 230400
"""8N1 with RTS/CTS."""

TICK_S = 25e-9
"""The core timer counts half of the 80 MHz CPU clock [s]; 32 bits of it last 107 s."""

RATE_HZ = 100.0

LARGEST_LOAD_G = 1_000_000
"""A larger load means a misaligned stream: no such cell carries a tonne [g]."""

_RECORD = struct.Struct(f"<I{ELECTRODES + 4}Hii")

RECORD_BYTES = _RECORD.size


class Pic32Layout(StrEnum):
    """Order of the 23 values, which changed between commits of the firmware."""

    PAC_FIRST = "pac_first"
    ELECTRODES_FIRST = "electrodes_first"


@dataclass(frozen=True, slots=True)
class Pic32Sample:
    """Every channel once, raw counts.

    Attributes:
        pac: Dynamic pressure.
        pdc: Static pressure.
        tac: Dynamic temperature.
        tdc: Static temperature.
        electrodes: E1..E19.
    """

    pac: int
    pdc: int
    tac: int
    tdc: int
    electrodes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Pic32Record:
    """One record of the stream.

    Attributes:
        tick: Unwrapped time stamp [25 ns]; from the device's own origin.
        sample: The finger.
        load_g: Load cell [g].
        reference_g: Reference of the device's own force control [g].
    """

    tick: int
    sample: Pic32Sample
    load_g: int
    reference_g: int


START_REQUEST = b"r\n"
"""Ask for the stream of records."""

STOP_REQUEST = b"q\n"
"""End the stream."""


def _sample(values: tuple[int, ...], layout: Pic32Layout) -> Pic32Sample | None:
    if max(values) > COUNTS_MAX:
        return None
    if layout is Pic32Layout.PAC_FIRST:
        others, electrodes = values[:4], values[4:]
    else:
        electrodes, others = values[:ELECTRODES], values[ELECTRODES:]
    pac, pdc, tac, tdc = others
    return Pic32Sample(pac, pdc, tac, tdc, electrodes)


class Pic32Decoder:
    """Records of a stream that begins with the first byte fed.

    Once ``misaligned`` or ``ended`` every further byte is junk: stop the device, drain the line,
    ``reset`` and start it again. Bytes of the records and of the end record, junk and ``pending``
    are all bytes fed.

    Args:
        layout: Order of the values in this firmware; the stream itself does not show it.
    """

    def __init__(self, layout: Pic32Layout = Pic32Layout.PAC_FIRST) -> None:
        self._layout = Pic32Layout(layout)
        self._pending = bytearray()
        self._tick: int | None = None
        self.misaligned = False
        """The stream has shown impossible values since the last ``reset``."""
        self.ended = False
        """The all-zero record that ends a run has come since the last ``reset``."""
        self.counters: dict[str, int] = dict.fromkeys(
            ("records", "end_records", "misaligned", "junk_bytes"), 0
        )

    @property
    def pending(self) -> int:
        """Bytes of the record that has begun."""
        return len(self._pending)

    def feed(self, data: bytes) -> list[Pic32Record]:
        """Take the next bytes; return the records that they complete."""
        self._pending += data
        records = []
        at = 0
        while not self.misaligned and not self.ended and len(self._pending) - at >= RECORD_BYTES:
            record = self._record(bytes(self._pending[at : at + RECORD_BYTES]))
            at += RECORD_BYTES
            if record is not None:
                records.append(record)
        del self._pending[:at]
        if self.misaligned or self.ended:
            self._drop_pending()
        self.counters["records"] += len(records)
        return records

    def reset(self) -> None:
        """The device was stopped and the line drained, or the connection is new."""
        self._drop_pending()
        self._tick = None
        self.misaligned = False
        self.ended = False

    def _drop_pending(self) -> None:
        self.counters["junk_bytes"] += len(self._pending)
        self._pending.clear()

    def _record(self, raw: bytes) -> Pic32Record | None:
        if not any(raw):
            self.ended = True
            self.counters["end_records"] += 1
            return None
        stamp, *values, load_g, reference_g = _RECORD.unpack(raw)
        sample = _sample(tuple(values), self._layout)
        if sample is None or max(abs(load_g), abs(reference_g)) > LARGEST_LOAD_G:
            self.misaligned = True
            self.counters["misaligned"] += 1
            self.counters["junk_bytes"] += RECORD_BYTES
            return None
        if self._tick is None:
            self._tick = stamp
        else:
            self._tick += (stamp - self._tick) % (1 << 32)
        return Pic32Record(self._tick, sample, load_g, reference_g)
