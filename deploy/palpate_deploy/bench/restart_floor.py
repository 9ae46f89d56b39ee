"""The floor of ``palpate bench restart``: a bare program under a bare supervisord, bare imports.

What no restart of ours can go below: supervisord as it comes has to notice the dead process and to
start another, and that one has to import the foreign packages that the process needs.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from palpate.errors import LinkError
from palpate_deploy.station.lifetime import start_child, stop_child
from palpate_deploy.station.profile import Service

_IMPORTS: dict[str, tuple[str, ...]] = {
    "router": ("zenoh",),
    "gateway": ("zenoh", "numpy", "pydantic", "google.protobuf"),
    "features": ("zenoh", "numpy", "pydantic", "google.protobuf", "onnxruntime"),
    "field": ("zenoh", "numpy", "pydantic", "google.protobuf", "onnxruntime"),
    "synthesis": ("zenoh", "numpy", "pydantic", "google.protobuf", "onnxruntime"),
    "recorder": ("zenoh", "numpy", "pydantic", "google.protobuf", "mcap.writer", "rerun"),
    "fem": ("zenoh", "numpy", "pydantic", "google.protobuf"),
}

# It writes its process id and goes on for ever.
_PROGRAM = """
import os, time
with open("pid.new", "w") as file:
    file.write(str(os.getpid()))
os.replace("pid.new", "pid")
while True:
    time.sleep(60)
"""

_CONFIG = """
[supervisord]
nodaemon = true
logfile = supervisord.log
pidfile = supervisord.pid
[program:bare]
command = {python} -S bare.py
autorestart = true
startsecs = 0
"""

_PATIENCE_S = 30.0


def restarts_s(times: int) -> list[float]:
    """Time from SIGKILL of a bare program to the first act of the one that replaces it [s]."""
    with _bare_station() as folder:
        taken: list[float] = []
        pid = _new_pid(folder, 0)
        for _ in range(times):
            time.sleep(0.5 + 0.1 * len(taken) % 1.0)  # at any time of supervisord's second
            began_s = time.monotonic()
            os.kill(pid, signal.SIGKILL)
            pid = _new_pid(folder, pid)
            taken.append(time.monotonic() - began_s)
        return taken


def import_s(service: Service) -> float:
    """Time in which Python starts and imports the foreign packages of a process [s]."""
    command = [sys.executable, "-c", f"import {', '.join(_IMPORTS[service])}"]
    taken = []
    for _ in range(3):
        began_s = time.monotonic()
        subprocess.run(command, check=True)
        taken.append(time.monotonic() - began_s)
    return min(taken)


@contextmanager
def _bare_station() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="palpate-floor-") as name:
        folder = Path(name)
        (folder / "bare.py").write_text(_PROGRAM, encoding="utf-8")
        config = folder / "bare.conf"
        config.write_text(_CONFIG.format(python=sys.executable), encoding="utf-8")
        start = f"import os; os.chdir({name!r}); from supervisor.supervisord import main; main()"
        command = [sys.executable, "-c", start, "-n", "-s", "-c", str(config)]
        process = start_child(command, folder / "out")
        try:
            yield folder
        finally:
            stop_child(process, _PATIENCE_S)


def _new_pid(folder: Path, before: int) -> int:
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        try:
            pid = int((folder / "pid").read_text(encoding="utf-8"))
        except FileNotFoundError:
            pid = before
        if pid != before:
            return pid
        time.sleep(0.005)
    raise LinkError(
        "the bare supervisord does not start its program",
        remedy=f"run it alone: {(folder / 'out').read_text(encoding='utf-8')[-300:]}",
    )
