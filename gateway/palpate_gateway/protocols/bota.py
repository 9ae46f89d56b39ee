"""Bota Systems SensONE and Rokubi on a serial line (hardware reference 3.6).

The sensor answers in text until the run command, then it sends frames of 37 bytes. Commands have no
line end. Letters, lists and defaults come from the hardware reference; the number format of offsets
from the maker's ROS 2 driver (one source).
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass

from palpate_gateway.protocols.framing import FrameFinder, crc16_x25

FRAME_BYTES = 37

_HEAD = b"\xaa"
_FIELDS = struct.Struct("<H6fIf")

STATUS_NAMES = ("app took too long", "overrange", "invalid", "raw")
"""Meaning of the status bits, lowest first."""

OVERRANGE = 1 << 1
INVALID = 1 << 2


@dataclass(frozen=True, slots=True)
class BotaFrame:
    """One frame.

    Attributes:
        status: Status word, see ``status_names``.
        wrench: Fx Fy Fz [N] Tx Ty Tz [N m] as sent; need not be finite.
        device_time_us: The device's clock [us]; wraps at 2**32, after 71.6 minutes.
        temperature_c: Temperature [degrees C].
    """

    status: int
    wrench: tuple[float, ...]
    device_time_us: int
    temperature_c: float


def status_names(status: int) -> tuple[str, ...]:
    """Names of the bits that are set; ``bit 9`` where a bit has no known meaning."""
    names = dict(enumerate(STATUS_NAMES))
    return tuple(names.get(bit, f"bit {bit}") for bit in range(16) if status >> bit & 1)


def _is_good(frame: bytes) -> bool:
    return crc16_x25(frame[1:-2]) == int.from_bytes(frame[-2:], "little")


class BotaDecoder(FrameFinder[BotaFrame]):
    """Frames out of a serial line; the text before them counts as junk."""

    def __init__(self) -> None:
        super().__init__({_HEAD: FRAME_BYTES}, _is_good, self._frame)

    def _frame(self, frame: bytes) -> BotaFrame:
        status, *wrench, time_us, temperature_c = _FIELDS.unpack_from(frame, 1)
        return BotaFrame(status, tuple(wrench), time_us, temperature_c)


CONFIG_REQUEST = b"C"
RUN_REQUEST = b"R"
"""Leave the configuration mode and send frames."""

BOOT_TEXT = b"App Init"
"""What the sensor writes when it has started."""

BAUD_CODES = {9600: 0, 57600: 1, 115200: 2, 230400: 3, 460800: 4}

BAUDS_TO_PROBE = (460800, 230400)
"""Defaults of the maker's Python example and of its ROS 2 driver: they differ by product."""

SINC_LENGTHS = (51, 64, 128, 205, 256, 512)
"""Lengths of the sinc filter that the maker lists."""

SINC_STEP_S = 19.53125e-6
"""Period of the frames per unit of sinc length [s]."""

_ACK = re.compile(rb"r,(\d{1,9}),([ -~]),(\d{1,9})")
_REMEMBERED_BYTES = 256


def period_s(sinc: int) -> float:
    """Time between two frames [s] at a sinc length; about 1, 1.25, 2.5, 4, 5, 10 ms."""
    return SINC_STEP_S * _one_of(SINC_LENGTHS, sinc, "sinc length")


def communication_request(*, baud: int, temperature_compensation: bool = False) -> bytes:
    """Send calibrated values in binary frames.

    Args:
        baud: One of ``BAUD_CODES``.
        temperature_compensation: Correct for temperature in the sensor.
    """
    code = BAUD_CODES[_one_of(BAUD_CODES, baud, "baud")]
    return b"c,%d,1,0,%d" % (temperature_compensation, code)


def filter_request(
    sinc: int, *, chop: bool = False, fast: bool = False, fir: bool = False
) -> bytes:
    """Set the filter; the sinc length (one of ``SINC_LENGTHS``) sets the rate too."""
    _one_of(SINC_LENGTHS, sinc, "sinc length")
    return b"f,%d,%d,%d,%d" % (sinc, chop, fast, not fir)


def offsets_request(offsets: Sequence[float]) -> bytes:
    """Set the six offsets Fx Fy Fz [N] Tx Ty Tz [N m]."""
    if len(offsets) != 6 or not all(map(math.isfinite, offsets)):
        raise ValueError(f"offsets {tuple(offsets)} are not six finite numbers")
    return b"b," + ",".join(f"{offset:.3f}" for offset in offsets).encode("ascii")


def expected_reply(request: bytes) -> bytes:
    """Reply that confirms the request."""
    return b"r,0,%b,0" % request[:1]


@dataclass(frozen=True, slots=True)
class BotaAck:
    """A reply ``r,<number>,<command>,<code>``.

    Attributes:
        command: First letter of the request.
        code: 0 = taken.
    """

    command: str
    code: int


def find_ack(text: bytes) -> BotaAck | None:
    """First reply in the text, which tells a refusal from silence."""
    found = _ACK.search(text)
    return BotaAck(found[2].decode("ascii"), int(found[3])) if found else None


class BotaTextWait:
    """Waits for a text, and returns the bytes that follow it: after ``R`` those are frames.

    Args:
        text: The text to wait for, not empty.
    """

    def __init__(self, text: bytes) -> None:
        self._text = text
        self._done = False
        self.before = b""
        """Last bytes before the text, at most 256, for the error when it does not come."""

    def feed(self, data: bytes) -> bytes | None:
        """Take bytes as they come; None until the text has come, then the bytes after it."""
        if self._done:
            return bytes(data)
        before, found, after = (self.before + data).partition(self._text)
        self.before = before[-_REMEMBERED_BYTES:]
        self._done = bool(found)
        return after if found else None


def _one_of(known: Sequence[int] | dict[int, int], value: int, name: str) -> int:
    if value not in known:
        raise ValueError(f"{name} {value} is not one of {', '.join(map(str, known))}")
    return value
