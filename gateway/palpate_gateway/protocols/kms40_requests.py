"""Commands to the Weiss KMS 40 (hardware reference 3.1).

The order seen in the field: mask, filter, divider, ``VL(0)``, start. Stop the stream before a tare,
and read on until the echo ``L0``: samples may still come before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

PORT = 1000
"""TCP port; the device's address is a setting, two defaults are known (hardware reference 6)."""

BASE_RATE_HZ = 500.0
"""Rate at divider 1: one sample each 2 ms [Hz]."""

DIVIDER_MAX = 500
"""Largest divider we ask for, one line a second; the device's own limit is not public."""

FILTER_MAX = 255
"""Largest filter number we ask for; the device's table of filters is not public."""


class Query(StrEnum):
    """Commands without arguments that only ask; the value is also the name of the reply."""

    IDENTITY = "ID"
    SERIAL_NUMBER = "SN"
    VERSION = "V"
    CALIBRATION_DATE = "CALDATE"
    TEMPERATURE = "T"
    FLAGS = "FLAGS"
    SAMPLE = "F"
    """One sample; the answer is a data line."""


def query_request(query: Query) -> bytes:
    """Ask for one fact."""
    return f"{query}()\n".encode("ascii")


def identify_requests() -> tuple[bytes, ...]:
    """Ask who the device is: identity, serial number and version, one request each."""
    return tuple(map(query_request, (Query.IDENTITY, Query.SERIAL_NUMBER, Query.VERSION)))


def start_request() -> bytes:
    """Start the stream; the device echoes ``L1``."""
    return b"L1()\n"


def stop_request() -> bytes:
    """Stop the stream; the device echoes ``L0``, perhaps after more samples."""
    return b"L0()\n"


def tare_request() -> bytes:
    """Take the present load as zero; the reply is ``TARE=1``."""
    return b"TARE(1)\n"


def clear_tare_request() -> bytes:
    """Forget the tare; the reply is ``TARE=0``."""
    return b"TARE(0)\n"


def quiet_request() -> bytes:
    """Ask for the shortest replies."""
    return b"VL(0)\n"


def mask_request(axes: Sequence[bool] = (True,) * 6) -> bytes:
    """Choose the axes to be sent; ``kms40.parse_line`` takes only samples of all six.

    Args:
        axes: Whether to send fx fy fz mx my mz.

    Raises:
        ValueError: There are not six, or none is chosen.
    """
    if len(axes) != 6 or not any(axes):
        raise ValueError(f"mask {list(axes)} is not six truth values with one true at least")
    return f"LMASK({{{','.join('1' if axis else '0' for axis in axes)}}})\n".encode("ascii")


def divider_request(divider: int) -> bytes:
    """Send only every n-th sample.

    Args:
        divider: The n, 1..500.

    Raises:
        ValueError: The divider is out of range.
    """
    _check("divider", divider, 1, DIVIDER_MAX)
    return f"LDIV({divider})\n".encode("ascii")


def filter_request(number: int) -> bytes:
    """Choose a filter.

    Args:
        number: Number in the device's table of filters, 0..255.

    Raises:
        ValueError: The number is out of range.
    """
    _check("filter number", number, 0, FILTER_MAX)
    return f"FLT({number})\n".encode("ascii")


def rate_of_divider(divider: int) -> float:
    """Lines per second at a divider [Hz].

    Raises:
        ValueError: The divider is out of range.
    """
    _check("divider", divider, 1, DIVIDER_MAX)
    return BASE_RATE_HZ / divider


def divider_of_rate(rate_hz: float) -> int:
    """Largest divider whose rate is not below the one asked for.

    Args:
        rate_hz: Lines per second, 1..500 [Hz].

    Raises:
        ValueError: The device cannot deliver at this rate.
    """
    slowest = BASE_RATE_HZ / DIVIDER_MAX
    if not slowest <= rate_hz <= BASE_RATE_HZ:
        raise ValueError(f"rate {rate_hz} Hz is not in {slowest:g}..{BASE_RATE_HZ:g} Hz")
    # Rounding can make 500 / (500 / n) a little less than n.
    return int(BASE_RATE_HZ / rate_hz * (1 + 1e-9))


def _check(name: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise ValueError(f"{name} {value} is not in {least}..{most}")
