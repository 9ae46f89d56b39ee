"""The process of a device: takes presses as they come, and solves them in slots.

Three threads: one takes messages and checks presses, one sends messages, and one keeps the device
busy, which must wait for neither.
"""

from __future__ import annotations

import itertools
import os
import queue
import sys
import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

from palpate.errors import ConfigError, PalpateError, SimulationError
from palpate_fem.indenter.approach import OuterSurface, check_clear
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.indenter.path import check_path
from palpate_fem.result import IndentationResult
from palpate_fem.service.channel import Channel, Outbox, channel_to_parent
from palpate_fem.service.fingertips import (
    FingertipCache,
    SlottedSolver,
    SlottedTip,
    load_factory,
    skin_of,
)
from palpate_fem.service.jobs import (
    DeviceSetup,
    JobFailed,
    JobStarted,
    NumberedPress,
    PressEnded,
    PressRefused,
    ResultTaken,
    Swept,
)

if TYPE_CHECKING:
    from palpate_fem.batched.fingertip import BatchedPress

RESULTS_MOST = 8
"""Results that the other end has not taken yet; each has 20 MB."""

_BEAT_S = 0.2


def _exit() -> None:
    os._exit(0)  # the other end is gone, and the solver's thread does not look at it


class WaitingPresses:
    """Presses that have come, as an iterator that may be asked again when it has ended.

    It ends when there is none at the moment: the solver asks in every sweep and must not be held
    up while slots are at work.

    Attributes:
        numbers: Of the presses that the solver has and that have not ended, by their order.
    """

    def __init__(self, come: queue.SimpleQueue[tuple[int, BatchedPress]]) -> None:
        self._come = come
        self._order = itertools.count()
        self._first: tuple[int, BatchedPress] | None = None
        self.numbers: dict[int, int] = {}

    def wait(self) -> None:
        """Wait for a press; nothing is at work."""
        self._order, self.numbers = itertools.count(), {}
        self._first = self._come.get()

    def __iter__(self) -> Iterator[BatchedPress]:
        return self

    def __next__(self) -> BatchedPress:
        found, self._first = self._first, None
        if found is None:
            try:
                found = self._come.get_nowait()
            except queue.Empty:
                raise StopIteration from None
        number, press = found
        self.numbers[next(self._order)] = number
        return press


class DeviceWorker:
    """Solves presses on a device and reports to the other end of the channel."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._outbox = Outbox(channel, _exit)
        self._come: queue.SimpleQueue[tuple[int, BatchedPress]] = queue.SimpleQueue()
        self._room = threading.Semaphore(RESULTS_MOST)
        self._beaten_s = 0.0
        self._skin: OuterSurface | None = None
        self._indenters: tuple[str, ...] = ()

    def run(self) -> None:
        """Serve until the other end is closed."""
        setup: DeviceSetup = self._channel.receive()
        threading.Thread(target=self._listen, name="presses", daemon=True).start()
        try:
            solver = self._prepare(setup)
            waiting = WaitingPresses(self._come)
            while True:
                waiting.wait()
                for order, result in solver.indent(waiting, on_sweep=self._beat):
                    self._give(waiting.numbers.pop(order), result)
        except Exception as error:
            self._outbox.put(JobFailed.of(error))
            self._outbox.close()
            if isinstance(error, PalpateError):
                sys.exit(1)  # the other end says it; a traceback is for defects
            raise

    def _prepare(self, setup: DeviceSetup) -> SlottedSolver:
        """Make the fingertip, report it, and put it on the device."""
        from palpate_fem.device import use_device

        use_device(setup.device)
        make, warm = setup.worker, setup.worker.warm
        tips = FingertipCache(load_factory(make.factory)(**make.options), 1)
        tip = tips.get(warm, lambda _: self._beat(0))
        if not isinstance(tip, SlottedTip):
            raise ConfigError(
                f"fingertips of {make.factory} cannot be put on a device",
                remedy="run them on the CPU: leave --device out",
            )
        fingertip = tips.describe(warm)
        self._skin, self._indenters = skin_of(fingertip), setup.indenters
        self._outbox.put(JobStarted(fingertip))
        try:
            return tip.on_device(
                setup.indenters,
                slots=setup.slots,
                device=setup.device,
                friction_coefficient=warm.friction_coefficient,
                limit_s=setup.limit_s,
            )
        except (RuntimeError, MemoryError) as error:  # what Warp raises if memory is short
            if isinstance(error, PalpateError):
                raise
            raise SimulationError(
                f"{setup.slots} slots cannot be had on {setup.device}: {error}",
                remedy="give fewer --slots; each takes about 0.25 GB",
            ) from error

    def _listen(self) -> None:
        while True:
            try:
                message = self._channel.receive()
            except (EOFError, OSError):
                _exit()
            if isinstance(message, ResultTaken):
                self._room.release()
            elif isinstance(message, NumberedPress):
                try:
                    self._come.put((message.number, self._checked(message)))
                except Exception as error:  # whatever it is, it is wrong with this one only
                    self._outbox.put(PressRefused(message.number, JobFailed.of(error)))

    def _checked(self, press: NumberedPress) -> BatchedPress:
        """A press whose path is valid and begins clear of the skin."""
        from palpate_fem.batched.fingertip import BatchedPress

        assert self._skin is not None  # presses come after the fingertip was reported
        indenter = make_indenter(press.indenter)
        path = check_path(press.path)
        check_clear(indenter, path[0], self._skin)
        return BatchedPress(self._indenters.index(indenter.name), path)

    def _beat(self, at_work: int) -> None:
        """Show that the solver makes progress."""
        now_s = time.monotonic()
        if now_s - self._beaten_s > _BEAT_S:
            self._beaten_s = now_s
            self._outbox.put(Swept(at_work))

    def _give(self, number: int, result: IndentationResult) -> None:
        """Report a result, when the other end has taken those before; not its fault if it waits."""
        while not self._room.acquire(timeout=_BEAT_S):
            self._beat(0)
        self._outbox.put(PressEnded(number, result))


def main() -> None:
    """Run as the process of a device until the socket closes."""
    DeviceWorker(channel_to_parent()).run()


if __name__ == "__main__":
    main()
