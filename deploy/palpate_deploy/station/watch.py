"""The watch over a station's processes, inside supervisord: ends what hangs, and says why.

A process is running once the loop that does its work has beaten (``palpate.heartbeat``). One that
ends before is started again after pauses that grow; one that ends later, at once. One that does
not beat for longer than its last beat allowed is killed, with all that it has started.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from supervisor.states import ProcessStates

from palpate.heartbeat import START_S, Pulse, read_pulse
from palpate_deploy.station.logs import USAGE

_LOOK_S = 0.5
_STACKS_S = 0.2
_LONGEST_PAUSE_S = 30
_NOT_YET_S = 1_000_000_000
"""What supervisord calls startsecs of a process that has not beaten [s]: it is not running yet."""


class Silence:
    """For how long a process has not beaten, of the time in which its watcher looked."""

    def __init__(self, pid: int, now_s: float) -> None:
        self.beaten = False
        """Whether it has beaten since it was started."""
        self.silent_s = 0.0
        """Time since it was started, or has beaten last [s]."""
        self._pid = pid
        self._allowed_s = START_S
        self._looked_s = now_s
        self._beaten_ns = 0

    def look(self, pulse: Pulse | None, now_s: float) -> None:
        """Take in what the heartbeat's file says at ``now_s`` of the monotonic clock [s]."""
        # A watcher that was itself paused does not know what the process did meanwhile.
        self.silent_s += min(now_s - self._looked_s, _LOOK_S)
        self._looked_s = now_s
        if pulse is not None and pulse.pid == self._pid and pulse.beaten_ns != self._beaten_ns:
            self.beaten, self.silent_s = True, 0.0
            self._beaten_ns, self._allowed_s = pulse.beaten_ns, pulse.allowed_ns * 1e-9

    @property
    def hangs(self) -> bool:
        """Whether it has not beaten for longer than it may."""
        return self.silent_s > self._allowed_s


@dataclass(slots=True)
class Watched:
    """A process of the station, over all its runs.

    Attributes:
        silence: That of the present, or else of the last run.
        pid: Process id of that run; 0 = it has never been started.
        began_s: When that run began, by the monotonic clock [s].
        starts: How often it was started.
        hangs: How often it was killed because it hung.
        served: Whether a run of it has ever beaten.
        exit_status: Of the run that ended last; negative = the signal that ended it.
        why: Why that run ended, for people; empty = none has.
        hung: Why the present run is being killed; empty = it is not.
        killed_s: When it will be killed, by the monotonic clock [s].
        continued: Whether the present run was told to go on and stop.
    """

    silence: Silence = field(default_factory=lambda: Silence(0, 0.0))
    pid: int = 0
    began_s: float = 0.0
    starts: int = 0
    hangs: int = 0
    served: bool = False
    exit_status: int = 0
    why: str = ""
    hung: str = ""
    killed_s: float = 0.0
    continued: bool = False


class HangWatch:
    """Watches the processes of supervisord, which are its children.

    Args:
        folder: Where each has its heartbeat's file, named as the process.
        processes: supervisord's objects of them.
        log: Called with a line for people whenever a process is killed.
    """

    def __init__(
        self, folder: Path, processes: Callable[[], Iterable[Any]], log: Callable[[str], None]
    ) -> None:
        self._folder = folder
        self._processes = processes
        self._log = log
        self._watched: dict[str, Watched] = {}

    def look(self) -> None:
        """Look at every process; call it several times a second, from supervisord's loop."""
        now_s = time.monotonic()
        for process in self._processes():
            self._note_backoff(process)
            if process.pid:
                watched = self._present(process, now_s)
                self._listen(process, watched, now_s)
                if process.state == ProcessStates.STOPPING:
                    self._let_it_stop(process, watched)
                elif watched.silence.hangs:
                    self._end(process, watched, now_s)
                else:
                    watched.hung = ""

    def ended(self, process: Any, wait_status: int) -> None:
        """A process has ended; call it before supervisord takes notice."""
        now_s = time.monotonic()
        watched = self._present(process, now_s)
        # It may have beaten and ended between two looks.
        self._listen(process, watched, now_s)
        watched.exit_status = os.waitstatus_to_exitcode(wait_status)
        if watched.hung:
            watched.hangs += 1
        watched.why = watched.hung or how_it_ended(watched.exit_status)

    def report(self) -> list[dict[str, Any]]:
        """Every process in supervisord's order, with values that XML-RPC can carry."""
        now_s = time.monotonic()
        return [self._plain(process, now_s) for process in self._processes()]

    def _plain(self, process: Any, now_s: float) -> dict[str, Any]:
        watched = self._watched.get(process.config.name, Watched())
        # A run that supervisord has just begun may not have been looked at yet.
        known = bool(process.pid) and watched.pid == process.pid
        return {
            "name": process.config.name,
            "state": process.state,
            "pid": process.pid,
            "uptime_s": now_s - watched.began_s if known else 0.0,
            "restarts": max(watched.starts - 1, 0),
            "hangs": watched.hangs,
            "served": watched.served,
            "exit_status": watched.exit_status,
            "why": watched.why,
        }

    def _present(self, process: Any, now_s: float) -> Watched:
        """What is known of a process; a run that is seen for the first time is noted."""
        watched = self._watched.setdefault(process.config.name, Watched())
        if watched.pid != process.pid:
            watched.pid, watched.began_s = process.pid, now_s
            watched.silence = Silence(process.pid, now_s)
            watched.starts += 1
            watched.hung, watched.continued = "", False
            process.config.startsecs = _NOT_YET_S
        return watched

    def _listen(self, process: Any, watched: Watched, now_s: float) -> None:
        watched.silence.look(read_pulse(self._folder / process.config.name), now_s)
        if watched.silence.beaten:
            watched.served = True
            process.config.startsecs = 0

    def _end(self, process: Any, watched: Watched, now_s: float) -> None:
        """Let it write where it hangs, then kill it; supervisord starts it again."""
        pid = process.pid
        if not watched.hung:
            watched.hung = f"hung: no heartbeat for {watched.silence.silent_s:.1f} s"
            watched.killed_s = now_s + _STACKS_S
            self._log(f"{process.config.name} (pid {pid}) {watched.hung}; it is killed")
            _send(os.kill, pid, signal.SIGUSR1)
        elif now_s >= watched.killed_s:
            _send(os.killpg, pid, signal.SIGKILL)

    def _let_it_stop(self, process: Any, watched: Watched) -> None:
        # A stopped process (SIGSTOP) gets no SIGTERM before it goes on; systemd does the same.
        if not watched.continued:
            watched.continued = True
            _send(os.killpg, process.pid, signal.SIGCONT)

    def _note_backoff(self, process: Any) -> None:
        process.backoff = min(process.backoff, _LONGEST_PAUSE_S)


def how_it_ended(exit_status: int) -> str:
    """An exit status for people; negative = the signal that ended the process."""
    if exit_status < 0:
        return f"ended by {signal.Signals(-exit_status).name}"
    return "ended by itself" if exit_status == 0 else f"ended with status {exit_status}"


def cannot_serve(*, served: bool, exit_status: int, why: str) -> bool:
    """Whether a process has shown that starting it again is of no use.

    It has never served, and ended because of its configuration. One that served before is started
    again all the same, with pauses: a station must not end because of a file that is being changed.
    """
    return not served and bool(why) and exit_status == USAGE


def _send(send: Callable[[int, int], None], pid: int, number: int) -> None:
    # The process is our child: until we have waited for it, no other one can have its id.
    with contextlib.suppress(ProcessLookupError):
        send(pid, number)


class WatchInterface:
    """What the watch answers over supervisord's RPC."""

    def __init__(self, watch: HangWatch) -> None:
        self._watch = watch

    def processes(self) -> list[dict[str, Any]]:
        """See ``HangWatch.report``."""
        return self._watch.report()


def make_interface(supervisord: Any, **_: str) -> WatchInterface:
    """Factory of ``WatchInterface``, named in supervisord's configuration."""
    return WatchInterface(supervisord.options.watch)
