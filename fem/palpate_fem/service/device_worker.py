"""The process of a device: takes presses as they come, and solves them in slots.

Three threads: one takes messages and checks presses, one sends messages, and one keeps the device
busy, which must wait for neither.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import queue
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from palpate.errors import ConfigError, PalpateError, SimulationError
from palpate_fem.indenter.approach import OuterSurface, check_clear
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.indenter.path import check_path
from palpate_fem.result import IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.service.channel import Channel, Outbox, channel_to_parent
from palpate_fem.service.fingertips import (
    FingertipCache,
    SlottedSolver,
    SlottedTip,
    load_factory,
    skin_of,
)
from palpate_fem.service.jobs import (
    DeviceReady,
    DeviceSetup,
    JobFailed,
    JobStarted,
    NumberedPress,
    PressEnded,
    PressRefused,
    PressStep,
    PressUnsolved,
    ResultTaken,
    StopPress,
    Swept,
)
from palpate_fem.trajectory import press_path

if TYPE_CHECKING:
    from palpate_fem.batched.fingertip import BatchedPress

RESULTS_MOST = 8
"""Results that the other end has not taken yet; each has 20 MB."""

_BEAT_S = 0.2
_WARM_DEPTH_M = 1e-4


def _exit() -> None:
    os._exit(0)  # the other end is gone, and the solver's thread does not look at it


@dataclass(frozen=True, slots=True)
class CheckedPress:
    """A press that can be solved, and when it must have ended [s, monotonic]."""

    number: int
    press: BatchedPress
    deadline: float


class WaitingPresses:
    """Presses that have come, as an iterator that is asked again after it has ended.

    It waits for one only while none is at work: else the solver asks in every sweep, and must not
    be held up.

    Attributes:
        at_work: Presses that the solver has, by their order; who takes its results removes them.
    """

    def __init__(self, come: queue.SimpleQueue[CheckedPress]) -> None:
        self._come = come
        self._order = itertools.count()
        self.at_work: dict[int, CheckedPress] = {}

    def __iter__(self) -> Iterator[BatchedPress]:
        return self

    def __next__(self) -> BatchedPress:
        try:
            found = self._come.get(block=not self.at_work)
        except queue.Empty:
            raise StopIteration from None
        self.at_work[next(self._order)] = found
        return found.press


class DeviceWorker:
    """Solves presses on a device and reports to the other end of the channel."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._outbox = Outbox(channel, _exit)
        self._come: queue.SimpleQueue[CheckedPress] = queue.SimpleQueue()
        self._presses = WaitingPresses(self._come)
        self._cancelled: set[int] = set()
        self._room = threading.Semaphore(RESULTS_MOST)
        self._beaten_s = 0.0
        self._skin: OuterSurface | None = None
        self._indenters: tuple[str, ...] = ()

    def run(self) -> None:
        """Serve until the other end is closed."""
        setup: DeviceSetup = self._channel.receive()
        threading.Thread(target=self._listen, name="presses", daemon=True).start()
        try:
            at_work = self._presses.at_work
            found = self._prepare(setup).solve(
                self._presses,
                on_sweep=self._beat,
                on_step=self._on_step if setup.streams else None,
                should_stop=self._should_stop,
            )
            for order, result in found:
                number = at_work.pop(order).number
                self._cancelled.discard(number)
                if not isinstance(result, IndentationResult):
                    if not setup.gives_up:
                        self._outbox.put(PressUnsolved(number))
                        continue
                    result = result.result
                self._give(number, replace(result, steps=()) if setup.streams else result)
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
            solver = tip.on_device(
                setup.indenters,
                slots=setup.slots,
                device=setup.device,
                friction_coefficient=warm.friction_coefficient,
            )
            self._warm_up(solver)
        except (RuntimeError, MemoryError) as error:  # what Warp raises if memory is short
            if isinstance(error, PalpateError):
                raise
            raise SimulationError(
                f"{setup.slots} slots cannot be had on {setup.device}: {error}",
                remedy="give fewer --slots; each takes about 0.22 GB",
            ) from error
        self._outbox.put(DeviceReady())
        return solver

    def _warm_up(self, solver: SlottedSolver) -> None:
        """Press a little, so that all kernels are compiled, which may take minutes."""
        from palpate_fem.batched.fingertip import BatchedPress

        assert self._skin is not None
        on_skin = self._skin.nodes[self._skin.used]
        lowest = on_skin[on_skin[:, 2].argmin()]
        indenter = make_indenter(self._indenters[0])
        with contextlib.suppress(PalpateError):  # a finger of another shape is warmed up by presses
            path = press_path(
                indenter, lowest, (0.0, 0.0, 1.0), self._skin, depth_m=_WARM_DEPTH_M, steps=1
            )
            for _ in solver.solve(iter([BatchedPress(0, path)]), on_sweep=self._beat):
                pass

    def _listen(self) -> None:
        while True:
            try:
                message = self._channel.receive()
            except (EOFError, OSError):
                _exit()
            if isinstance(message, ResultTaken):
                self._room.release()
            elif isinstance(message, StopPress):
                self._cancelled.add(message.number)
            elif isinstance(message, NumberedPress):
                try:
                    self._come.put(self._checked(message))
                except Exception as error:  # whatever it is, it is wrong with this one only
                    self._outbox.put(PressRefused(message.number, JobFailed.of(error)))

    def _checked(self, press: NumberedPress) -> CheckedPress:
        """A press whose path is valid and begins clear of the skin."""
        from palpate_fem.batched.fingertip import BatchedPress

        assert self._skin is not None  # presses come after the fingertip was reported
        deadline = time.monotonic() + press.deadline_s
        indenter = make_indenter(press.indenter)
        path = check_path(press.path)
        check_clear(indenter, path[0], self._skin)
        there = BatchedPress(self._indenters.index(indenter.name), path)
        return CheckedPress(press.number, there, deadline)

    def _should_stop(self, order: int) -> IndentationOutcome | None:
        press = self._presses.at_work[order]
        if press.number in self._cancelled:
            return IndentationOutcome.CANCELLED
        return IndentationOutcome.DEADLINE if time.monotonic() > press.deadline else None

    def _on_step(self, order: int, step: IndentationStep) -> None:
        self._outbox.put(PressStep(self._presses.at_work[order].number, step))

    def _beat(self, at_work: int) -> None:
        """Show that the solver makes progress."""
        now_s = time.monotonic()
        if now_s - self._beaten_s > _BEAT_S:
            self._beaten_s = now_s
            self._outbox.put(Swept())

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
