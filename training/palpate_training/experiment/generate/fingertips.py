"""An experiment on several fingertips: dealt to them, and made on several devices at a time.

The processes of a fingertip's devices begin and end with it, and its trials need cores alone. So
each device presses a fingertip of its own, and the next one as soon as that is done.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Generic, TypeVar

from palpate.cluster import WorkerLostError
from palpate.errors import ConfigError, PalpateError
from palpate.process import begin_worker
from palpate_training.experiment.generate.pipeline import (
    MECHANICS,
    SPEC,
    GeneratedExperiment,
    OnStage,
    generate,
    is_finished,
)
from palpate_training.experiment.generate.simulator import (
    ExperimentSpec,
    Specimen,
    TwinSimulator,
)
from palpate_training.experiment.generate.workers import limit_threads

_SEEDS = 1000  # of one experiment on several fingertips; presses are a function of the seed

_FOLDER = "fingertip-"

_AHEAD = 2
"""Fingertips for each device: one is pressed while the trials of another are made."""

_POLL_S = 0.2
"""Longest time until progress is shown, or a request to stop is passed on [s]."""

_END_S = 10.0
"""Time for a process to stop [s]; one that fits bases does not look, one that hangs never does."""

OnShareStage = Callable[[str, str, int, int, str], None]
"""Called with the name of a share, and the progress of a stage as `OnStage` has it."""

Summary = TypeVar("Summary")


@dataclass(frozen=True, slots=True)
class FingertipShare:
    """What one of several fingertips gets of an experiment.

    A simulation belongs to one fingertip, and so does what is made of it: each has a folder with an
    experiment, and `palpate_training.datasets.features.joined` puts their rows together.

    Attributes:
        name: Of its folder.
        spec: Its experiment.
        specimens: Those whose skin it is.
    """

    name: str
    spec: ExperimentSpec
    specimens: tuple[Specimen, ...]


def share_out(
    spec: ExperimentSpec, fingertips: Sequence[Mapping[str, Any]], specimens: Sequence[Specimen]
) -> tuple[FingertipShare, ...]:
    """Deal presses and specimens evenly, the first specimens to the first fingertip.

    Args:
        spec: The experiment; its presses are divided.
        fingertips: Skin and fill of each, by the names of the settings of an experiment.
        specimens: Each gets one of the fingertips.

    Raises:
        ConfigError: A fingertip would have no press, or fewer specimens than execute each; or there
            are too many.
    """
    count, least = len(fingertips), max(1, spec.units_each)
    if not 0 < count <= min(_SEEDS, spec.presses, len(specimens) // least):
        raise ConfigError(
            f"{spec.presses} presses and {len(specimens)} specimens for {count} fingertips",
            remedy=f"give each of at most {_SEEDS} a press and {least} specimens",
        )
    shares = []
    for number, fingertip in enumerate(fingertips):
        (first, end), (one, other) = (
            [total * k // count for k in (number, number + 1)]
            for total in (spec.presses, len(specimens))
        )
        own = replace(spec, presses=end - first, seed=_SEEDS * spec.seed + number, **fingertip)
        shares.append(
            FingertipShare(f"{_FOLDER}{number + 1:02d}", own, tuple(specimens[one:other]))
        )
    return tuple(shares)


@dataclass(frozen=True, slots=True)
class SharedExperiment(Generic[Summary]):
    """How the experiments of fingertips are made; see `generate` for what is not said here.

    Attributes:
        out: Takes a folder for each fingertip.
        simulator: Simulates skin and electrodes.
        summarise: What is to be known of each; can be pickled.
        workers: Processes, of all that are made at a time.
        threads: Threads of each solver.
        ray: Address of a Ray cluster, all of which works on one fingertip at a time.
        devices: Devices of this host; each presses a fingertip of its own.
        slots: Trajectories at once on each.
        command: For provenance.
    """

    out: Path
    simulator: TwinSimulator
    summarise: Callable[[GeneratedExperiment], Summary]
    workers: int
    threads: int = 1
    ray: str | None = None
    devices: tuple[str, ...] = ()
    slots: int | None = None
    command: str = "palpate data generate"

    def made(
        self,
        shares: Sequence[FingertipShare],
        stop: threading.Event,
        on_stage: OnShareStage = lambda *_: None,
    ) -> Iterator[tuple[FingertipShare, Summary | None]]:
        """Make those that are not there yet, and yield each when it is there.

        If one fails the others end early, as they do when ``stop`` is set; run again, they go on.

        Args:
            shares: The fingertips.
            stop: Set it to end early; what is not finished then is not yielded.
            on_stage: Called with the progress.

        Yields:
            Each, with its summary; None = it was finished before.

        Raises:
            ConfigError: One fingertip is asked for and the folder holds several, or otherwise.
            WorkerLostError: A process died.
            See `generate` for others.
        """
        if any(share.name for share in shares):
            others, kind = self.out.glob(SPEC), "one fingertip"
        else:
            others, kind = self.out.glob(f"{_FOLDER}*/{SPEC}"), "several fingertips"
        if other := next(others, None):
            raise ConfigError(
                f"{self.out} holds another experiment, on {kind}: {other}",
                remedy="name another folder",
            )
        left = []
        for share in shares:
            # One without a name is the whole experiment, whose data sets are made again.
            if share.name and is_finished(self.out / share.name, share.spec, share.specimens):
                yield share, None
            else:
                left.append(share)
        if self.ray is None and self.devices and len(left) > 1:
            yield from self._several(left, stop, on_stage)
            return
        for share in left:
            summary = self.one(
                share, self.devices, self.workers, stop, partial(on_stage, share.name)
            )
            if summary is None:
                return
            yield share, summary

    def one(
        self,
        share: FingertipShare,
        devices: tuple[str, ...],
        workers: int,
        stop: threading.Event,
        on_stage: OnStage,
    ) -> Summary | None:
        """Make one; None = stopped."""
        result = generate(
            self.out / share.name,
            share.spec,
            share.specimens,
            self.simulator,
            workers=workers,
            threads=self.threads,
            ray=self.ray,
            devices=devices,
            slots=self.slots,
            stop=stop,
            on_stage=on_stage,
            command=self.command,
        )
        return None if result is None else self.summarise(result)

    def _several(
        self, shares: Sequence[FingertipShare], stop: threading.Event, on_stage: OnShareStage
    ) -> Iterator[tuple[FingertipShare, Summary]]:
        """Make several at a time, each in a process: as many are pressed as there are devices.

        Threads would share the kernels of the host, whose library is not made for that.
        """
        makers: list[_Maker] = []
        idle: list[_Maker] = []
        free, waiting = deque(self.devices), deque(shares)
        failure: PalpateError | None = None
        end_at = math.inf
        try:
            while waiting or makers:
                if end_at == math.inf and (stop.is_set() or failure is not None):
                    end_at = time.monotonic() + _END_S
                    waiting.clear()
                    for maker in makers:
                        maker.end()
                if time.monotonic() > end_at:
                    break
                while waiting and free and (idle or len(makers) < _AHEAD * len(self.devices)):
                    if not idle:
                        idle.append(_Maker(self))
                        makers.append(idle[-1])
                    idle.pop().give(waiting.popleft(), free.popleft())
                while idle and not waiting:
                    makers.remove(idle[-1])
                    idle.pop().close()
                for maker in _with_news(makers):
                    news = maker.news()
                    pressing = isinstance(news, tuple) and news[1] == MECHANICS
                    if not pressing and maker.device is not None:
                        free.append(maker.device)
                        maker.device = None
                    if isinstance(news, tuple):
                        on_stage(*news)
                        continue
                    if maker not in idle:  # one may die while it waits
                        idle.append(maker)
                    if isinstance(news, PalpateError):
                        failure = failure or news
                    elif news.summary is not None:
                        yield maker.share, news.summary
        finally:
            for maker in makers:
                maker.link.close()
            for maker in makers:
                maker.close(max(0.0, min(end_at - time.monotonic(), _END_S)))
        if failure is not None:
            raise failure


@dataclass(frozen=True, slots=True)
class _Made:
    """The end of an experiment; summary None = stopped."""

    summary: Any


class _Maker:
    """A process that makes experiments, one after the other.

    It is told by a pipe of its own: of one that is killed nothing is left that others wait for.

    Attributes:
        link: Its end of that pipe.
        share: What it makes, or has made last.
        device: What presses it; None = it is pressed.
    """

    share: FingertipShare
    device: str | None = None

    def __init__(self, experiment: SharedExperiment[Any]) -> None:
        context = get_context("spawn")
        self.link, theirs = context.Pipe()
        self._process = context.Process(target=_make, args=(experiment, theirs), name="fingertips")
        self._process.start()
        theirs.close()

    def give(self, share: FingertipShare, device: str) -> None:
        """Let it make an experiment."""
        self.share, self.device = share, device
        self._send((share, device))

    def end(self) -> None:
        """Let it stop; may be called again."""
        self._send(None)

    def news(self) -> Any:
        """Wait for arguments of `OnShareStage`, an experiment's end, or the error that ended it."""
        try:
            return self.link.recv()
        except (EOFError, OSError):
            return WorkerLostError(
                f"the process that made {self.share.name} died",
                remedy="give it more memory, or name fewer devices; run again, it goes on",
            )

    def close(self, patience_s: float = _END_S) -> None:
        """Let it stop, and end it if it takes long: its files appear whole or not at all."""
        self.link.close()
        self._process.join(patience_s)
        self._process.kill()  # its own processes end with it
        self._process.join()

    def _send(self, message: tuple[FingertipShare, str] | None) -> None:
        with contextlib.suppress(OSError):  # it died, which its news will be
            self.link.send(message)


def _with_news(makers: Sequence[_Maker]) -> list[_Maker]:
    ready = wait([maker.link for maker in makers], _POLL_S)
    return [maker for maker in makers if maker.link in ready]


def _make(experiment: SharedExperiment[Any], link: Connection) -> None:
    """Make the experiments that come, until None comes or nobody is there any more."""
    begin_worker()
    for number in (signal.SIGINT, signal.SIGTERM):  # those to the whole group are the command's
        signal.signal(number, lambda *_: None)  # unlike SIG_IGN not for processes that begin here
    # While some are pressed others need the cores, about as many as there are devices. More threads
    # than cores wait for each other: three fits of bases on two cores took 162 s, not 57 s.
    at_once = len(experiment.devices)
    limit_threads(max(1, (os.cpu_count() or 1) // (_AHEAD * at_once)))
    workers = max(1, experiment.workers // at_once)
    stop, orders = threading.Event(), SimpleQueue[tuple[FingertipShare, str] | None]()

    def listen() -> None:
        while True:
            try:
                order = link.recv()
            except (EOFError, OSError):
                order = None
            orders.put(order)
            if order is None:
                stop.set()
                return

    threading.Thread(target=listen, name="orders", daemon=True).start()
    while (order := orders.get()) is not None:
        share, device = order
        tell = partial(_tell, link, share.name)
        try:
            link.send(_Made(experiment.one(share, (device,), workers, stop, tell)))
        except PalpateError as error:
            link.send(error)
        except BrokenPipeError:  # nobody waits for it
            return


def _tell(link: Connection, name: str, stage: str, done: int, total: int, word: str) -> None:
    link.send((name, stage, done, total, word))
