"""Actors of a Ray cluster that have the process of a device, and how a batch sees them."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
import time
from dataclasses import dataclass
from typing import Any

from palpate.cluster import RayCluster
from palpate.heartbeat import Turns
from palpate_fem.service.batch import TrajectoryPlan
from palpate_fem.service.device_process import DeviceProcess
from palpate_fem.service.jobs import (
    DeviceEvent,
    DeviceSetup,
    JobFailed,
    JobStarted,
    NumberedPress,
    PressEnded,
    PressRefused,
    PressUnsolved,
)

_ANSWER_S = 1.0  # in which an actor answers, if only that nothing has happened
_LOOK_S = 0.1
_THREADS = 4  # of an actor's process: the fingertip is made on the CPU


@dataclass(frozen=True, slots=True)
class _Gone:
    """Last event of an actor whose device's process has ended: why."""

    why: str


class DeviceHost:
    """On a machine of a cluster, in a process that Ray starts: has the process of a device.

    The solver is a process of its own here, too: whatever becomes of it, this one tells.

    Args:
        setup: What it solves, and where.
        threads: Threads that its libraries may use.
        hang_s: See `DeviceProcess`.
        start_s: See `DeviceProcess`.
    """

    def __init__(self, setup: DeviceSetup, threads: int, hang_s: float, start_s: float) -> None:
        self._events: queue.SimpleQueue[DeviceEvent | _Gone] = queue.SimpleQueue()
        self._process: DeviceProcess[None] = DeviceProcess(
            setup, threads, self._on_event, hang_s=hang_s, start_s=start_s
        )
        threading.Thread(target=self._watch, name="watch", daemon=True).start()

    def pids(self) -> tuple[int, int]:
        """Process ids of this and of the device's process, on their machine."""
        return os.getpid(), self._process.pid

    def send(self, message: object) -> None:
        """Pass a message on to the process."""
        if isinstance(message, NumberedPress):
            self._process.give(message, None)
        else:
            self._process.send(message)

    def events(self) -> list[DeviceEvent | _Gone]:
        """What has happened since the last call; waits a moment if that is nothing.

        No more than one result: each has 20 MB, and an answer waits in the memory of the other end.
        """
        found: list[DeviceEvent | _Gone] = []
        with contextlib.suppress(queue.Empty):
            found.append(self._events.get(timeout=_ANSWER_S))
            while not isinstance(found[-1], PressEnded):
                found.append(self._events.get_nowait())
        return found

    def _watch(self) -> None:
        while True:  # in a thread: calls come when they come
            self._process.end_if_hung()
            time.sleep(_LOOK_S)

    def _on_event(self, process: DeviceProcess[None], event: DeviceEvent | None) -> None:
        match event:
            case JobStarted():
                process.ready = True
            case JobFailed():
                process.last_words = event
            case PressEnded() | PressUnsolved() | PressRefused():
                process.open.pop(event.number, None)
        self._events.put(_Gone(process.why_it_ended()) if event is None else event)


class RayDevice:
    """An actor of a cluster that solves in slots, as the batch sees it; a `BusyDevice`.

    Args:
        cluster: The cluster.
        setup: What it solves.
        needs: What Ray has to find for it, as options of an actor.
        hang_s: See `DeviceProcess`.
        start_s: See `DeviceProcess`.
        silent_s: If it does not answer for so long its machine counts as lost [s].

    Attributes:
        answer: Ray's reference of its next events.
        heard_s: When it answered last [s, monotonic]; 0 = Ray has not found a place for it yet.
        useful: Whether it has solved something.
        lost: Whether it answered once and Ray has lost it since, as it does with its machine.
        why: Why it ended.
    """

    def __init__(
        self,
        cluster: RayCluster,
        setup: DeviceSetup,
        needs: dict[str, int],
        *,
        hang_s: float,
        start_s: float,
        silent_s: float,
    ) -> None:
        self.open: dict[int, TrajectoryPlan] = {}
        self.ready = self.warm = self.useful = self.lost = False
        self.last_words: JobFailed | None = None
        self.heard_s = 0.0
        self.why = ""
        self._silent_s, self._turns = silent_s, Turns()
        self._ray = cluster.ray
        # Two calls at once: one waits for events, the other brings messages.
        host = self._ray.remote(DeviceHost).options(max_concurrency=2, **needs)
        self.actor = host.remote(setup, 1 if setup.device == "cpu" else _THREADS, hang_s, start_s)
        self.answer: Any = self.actor.events.remote()

    def give(self, press: NumberedPress, owner: TrajectoryPlan) -> None:
        """Give it a trajectory."""
        self.open[press.number] = owner
        self.send(press)

    def send(self, message: object) -> None:
        """Send it a message; lost if it is gone."""
        self.actor.send.remote(message)

    def events(self) -> list[DeviceEvent | None]:
        """The events that ``answer`` is of, when Ray has them; None = it is gone."""
        try:
            found = self._ray.get(self.answer)
        except self._ray.exceptions.RayError as error:
            self.why = f"was lost: {last_line(error)}"
            self.lost = self.heard_s > 0.0
            return [None]
        self.heard_s = time.monotonic()
        self._turns.next(self._silent_s)
        events: list[DeviceEvent | None] = []
        for event in found:
            if isinstance(event, _Gone):
                self.why = event.why
                return [*events, None]
            self.useful = self.useful or isinstance(event, PressEnded | PressUnsolved)
            events.append(event)
        self.answer = self.actor.events.remote()
        return events

    def is_silent(self) -> bool:
        """Whether its machine counts as lost; to be asked often."""
        if not self._turns.are_late():
            return False
        self.lost = True
        self.why = f"did not answer for {self._silent_s:g} s"
        return True

    def kill(self) -> None:
        """End it now."""
        with contextlib.suppress(Exception):  # the cluster itself may be gone
            self._ray.kill(self.actor)

    def join(self) -> None:
        """Ray does not tell when it has ended."""

    def why_it_ended(self) -> str:
        """The end of an error message."""
        return self.why


def last_line(error: BaseException) -> str:
    """What Ray says in the end, after traces and before advice."""
    last = (str(error).strip().splitlines() or [type(error).__name__])[-1]
    return last.partition(" Some common causes")[0].strip()
