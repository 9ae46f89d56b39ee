"""Files of trajectories made by other processes: packing one takes a core 50 to 100 ms.

A device that solves ten trajectories a second needs more than one core for that. Only the image is
made elsewhere; this process keeps the claims and writes the files.
"""

from __future__ import annotations

import itertools
import math
import threading

import numpy as np

from palpate.heartbeat import Turns
from palpate.process import Closing
from palpate_fem.result import IndentationResult
from palpate_fem.service.channel import ChildProcess, channel_to_parent
from palpate_fem.service.jobs import ImageJob, ImageMade
from palpate_fem.store.writer import TrajectoryClaim, TrajectoryImages

_JOBS_EACH = 2
"""Trajectories that a process has at most: one that it packs, and the next."""


HANG_S = 60.0
"""A process that has trajectories and is silent for so long is ended [s]."""

_LOOK_S = 0.2


class PackingProcesses(Closing):
    """Writes trajectories whose files other processes have made; from threads of its own.

    Args:
        images: Makes the files.
        count: Number of processes.
    """

    def __init__(self, images: TrajectoryImages, count: int) -> None:
        self._numbers = itertools.count()
        self._changed = threading.Condition()
        self._error: BaseException | None = None
        self._closing = False
        self._orphans = 0  # of processes that have ended, being packed here
        self._jobs: dict[ChildProcess, dict[int, tuple[TrajectoryClaim, IndentationResult]]] = {}
        self._turns: dict[ChildProcess, Turns] = {}
        with self._changed:
            for _ in range(count):
                child = ChildProcess(
                    "palpate_fem.service.packing",
                    images,
                    threads=1,
                    on_message=self._on_made,
                    on_gone=self._on_gone,
                )
                self._jobs[child], self._turns[child] = {}, Turns()

    @property
    def pids(self) -> list[int]:
        """Process ids of those that are left."""
        return [child.pid for child in self._jobs]

    def put(self, claim: TrajectoryClaim, result: IndentationResult) -> None:
        """Write a trajectory and close its claim, soon; waits while too many are on their way.

        Raises:
            StoreDiskError: The disk refused this one or one before.
        """
        with self._changed:
            while self._jobs and self._error is None:
                child = min(self._jobs, key=lambda one: len(self._jobs[one]))
                if len(self._jobs[child]) < _JOBS_EACH:
                    if not self._jobs[child]:
                        self._turns[child].next(HANG_S)
                    number = next(self._numbers)
                    self._jobs[child][number] = (claim, result)
                    child.send(ImageJob(number, claim.trajectory, result))
                    return
                self._wait()
        with claim:
            self._raise()
            claim.write(result)  # all processes are gone

    def finish(self) -> None:
        """Wait until all is on the disk.

        Raises:
            StoreDiskError: The disk refused one.
        """
        with self._changed:
            while self._error is None and (any(self._jobs.values()) or self._orphans):
                self._wait()
        self._raise()

    def close(self) -> None:
        """End the processes; what is not on the disk yet is dropped."""
        with self._changed:
            self._closing = True
            children = list(self._jobs)
        for child in children:
            child.kill()
        for child in children:
            child.join()

    def _wait(self) -> None:
        """Wait a moment for a change; what a process that hangs had is made here then."""
        for child, jobs in self._jobs.items():
            if jobs and self._turns[child].are_late():
                child.kill()
        self._changed.wait(_LOOK_S)

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error

    def _on_made(self, child: ChildProcess, made: ImageMade) -> None:
        claim, _ = self._jobs[child][made.number]
        with self._changed:  # what follows is the disk's time, and not the process's
            self._turns[child].next(math.inf)
        try:
            with claim:
                claim.commit(made.image.data)
        except Exception as error:  # raised again where the next one is put
            self._error = self._error or error
        with self._changed:
            self._turns[child].next(HANG_S)
            del self._jobs[child][made.number]
            self._changed.notify_all()

    def _on_gone(self, child: ChildProcess) -> None:
        """Make here what a process has left undone, e.g. because memory ran out."""
        with self._changed:
            left = self._jobs.pop(child)
            self._orphans += len(left)
        for claim, result in left.values():
            try:
                with claim:
                    if not self._closing:
                        claim.write(result)
            except Exception as error:
                self._error = self._error or error
        with self._changed:
            self._orphans -= len(left)
            self._changed.notify_all()


def main() -> None:
    """Make files until the socket closes."""
    channel = channel_to_parent()
    try:
        images: TrajectoryImages = channel.receive()
        while True:
            job: ImageJob = channel.receive()
            image = images.image(job.trajectory, job.result)
            channel.send(ImageMade(job.number, np.frombuffer(image, np.uint8)))
    except (EOFError, OSError):
        return  # the process that started us has ended


if __name__ == "__main__":
    main()
