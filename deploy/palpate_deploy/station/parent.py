"""A process that must not outlive the one that started it.

A parent killed with ``kill -9`` cannot clean up, so its children watch it: each is told the
parent's process id in the environment and gets ``SIGTERM``, its normal way to stop, when that
process is gone.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time

PARENT_PID = "_PALPATE_PARENT_PID"
"""Environment variable with the process id of the parent to live by; absent = live alone."""

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_POLL_S = 0.5


def environment_for_children() -> dict[str, str]:
    """This process's environment for children that must end with it.

    Settings of the profile are left out: children are given the resolved profile as a file, and
    the same variables applied twice would undo what a command changed in it.
    """
    kept = {k: v for k, v in os.environ.items() if not k.upper().startswith("PALPATE_")}
    return {**kept, PARENT_PID: str(os.getpid())}


def end_with_parent() -> None:
    """Arrange ``SIGTERM`` for this process when its parent ends, if it was told to.

    Call it after the handler of ``SIGTERM`` is in place.
    """
    told = os.environ.get(PARENT_PID)
    if told is None:
        return
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    else:  # no such signal: look now and then
        threading.Thread(target=_watch, args=(int(told),), daemon=True).start()
    if os.getppid() != int(told):  # it was gone before we could ask
        os.kill(os.getpid(), signal.SIGTERM)


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL_S)
    os.kill(os.getpid(), signal.SIGTERM)
