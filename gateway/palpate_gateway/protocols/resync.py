"""Frames out of a byte stream that may begin anywhere and hold junk.

One search for all serial devices whose frames have a fixed head, a length known from the head and a
check: a head alone is never trusted (hardware reference 4.3), and after a failed check one byte is
dropped, because the true head may stand inside what looked like a frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping


class FrameFinder:
    """Finds the frames that begin with a known head and pass their check.

    Every byte is accounted for: bytes of returned frames, ``counters["junk_bytes"]``, ``pending``.
    ``counters["failed_checks"]`` counts heads whose frame failed; many of them are chance heads in
    the data that follows one damaged frame.

    Args:
        lengths: Head to length of its whole frame [bytes]. All heads begin with the same byte and
            none begins with another.
        is_good: Whether a whole frame passes its check.
    """

    def __init__(self, lengths: Mapping[bytes, int], is_good: Callable[[bytes], bool]) -> None:
        self._lengths = dict(lengths)
        self._first = next(iter(lengths))[:1]
        if not self._first or any(head[:1] != self._first for head in lengths):
            raise ValueError("the heads do not begin with the same byte")
        self._is_good = is_good
        self._buffer = bytearray()
        self.counters: dict[str, int] = {"junk_bytes": 0, "failed_checks": 0}

    @property
    def pending(self) -> int:
        """Bytes of a frame that has begun; fewer than the longest frame."""
        return len(self._buffer)

    def reset(self) -> None:
        """A new connection: the frame that has begun will not go on, its bytes are junk."""
        self.counters["junk_bytes"] += len(self._buffer)
        self._buffer.clear()

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes as they come; return the frames that are now whole."""
        buffer = self._buffer
        buffer += data
        frames: list[bytes] = []
        at = junk = 0
        while (head := buffer.find(self._first, at)) >= 0:
            junk += head - at
            at = head
            length = self._length_at(at)
            if length > len(buffer) - at:
                break
            frame = bytes(buffer[at : at + length])
            if length and self._is_good(frame):
                frames.append(frame)
                at += length
            else:
                self.counters["failed_checks"] += length > 0
                junk += 1
                at += 1
        else:
            junk += len(buffer) - at
            at = len(buffer)
        del buffer[:at]
        self.counters["junk_bytes"] += junk
        return frames

    def _length_at(self, at: int) -> int:
        """Bytes that are needed to go on from here; 0 where no frame begins."""
        for head, length in self._lengths.items():
            begun = bytes(self._buffer[at : at + len(head)])
            if begun == head:
                return length
            if begun and head.startswith(begun):  # the buffer ends inside a head
                return len(head)
        return 0
