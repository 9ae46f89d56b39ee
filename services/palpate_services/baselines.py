"""Finding the baseline of a frame without letting one lost tare hold up every sensor."""

from __future__ import annotations

import time

from palpate.bus.tares import TareBook
from palpate.errors import PalpateError
from palpate.messages import Tare

FIRST_RETRY_S = 0.5
"""After a first miss the same tare is asked for again no sooner than this."""

LAST_RETRY_S = 5.0
"""Longest time between two questions for the same tare; it doubles up to here."""

PATIENCE_S = 2.0
"""How long a lossless replay waits for a tare, which may overtake nothing but can be overtaken."""

_REMEMBERED = 256


class Baselines:
    """Looks tares up, and after a miss leaves the gateway alone for a while. One thread only.

    Args:
        book: The station's tares.
        patient: Wait for a tare instead of answering that nobody knows it (lossless replay).
    """

    def __init__(self, book: TareBook, *, patient: bool) -> None:
        self._book = book
        self._patient = patient
        self._misses: dict[tuple[str, int], tuple[float, float]] = {}

    def find(self, sensor: str, tare_id: int) -> tuple[Tare | None, bool]:
        """The tare a frame names.

        Args:
            sensor: Name of the sensor.
            tare_id: From the frame; not ``NO_TARE``.

        Returns:
            The tare, or None if nobody knows it; and whether looking for it may have taken time.
        """
        key = (sensor, tare_id)
        miss = self._misses.get(key) if self._misses else None
        if miss is not None and time.monotonic() < miss[0]:
            return None, False
        began_s = time.monotonic()
        while True:
            try:
                tare = self._book.baseline(sensor, tare_id)
            except PalpateError:
                if self._patient and miss is None and time.monotonic() - began_s < PATIENCE_S:
                    time.sleep(0.02)
                    continue
                self._remember_miss(key, FIRST_RETRY_S if miss is None else 2 * miss[1])
                return None, True
            if miss is not None:
                del self._misses[key]
            return tare, time.monotonic() - began_s > 1e-3

    def _remember_miss(self, key: tuple[str, int], wait_s: float) -> None:
        wait_s = min(wait_s, LAST_RETRY_S)
        self._misses[key] = (time.monotonic() + wait_s, wait_s)
        while len(self._misses) > _REMEMBERED:
            self._misses.pop(next(iter(self._misses)))
