"""Lines that carry the data bytes of Robotous RFT sensors (hardware reference 3.5).

Serial: ``55``, data, sum of the data mod 256, ``AA``. CAN: an answer comes in two messages, the
halves of D1..D16, with an id each; a request is one message.
"""

from __future__ import annotations

from palpate_gateway.protocols.checksums import sum8
from palpate_gateway.protocols.resync import FrameFinder
from palpate_gateway.protocols.robotous import REPLY_BYTES, REQUEST_BYTES

REQUEST_ID = 0x64
FIRST_ID = 0x01
SECOND_ID = 0x02
"""CAN ids as delivered; each can be set to 1..255."""

_HEAD = b"\x55"
_END = 0xAA
_EXTRA_BYTES = 3
_HALF_BYTES = REPLY_BYTES // 2


def serial_frame(data: bytes) -> bytes:
    """Frame of a request (8 data bytes: 11 bytes) or of an answer (16: 19 bytes).

    Raises:
        ValueError: There are neither 8 nor 16 data bytes.
    """
    if len(data) not in (REQUEST_BYTES, REPLY_BYTES):
        raise ValueError(f"{len(data)} data bytes are neither {REQUEST_BYTES} nor {REPLY_BYTES}")
    return _HEAD + data + bytes((sum8(data), _END))


def _is_good(frame: bytes) -> bool:
    return frame[-1] == _END and frame[-2] == sum8(frame[1:-2])


class RobotousSerialDecoder:
    """Data bytes out of a serial line.

    Args:
        data_bytes: Data bytes of a frame: 16 from the sensor, 8 on the way to it.
    """

    def __init__(self, data_bytes: int = REPLY_BYTES) -> None:
        self._finder = FrameFinder({_HEAD: data_bytes + _EXTRA_BYTES}, _is_good)
        self.counters = self._finder.counters

    @property
    def pending(self) -> int:
        """Bytes of a frame that has begun."""
        return self._finder.pending

    def reset(self) -> None:
        """A new connection: partial bytes are counted as junk, counters are kept."""
        self._finder.reset()

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes as they come; return the data bytes of each good frame."""
        return [frame[1:-2] for frame in self._finder.feed(data)]


def can_messages(
    payload: bytes, first_id: int = FIRST_ID, second_id: int = SECOND_ID
) -> tuple[tuple[int, bytes], tuple[int, bytes]]:
    """Id and data of the two messages that carry one answer.

    Raises:
        ValueError: There are not 16 data bytes.
    """
    if len(payload) != REPLY_BYTES:
        raise ValueError(f"{len(payload)} data bytes are not {REPLY_BYTES}")
    return (first_id, payload[:_HALF_BYTES]), (second_id, payload[_HALF_BYTES:])


class RobotousCanDecoder:
    """Data bytes out of CAN messages.

    A half whose other half did not follow is dropped: ``lonely_first``, ``lonely_second``.
    ``swapped_pairs`` counts those among them that came as a pair in the wrong order. The sensor
    numbers nothing: where a second half and the next first half are lost together, the halves of
    two samples make one answer. Only the times of the messages show that; the caller who sees
    such a gap calls ``reset()`` before it feeds on.

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
        """A new connection: a half that waits is counted as lonely, counters are kept."""
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
