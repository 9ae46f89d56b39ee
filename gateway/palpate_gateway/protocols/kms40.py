"""Lines of the Weiss KMS 40's text protocol (hardware reference 3.1).

The device answers over TCP (or RS-232, same text) in ASCII lines that end with LF: data
``F={fx,fy,fz,mx,my,mz},timestamp``, replies ``NAME=value``, echoes ``L1`` and ``L0``, refusals
``ERROR(code)``. Replies and data lines may come in any order, also between ``L0()`` and its echo.
There is no checksum: a line is taken only if all of it has one of these shapes. What is sent to the
device is in ``kms40_requests``.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import IntFlag, StrEnum

LINE_MAX = 4096
"""A line longer than this is no line of this protocol [bytes, without LF]."""

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
"""A sample as it should be, in one match: 500 come in a second."""
_FLAGS = re.compile(r"\d{1,10}|0[xX][0-9a-fA-F]{1,8}")


class SystemFlags(IntFlag):
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


FAULTS = SystemFlags.CALIBRATION_FAULT | SystemFlags.TEMPERATURE_FAULT | SystemFlags.POWER_FAULT
"""Flags that say the forces cannot be trusted."""


class LineFault(StrEnum):
    """Why a line is dropped; the values are names of counters."""

    OVERLONG = "overlong_lines"
    NON_ASCII = "non_ascii_lines"
    BLANK = "blank_lines"
    MALFORMED = "malformed_lines"
    WRONG_COUNT = "wrong_counts"
    BAD_NUMBER = "bad_numbers"
    UNKNOWN = "unknown_lines"


@dataclass(frozen=True, slots=True)
class ForceLine:
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
class Reply:
    """The answer to a command.

    Attributes:
        name: Name of the command; ``L1`` and ``L0`` for the echoes that end starting and stopping.
        value: Text after the equals sign, without quotation marks; empty for an echo.
    """

    name: str
    value: str


@dataclass(frozen=True, slots=True)
class Refusal:
    """The device refuses a command; it does not say which.

    Attributes:
        code: The device's number.
        meaning: What the number means.
    """

    code: int
    meaning: str


KmsRecord = ForceLine | Reply | Refusal

_COUNTER_OF = {ForceLine: "data_lines", Reply: "replies", Refusal: "refusals"}


class KmsDecoder:
    """Cuts the stream of bytes into lines and reads them; see ``parse_line``.

    ``untimed_lines`` counts samples without a usable time stamp, which are delivered all the same.
    """

    def __init__(self) -> None:
        self._line = bytearray()
        self._skipping = False
        self.counters: dict[str, int] = dict.fromkeys(
            (*_COUNTER_OF.values(), "untimed_lines", *LineFault, "record_bytes", "junk_bytes"), 0
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

    def reset(self) -> None:
        """Begin anew on a new connection: the line that has begun becomes junk."""
        self.counters["junk_bytes"] += len(self._line)
        self._line.clear()
        self._skipping = False

    def _append(self, piece: bytes) -> None:
        if not self._skipping and len(self._line) + len(piece) <= LINE_MAX:
            self._line += piece
            return
        if not self._skipping:
            self._skipping = True
            self.counters[LineFault.OVERLONG] += 1
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
        if isinstance(record, LineFault):
            self.counters[record] += 1
            self.counters["junk_bytes"] += len(line) + 1
            return None
        self.counters[_COUNTER_OF[type(record)]] += 1
        self.counters["record_bytes"] += len(line) + 1
        if isinstance(record, ForceLine) and record.timestamp is None:
            self.counters["untimed_lines"] += 1
        return record


def parse_line(line: bytes) -> KmsRecord | LineFault:
    """Read one line; blanks and a CR around it do not matter.

    Args:
        line: The line without its LF.
    """
    if len(line) > LINE_MAX:
        return LineFault.OVERLONG
    line = line.strip()
    if not line:
        return LineFault.BLANK
    text = line.decode("latin-1")
    if not (text.isascii() and text.isprintable()):
        return LineFault.NON_ASCII
    if text.startswith("F="):
        return _parse_data(text)
    if text.startswith("ERROR"):
        refusal = _REFUSAL.fullmatch(text)
        if refusal is None:
            return LineFault.MALFORMED
        code = int(refusal[1])
        return Refusal(code, REFUSALS.get(code, f"unknown error {code}"))
    if text in ("L1", "L0"):
        return Reply(text, "")
    reply = _REPLY.fullmatch(text)
    if reply is None:
        return LineFault.UNKNOWN
    value = reply[2].strip()
    quoted = len(value) >= 2 and value[0] == value[-1] == '"'
    return Reply(reply[1], value[1:-1] if quoted else value)


def _parse_data(text: str) -> ForceLine | LineFault:
    sample = _SAMPLE.fullmatch(text)
    if sample is not None:
        fx, fy, fz, mx, my, mz = map(float, sample.groups()[:6])
        ticks = sample[7]
        # Each of them is finite if their sum is; if not, see below.
        if math.isfinite(fx + fy + fz + mx + my + mz):
            return ForceLine((fx, fy, fz), (mx, my, mz), None if ticks is None else int(ticks))
    data = _DATA.fullmatch(text)
    if data is None:
        return LineFault.MALFORMED
    fields = [field.strip() for field in data[1].split(",")]
    if len(fields) != len(AXES):
        return LineFault.WRONG_COUNT
    # The device's "nan" and "inf", and numbers too large for a float, are all bad.
    if not all(_NUMBER.fullmatch(field) for field in fields):
        return LineFault.BAD_NUMBER
    fx, fy, fz, mx, my, mz = (float(field) for field in fields)
    if not all(map(math.isfinite, (fx, fy, fz, mx, my, mz))):
        return LineFault.BAD_NUMBER
    timestamp = None
    if data[2] is not None:
        ticks = data[2].strip()
        if _TICKS.fullmatch(ticks):
            timestamp = int(ticks)
        elif not _NUMBER.fullmatch(ticks):
            return LineFault.MALFORMED
    return ForceLine((fx, fy, fz), (mx, my, mz), timestamp)


def parse_flags(value: str) -> SystemFlags | None:
    """Status word in the value of a ``FLAGS`` reply; None if it is no 32-bit number."""
    if not _FLAGS.fullmatch(value):
        return None
    # Not int(value, 0), which refuses leading zeros.
    word = int(value, 16 if value[:2] in ("0x", "0X") else 10)
    return SystemFlags(word) if word < 1 << 32 else None


def flag_names(flags: SystemFlags) -> tuple[str, ...]:
    """Names of the flags that are set, lowest first; ``bit 7`` where the reference has no name."""
    return tuple(
        (SystemFlags(1 << bit).name or f"bit {bit}").lower().replace("_", " ")
        for bit in range(flags.bit_length())
        if flags >> bit & 1
    )


def over_range_axes(flags: SystemFlags) -> tuple[str, ...]:
    """Axes whose range is exceeded, as named in ``AXES``."""
    first = SystemFlags.OVER_RANGE_FX.bit_length() - 1
    return tuple(axis for k, axis in enumerate(AXES) if flags >> first + k & 1)
