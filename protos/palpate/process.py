"""For every process of palpate: ends, optional packages, folders, use of the host, progress."""

from __future__ import annotations

import ctypes
import gc
import importlib
import importlib.util
import os
import queue
import shlex
import signal
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, ModuleType, TracebackType
from typing import TYPE_CHECKING, Self

from palpate.errors import MissingExtraError

if TYPE_CHECKING:
    from rich.progress import Progress

_LOOK_S = 0.5
"""Least time between two looks [s]: a share of the processor over less is noise."""

_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_TICKS_HZ = os.sysconf("SC_CLK_TCK")

LINE_EVERY_S = 30.0
"""Least time between two lines on progress in a log [s]."""


def cpu_time_s(pid: int) -> float:
    """Processor time of all threads of a process since its start [s].

    Raises:
        OSError: It has ended, or this is not Linux.
    """
    text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    words = text.rpartition(")")[2].split()  # the program's name, in brackets, may hold anything
    return (int(words[11]) + int(words[12])) / _TICKS_HZ


def resident_bytes(pid: int) -> int:
    """Resident memory of a process [bytes].

    Raises:
        OSError: It has ended, or this is not Linux.
    """
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * _PAGE_BYTES


class ProcessUsage:
    """Measures one process of this host, by default this one. Safe to use from several threads."""

    def __init__(self, pid: int | None = None) -> None:
        self._pid = os.getpid() if pid is None else pid
        self._lock = threading.Lock()
        self._gauges: dict[str, float] = {}
        self._looked_s = time.monotonic()
        self._cpu_s = self._cpu_time_s()

    def gauges(self) -> dict[str, float]:
        """Present values, looked up at most twice a second; empty where they are not to be had.

        ``process_rss_bytes`` is the resident memory, ``process_cpu_ratio`` the share of one
        core since the last look (1 = a whole core), ``process_threads`` and ``process_open_files``
        are numbers.
        """
        with self._lock:
            now_s = time.monotonic()
            since_s = now_s - self._looked_s
            if self._gauges and since_s < _LOOK_S:
                return self._gauges
            cpu_s = self._cpu_time_s()
            try:
                gauges = {
                    "process_rss_bytes": float(resident_bytes(self._pid)),
                    "process_threads": float(len(os.listdir(f"/proc/{self._pid}/task"))),
                    "process_open_files": float(len(os.listdir(f"/proc/{self._pid}/fd"))),
                }
            except (OSError, ValueError, IndexError):  # not Linux, not allowed, or it has ended
                gauges = {}
            if since_s >= _LOOK_S and cpu_s is not None and self._cpu_s is not None:
                gauges["process_cpu_ratio"] = max(0.0, (cpu_s - self._cpu_s) / since_s)
            if since_s >= _LOOK_S:
                self._cpu_s, self._looked_s = cpu_s, now_s
            self._gauges = gauges
            return gauges

    def _cpu_time_s(self) -> float | None:
        try:
            return cpu_time_s(self._pid)
        except (OSError, ValueError, IndexError):
            return None


def state_folder() -> Path:
    """What palpate remembers and can lose: logs, profiles of runs, what was served last."""
    return _base("XDG_STATE_HOME", ".local/state") / "palpate"


def data_folder() -> Path:
    """What the user has given to palpate: bundles."""
    return _base("XDG_DATA_HOME", ".local/share") / "palpate"


def _base(variable: str, default: str) -> Path:
    given = os.environ.get(variable)
    return Path(given) if given else Path.home() / default


class Closing(ABC):
    """Base of what has to be closed: a ``with`` block closes it on every path."""

    @abstractmethod
    def close(self) -> None:
        """Release threads, files and sessions."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


@contextmanager
def until_signal() -> Iterator[None]:
    """A block that Ctrl-C or ``SIGTERM`` ends without an error; its ``finally`` clauses run."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, signal.default_int_handler) for number in numbers}
    try:
        yield
    except KeyboardInterrupt:
        pass
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def setter_for_signals(event: threading.Event) -> Callable[[], None]:
    """A function that sets an event and that a signal handler may call.

    ``Event.set`` takes a lock that is no use to its own thread twice. A handler runs in the main
    thread between any two of its steps, also while that thread waits for the event or sets it, and
    would wait for itself for ever. So a thread sets it; ``SimpleQueue.put`` may be interrupted.
    """
    told: queue.SimpleQueue[None] = queue.SimpleQueue()

    def pass_on() -> None:
        while True:
            told.get()
            event.set()

    threading.Thread(target=pass_on, name="signals", daemon=True).start()
    return lambda: told.put(None)


def stop_on_signals(*signals: signal.Signals) -> threading.Event:
    """An event that each of these signals sets.

    None given = ``SIGINT``, ``SIGTERM`` and, unless the program was started to ignore it (nohup),
    ``SIGHUP``: the terminal or its connection has ended.
    """
    stop = threading.Event()
    tell = setter_for_signals(stop)

    def on_signal(number: int, frame: FrameType | None) -> None:
        tell()

    if not signals:
        signals = (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            signals = (*signals, signal.SIGHUP)
    for number in signals:
        signal.signal(number, on_signal)
    return stop


def begin_worker() -> None:
    """Let a worker of `multiprocessing` end with the process that started it, also if killed.

    Otherwise it would wait for its next task for ever. Ctrl-C is for that process alone.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from multiprocessing import parent_process  # of use to few processes

    parent = parent_process()
    assert parent is not None

    def wait_for_end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait_for_end, name="parent", daemon=True).start()


@contextmanager
def told_in_log(progress: Progress, every_s: float = LINE_EVERY_S) -> Iterator[None]:
    """Write the tasks of a progress bar that got on to stderr where no terminal shows the bar.

    A line every ``every_s`` [s], none where nothing got on, so that a job whose output is a file is
    seen to work, or to hang.
    """
    if progress.console.is_terminal:
        yield
        return
    began_s, ended = time.monotonic(), threading.Event()
    told: dict[int, float] = {}

    def tell() -> None:
        while not ended.wait(every_s):
            moved = [one for one in progress.tasks if told.get(one.id, 0.0) != one.completed]
            told.update((one.id, one.completed) for one in moved)
            if moved:
                words = ", ".join(
                    f"{one.description} {one.completed:g}"
                    + ("" if one.total is None else f" of {one.total:g}")
                    for one in moved
                )
                sys.stderr.write(f"after {time.monotonic() - began_s:.0f} s: {words}\n")
                sys.stderr.flush()

    teller = threading.Thread(target=tell, name="progress", daemon=True)
    teller.start()
    try:
        yield
    finally:
        ended.set()
        teller.join()


def require(module: str, *, extra: str) -> ModuleType:
    """Import an optional dependency, e.g. ``"onnxruntime"``.

    Raises:
        MissingExtraError: It is not installed; ``extra`` of palpate installs it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        # A broken dependency inside an installed package must keep its own message.
        if error.name is not None and not module.startswith(error.name):
            raise
        raise MissingExtraError(module, extra=extra) from error


def check_installed(module: str, *, extra: str) -> None:
    """Check that an optional dependency is there, without importing it.

    Raises:
        MissingExtraError: It is not installed; ``extra`` of palpate installs it.
    """
    try:
        found = importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # the package around it is missing
        found = False
    if not found:
        raise MissingExtraError(module, extra=extra)


def typed_command() -> str:
    """The command line as typed, without the folder of the program, for provenance."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


_YOUNG_OBJECTS = 50_000
"""New container objects between two collections; frames and estimates hold no cycles."""

_SWITCH_S = 0.0005
"""How long a busy thread may hold the interpreter lock [s]; Python's default is 5 ms."""


def avoid_pauses() -> None:
    """Prevent long pauses of Python. Call once, after everything is loaded, before serving.

    A full garbage collection visits every object of every imported module, which takes 10 ms or
    more: the whole period of a frame. These objects live as long as the process, so the collector
    is told to ignore them (``gc.freeze``). What NumPy imports late is imported now.
    """
    # ``np.percentile`` imports it at its first call, for 40 to 80 ms: a first report lost frames.
    importlib.import_module("numpy.ma")
    gc.collect()
    gc.freeze()
    gc.set_threshold(_YOUNG_OBJECTS, 20, 50)
    sys.setswitchinterval(_SWITCH_S)


_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # mallopt(3), of glibc only
_ARENAS = 2
_LARGE_BYTES = 1 << 20


def use_few_resources() -> None:
    """Keep native libraries from wasting processor and memory. Call once, before NumPy is loaded.

    NumPy's threads wait for one another by spinning. Where products of some microseconds are
    computed a hundred times a second, that keeps a whole core busy. So NumPy gets one thread,
    unless the environment says otherwise. glibc gives every few threads a memory pool of their own,
    and each pool keeps what its busiest moment took: a recorder grew by 30 MB/h. So there are two
    pools, and large blocks go back to the system as soon as they are freed. Rerun has mimalloc,
    which is told to give back what is free at once, too.
    """
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    os.environ.setdefault("MIMALLOC_PURGE_DELAY", "0")  # [ms]
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(_M_ARENA_MAX, _ARENAS)
            mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
