"""RDT datagrams: one format of ATI, Schunk and OnRobot (hardware reference 3.2, 3.3).

A request is 8 bytes, a record 36, all big-endian, over UDP port 49152. A datagram holds one record,
or several if the device buffers. What products do differently is in ``rdt_profiles``. There is no
checksum beyond UDP's and no signature: take datagrams only from the device's own address.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

PORT = 49152
RECORD_BYTES = 36

U32 = 1 << 32

LATE_WINDOW = 128
"""A record that is further behind than this is not late: the device has restarted [records]."""

LATE_COUNTS = 8000
"""Nor is one that was sampled earlier than by this: a second of the fastest counter [counts]."""

BELIEVABLE_LOSS = 1_000_000
"""More is not taken for a loss where a restart is possible too [records]."""

_REQUEST = struct.Struct(">HHI")
_REQUEST_HEADER = 0x1234
_RECORD = struct.Struct(">3I6i")

RECORD_TYPE = np.dtype(
    [("rdt_sequence", ">u4"), ("ft_sequence", ">u4"), ("status", ">u4"), ("counts", ">i4", 6)]
)
"""A record as NumPy sees it in a datagram."""


@dataclass(frozen=True, slots=True)
class RdtRecord:
    """One record, raw.

    Attributes:
        rdt_sequence: Number of the record since the start request, from 1.
        ft_sequence: The device's own counter of samples or time since it was switched on.
        status: Status word; its bits differ per product.
        counts: Fx, Fy, Fz, Tx, Ty, Tz [counts].
    """

    rdt_sequence: int
    ft_sequence: int
    status: int
    counts: tuple[int, int, int, int, int, int]


@dataclass(frozen=True, slots=True)
class RdtScale:
    """What a count is worth.

    Attributes:
        counts_per_n: Counts of 1 N.
        counts_per_n_m: Counts of 1 N m.
    """

    counts_per_n: float
    counts_per_n_m: float

    def __post_init__(self) -> None:
        for name, value in (
            ("counts_per_n", self.counts_per_n),
            ("counts_per_n_m", self.counts_per_n_m),
        ):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} {value} is not a positive finite number")

    def wrench(self, counts: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Force [N] and torque [N m], shape ``(..., 6)``.

        Args:
            counts: Counts of a record, or of many, shape ``(..., 6)``.
        """
        per_unit = np.repeat([self.counts_per_n, self.counts_per_n_m], 3)
        wrench: npt.NDArray[np.float64] = np.asarray(counts, np.float64) / per_unit
        return wrench


class RdtDecoder:
    """Reads datagrams; each is whole or nothing, so no bytes are ever kept."""

    pending = 0

    def __init__(self) -> None:
        self.counters: dict[str, int] = dict.fromkeys(
            ("datagrams", "records", "bad_lengths", "junk_bytes"), 0
        )

    def feed(self, datagram: bytes) -> list[RdtRecord]:
        """Take one datagram; return its records, none if its length is not that of records."""
        self.counters["datagrams"] += 1
        if not datagram or len(datagram) % RECORD_BYTES:
            self.counters["bad_lengths"] += 1
            self.counters["junk_bytes"] += len(datagram)
            return []
        if len(datagram) == RECORD_BYTES:
            rdt_sequence, ft_sequence, status, *axes = _RECORD.unpack(datagram)
            fields = [(rdt_sequence, ft_sequence, status, axes)]
        else:
            fields = decode_records(datagram).tolist()
        self.counters["records"] += len(fields)
        return [
            RdtRecord(rdt_sequence, ft_sequence, status, tuple(counts))
            for rdt_sequence, ft_sequence, status, counts in fields
        ]

    def reset(self) -> None:
        """Nothing is kept from one datagram to the next."""


@dataclass(frozen=True, slots=True)
class Step:
    """What a record's numbers say about its place in the stream.

    Attributes:
        keep: Whether the record is new; a repeated or late one is to be dropped.
        new_epoch: The device counts from 1 again, after a start request or a loss of power: its
            clock and its bias may be others than before. True for the first record too.
        lost: Records that did not arrive directly before this one.
        tick: Number of the record over all epochs, from 0, lost ones included.
    """

    keep: bool
    new_epoch: bool
    lost: int
    tick: int


class RdtSequence:
    """Follows ``rdt_sequence`` modulo 2^32.

    A step back may be a late record or a restart, for every start request sets the number to 1, and
    record 1 itself may be lost. A late record was sampled earlier, one after a restart later: the
    device's own counter ``ft_sequence``, which runs on, tells them apart.

    A record that comes late was counted as lost before, and stays so.
    """

    def __init__(self) -> None:
        self._last: tuple[int, int] | None = None
        self._tick = -1
        self.counters: dict[str, int] = dict.fromkeys(
            ("lost_records", "repeated_records", "late_records", "restarts"), 0
        )

    def step(self, rdt_sequence: int, ft_sequence: int) -> Step:
        """Take the numbers of the next record that arrived."""
        if self._last is None:
            return self._accept(rdt_sequence, ft_sequence, lost=0, new_epoch=True)
        last, last_ft = self._last
        ahead = (rdt_sequence - last) % U32
        behind = U32 - ahead
        sampled_behind = (last_ft - ft_sequence) % U32
        if ahead == 0 and (rdt_sequence != 1 or sampled_behind == 0):
            return self._drop("repeated_records")
        in_order = 0 < ahead < U32 // 2 and (rdt_sequence > last or ahead <= BELIEVABLE_LOSS)
        if in_order and not 0 < sampled_behind < U32 // 2:
            return self._accept(rdt_sequence, ft_sequence, lost=ahead - 1, new_epoch=False)
        # One that is ahead and was sampled before is late by the numbers of an earlier start. A
        # device may send faster than it samples; but no record is before the first.
        sampled_before = 0 < sampled_behind <= LATE_COUNTS
        sampled_before |= sampled_behind == 0 and rdt_sequence != 1
        if (in_order or behind <= LATE_WINDOW) and sampled_before:
            return self._drop("late_records")
        self.counters["restarts"] += 1
        lost = max(rdt_sequence - 1, 0)
        lost = lost if lost <= BELIEVABLE_LOSS else 0
        return self._accept(rdt_sequence, ft_sequence, lost=lost, new_epoch=True)

    def reset(self) -> None:
        """Begin anew on a new connection; ticks run on, counters are kept."""
        self._last = None

    def _accept(self, rdt_sequence: int, ft_sequence: int, *, lost: int, new_epoch: bool) -> Step:
        self._last = rdt_sequence, ft_sequence
        self._tick += 1 + lost
        self.counters["lost_records"] += lost
        return Step(True, new_epoch, lost, self._tick)

    def _drop(self, counter: str) -> Step:
        self.counters[counter] += 1
        return Step(False, False, 0, self._tick)


def unwrap(raw: int, previous: int) -> int:
    """Value nearest to the previous one that equals a 32-bit counter modulo 2^32.

    Args:
        raw: The counter as sent.
        previous: The value before, unwrapped; any first value will do.
    """
    return previous + (raw - previous + U32 // 2) % U32 - U32 // 2


def decode_records(datagram: bytes) -> npt.NDArray[np.void]:
    """Read many records at once, shape ``(N,)``, fields of ``RECORD_TYPE``.

    Raises:
        ValueError: The length is no multiple of 36 bytes.
    """
    if len(datagram) % RECORD_BYTES:
        raise ValueError(f"{len(datagram)} bytes are not a multiple of {RECORD_BYTES}")
    return np.frombuffer(datagram, RECORD_TYPE)


def encode_request(command: int, count: int = 0) -> bytes:
    """The 8 bytes of a request.

    Args:
        command: Command 0..65535.
        count: Samples to send, 0 = endless; some commands take another number here.

    Raises:
        ValueError: A number does not fit its field.
    """
    if not 0 <= command <= 0xFFFF:
        raise ValueError(f"command {command} is not in 0..65535")
    if not 0 <= count < U32:
        raise ValueError(f"count {count} is not in 0..{U32 - 1}")
    return _REQUEST.pack(_REQUEST_HEADER, command, count)
