"""One cell of a table: a system, trained on the rows of a fold from a seed, tested on the others.

Cells are kept in a folder, each in a file named by a hash of what decides it: the data, the rows
of each side, the seed and the code of the system (`cell_key` says what is left out). So a run that
was killed goes on where it was, and what has changed is made again. The work is spread over
processes.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import multiprocessing
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch

from palpate.cluster import WorkerLostError
from palpate.errors import DatasetError
from palpate.files.atomic import written_whole
from palpate.files.hdf5 import add_array
from palpate.process import begin_worker
from palpate_training.datasets.container import read_archive
from palpate_training.learning.splits import Fold, RowSplit

_log = logging.getLogger(__name__)

Arrays = dict[str, npt.NDArray[Any]]

_CODE = "palpate_training."


class Tested(Protocol):
    """A system as the tables see it."""

    @property
    def name(self) -> str:
        """As tables call it."""

    @property
    def source(self) -> str:
        """Where it is specified."""

    @property
    def seeded(self) -> bool:
        """Whether its estimates depend on the seed."""

    @property
    def fit(self) -> Callable[..., Any]:
        """Fits it; its module is the code that decides its estimates."""


class Task(Protocol):
    """What is estimated, by which systems; can be pickled."""

    @property
    def name(self) -> str:
        """As files and tables call it."""

    @property
    def data_sha256(self) -> str:
        """Content hash of the data set."""

    @property
    def systems(self) -> Sequence[Tested]:
        """Every system that can be tested."""

    def fit_and_test(self, system: Tested, rows: RowSplit, seed: int) -> Arrays:
        """Train a system, and give what is kept of its test, row by row of ``rows.test``."""


@dataclass(frozen=True, slots=True)
class Cell:
    """A training and its test.

    Attributes:
        task: What is estimated.
        fold: On which rows.
        system: Name of the system.
        seed: Of everything random in it.
    """

    task: str
    fold: Fold
    system: str
    seed: int


@dataclass(frozen=True, slots=True)
class CellResult:
    """What is kept of a cell.

    Attributes:
        arrays: Of its test, row by row.
        seconds: How long training and test took [s].
    """

    arrays: Arrays
    seconds: float


def grouped(
    results: Mapping[Cell, CellResult],
) -> Iterator[tuple[tuple[str, str, str], list[list[Cell]]]]:
    """Split, test and system, with the cells of each seed, their parts in the same order."""
    groups: dict[tuple[str, str, str], dict[int, list[Cell]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for cell in results:
        groups[cell.fold.split, cell.fold.test, cell.system][cell.seed].append(cell)
    for key, by_seed in groups.items():
        yield key, list(by_seed.values())


def cells_of(task: Task, folds: Iterable[Fold], seeds: Sequence[int]) -> Iterator[Cell]:
    """All cells; a system that does not depend on the seed has one a fold."""
    for fold in folds:
        for system in task.systems:
            for seed in seeds if system.seeded else seeds[:1]:
                yield Cell(task.name, fold, system.name, seed)


def cell_key(task: Task, cell: Cell) -> str:
    """Hash of the data, the rows, the seed, the system and its code in this package, hex.

    What else may change results does not make kept ones anew: the device, the versions of the
    libraries, and ``palpate`` itself, whose places of the electrodes many systems read.
    """
    digest = hashlib.sha256()
    facts = [task.name, task.data_sha256, cell.system, cell.seed, code_of(_system(task, cell))]
    digest.update(json.dumps(facts).encode())
    for side in ("train", "validation", "test"):
        add_array(digest, side, getattr(cell.fold.rows, side))
    return digest.hexdigest()[:32]


@cache
def _file_sha256(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def code_of(system: Tested) -> str:
    """Hash of the modules that decide a system's estimates, hex: its own and all they build on."""
    inner: Any = system.fit
    while isinstance(inner, partial):
        inner = inner.func
    files: dict[str, str] = {}
    waiting = [inner.__module__]
    while waiting:
        name = waiting.pop()
        if name in files or not name.startswith(_CODE):
            continue
        module = sys.modules[name]
        files[name] = _file_sha256(str(module.__file__))
        # What a module imports by name knows where it was defined; a whole module is its own.
        waiting += [
            value.__name__
            if isinstance(value, ModuleType)
            else str(getattr(value, "__module__", ""))
            for value in vars(module).values()
        ]
    return hashlib.sha256(json.dumps(sorted(files.items())).encode()).hexdigest()


def _system(task: Task, cell: Cell) -> Tested:
    return next(system for system in task.systems if system.name == cell.system)


def cell_path(folder: Path, task: Task, cell: Cell) -> Path:
    """File of a cell."""
    return folder / task.name / f"{cell_key(task, cell)}.npz"


def read_cell(path: Path) -> CellResult:
    """What is kept of a cell.

    Raises:
        DatasetError: The file is damaged; names it.
    """
    arrays = read_archive(
        path,
        lambda held: dict.fromkeys([*held, "seconds"]),
        remedy="remove it and run the command again",
    )
    return CellResult(arrays, float(arrays.pop("seconds")))


def make_cells(
    tasks: Sequence[Task],
    cells: Sequence[Cell],
    folder: Path,
    *,
    workers: int,
    device: str = "cpu",
    on_cell: Callable[[Cell, bool], None],
) -> None:
    """Make the cells that the folder does not hold, in ``workers`` processes (0 = in this one).

    Networks are trained on ``device``, as torch calls it; with ``cuda`` the processes take turns
    among the GPUs that there are. ``on_cell`` is told each cell, and whether it had to be made.
    A training that fails is logged, and the others go on. Whatever ends this early, Ctrl-C too,
    those under way in processes are waited for and kept; Ctrl-C while they are ends them.

    Raises:
        DatasetError: The disk refuses.
        WorkerLostError: A process died, e.g. because memory ran out.
        Exception: What the first training that failed raised, once all others are kept.
    """
    by_name = {task.name: task for task in tasks}
    left = []
    for cell in cells:
        if cell_path(folder, by_name[cell.task], cell).exists():
            on_cell(cell, False)
        else:
            left.append(cell)
    failed: list[Exception] = []

    def finish(cell: Cell, made: Callable[[], bytes]) -> None:
        try:
            content = made()
        except BrokenProcessPool:
            raise
        except Exception as error:  # of any library that a system is made with
            test = f"{cell.fold.split} {cell.fold.test} {cell.fold.part}".rstrip()
            _log.warning("%s: %s, %s, seed %d: %s", cell.task, cell.system, test, cell.seed, error)
            failed.append(error)
            return
        _keep(folder, by_name[cell.task], cell, content)
        on_cell(cell, True)

    if workers == 0:
        for cell in left:
            with torch.device(device):
                finish(cell, partial(_made, by_name[cell.task], cell))
    else:
        _make_in_processes(by_name, left, workers, device, finish)
    if failed:
        raise failed[0]


def _make_in_processes(
    tasks: dict[str, Task],
    cells: Sequence[Cell],
    workers: int,
    device: str,
    finish: Callable[[Cell, Callable[[], bytes]], None],
) -> None:
    others = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(
        min(workers, max(1, len(cells))),
        mp_context=context,
        initializer=_take_tasks,
        initargs=(tasks, device, context.Value("i", 0)),
    )
    running: dict[Future[bytes], Cell] = {}

    def finish_some() -> None:
        for done in wait(running, return_when=FIRST_COMPLETED).done:
            finish(running[done], done.result)
            del running[done]

    try:
        # One a process, so that nothing that was asked for is still to begin when this ends.
        for cell in cells:
            running[pool.submit(_work, cell)] = cell
            if len(running) >= workers:
                finish_some()
        while running:
            finish_some()
    except BrokenProcessPool as error:
        raise WorkerLostError(
            "a worker process died", remedy="give it more memory, or use fewer workers"
        ) from error
    finally:
        try:
            if count := sum(not future.done() for future in running):
                _log.warning("waits for %d trainings to keep them; Ctrl-C ends them at once", count)
            wait(running)
        except KeyboardInterrupt:
            # The pool and the interpreter's exit would wait for them, too.
            for worker in set(multiprocessing.active_children()) - others:
                worker.kill()
            raise
        finally:
            pool.shutdown()
            for future, cell in running.items():
                if future.exception() is None:
                    finish(cell, future.result)


_tasks: dict[str, Task] = {}


def _take_tasks(tasks: dict[str, Task], device: str, begun: Synchronized[int]) -> None:
    begin_worker()
    os.nice(5)  # so that the machine stays usable during a night's work
    if device == "cuda":
        with begun.get_lock():
            torch.cuda.set_device(begun.value % torch.cuda.device_count())
            begun.value += 1
    torch.set_default_device(device)
    _tasks.update(tasks)


def _work(cell: Cell) -> bytes:
    return _made(_tasks[cell.task], cell)


def _made(task: Task, cell: Cell) -> bytes:
    began_s = time.monotonic()
    arrays = task.fit_and_test(_system(task, cell), cell.fold.rows, cell.seed)
    buffer = io.BytesIO()
    kept: Any = {**arrays, "seconds": np.array(time.monotonic() - began_s)}
    np.savez_compressed(buffer, **kept)
    return buffer.getvalue()


def _keep(folder: Path, task: Task, cell: Cell, content: bytes) -> None:
    path = cell_path(folder, task, cell)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(path) as part:
            part.write_bytes(content)
    except OSError as error:
        raise DatasetError(f"{path}: {error}", remedy="free some space, and run again") from error
