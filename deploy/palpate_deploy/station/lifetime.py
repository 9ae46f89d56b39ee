"""How a process ends together with the process that started it.

A parent that is killed with ``kill -9`` cannot stop its children, so they watch it: the environment
names the parent's process id, and each child gets ``SIGTERM`` when that process is gone.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from palpate.heartbeat import without_watch

PARENT_PID = "_PALPATE_PARENT_PID"
"""Environment variable with the process id of the parent; a process without it ends alone."""

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_POLL_S = 0.5


def environment_for_children() -> dict[str, str]:
    """This process's environment for children that must end with it.

    Without the variables that change a profile: children read the resolved profile from a file, and
    the same variables applied twice would undo what a command changed in it. Without those of a
    watch over this process, for which its children must not answer.
    """
    kept = {
        k: v for k, v in without_watch(os.environ).items() if not k.upper().startswith("PALPATE_")
    }
    return {**kept, PARENT_PID: str(os.getpid())}


def start_child(
    command: Sequence[str], log: Path, variables: Mapping[str, str] | None = None
) -> subprocess.Popen[bytes]:
    """Start a process that ends with this one and writes into a log of its own.

    ``variables`` are added to its environment.
    """
    with open(log, "ab") as output:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env={**environment_for_children(), **(variables or {})},
            # Ctrl-C must reach only the command itself, which stops its children in order.
            start_new_session=True,
        )


def stop_child(process: subprocess.Popen[bytes], timeout_s: float) -> int:
    """Stop a process with ``SIGTERM``, after the timeout with ``SIGKILL``; its exit status."""
    process.terminate()
    # A stopped process (SIGSTOP) gets no SIGTERM before it goes on.
    process.send_signal(signal.SIGCONT)
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def end_with_parent() -> None:
    """Arrange ``SIGTERM`` for this process at the end of its parent, if the environment names one.

    Call it after the handler of ``SIGTERM`` is in place.
    """
    parent = os.environ.get(PARENT_PID)
    if parent is None:
        return
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    else:  # no such signal: poll
        threading.Thread(target=_watch, args=(int(parent),), daemon=True).start()
    if os.getppid() != int(parent):  # it ended before the signal was arranged
        os.kill(os.getpid(), signal.SIGTERM)


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL_S)
    os.kill(os.getpid(), signal.SIGTERM)
