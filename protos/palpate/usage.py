"""What a process uses of its host: memory, processor, threads, open files."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

_LOOK_S = 0.5
"""Least time between two looks [s]: a share of the processor over less is noise."""

_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_TICKS_HZ = os.sysconf("SC_CLK_TCK")


class ProcessUsage:
    """Measures one process of this host, by default this one. Safe to use from several threads."""

    def __init__(self, pid: int | None = None) -> None:
        self._folder = Path("/proc") / ("self" if pid is None else str(pid))
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
                    "process_rss_bytes": float(self._statm()[1] * _PAGE_BYTES),
                    "process_threads": float(len(os.listdir(self._folder / "task"))),
                    "process_open_files": float(len(os.listdir(self._folder / "fd"))),
                }
            except (OSError, ValueError, IndexError):  # not Linux, not allowed, or it has ended
                gauges = {}
            if since_s >= _LOOK_S and cpu_s is not None and self._cpu_s is not None:
                gauges["process_cpu_ratio"] = max(0.0, (cpu_s - self._cpu_s) / since_s)
            if since_s >= _LOOK_S:
                self._cpu_s, self._looked_s = cpu_s, now_s
            self._gauges = gauges
            return gauges

    def _statm(self) -> list[int]:
        return [int(word) for word in (self._folder / "statm").read_text().split()]

    def _cpu_time_s(self) -> float | None:
        """Processor time of all its threads since its start [s]."""
        try:
            # The name of the program, in brackets, may hold anything.
            words = (self._folder / "stat").read_text().rpartition(")")[2].split()
            return (int(words[11]) + int(words[12])) / _TICKS_HZ
        except (OSError, ValueError, IndexError):
            return None
