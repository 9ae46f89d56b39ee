"""The process manager's process: supervisord, bound to the ``palpate`` that started it.

``python -m palpate_deploy.station.supervisord -n -s -c FILE`` is ``supervisord`` with five
differences: it stops, and stops its processes, when its parent is gone; it notices a dead process
within a tenth of a second instead of a second, which is a third of the time a restart may take; it
kills a process that hangs (``station/watch.py``); it goes on when a full disk refuses its logs; and
in FILE `` #`` and `` ;`` are part of a path, and begin no comment.
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from supervisor import loggers
from supervisor import options as supervisor_options
from supervisor.medusa import asyncore_25 as asyncore
from supervisor.options import ServerOptions
from supervisor.poller import Poller
from supervisor.supervisord import Supervisor

from palpate_deploy.station.lifetime import PARENT_PID, end_with_parent
from palpate_deploy.station.watch import HangWatch

WATCH_FOLDER = "_PALPATE_WATCH"
"""Environment variable with the folder of the processes' heartbeats; removed at the end."""

_WAIT_S = 0.1


class _WatchfulPoller(Poller):  # type: ignore[misc]  # supervisor has no types
    def poll(self, timeout: float) -> Any:
        self.options.watch.look()
        return super().poll(min(timeout, _WAIT_S))


class _Options(ServerOptions):  # type: ignore[misc]
    watch: HangWatch

    def waitpid(self) -> tuple[int | None, int | None]:
        pid, status = super().waitpid()
        process = self.pidhistory.get(pid) if pid else None
        if process is not None and status is not None:
            self.watch.ended(process, status)
        return pid, status

    def make_http_servers(self, supervisord: Supervisor) -> Any:
        # The socket keeps its owner, which supervisor says by a chown that changes nothing. Where a
        # service manager forbids that call altogether, supervisord would end here.
        real = os.chown
        os.chown = lambda *_, **__: None
        try:
            return super().make_http_servers(supervisord)
        finally:
            os.chown = real


_report_error = loggers.Handler.handleError


def _drop_refused(handler: loggers.Handler) -> None:
    """Drop a line of a log that the disk refuses; stderr, where supervisor says so, is there, too.

    That would raise in turn, and end supervisord with all its processes.
    """
    if not isinstance(sys.exc_info()[1], OSError):
        _report_error(handler)


def _processes(supervisord: Supervisor) -> Iterator[Any]:
    for group in (supervisord.process_groups or {}).values():
        yield from group.processes.values()


def main() -> None:
    """Run supervisord with the arguments of this process."""
    end_with_parent()
    loggers.Handler.handleError = _drop_refused
    os.environ[PARENT_PID] = str(os.getpid())  # its processes live by it
    supervisor_options.UnhosedConfigParser = functools.partial(
        supervisor_options.UnhosedConfigParser, inline_comment_prefixes=None
    )
    options = _Options()
    options.poller = _WatchfulPoller(options)
    options.realize(sys.argv[1:], doc=__doc__)
    options.first = True
    options.test = False
    supervisord = Supervisor(options)
    folder = Path(os.environ.pop(WATCH_FOLDER))
    options.watch = HangWatch(
        folder,
        lambda: _processes(supervisord),
        lambda line: options.logger.warn(line),
    )
    with contextlib.suppress(asyncore.ExitNow):
        supervisord.main()
    options.close_httpservers()
    with contextlib.suppress(OSError):
        options.close_logger()
    # Here too, because a `palpate up` that was killed cannot do it.
    shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
