"""The counter of an RDT sensor as a clock, and whether it can be believed."""

from __future__ import annotations

from palpate.errors import DeviceLost
from palpate_gateway.protocols.rdt import unwrap

CHECK_S = 10.0
"""The counter's rate is measured over this time [s]."""

_TOLERANCE = 0.03
"""Rates of products differ by more, and late arrivals change what is measured by less."""

_RESTART_S = 0.5
"""Clocks that differ by more over a gap in the stream say that the device was off [s]."""


class CounterClock:
    """Unwraps a 32-bit counter into seconds.

    Args:
        rate_hz: Its rate; None = unknown, it only shows whether the device was restarted.
        name: The device, for errors.
    """

    def __init__(self, rate_hz: float | None, name: str) -> None:
        self.wrong = False
        """Whether the counter was found to run at another rate."""
        self._rate_hz, self._name = rate_hz, name
        self._last: tuple[int, float] | None = None
        self._first: tuple[int, float] | None = None
        self._suspect_hz = 0.0

    def follow(self, raw: int, arrival_s: float, *, new_epoch: bool) -> float | None:
        """The device's time [s]; None if the rate is unknown.

        Args:
            raw: The counter as sent.
            arrival_s: Host time when it arrived [s].
            new_epoch: The record is the first after a start request.

        Raises:
            DeviceLost: The device was restarted, or the counter runs at another rate.
        """
        if self._last is None or self._first is None:
            self._first = self._last = raw, arrival_s
        counter = unwrap(raw, self._last[0])
        if new_epoch:
            self._check_restart(counter - self._last[0], arrival_s - self._last[1])
        self._last = counter, arrival_s
        if self._rate_hz is None:
            return None
        waited_s = arrival_s - self._first[1]
        if waited_s >= CHECK_S:
            self._check_rate((counter - self._first[0]) / waited_s, self._rate_hz)
            self._first = self._last
        return counter / self._rate_hz

    def _check_restart(self, gained: int, waited_s: float) -> None:
        went_on = gained >= 0
        if self._rate_hz is not None:
            went_on = went_on and abs(gained / self._rate_hz - waited_s) <= _RESTART_S
        if not went_on:
            raise DeviceLost(
                f"{self._name}: its counter did not go on: it was restarted",
                remedy="it is opened again by itself; its zero is gone, take it again",
            )

    def _check_rate(self, measured_hz: float, rate_hz: float) -> None:
        if abs(measured_hz / rate_hz - 1.0) <= _TOLERANCE:
            self._suspect_hz = 0.0
            return
        # A pause of this process looks like a slow counter, and then like a fast one.
        again = abs(self._suspect_hz / measured_hz - 1.0) <= _TOLERANCE if measured_hz else False
        self._suspect_hz = measured_hz
        if again:
            self.wrong = True
            raise DeviceLost(
                f"{self._name}: its counter runs at {measured_hz:.0f} Hz, not {rate_hz:g} Hz",
                remedy="it is opened again with the host's clock; give the option counter_hz",
            )
