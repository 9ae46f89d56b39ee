"""Answers of a Robotous sensor as they come by CAN."""

from __future__ import annotations

from palpate_gateway.protocols.robotous import FIRST_ID, REPLY_BYTES, SECOND_ID


def can_messages(
    payload: bytes, first_id: int = FIRST_ID, second_id: int = SECOND_ID
) -> tuple[tuple[int, bytes], tuple[int, bytes]]:
    """Id and data of the two messages that carry one answer.

    Raises:
        ValueError: There are not 16 data bytes.
    """
    if len(payload) != REPLY_BYTES:
        raise ValueError(f"{len(payload)} data bytes are not {REPLY_BYTES}")
    return (first_id, payload[: REPLY_BYTES // 2]), (second_id, payload[REPLY_BYTES // 2 :])
