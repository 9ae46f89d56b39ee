"""A worker process as its owner sees it: started, spoken to, heard, ended."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from enum import Enum
from multiprocessing.connection import Connection

from palpate_fem.service.jobs import Cancel, Event, Job, Setup

_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)
_END_WAIT_S = 5.0


class WorkerState(Enum):
    """What a worker is at."""

    STARTING = "starting"
    IDLE = "idle"
    BUSY = "busy"


class WorkerProcess:
    """One worker process.

    Not ``multiprocessing.Process``: that imports the caller's main script again, which must then be
    written for it.

    Args:
        setup: How it makes fingertips.
        threads: Threads that its libraries may use.
        on_event: Called from a thread of its own with what it says.
        on_gone: Called once from that thread, when it has ended.

    Attributes:
        state: Kept by the owner.
    """

    def __init__(
        self,
        setup: Setup,
        threads: int,
        on_event: Callable[[WorkerProcess, Event], None],
        on_gone: Callable[[WorkerProcess], None],
    ) -> None:
        self.state = WorkerState.STARTING
        self._killed = False
        self._on_event = on_event
        self._on_gone = on_gone
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "palpate_fem.service.worker", str(theirs.fileno())],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                env={**os.environ, **dict.fromkeys(_THREAD_VARIABLES, str(threads))},
            )
        self._connection = Connection(ours.detach())
        self._sending = threading.Lock()
        self._send(setup)
        self._reader = threading.Thread(target=self._read, name=f"worker {self.pid}", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def start(self, job: Job) -> None:
        """Hand it a job."""
        self.state = WorkerState.BUSY
        self._send(job)

    def cancel(self, job_id: str) -> None:
        """Ask it to stop a job."""
        self._send(Cancel(job_id))

    def kill(self) -> None:
        """End it now."""
        self._killed = True
        self._process.kill()

    def join(self) -> None:
        """Wait until it has ended."""
        self._reader.join(_END_WAIT_S)

    def epitaph(self) -> str:
        """How it ended, for people."""
        status = self._process.poll()
        if self._killed:
            return "was ended because it did not stop by itself"
        if status is None:
            return "lost its connection"
        if status >= 0:
            return f"ended with exit status {status}"
        name = signal.Signals(-status).name
        hint = " (out of memory?)" if -status == signal.SIGKILL else ""
        return f"was ended by {name}{hint}"

    def _send(self, message: Setup | Job | Cancel) -> None:
        # One that is gone is noticed by the reader, which tells the owner.
        with self._sending, contextlib.suppress(OSError):
            self._connection.send(message)

    def _read(self) -> None:
        while True:
            try:
                event = self._connection.recv()
            except (EOFError, OSError):
                break
            self._on_event(self, event)
        self._process.kill()  # alive or not, nobody can speak to it any more
        self._process.wait()
        with self._sending:
            self._connection.close()
        self._on_gone(self)
