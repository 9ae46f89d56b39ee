"""How a process ends: whenever a signal comes."""

from __future__ import annotations

import subprocess
import sys

import pytest

WAITS = """
import signal, sys, threading
from palpate.process import stop_on_signals

stop = stop_on_signals(signal.SIGTERM)

def at_each_step(frame, event, _):
    if frame.f_code.co_filename == threading.__file__:
        signal.raise_signal(signal.SIGTERM)
        return at_each_step

sys.settrace(at_each_step)
stop.wait(20.0)
sys.settrace(None)
print("stopped" if stop.wait(20.0) else "still waits")
"""
"""A signal at each step of the main thread inside of the event, also before and after it waits."""


@pytest.mark.parametrize(
    ("before", "answer"), [("SIG_DFL", "stopped"), ("SIG_IGN", "goes on")], ids=["plain", "nohup"]
)
def test_the_end_of_the_terminal_is_a_signal_unless_it_is_ignored(before: str, answer: str) -> None:
    program = f"""
import signal
signal.signal(signal.SIGHUP, signal.{before})
from palpate.process import stop_on_signals
stop = stop_on_signals()
signal.raise_signal(signal.SIGHUP)
print("stopped" if stop.wait({20.0 if answer == "stopped" else 0.2}) else "goes on")
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout) == (0, f"{answer}\n"), done.stderr


def test_a_signal_may_come_at_any_step_of_waiting_for_it() -> None:
    """A handler that sets the event itself would wait for a lock that its own thread holds.

    So it went where a parent was killed while its station was stopped: the signals came together.
    """
    done = subprocess.run(
        [sys.executable, "-c", WAITS], capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.returncode, done.stdout) == (0, "stopped\n"), done.stderr
