"""What palpate and the floor share in a benchmark: frames, gate and rows of results."""

from __future__ import annotations

import mmap
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from palpate.errors import StreamTimeout
from palpate.process import avoid_pauses, stop_on_signals
from palpate_deploy.station.lifetime import end_with_parent
from palpate_gateway.one_core import stay_on_one_core

if TYPE_CHECKING:  # the floor, which uses this module too, does without palpate's bus
    from palpate.bus import ReceivedMessage, Subscriber

M = TypeVar("M")

SERIAL = "BENCH-0001"
REST_COUNTS = 3000
SLOTS = 44
KINDS = 256
"""Different frames, prepared before the first is due."""

STAGES = ("age_at_arrival", "waiting", "decode", "tare", "infer", "encode")
"""Stages of an estimate, whose times [ns] may follow its row; -1 = unknown."""

_NOISE_COUNTS = 2
_SEED = 1
_LOOK_S = 0.02


def bench_counts() -> npt.NDArray[np.uint16]:
    """Raw counts of the prepared frames: E1..E19, PDC, 22 PAC, TAC, TDC; shape ``(KINDS, 44)``."""
    noise = np.random.default_rng(_SEED).integers(-_NOISE_COUNTS, _NOISE_COUNTS + 1, (KINDS, SLOTS))
    return (REST_COUNTS + noise).astype(np.uint16)


class SourceGate:
    """Pauses a source by one byte of shared memory, which costs nothing to read.

    A source stopped by a signal would lose its links once their lease has expired. ``path`` is the
    file of the bytes, made if absent; ``index`` the source's byte.
    """

    SIZE = 16

    def __init__(self, path: Path, index: int) -> None:
        if not path.exists():
            path.write_bytes(bytes(self.SIZE))
        with open(path, "r+b") as file:
            self._memory = mmap.mmap(file.fileno(), self.SIZE)
        self._index = index

    @property
    def is_open(self) -> bool:
        """Whether the source may send."""
        return self._memory[self._index] != 0

    def set(self, is_open: bool) -> None:
        """Open or close it."""
        self._memory[self._index] = int(is_open)

    def wait(self) -> None:
        """Wait until it is open."""
        while not self.is_open:
            time.sleep(_LOOK_S)


def stop_on_sigterm() -> threading.Event:
    """An event that ``SIGTERM`` sets; the process also ends with its parent."""
    stop = stop_on_signals(signal.SIGTERM)
    end_with_parent()
    return stop


def equal_terms(core: str = "") -> None:
    """Before a process of a bench serves: what palpate's processes do, for the floor and clients.

    Garbage collection and the switch of threads, and for the source its ``core``.
    """
    avoid_pauses()
    if core:
        stay_on_one_core(int(core))


def received(stream: Subscriber[M], stop: threading.Event) -> Iterator[ReceivedMessage[M]]:
    """The messages of a stream until ``stop`` is set."""
    while not stop.is_set():
        try:
            yield stream.next(timeout_s=0.1)
        except StreamTimeout:
            continue


def dropped_by(*streams: Subscriber[Any]) -> int:
    """How many messages did not find room in these streams."""
    keys = ("dropped", "overflow")
    return sum(stream.counters.get(key, 0) for stream in streams for key in keys)


def write_rows(out: Path, sensors: list[str], rows: Any, *, dropped: int, columns: int = 3) -> None:
    """Write rows of a client: by default sequence, stamp and arrival [ns] of each estimate.

    With more columns, ``STAGES`` follow.
    """
    np.savez(
        out,
        sensors=np.array(sensors, dtype=str),
        rows=np.array(rows, dtype=np.int64).reshape(-1, columns),
        dropped=np.int64(dropped),
    )


def read_rows(path: Path) -> tuple[npt.NDArray[np.str_], npt.NDArray[np.int64], int]:
    """Sensors, rows and number of drops, as ``write_rows`` wrote them."""
    with np.load(path, allow_pickle=False) as archive:
        return archive["sensors"], archive["rows"], int(archive["dropped"])
