"""The text protocol of the Weiss KMS 40 (hardware reference 3.1): its lines, and commands to it.

The device answers over TCP (or RS-232, same text) in ASCII lines that end with LF: data
``F={fx,fy,fz,mx,my,mz},timestamp``, replies ``NAME=value``, echoes ``L1`` and ``L0``, refusals
``ERROR(code)``. Replies and data lines may come in any order, also between ``L0()`` and its echo.
There is no checksum: a line is accepted only if all of it has one of these shapes.

The order of commands seen in the field: mask, filter, divider, ``VL(0)``, start. Stop the stream
before a tare, and read on until the echo ``L0``: samples may still come before it.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import IntFlag, StrEnum

LINE_MAX = 4096
"""Longest line of this protocol [bytes, without LF]."""

AXES = ("fx", "fy", "fz", "mx", "my", "mz")

REFUSALS: dict[int, str] = dict(enumerate((
    "success", "not available", "no sensor", "not initialised", "already running",
    "feature not supported", "inconsistent data", "timeout", "read error", "write error",
    "insufficient resources", "checksum error", "no parameter expected", "not enough parameters",
    "unknown command", "command format error", "access denied", "already open", "command failed",
    "command aborted", "invalid handle", "not found", "not open", "input/output error",
    "invalid parameter", "index out of bounds", "command pending", "overrun", "range error",
    "axis blocked", "file exists",
)))  # fmt: skip
"""Meaning of the number in ``ERROR(number)``."""

_DATA = re.compile(r"F=\{([^{}]*)\}(?:,(.*))?")
_REPLY = re.compile(r"([A-Z][A-Z0-9_]*)=(.*)")
_REFUSAL = re.compile(r"ERROR\(\s*(\d{1,9})\s*(?:,.*)?\)")
_NUMBER = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?")
_TICKS = re.compile(r"\d{1,20}")
_SAMPLE = re.compile(
    r"F=\{" + ",".join([rf" *({_NUMBER.pattern}) *"] * 6) + rf"\}}(?:, *({_TICKS.pattern}) *)?"
)
"""A well-formed sample, read by one match: 500 come each second."""
_FLAGS = re.compile(r"\d{1,10}|0[xX][0-9a-fA-F]{1,8}")


class KmsFlags(IntFlag):
    """Bits of the status word that ``FLAGS()`` asks for."""

    CALIBRATION_VALID = 1 << 0
    STABLE = 1 << 1
    TARE_ON = 1 << 2
    FILTER_ON = 1 << 3
    ACQUISITION_RUNNING = 1 << 4
    SCRIPT_RUNNING = 1 << 5
    CALIBRATION_EXPIRED = 1 << 10
    TEMPERATURE_WARNING = 1 << 11
    OVER_RANGE_FX = 1 << 20
    OVER_RANGE_FY = 1 << 21
    OVER_RANGE_FZ = 1 << 22
    OVER_RANGE_MX = 1 << 23
    OVER_RANGE_MY = 1 << 24
    OVER_RANGE_MZ = 1 << 25
    CALIBRATION_FAULT = 1 << 26
    TEMPERATURE_FAULT = 1 << 27
    POWER_FAULT = 1 << 28
    COMMAND_FAILED = 1 << 29
    SCRIPT_FAILURE = 1 << 30


FAULTS = KmsFlags.CALIBRATION_FAULT | KmsFlags.TEMPERATURE_FAULT | KmsFlags.POWER_FAULT
"""Flags that make the forces invalid."""


class KmsLineFault(StrEnum):
    """Why a line is dropped; the values are names of counters."""

    OVERLONG = "overlong_lines"
    NON_ASCII = "non_ascii_lines"
    BLANK = "blank_lines"
    MALFORMED = "malformed_lines"
    WRONG_COUNT = "wrong_counts"
    BAD_NUMBER = "bad_numbers"
    UNKNOWN = "unknown_lines"


@dataclass(frozen=True, slots=True)
class KmsForceLine:
    """One sample.

    Attributes:
        force: Force [N], x y z.
        torque: Torque [N m], x y z.
        timestamp: The device's number after the braces, of unknown unit; None if there is none or
            it is no unsigned whole number.
    """

    force: tuple[float, float, float]
    torque: tuple[float, float, float]
    timestamp: int | None


@dataclass(frozen=True, slots=True)
class KmsReply:
    """The answer to a command.

    Attributes:
        name: Name of the command; ``L1`` and ``L0`` for the echoes that end starting and stopping.
        value: Text after the equals sign, without quotation marks; empty for an echo.
    """

    name: str
    value: str


@dataclass(frozen=True, slots=True)
class KmsRefusal:
    """The device refuses a command; its line does not name the command.

    Attributes:
        code: The device's number.
        meaning: What the number means.
    """

    code: int
    meaning: str


KmsRecord = KmsForceLine | KmsReply | KmsRefusal

_COUNTER_OF = {KmsForceLine: "data_lines", KmsReply: "replies", KmsRefusal: "refusals"}


class KmsDecoder:
    """Cuts the stream of bytes into lines and reads them; see ``parse_line``.

    ``untimed_lines`` counts samples without a usable time stamp; they are delivered.
    """

    def __init__(self) -> None:
        self._line = bytearray()
        self._skipping = False
        self.counters: dict[str, int] = dict.fromkeys(
            (*_COUNTER_OF.values(), "untimed_lines", *KmsLineFault, "record_bytes", "junk_bytes"), 0
        )

    @property
    def pending(self) -> int:
        """Bytes of the line that has begun and not ended."""
        return len(self._line)

    def feed(self, data: bytes) -> list[KmsRecord]:
        """Take bytes as they come; return the records of the lines that end in them."""
        records = []
        *ended, rest = data.split(b"\n")
        for piece in ended:
            self._append(piece)
            record = self._end_line()
            if record is not None:
                records.append(record)
        self._append(rest)
        return records

    def _append(self, piece: bytes) -> None:
        if not self._skipping and len(self._line) + len(piece) <= LINE_MAX:
            self._line += piece
            return
        if not self._skipping:
            self._skipping = True
            self.counters[KmsLineFault.OVERLONG] += 1
            self.counters["junk_bytes"] += len(self._line)
            self._line.clear()
        self.counters["junk_bytes"] += len(piece)

    def _end_line(self) -> KmsRecord | None:
        if self._skipping:
            self._skipping = False
            self.counters["junk_bytes"] += 1
            return None
        line = bytes(self._line)
        self._line.clear()
        record = parse_line(line)
        if isinstance(record, KmsLineFault):
            self.counters[record] += 1
            self.counters["junk_bytes"] += len(line) + 1
            return None
        self.counters[_COUNTER_OF[type(record)]] += 1
        self.counters["record_bytes"] += len(line) + 1
        if isinstance(record, KmsForceLine) and record.timestamp is None:
            self.counters["untimed_lines"] += 1
        return record


def parse_line(line: bytes) -> KmsRecord | KmsLineFault:
    """Read one line without its LF; blanks and a CR around it do not matter."""
    if len(line) > LINE_MAX:
        return KmsLineFault.OVERLONG
    line = line.strip()
    if not line:
        return KmsLineFault.BLANK
    text = line.decode("latin-1")
    if not (text.isascii() and text.isprintable()):
        return KmsLineFault.NON_ASCII
    if text.startswith("F="):
        return _parse_data(text)
    if text.startswith("ERROR"):
        refusal = _REFUSAL.fullmatch(text)
        if refusal is None:
            return KmsLineFault.MALFORMED
        code = int(refusal[1])
        return KmsRefusal(code, REFUSALS.get(code, f"unknown error {code}"))
    if text in ("L1", "L0"):
        return KmsReply(text, "")
    reply = _REPLY.fullmatch(text)
    if reply is None:
        return KmsLineFault.UNKNOWN
    value = reply[2].strip()
    quoted = len(value) >= 2 and value[0] == value[-1] == '"'
    return KmsReply(reply[1], value[1:-1] if quoted else value)


def _parse_data(text: str) -> KmsForceLine | KmsLineFault:
    sample = _SAMPLE.fullmatch(text)
    if sample is not None:
        fx, fy, fz, mx, my, mz = map(float, sample.groups()[:6])
        ticks = sample[7]
        # A finite sum means that each value is finite; the other case is examined below.
        if math.isfinite(fx + fy + fz + mx + my + mz):
            return KmsForceLine((fx, fy, fz), (mx, my, mz), None if ticks is None else int(ticks))
    data = _DATA.fullmatch(text)
    if data is None:
        return KmsLineFault.MALFORMED
    fields = [field.strip() for field in data[1].split(",")]
    if len(fields) != len(AXES):
        return KmsLineFault.WRONG_COUNT
    # The device's "nan" and "inf", and numbers too large for a float, are all bad.
    if not all(_NUMBER.fullmatch(field) for field in fields):
        return KmsLineFault.BAD_NUMBER
    fx, fy, fz, mx, my, mz = (float(field) for field in fields)
    if not all(map(math.isfinite, (fx, fy, fz, mx, my, mz))):
        return KmsLineFault.BAD_NUMBER
    timestamp = None
    if data[2] is not None:
        ticks = data[2].strip()
        if _TICKS.fullmatch(ticks):
            timestamp = int(ticks)
        elif not _NUMBER.fullmatch(ticks):
            return KmsLineFault.MALFORMED
    return KmsForceLine((fx, fy, fz), (mx, my, mz), timestamp)


def parse_flags(value: str) -> KmsFlags | None:
    """Status word in the value of a ``FLAGS`` reply; None if it is no 32-bit number."""
    if not _FLAGS.fullmatch(value):
        return None
    # Not int(value, 0), which refuses leading zeros.
    word = int(value, 16 if value[:2] in ("0x", "0X") else 10)
    return KmsFlags(word) if word < 1 << 32 else None


def flag_names(flags: KmsFlags) -> tuple[str, ...]:
    """Names of the flags that are set, lowest first; ``bit 7`` where the reference has no name."""
    return tuple(
        (KmsFlags(1 << bit).name or f"bit {bit}").lower().replace("_", " ")
        for bit in range(flags.bit_length())
        if flags >> bit & 1
    )


def over_range_axes(flags: KmsFlags) -> tuple[str, ...]:
    """Axes whose range is exceeded, as named in ``AXES``."""
    first = KmsFlags.OVER_RANGE_FX.bit_length() - 1
    return tuple(axis for k, axis in enumerate(AXES) if flags >> first + k & 1)


PORT = 1000
"""TCP port; the device's address is a setting, two defaults are known (hardware reference 6)."""

BASE_RATE_HZ = 500.0
"""Rate at divider 1: one sample each 2 ms [Hz]."""

DIVIDER_MAX = 500
"""Largest divider that we set, one line a second; the device's own limit is not public."""

FILTER_MAX = 255
"""Largest filter number that we set; the device's table of filters is not public."""


class KmsQuery(StrEnum):
    """Questions to the device; the value is also the name of the reply."""

    IDENTITY = "ID"
    SERIAL_NUMBER = "SN"
    FLAGS = "FLAGS"


def query_request(query: KmsQuery) -> bytes:
    """Ask one question."""
    return f"{query}()\n".encode("ascii")


START_REQUEST = b"L1()\n"
"""Start the stream; the device echoes ``L1``."""

STOP_REQUEST = b"L0()\n"
"""Stop the stream; the device echoes ``L0``, perhaps after more samples."""

TARE_REQUEST = b"TARE(1)\n"
"""Take the present load as zero; the reply is ``TARE=1``."""

QUIET_REQUEST = b"VL(0)\n"
"""Choose the shortest replies."""

ALL_AXES_REQUEST = b"LMASK({1,1,1,1,1,1})\n"
"""Send all six axes: ``parse_line`` takes only such samples."""


def divider_request(divider: int) -> bytes:
    """Send only every n-th sample, n in 1..500; otherwise raises ValueError."""
    _check("divider", divider, 1, DIVIDER_MAX)
    return f"LDIV({divider})\n".encode("ascii")


def filter_request(number: int) -> bytes:
    """Choose a filter of the device's table, 0..255; otherwise raises ValueError."""
    _check("filter number", number, 0, FILTER_MAX)
    return f"FLT({number})\n".encode("ascii")


def rate_of_divider(divider: int) -> float:
    """Lines per second at a divider [Hz]; raises ValueError for one out of range."""
    _check("divider", divider, 1, DIVIDER_MAX)
    return BASE_RATE_HZ / divider


def divider_of_rate(rate_hz: float) -> int:
    """Largest divider whose rate is not below the one asked for, 1..500 Hz; else ValueError."""
    slowest = BASE_RATE_HZ / DIVIDER_MAX
    if not slowest <= rate_hz <= BASE_RATE_HZ:
        raise ValueError(f"rate {rate_hz} Hz is not in {slowest:g}..{BASE_RATE_HZ:g} Hz")
    # Rounding can make 500 / (500 / n) a little less than n.
    return int(BASE_RATE_HZ / rate_hz * (1 + 1e-9))


def _check(name: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise ValueError(f"{name} {value} is not in {least}..{most}")
