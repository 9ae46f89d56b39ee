"""What travels beside a payload: how long the caller of a question waits, timings of an estimate.

Nobody works for a caller who has left.

The time that is left, not the instant when it ends, is in the attachment of the query, because
clocks of two hosts differ. It is text that any language can write: ``palpate.v1;timeout_ms=1500``.
Further ``;key=value`` may follow and are ignored, as are attachments that begin otherwise.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from palpate.bus.topics import CONTRACT_VERSION
from palpate.codec import STAGE_TIMINGS
from palpate.errors import WireError
from palpate.messages import StageTimings

OnTimings = Callable[[StageTimings], None]
"""Called with the timings of an estimate."""


def timings_of(attachment: bytes) -> StageTimings | None:
    """The timings in the attachment of an estimate; None if there are none, or of another kind.

    What cannot be read costs no message.
    """
    if not attachment:
        return None
    try:
        return STAGE_TIMINGS.decode(attachment)
    except WireError:
        return None


_HEAD = f"palpate.v{CONTRACT_VERSION};"
_KEY = "timeout_ms="
_MOST_BYTES = 256


def attachment_of(timeout_s: float) -> bytes:
    """The attachment of a question whose caller waits so long [s]."""
    return f"{_HEAD}{_KEY}{math.ceil(timeout_s * 1000)}".encode()


def deadline_of(attachment: bytes | None) -> float:
    """When the caller of a question that arrives now stops waiting [s, monotonic]; inf = unknown.

    Raises:
        WireError: It is an attachment of this contract, and damaged (reason ``"attachment"``).
    """
    if attachment is None or not attachment.startswith(_HEAD.encode()):
        return math.inf
    text = attachment[:_MOST_BYTES].decode("ascii", "replace").removeprefix(_HEAD)
    for part in text.split(";"):
        if part.startswith(_KEY):
            number = part.removeprefix(_KEY)
            if not (number.isascii() and number.isdigit() and len(number) <= 12):
                raise WireError(
                    f"{number!r} in the attachment of the query is no time in milliseconds",
                    remedy=f"attach {attachment_of(1.5).decode()!r}, or nothing",
                    reason="attachment",
                )
            return time.monotonic() + int(number) * 1e-3
    return math.inf
