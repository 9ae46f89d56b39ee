"""Robotous RFT force/torque sensors: data bytes, and the frames that carry them.

A request has 8 data bytes, an answer 16 (D1..D16, D1 names the command). On a serial line they are
framed as ``55``, data, sum of the data mod 256, ``AA``. On CAN an answer comes in two messages, the
halves of D1..D16, with an id each; a request is one message. The sensor sends neither a counter nor
a time (hardware reference 3.5). Where the reference leaves the place of a setting inside a reply
open, it is that of the maker's own packet class ``RFT_IF_PACKET`` (one source).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum

from palpate_gateway.protocols.framing import FrameFinder, sum8

REQUEST_BYTES = 8
REPLY_BYTES = 16

AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")

_COUNTS = struct.Struct(">6h")


class RobotousCommand(IntEnum):
    """First data byte of requests and replies; those that the driver needs."""

    MODEL = 1
    SERIAL = 2
    FIRMWARE = 3
    SET_BAUD = 6
    SET_FILTER = 8
    SAMPLE = 10
    START = 11
    STOP = 12
    SET_RATE = 15
    BIAS = 17


class RobotousFilterOrder(Enum):
    """How filter cutoffs are numbered; the sources conflict (hardware reference 6).

    Both manuals count down from 500 Hz, the maker's sample header up from 1 Hz.
    """

    MANUALS = "manuals"
    SAMPLE_HEADER = "sample_header"


RATE_CODES = {10: 1, 20: 2, 50: 3, 100: 4, 200: 5, 333: 6, 500: 7, 1000: 8}
"""Rate [Hz] to code. Code 0 is 200 Hz too; code 6 is 300 Hz in the maker's header: measure it."""

BAUD_CODES = {115200: 0, 921600: 1, 460800: 2, 230400: 3, 57600: 5}
"""Baud to code. Code 4 is 115200 too."""

HIGHEST_RATE_HZ = {57600: 200, 115200: 333, 230400: 500, 460800: 500, 921600: 1000}
"""Highest rate [Hz] at a baud of the serial line; CAN at 1 Mbit/s carries all (manual 1.7)."""

CUTOFFS_HZ = (500, 300, 200, 150, 100, 50, 40, 30, 20, 10, 5, 3, 2, 1)
"""Cutoffs of the first-order low-pass [Hz] in the manuals' order: codes 1 to 14."""

ERRORS = {1: "unsupported", 2: "out of range", 3: "failed"}
"""Meaning of the error code of a refused setting."""

_COMMANDS = {int(command): command for command in RobotousCommand}
_TEXTS = (RobotousCommand.MODEL, RobotousCommand.SERIAL, RobotousCommand.FIRMWARE)
_SETTINGS = (RobotousCommand.SET_BAUD, RobotousCommand.SET_FILTER, RobotousCommand.SET_RATE)


@dataclass(frozen=True, slots=True)
class RobotousData:
    """One wrench, raw.

    Attributes:
        command: ``START`` for a streamed one, ``SAMPLE`` for one asked for.
        counts: Fx Fy Fz Tx Ty Tz as sent.
        overload: Status byte; bit 5 Fx ... bit 0 Tz set where a load passes 120 % of its rating.
    """

    command: RobotousCommand
    counts: tuple[int, ...]
    overload: int


@dataclass(frozen=True, slots=True)
class RobotousText:
    """Model, serial number or firmware version."""

    command: RobotousCommand
    text: str


@dataclass(frozen=True, slots=True)
class RobotousResult:
    """Answer to a set request.

    Attributes:
        command: The request that is answered.
        ok: The setting was taken.
        error: Error code, see ``ERRORS``; 0 if none.
    """

    command: RobotousCommand
    ok: bool
    error: int


@dataclass(frozen=True, slots=True)
class RobotousUnknown:
    """An answer of another kind, as it came."""

    payload: bytes


RobotousRecord = RobotousData | RobotousText | RobotousResult | RobotousUnknown


def decode(payload: bytes) -> RobotousRecord:
    """Read the data bytes D1..D16 of one answer; what cannot be read is ``RobotousUnknown``."""
    command = _COMMANDS.get(payload[0]) if len(payload) == REPLY_BYTES else None
    if command is None:
        return RobotousUnknown(payload)
    if command in (RobotousCommand.SAMPLE, RobotousCommand.START):
        return RobotousData(command, _COUNTS.unpack_from(payload, 1), payload[13])
    if command in _TEXTS:
        text = payload[1:].split(b"\0")[0].decode("ascii", "replace")
        return RobotousText(command, text.strip())
    if command in _SETTINGS:
        ok = payload[1] == 1
        return RobotousResult(command, ok, 0 if ok else payload[2])
    return RobotousUnknown(payload)  # stop and bias have no answer


def overloaded_axes(overload: int) -> tuple[str, ...]:
    """Names of the axes whose bit is set in the status byte."""
    return tuple(axis for at, axis in enumerate(AXES) if overload & 0x20 >> at)


FORCE_DIVISOR = 50.0
"""Counts per newton."""


@dataclass(frozen=True, slots=True)
class RobotousScale:
    """Counts per unit of one model.

    Attributes:
        torque_divisor: Counts per newton metre; those per newton are the same for all models.
    """

    torque_divisor: float

    def wrench(self, counts: Sequence[int]) -> tuple[float, ...]:
        """Fx Fy Fz [N] Tx Ty Tz [N m] of the six counts."""
        force = tuple(count / FORCE_DIVISOR for count in counts[:3])
        return force + tuple(count / self.torque_divisor for count in counts[3:])


TORQUE_DIVISORS: dict[str, float] = {
    "RFT40-SA01": 2000.0,
    "RFT44-SB01": 2000.0,
    "RFT60-HA01": 2000.0,
    "RFT64-SB01": 2000.0,
    "RFT76-HA01": 2000.0,
    "RFT80-6A01": 1000.0,
    "RFT82-HA02": 1000.0,
}
"""Counts per newton metre by model."""


def scale_of(model: str, *, torque_divisor: float | None = None) -> RobotousScale:
    """Scale of a model.

    Args:
        model: Name as the sensor sends it, e.g. ``"RFT40-SA01-C"``; a suffix is ignored.
        torque_divisor: Counts per newton metre in place of the table's (the maker's ROS 2 driver
            uses 1000 for all models).

    Raises:
        ValueError: The model is not in the table and no divisor is given, or it is not positive.
    """
    if torque_divisor is None:
        known = [name for name in TORQUE_DIVISORS if model.strip().upper().startswith(name)]
        if not known:
            names = ", ".join(TORQUE_DIVISORS)
            raise ValueError(f"model {model!r} is not in {names}: give the torque divisor")
        torque_divisor = TORQUE_DIVISORS[known[0]]
    if not 0 < torque_divisor < float("inf"):
        raise ValueError(f"torque divisor {torque_divisor} is not above 0")
    return RobotousScale(torque_divisor)


def request(command: RobotousCommand, *parameters: int) -> bytes:
    """Data bytes of a request."""
    return bytes((command, *parameters)).ljust(REQUEST_BYTES, b"\0")


START_REQUEST = request(RobotousCommand.START)
"""Start the stream; while it runs, the sensor accepts only stop and bias."""

STOP_REQUEST = request(RobotousCommand.STOP)
"""Stop the stream; there is no answer."""

BIAS_REQUEST = request(RobotousCommand.BIAS, 1)
"""Take the present load as zero; there is no answer."""


def rate_request(rate_hz: int) -> bytes:
    """Set the stream's rate [Hz], one of ``RATE_CODES``; serial lines: ``HIGHEST_RATE_HZ``."""
    return request(RobotousCommand.SET_RATE, _code(RATE_CODES, rate_hz, "rate [Hz]"))


def baud_request(baud: int) -> bytes:
    """Set the baud of the serial line, one of ``BAUD_CODES``."""
    return request(RobotousCommand.SET_BAUD, _code(BAUD_CODES, baud, "baud"))


def filter_request(
    cutoff_hz: int | None, *, order: RobotousFilterOrder = RobotousFilterOrder.MANUALS
) -> bytes:
    """Set the low-pass.

    Args:
        cutoff_hz: One of ``CUTOFFS_HZ``; None for no filter.
        order: How the sensor numbers cutoffs. Confirm it by the noise level.
    """
    if cutoff_hz is None:
        return request(RobotousCommand.SET_FILTER, 0, 0)
    cutoffs_hz = CUTOFFS_HZ if order is RobotousFilterOrder.MANUALS else CUTOFFS_HZ[::-1]
    codes = {one_hz: code for code, one_hz in enumerate(cutoffs_hz, 1)}
    return request(RobotousCommand.SET_FILTER, 1, _code(codes, cutoff_hz, "cutoff [Hz]"))


def _code(codes: dict[int, int], value: int, name: str) -> int:
    if value not in codes:
        raise ValueError(f"{name} {value} is not one of {', '.join(map(str, sorted(codes)))}")
    return codes[value]


REQUEST_ID = 0x64
FIRST_ID = 0x01
SECOND_ID = 0x02
"""CAN ids as delivered; each can be set to 1..255."""

_HEAD = b"\x55"
_END = 0xAA
_EXTRA_BYTES = 3
_HALF_BYTES = REPLY_BYTES // 2


def serial_frame(data: bytes) -> bytes:
    """Frame of a request (8 data bytes: 11 bytes) or of an answer (16: 19); else ValueError."""
    if len(data) not in (REQUEST_BYTES, REPLY_BYTES):
        raise ValueError(f"{len(data)} data bytes are neither {REQUEST_BYTES} nor {REPLY_BYTES}")
    return _HEAD + data + bytes((sum8(data), _END))


def _is_good(frame: bytes) -> bool:
    return frame[-1] == _END and frame[-2] == sum8(frame[1:-2])


class RobotousSerialDecoder(FrameFinder[bytes]):
    """Data bytes out of a serial line.

    Args:
        data_bytes: Data bytes of a frame: 16 from the sensor, 8 on the way to it.
    """

    def __init__(self, data_bytes: int = REPLY_BYTES) -> None:
        super().__init__({_HEAD: data_bytes + _EXTRA_BYTES}, _is_good, lambda frame: frame[1:-2])


class RobotousCanDecoder:
    """Data bytes out of CAN messages.

    A half whose other half did not follow is dropped: ``lonely_first``, ``lonely_second``.
    ``swapped_pairs`` counts those among them that came as a pair in the wrong order. The sensor
    numbers nothing: where a second half and the next first half are lost together, the halves of
    two samples would make one answer. Only the times of the messages show that: call ``reset()``
    when there is such a gap between them.

    Args:
        first_id: CAN id of D1..D8.
        second_id: CAN id of D9..D16.

    Raises:
        ValueError: The ids are the same or not in 1..255.
    """

    def __init__(self, first_id: int = FIRST_ID, second_id: int = SECOND_ID) -> None:
        if first_id == second_id or not (1 <= first_id <= 255 and 1 <= second_id <= 255):
            raise ValueError(f"CAN ids {first_id}, {second_id} are not two different in 1..255")
        self._first_id = first_id
        self._second_id = second_id
        self._first: bytes | None = None
        self._after_lonely_second = False
        self._first_after_lonely_second = False
        self.counters: dict[str, int] = dict.fromkeys(
            ("other_ids", "wrong_lengths", "lonely_first", "lonely_second", "swapped_pairs"), 0
        )

    @property
    def pending(self) -> int:
        """Messages that wait for their second half: 0 or 1."""
        return int(self._first is not None)

    def reset(self) -> None:
        """A new connection: a half that waits is counted as lonely; counters are kept."""
        self._drop_first()
        self._after_lonely_second = False

    def feed(self, can_id: int, data: bytes) -> list[bytes]:
        """Take one message; return the 16 data bytes of the answer that is now whole, if any."""
        if can_id not in (self._first_id, self._second_id):
            self.counters["other_ids"] += 1
            return []
        if len(data) != _HALF_BYTES:
            self.counters["wrong_lengths"] += 1
            self.reset()
            return []
        if can_id == self._first_id:
            self._drop_first()
            self._first = bytes(data)
            self._first_after_lonely_second = self._after_lonely_second
            self._after_lonely_second = False
            return []
        if self._first is None:
            self.counters["lonely_second"] += 1
            self._after_lonely_second = True
            return []
        payload = self._first + data
        self._first = None
        return [payload]

    def _drop_first(self) -> None:
        if self._first is None:
            return
        self.counters["lonely_first"] += 1
        self.counters["swapped_pairs"] += self._first_after_lonely_second
        self._first = None
