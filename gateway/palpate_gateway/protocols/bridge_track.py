"""Gaps, repetitions and starts of a bridge, from the numbers and times of its packets."""

from __future__ import annotations

from dataclasses import dataclass

_SEQUENCES = 1 << 16
_TIMES = 1 << 32

_LATE_US = 1_000_000
"""A HELLO has the time it is sent, the slots behind it that of the first, which is earlier [us]."""


@dataclass(slots=True)
class PacketTrack:
    """Where the packets of a bridge have got to since it started.

    Attributes:
        sequence: Number of its last packet, modulo 65536.
        time_us: Device time of that packet, unwrapped [us].
    """

    sequence: int
    time_us: int

    def has_restarted(self, sequence: int, time_us: int, *, hello: bool) -> bool:
        """Whether the next packet is of another start.

        Its time goes back in a HELLO, or together with its number, or by more than slots are late.
        """
        step = _signed(sequence - self.sequence, _SEQUENCES)
        elapsed_us = _signed(time_us - self.time_us, _TIMES)
        if elapsed_us < 0 and (hello or step < 0 or elapsed_us < -_LATE_US):
            return True
        # After more than 36 minutes a start looks like time that goes on over its wrap; but the
        # first HELLO of all has number 0, out of its turn.
        return hello and sequence == 0 and step != 1 and time_us < self.time_us % _TIMES

    def follow(self, sequence: int, time_us: int) -> int | None:
        """Go on to the next packet.

        Args:
            sequence: Its number, modulo 65536.
            time_us: Its device time, modulo 2**32 [us].

        Returns:
            How many packets are missing before it; None if it repeats the last.
        """
        lost = (sequence - self.sequence - 1) % _SEQUENCES
        if lost == _SEQUENCES - 1:
            return None
        self.sequence = sequence
        self.time_us += _signed(time_us - self.time_us, _TIMES)
        return lost


def _signed(difference: int, modulus: int) -> int:
    """The shorter way around."""
    half = modulus // 2
    return (difference + half) % modulus - half
