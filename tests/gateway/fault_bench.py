"""A sensor's whole way, from an emulator that has faults to what would be published.

The gateway's own worker and pipeline read the device; in place of the bus there is a list. Each
trial asks: was it noticed and by what name, was anything wrong published, when was all well again?
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self, cast

from tests.gateway.device_cases import Case
from tests.gateway.scenes import was_approached, was_felt, was_measured

from palpate.errors import PalpateError
from palpate.health import Health
from palpate.messages import ElectrodeFrame, IndenterPoseFrame, WrenchFrame
from palpate_gateway.service.pipeline import Pipeline
from palpate_gateway.service.worker import SensorWorker

PATIENCE_S = 90.0
SOUND = 15
"""Good messages in a row that say that all is well."""

_ONCE_S = 0.5
"""How long a fault that is had once may let wait for it [s]."""

_FOREVER_S = 3600.0
_LIVED_S = 0.05

_FLOW = frozenset(
    "samples frames frames_published frames_untared tares tares_refused records packets datagrams "
    "data_lines replies record_bytes slots placed retares".split()
)
"""Counters that grow while all is well."""


Shows = Callable[[Mapping[str, int], Collection[PalpateError]], object]
"""Takes the counters that have grown and the errors that were told."""


@dataclass(frozen=True, slots=True)
class Published:
    """One message.

    Attributes:
        at_s: When it was published, host's monotonic clock [s].
        sampled_s: Its time stamp, on the same clock [s].
        right: It says what was measured, in every channel that it claims to be good.
        good: It is right, and nothing in it is marked as bad.
        order: Its sequence number and stamp follow on those of the one before.
    """

    at_s: float
    sampled_s: float
    right: bool
    good: bool
    order: bool


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one fault.

    Attributes:
        counted: Counters that grew, by how much; without those that always grow.
        errors: What the gateway's health was told, in order.
        published: Messages while it lasted and until all was well.
        wrong: Those among them that say what was not measured.
        disordered: Those whose number or stamp does not follow on the one before.
        recovery_s: From its end to the first of the good messages that followed one another [s].
    """

    counted: dict[str, int]
    errors: tuple[PalpateError, ...]
    published: int
    wrong: int
    disordered: int
    recovery_s: float


class _Telling(Health):
    """Health that remembers all it was told."""

    def __init__(self) -> None:
        super().__init__("gateway", "bench")
        self.errors: list[PalpateError] = []

    def fail(self, error: PalpateError, *, degraded: bool = True) -> None:
        self.errors.append(error)
        super().fail(error, degraded=degraded)


@dataclass
class _Sink:
    """Takes messages as a publisher does, and judges them."""

    case: Case
    seen: list[Published] = field(default_factory=list)
    saturated: bool = False
    _last: tuple[int, int] = (0, 0)
    _whole: int = 0

    def encode(self, message: Any) -> bytes:
        return b""

    def put(self, message: Any) -> None:
        if not isinstance(message, ElectrodeFrame | IndenterPoseFrame | WrenchFrame):
            return
        now_s = time.monotonic()
        stamp = message.stamp
        order = stamp.sequence == self._last[0] + 1 and stamp.monotonic_ns >= self._last[1]
        self._last = stamp.sequence, stamp.monotonic_ns
        if isinstance(message, WrenchFrame):
            right = was_felt(message.force, message.torque, self.case.tolerance)
            good = right and not message.overload
        elif isinstance(message, IndenterPoseFrame):
            good = right = was_approached(message.position, message.orientation)
        else:
            slow = (message.pdc, message.tac, message.tdc)
            right = was_measured(
                message.electrodes, slow, message.pac, message.validity, saturated=self.saturated
            )
            self._whole |= message.validity
            sober = was_measured(message.electrodes, slow, message.pac, message.validity)
            good = sober and message.validity == self._whole
        self.seen.append(Published(now_s, 1e-9 * stamp.monotonic_ns, right, good, order))

    def put_payload(self, payload: bytes) -> None:
        raise AssertionError("a live device has no recorded messages")


class FaultBench(AbstractContextManager["FaultBench"]):
    """One emulated device and the worker that serves it.

    Args:
        case: Which.
    """

    def __init__(self, case: Case) -> None:
        assert case.emulate is not None
        self.case = case
        self.emulator = case.emulate()
        self._stop = threading.Event()
        self._health = _Telling()
        self._sink = _Sink(case)
        self._worker: SensorWorker | None = None

    def __enter__(self) -> Self:
        self.emulator.start()
        device = self.case.device(self.emulator)
        sinks = dict.fromkeys(("electrodes", "wrench", "pose", "tare"), cast(Any, self._sink))
        self._worker = SensorWorker(
            "bench", device, Pipeline(device.info), sinks, self._health,
            pace="recorded", stop=self._stop,
        )  # fmt: skip
        self._worker.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        assert self._worker is not None
        self._worker.join(PATIENCE_S)
        self.emulator.stop()
        crash = self._worker.crash
        if crash is not None and error is None:
            raise crash

    def trial(self, fault: str, duration_s: float, *, shows: Shows | None = None) -> Outcome:
        """Have a fault, and wait until all is well again.

        Args:
            fault: One of the emulator's.
            duration_s: How long it lasts [s]; 0 = once.
            shows: Whether it has shown, by what was counted and told; it lasts until then.
        """
        self._sink.saturated = False
        self._until_sound(time.monotonic())
        before, told = self._counters(), len(self._health.errors)
        self._sink.saturated = fault == "saturated"
        first = len(self._sink.seen)
        self.emulator.inject(fault, _FOREVER_S if duration_s else 0.0)
        # What is had once may never come, e.g. a request that is not heard if none is made.
        _live(duration_s or _ONCE_S, lambda: not duration_s and self.emulator.sound)
        if shows is not None:
            self._wait(lambda: 0.0 if shows(self._counted(before), self._told(told)) else None)
        self.emulator.end(fault)
        ended_s = time.monotonic()
        recovered_s = self._until_sound(ended_s)
        seen = self._sink.seen[first:]
        return Outcome(
            self._counted(before),
            self._told(told),
            len(seen),
            sum(not one.right for one in seen),
            sum(not one.order for one in seen),
            max(recovered_s - ended_s, 0.0),
        )

    def _counted(self, before: Counter[str]) -> dict[str, int]:
        """Counters that have grown, without those that always grow."""
        counted = self._counters()
        counted.subtract(before)
        return {name: count for name, count in counted.items() if count and name not in _FLOW}

    def _told(self, before: int) -> tuple[PalpateError, ...]:
        return tuple(self._health.errors[before:])

    def _counters(self) -> Counter[str]:
        assert self._worker is not None
        return Counter(self._worker.counters())

    def _until_sound(self, from_s: float) -> float:
        """When the first of the good messages was published that follow one another.

        They must have been sampled after ``from_s``: a worker that lags publishes messages from
        before a fault when the fault has ended and was counted.
        """

        def sound(one: Published) -> bool:
            return one.good and one.sampled_s >= from_s

        def found() -> float | None:
            seen = self._sink.seen
            last = seen[-SOUND:]
            if len(last) < SOUND or not all(sound(one) for one in last):
                return None
            at = len(seen)
            while at and sound(seen[at - 1]):
                at -= 1
            return seen[at].at_s

        return self._wait(found)

    def _wait(self, found: Callable[[], float | None]) -> float:
        deadline = time.monotonic() + PATIENCE_S
        while (value := found()) is None:
            assert self._worker is not None
            if time.monotonic() > deadline or self._worker.ended.is_set():
                told = [str(error) for error in self._health.errors[-3:]]
                raise AssertionError(f"no good messages: {told}, {dict(self._counters())}")
            time.sleep(0.01)
        return value


def _live(time_s: float, over: Callable[[], bool]) -> None:
    """Wait until this process has lived for a time, or something is over.

    A time in which it was halted does not count: nobody had a fault meanwhile.
    """
    lived_s, last_s = 0.0, time.monotonic()
    while lived_s < time_s and not over():
        time.sleep(0.005)
        now_s = time.monotonic()
        lived_s += min(now_s - last_s, _LIVED_S)
        last_s = now_s
