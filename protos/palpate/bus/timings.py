"""Timings of an estimate: they travel beside it, as the attachment of its message or reply."""

from __future__ import annotations

from collections.abc import Callable

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
