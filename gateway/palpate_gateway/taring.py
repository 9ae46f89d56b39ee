"""The tares that one sensor attempts: its own, and those that somebody asks for."""

from __future__ import annotations

import threading
from concurrent.futures import Future

from palpate.errors import DeviceError, PalpateError
from palpate.messages import ElectrodeFrame, Tare
from palpate_gateway.condition.stillness import StillLimits
from palpate_gateway.tare import TareCollector, TareLedger


class Taring:
    """Offers each frame to every attempt that is under way.

    ``offer`` and ``finish`` belong to one thread; the rest may be called from any.

    Args:
        frames: Frames in a tare, unless asked otherwise.
        limits: What a sensor that nothing touches does not exceed.
        at_start: Whether to tare without being asked, as soon as it can be done.
    """

    def __init__(self, frames: int, limits: StillLimits, *, at_start: bool) -> None:
        self.ledger = TareLedger()
        self.counters: dict[str, int] = {"tares": 0, "tares_refused": 0}
        self.error: DeviceError | None = None
        """Why the last attempt failed; None after a success."""
        self.frames = frames
        self._limits = limits
        self._own = TareCollector(frames, limits) if at_start else None
        self._lock = threading.Lock()
        self._asked: list[tuple[TareCollector, Future[Tare]]] = []
        self._over = ""

    @property
    def attempting(self) -> bool:
        """Whether it tries to tare without having been asked."""
        return self._own is not None

    def attempt(self) -> None:
        """Tare as soon as it can be done, or do nothing if that is being tried."""
        if self._own is None:
            self._own = TareCollector(self.frames, self._limits)

    def ask(self, frames: int, *, sensor: str, never: str = "") -> Future[Tare]:
        """Tare with the next frames (0 = the usual number).

        Args:
            frames: How many.
            sensor: What a person calls it.
            never: Why it can never be tared; empty = it can.

        Raises:
            DeviceError: No further frames will come to be averaged.
        """
        future: Future[Tare] = Future()
        collector = TareCollector(frames or self.frames, self._limits)
        with self._lock:
            if self._over or never:
                raise DeviceError(
                    f"{sensor} cannot be tared: {self._over or never}",
                    remedy="tare a live sensor, or ask for a known tare by its id",
                )
            self._asked.append((collector, future))
        return future

    def offer(self, frame: ElectrodeFrame) -> list[Tare]:
        """Take a frame; the tares that it has completed, which are in force now."""
        if self._own is None and not self._asked:
            return []
        tares = []
        if self._own is not None:
            tare = self._try(self._own, frame)
            if isinstance(tare, Tare):
                tares.append(tare)
        with self._lock:
            asked = list(self._asked)
        for collector, future in asked:
            answer = self._try(collector, frame)
            if answer is None:
                continue
            if isinstance(answer, Tare):
                tares.append(answer)
            self._answer(collector, future, answer)
        return tares

    def finish(self, why: str) -> None:
        """No further frame will come."""
        with self._lock:
            self._over = why
            asked, self._asked = self._asked, []
        for _, future in asked:
            future.set_exception(
                DeviceError(f"not tared: {why}", remedy="tare while the sensor delivers")
            )

    def recorded(self, tare: Tare) -> None:
        """A record brought a tare of its own."""
        self.ledger.enter(tare)
        self.counters["tares"] += 1

    def refuse(self, error: DeviceError) -> None:
        """An attempt failed."""
        self.error = error
        self.counters["tares_refused"] += 1

    def _try(self, collector: TareCollector, frame: ElectrodeFrame) -> Tare | DeviceError | None:
        try:
            tare = collector.add(frame)
        except DeviceError as error:
            self.refuse(error)
            return error
        if tare is not None:
            self._own = None
            self.error = None
            self.recorded(tare)
        return tare

    def _answer(
        self, collector: TareCollector, future: Future[Tare], answer: Tare | PalpateError
    ) -> None:
        with self._lock:
            self._asked = [item for item in self._asked if item[0] is not collector]
        if not future.set_running_or_notify_cancel():
            return
        if isinstance(answer, PalpateError):
            future.set_exception(answer)
        else:
            future.set_result(answer)
