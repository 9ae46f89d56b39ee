"""OptoForce DAQ on a serial line (hardware reference 3.4).

Big-endian; every frame ends with the 16-bit sum of the bytes before it. The CAN version carries the
same bytes cut into messages of eight: feed their data one after the other.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

from palpate_gateway.protocols.framing import FrameFinder, sum16

BAUD = 1_000_000

RATE_CODES = {0: 0, 1000: 1, 333: 3, 100: 10, 30: 33, 10: 100}
"""Rate [Hz] to speed code, 0 stops; the code is the period [ms]."""

FILTER_CODES: dict[float | None, int] = {None: 0, 500: 1, 150: 2, 50: 3, 15: 4, 5: 5, 1.5: 6}
"""Cutoff [Hz] to filter code; None is no filter (hardware reference 3.3)."""

_CONFIGURE = bytes.fromhex("AA 00 32 03")
_REPLY = bytes.fromhex("AA 00 50 01")
_DATA_VALUES = {
    bytes.fromhex("AA 07 08 0A"): 3,
    bytes.fromhex("AA 07 08 10"): 6,
    bytes.fromhex("AA 07 08 1C"): 12,
}
"""Head to number of values: 3-axis, 6-axis, four 3-axis sensors."""

_HEAD_BYTES = 4
_LENGTHS = {_REPLY: 7} | {head: 10 + 2 * values for head, values in _DATA_VALUES.items()}
_ZERO_SET = 255
_ZERO_CLEAR = 0


@dataclass(frozen=True, slots=True)
class OptoForceData:
    """One sample, raw.

    Attributes:
        count: The device's sample counter, 16 bits: wraps after 65.5 s at 1 kHz.
        status: Status word as sent; 0 is good, the page does not name the DAQ's bits.
        counts: 3 values (Fx Fy Fz), 6 (and Tx Ty Tz), or 12 (Fx Fy Fz of four sensors).
    """

    count: int
    status: int
    counts: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class OptoForceReply:
    """Answer to a configure request.

    Attributes:
        status: Status byte as sent; 0 in the page's example.
    """

    status: int


OptoForceRecord = OptoForceData | OptoForceReply


def configure_request(*, rate_hz: int, cutoff_hz: float | None, zero: bool) -> bytes:
    """Set rate, filter and zero; the three go together.

    Args:
        rate_hz: One of ``RATE_CODES`` [Hz]; 0 stops.
        cutoff_hz: One of ``FILTER_CODES`` [Hz]; None for no filter.
        zero: Take the present load as zero; False forgets that zero.

    Raises:
        ValueError: Rate or cutoff is not in its table.
    """
    if rate_hz not in RATE_CODES:
        raise ValueError(f"rate [Hz] {rate_hz} is not one of {', '.join(map(str, RATE_CODES))}")
    if cutoff_hz not in FILTER_CODES:
        known = ", ".join(map(str, FILTER_CODES))
        raise ValueError(f"cutoff [Hz] {cutoff_hz} is not one of {known}")
    values = (RATE_CODES[rate_hz], FILTER_CODES[cutoff_hz], _ZERO_SET if zero else _ZERO_CLEAR)
    request = _CONFIGURE + bytes(values)
    return request + sum16(request).to_bytes(2, "big")


@dataclass(frozen=True, slots=True)
class OptoForceScale:
    """Sensitivity of one sensor, from its own sensitivity report.

    Attributes:
        counts: Counts at nominal load, one for each of the 3, 6 or 12 values.
        loads: That nominal load [N] or [N m], as many.
    """

    counts: tuple[float, ...]
    loads: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check it: a wrong scale would show only as wrong forces."""
        if len(self.counts) not in _DATA_VALUES.values() or len(self.loads) != len(self.counts):
            raise ValueError(
                f"{len(self.counts)} counts and {len(self.loads)} loads are not 3, 6 or 12 each"
            )
        if not all(math.isfinite(value) and value for value in (*self.counts, *self.loads)):
            raise ValueError("a count or load at nominal load is zero or not finite")

    def values(self, counts: Sequence[int]) -> tuple[float, ...]:
        """Forces [N] and torques [N m] of a sample's counts.

        Raises:
            ValueError: The sample has another number of values.
        """
        if len(counts) != len(self.counts):
            raise ValueError(f"{len(counts)} counts do not fit a scale of {len(self.counts)}")
        rows = zip(counts, self.counts, self.loads, strict=True)
        return tuple(count / full * load for count, full, load in rows)


def _is_good(frame: bytes) -> bool:
    return sum16(frame[:-2]) == int.from_bytes(frame[-2:], "big")


def _read(frame: bytes) -> OptoForceRecord:
    values = _DATA_VALUES.get(frame[:_HEAD_BYTES])
    if values is None:
        return OptoForceReply(frame[_HEAD_BYTES])
    count, status, *counts = struct.unpack_from(f">HH{values}h", frame, _HEAD_BYTES)
    return OptoForceData(count, status, tuple(counts))


class OptoForceDecoder(FrameFinder[OptoForceRecord]):
    """Samples and replies out of the byte stream."""

    def __init__(self) -> None:
        super().__init__(_LENGTHS, _is_good, _read)
