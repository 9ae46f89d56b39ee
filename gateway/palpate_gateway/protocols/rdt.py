"""RDT datagrams: one format of ATI, Schunk and OnRobot (hardware reference 3.2, 3.3).

A request is 8 bytes, a record 36, all big-endian, over UDP port 49152. A datagram holds one record,
or several if the device buffers. There is no checksum beyond
UDP's and no signature: take datagrams only from the device's own address.

A profile holds what a product does differently. All of them start with command 2: command 1 is
undefined on the Net F/T (hardware reference 6). A status bit that is not known to be harmless makes
the data invalid.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

PORT = 49152
RECORD_BYTES = 36

U32 = 1 << 32

LATE_WINDOW = 128
"""A record further behind than this is not late, if its number is one of the first of a start, no
greater than this: the device has restarted [records]."""

LATE_COUNTS = 8000
"""The same for the time of sampling: a second of the fastest counter [counts]."""

BELIEVABLE_LOSS = 1_000_000
"""A larger gap is taken for a restart where both are possible [records]."""

_RECORD = struct.Struct(">3I6i")


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
    """Counts per unit of force and torque.

    Attributes:
        counts_per_n: Counts of 1 N.
        counts_per_n_m: Counts of 1 N m.
    """

    counts_per_n: float
    counts_per_n_m: float

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} {value} is not a positive finite number")

    def wrench(self, counts: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Force [N] and torque [N m] of the counts of a record or of many, shapes ``(..., 6)``."""
        per_unit = np.repeat([self.counts_per_n, self.counts_per_n_m], 3)
        wrench: npt.NDArray[np.float64] = np.asarray(counts, np.float64) / per_unit
        return wrench


class RdtDecoder:
    """Reads datagrams; each holds whole records, so no bytes are kept from one to the next."""

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
        records = [
            RdtRecord(rdt_sequence, ft_sequence, status, (fx, fy, fz, tx, ty, tz))
            for rdt_sequence, ft_sequence, status, fx, fy, fz, tx, ty, tz in _RECORD.iter_unpack(
                datagram
            )
        ]
        self.counters["records"] += len(records)
        return records


@dataclass(frozen=True, slots=True)
class RdtStep:
    """Place of a record in the stream, from its numbers.

    Attributes:
        keep: Whether the record is new; a repeated or late one is to be dropped.
        new_epoch: The device counts from 1 again, after a start request or a loss of power: its
            clock and its bias may have changed. True for the first record too.
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

    def step(self, rdt_sequence: int, ft_sequence: int) -> RdtStep:
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
        window = LATE_COUNTS if rdt_sequence > LATE_WINDOW else LATE_WINDOW
        if (in_order or behind <= window) and sampled_before:
            return self._drop("late_records")
        self.counters["restarts"] += 1
        lost = max(rdt_sequence - 1, 0)
        lost = lost if lost <= BELIEVABLE_LOSS else 0
        return self._accept(rdt_sequence, ft_sequence, lost=lost, new_epoch=True)

    def _accept(
        self, rdt_sequence: int, ft_sequence: int, *, lost: int, new_epoch: bool
    ) -> RdtStep:
        self._last = rdt_sequence, ft_sequence
        self._tick += 1 + lost
        self.counters["lost_records"] += lost
        return RdtStep(True, new_epoch, lost, self._tick)

    def _drop(self, counter: str) -> RdtStep:
        self.counters[counter] += 1
        return RdtStep(False, False, 0, self._tick)


def unwrap(raw: int, previous: int) -> int:
    """Value nearest to the previous one, unwrapped, that equals a 32-bit counter modulo 2^32."""
    return previous + (raw - previous + U32 // 2) % U32 - U32 // 2


_BIAS, _HEX_FILTER, _HEX_PERIOD = 0x42, 0x81, 0x82


def _request(command: int, count: int = 0) -> bytes:
    return struct.pack(">HHI", 0x1234, command, count)


START_REQUEST = _request(0x02)
"""Start sending without end; a repeated start begins to count from 1 again."""

STOP_REQUEST = _request(0x00)

HEX_FILTERS_HZ: dict[int, float | None] = {
    0: None, 1: 500.0, 2: 150.0, 3: 50.0, 4: 15.0, 5: 5.0, 6: 1.5,
}  # fmt: skip
"""Cut-off of each filter code [Hz]; None = no filter, 4 is the factory setting."""

HEX_PERIOD_MAX_MS = 255

_SUMMARY = 1 << 31
_LATCHED = 1 << 16

_SUMMARY_NAME = "error summary"
_LATCHED_NAME = "monitor condition latched"


@dataclass(frozen=True, slots=True)
class RdtProfile:
    """How to talk to one family of devices and read its status word.

    Attributes:
        name: Name in configurations.
        ft_rate_hz: Rate of ``ft_sequence`` [Hz]; None = unknown, to be read or measured.
        scale: What a count is worth; None = must be read from the device.
        status_mask: Bits of the status word that are conditions of the device.
        bit_names: Name of each bit with a known meaning.
        harmless: Bits that leave the data good.
        overload: Bits that report an exceeded range.
        latch_sets_summary: A latched threshold sets the summary bit as an error does.
        bias_request: Request that takes the present load as zero, in the device.
    """

    name: str
    ft_rate_hz: float | None
    scale: RdtScale | None
    bit_names: Mapping[int, str] = field(repr=False)
    status_mask: int = 0xFFFFFFFF
    harmless: int = _LATCHED
    overload: int = 0
    latch_sets_summary: bool = False
    bias_request: bytes = _request(_BIAS)

    def status_names(self, status: int) -> tuple[str, ...]:
        """What the set bits mean, highest first; ``bit 9`` where the reference has no name."""
        word = status & self.status_mask
        bits = [bit for bit in reversed(range(32)) if word >> bit & 1]
        return tuple(dict.fromkeys(self.bit_names.get(bit, f"bit {bit}") for bit in bits))

    def valid(self, status: int) -> bool:
        """Whether the data of a record with this status word is valid."""
        word = status & self.status_mask
        if self.latch_sets_summary and word & _LATCHED:
            word &= ~_SUMMARY
        return not word & ~self.harmless

    def overloaded(self, status: int) -> bool:
        """Whether the device reports that the range of some axis is exceeded."""
        return bool(status & self.overload)


NET_FT = RdtProfile(
    name="ati_net_ft",
    ft_rate_hz=7000.0,
    scale=None,
    bit_names={
        31: _SUMMARY_NAME,
        30: "CPU or RAM fault",
        29: "digital board fault",
        28: "analogue board fault",
        27: "serial link to transducer fault",
        26: "program memory fault",
        25: "halted by configuration",
        24: "settings fault",
        23: "calibration incompatible",
        22: "network fault",
        21: "CAN fault",
        20: "RDT fault",
        19: "EtherNet/IP fault",
        18: "DeviceNet fault",
        17: "transducer saturated or converter fault",
        16: _LATCHED_NAME,
        14: "watchdog fault",
        1: "HTTP fault",
    },
    overload=1 << 17,
    # 0x80010000: a threshold latched and the data is good.
    latch_sets_summary=True,
)
"""ATI Net F/T; its counter runs at the rate of its converter, whatever the RDT rate."""

AXIA = RdtProfile(
    name="ati_axia",
    # It counts samples of the converter, whose rate is a setting of the device.
    ft_rate_hz=None,
    scale=None,
    bit_names={
        31: _SUMMARY_NAME,
        30: "force or torque out of range",
        29: "calibration checksum wrong",
        28: "simulated error",
        27: "gage out of range",
        16: _LATCHED_NAME,
        7: "calibration not accessible",
        5: "other error",
        3: "busy",
        2: "broken gage",
        1: "supply voltage out of range",
        0: "temperature out of range",
    },
    overload=1 << 30 | 1 << 27,
)
"""ATI Ethernet Axia."""

SCHUNK_FTN = replace(AXIA, name="schunk_ftn")
"""Schunk FTN-AXIA: the same device as an Axia."""

HEX = RdtProfile(
    name="onrobot_hex",
    ft_rate_hz=1000.0,
    scale=RdtScale(counts_per_n=10_000.0, counts_per_n_m=100_000.0),
    # Bits 0..2 are a number, the upper half says nothing.
    status_mask=0xFFF8,
    bit_names={
        # The sources disagree which bit is which axis (hardware reference 6).
        **dict.fromkeys(range(4, 10), "overload on some axis"),
        3: "several sensors",
        10: "sensor not detected",
        11: "sensor failed",
        12: "sensor temperature",
        13: "converter: DAQ error",
        14: "converter: communication error",
        15: "converter: unknown error",
    },
    harmless=1 << 3,
    overload=0x3F << 4,
    bias_request=_request(_BIAS, 0xFF),
)
"""OnRobot HEX or OptoForce with the Ethernet converter; its counter counts milliseconds."""

PROFILES: dict[str, RdtProfile] = {
    profile.name: profile for profile in (NET_FT, AXIA, SCHUNK_FTN, HEX)
}


def hex_sensor_number(status: int) -> int:
    """Number of the sensor at the converter that a HEX record is from, 0..7."""
    return status & 0b111


def hex_filter_request(code: int) -> bytes:
    """Choose the low-pass filter of a HEX, by a key of ``HEX_FILTERS_HZ``, else ValueError."""
    if code not in HEX_FILTERS_HZ:
        raise ValueError(f"filter code {code} is not in 0..{max(HEX_FILTERS_HZ)}")
    return _request(_HEX_FILTER, code)


def hex_period_request(period_ms: int) -> bytes:
    """Choose the time between two records of a HEX, 1..255 [ms]; the factory setting is 10 ms.

    Raises ValueError outside that range: the device would take 0 as a stop.
    """
    if not 1 <= period_ms <= HEX_PERIOD_MAX_MS:
        raise ValueError(f"period {period_ms} ms is not in 1..{HEX_PERIOD_MAX_MS} ms")
    return _request(_HEX_PERIOD, period_ms)
