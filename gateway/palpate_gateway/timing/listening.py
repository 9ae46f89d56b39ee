"""How long a device has been silent, of the time in which this process listened."""

from __future__ import annotations

import time

_STALL_S = 0.02
"""A read that takes longer than it was allowed by more than this [s] says that the process stood
still, and what came meanwhile is yet to be read."""

_LEAST_S = 1e-3


class Listening:
    """Times the silences of one device.

    Args:
        lost_s: A longer silence is one to tell of [s].
        read_s: How long to wait for the end of such a silence at a time [s].
    """

    def __init__(self, lost_s: float, read_s: float) -> None:
        self._lost_s, self._read_s = lost_s, read_s
        self.silent_s = 0.0
        """How long nothing came [s]."""
        self._began_s = time.monotonic()
        self._allowed_s = read_s
        self._stalled = False

    @property
    def lost(self) -> bool:
        """Whether the silence is long enough to be told."""
        return self.silent_s >= self._lost_s

    def begin(self) -> float:
        """A read begins: how long it may wait [s], so that a silence is told when it is due."""
        left_s = self._lost_s - self.silent_s
        self._allowed_s = max(left_s, _LEAST_S) if left_s > 0.0 else self._read_s
        self._began_s = time.monotonic()
        return self._allowed_s

    def heard(self) -> None:
        """Something came, or the device was kept busy by other things."""
        self.silent_s, self._stalled = 0.0, False

    def heard_nothing(self) -> None:
        """The read that was begun timed out."""
        took_s = time.monotonic() - self._began_s
        # Once: a driver that always takes too long must not hide that nothing comes.
        if took_s > self._allowed_s + _STALL_S and not self._stalled:
            self._stalled = True
            return
        self.silent_s += took_s
