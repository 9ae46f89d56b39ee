"""The interface of an emulator: a device in software, at a real address, with faults on request."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar, Self

Wrench = tuple[float, float, float, float, float, float]
"""Fx Fy Fz [N] Tx Ty Tz [N m]."""

WrenchSource = Callable[[float], Sequence[float]]
"""Gives the wrench at a time of the emulator's own clock [s], which counts from its start."""


class HostTimed:
    """A source that follows the host's clock, so that several emulators play one scene.

    Attributes:
        lead_s: Host's monotonic time less the emulator's own time [s]; its emulator sets it.
    """

    lead_s = 0.0


class Emulator(ABC):
    """Serves one device from a thread of its own until it is stopped.

    Arguments of subclasses mean the same as the options of their commands (``palpate emulate``):
    address, rates, ``drift_ppm`` of their clock during the fault ``clock_drift`` and so on; an
    empty ``path`` or a ``port`` 0 is a new one. ``source``, ``counts`` or ``tip`` is what the
    device measures.

    Args:
        rate_hz: Samples each second.
    """

    faults: ClassVar[frozenset[str]]
    """Names of the faults that it can have."""

    def __init__(self, rate_hz: float) -> None:
        if not 0.0 < rate_hz <= 100_000.0:
            raise ValueError(f"rate_hz {rate_hz} is not in 0..100000")
        self.rate_hz = rate_hz
        self.sent = 0
        """Samples that went out whole, each once; what a fault made them say does not matter."""
        self._until: dict[str, float] = {}
        self._held_s: float | None = None
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    @abstractmethod
    def address(self) -> str:
        """Address for a driver's options, e.g. a device file or ``host:port``."""

    def inject(self, fault: str, duration_s: float = 0.0) -> None:
        """Start a fault for a duration [s]; 0 = once, at the next sample.

        One that acts already goes on until the later of both ends.

        Raises:
            ValueError: It has no such fault.
        """
        self._check(fault)
        with self._lock:
            now_s = time.monotonic()
            until_s = now_s + duration_s if duration_s > 0.0 else 0.0
            acts_until_s = self._until.get(fault, 0.0)
            if acts_until_s > now_s:
                until_s = max(until_s, acts_until_s)
            self._until[fault] = until_s

    def faulty(self, fault: str) -> bool:
        """Whether a fault acts now; a call that returns True uses up a fault injected for once."""
        with self._lock:
            until = self._until.get(fault)
            if until is None:
                return False
            if until == 0.0 or time.monotonic() >= until:
                del self._until[fault]
            return until == 0.0 or time.monotonic() < until

    def end(self, fault: str) -> None:
        """End a fault now, or cancel it if it has not acted yet.

        Raises:
            ValueError: It has no such fault.
        """
        self._check(fault)
        with self._lock:
            self._until.pop(fault, None)

    @property
    def sound(self) -> bool:
        """Whether no fault acts or waits; cheap, because it is checked at each sample."""
        return not self._until

    def held(self, t: float) -> float:
        """Time to measure at [s]: ``t``, or during the fault ``stuck`` the time of its begin."""
        if self.sound or not self.faulty("stuck"):
            self._held_s = None
            return t
        if self._held_s is None:
            self._held_s = t
        return self._held_s

    def _check(self, fault: str) -> None:
        if fault not in self.faults:
            raise ValueError(f"fault {fault!r} is none of {', '.join(sorted(self.faults))}")

    def start(self) -> None:
        """Start to serve; the address is valid afterwards."""
        self._listen()
        self._thread = threading.Thread(target=self._serve, name=type(self).__name__, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop serving; a second call does nothing."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(5.0)
            self._thread = None
            self._hang_up()

    @abstractmethod
    def _listen(self) -> None:
        """Open what clients connect to."""

    @abstractmethod
    def _serve(self) -> None:
        """Serve until ``self._stop`` is set."""

    @abstractmethod
    def _hang_up(self) -> None:
        """Close what ``_listen`` opened, and all connections."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.stop()


def set_lead(source: object, lead_s: float) -> None:
    """Set ``lead_s`` of a source that follows the host's clock; other sources are left alone."""
    if isinstance(source, HostTimed):
        source.lead_s = lead_s


def no_load(t: float) -> Wrench:
    """No load."""
    return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def slow_press(t: float) -> Wrench:
    """A slow load: up to 4 N every five seconds, with some shear."""
    share = max(0.0, 1.0 - abs(t % 5.0 - 2.5) / 1.5)
    return (0.5 * share, -0.25 * share, 4.0 * share, 0.004 * share, -0.008 * share, 0.001 * share)


class SampleTicker:
    """Ticks at a rate, without drift; after a pause of this process it continues from now."""

    def __init__(self, rate_hz: float, stop: threading.Event) -> None:
        self._period_s, self._stop = 1.0 / rate_hz, stop
        self.fast = 0.0
        """Relative excess of its rate, e.g. 2e-4."""
        self.clock_s = 0.0
        """Time of the device's own clock at the last tick, since the start [s]: one period a tick,
        and a pause of this process as well."""
        self._next_s = time.monotonic()

    def wait(self) -> float:
        """Wait until the next tick or until ``stop``; when the tick was due [s, monotonic]."""
        last_s = self._next_s
        self._next_s += self._period_s / (1.0 + self.fast)
        left_s = self._next_s - time.monotonic()
        if left_s > 0.0:
            self._stop.wait(left_s)
        elif left_s < -0.5:
            # Shorter delays are caught up by ticks in quick succession, as a device would send.
            self._next_s = time.monotonic()
        self.clock_s += (self._next_s - last_s) * (1.0 + self.fast)
        return self._next_s
