"""The processes of a station under supervisord, which restarts one that ends or hangs."""

from __future__ import annotations

import configparser
import contextlib
import http.client
import io
import os
import shlex
import shutil
import signal
import socket
import sys
import tempfile
import time
import xmlrpc.client
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from supervisor.states import getProcessStateDescription

from palpate.errors import PalpateError
from palpate.heartbeat import FILE_VARIABLE, read_pulse
from palpate_deploy.station.host import (
    check_free,
    end_run,
    new_run_folder,
    write_profile,
    write_run_file,
)
from palpate_deploy.station.lifetime import start_child, stop_child
from palpate_deploy.station.logs import DEVICE
from palpate_deploy.station.processes import START_ORDER, command_line
from palpate_deploy.station.profile import Profile, Service
from palpate_deploy.station.supervisord import WATCH_FOLDER

STOP_WAIT_S = 10
"""A process that still runs this long after SIGTERM is killed [s]."""

_START_WAIT_S = 10.0
_ANSWER_S = 5.0
_MUTE_STOP_S = 15.0
"""A supervisord that does not answer has this long to stop all processes before it is killed."""

_MEMORY = Path("/dev/shm")
_RPC_ERRORS = (OSError, http.client.HTTPException, xmlrpc.client.Error)


class SupervisorError(PalpateError, RuntimeError):
    """supervisord itself does not work."""


@dataclass(frozen=True, slots=True)
class ProcessState:
    """One supervised process.

    ``state`` is named by supervisord: ``STARTING`` until the first heartbeat, ``RUNNING``,
    ``BACKOFF``, ``EXITED``, ...; ``pid`` is 0 if it does not run; ``uptime_s`` counts from its last
    start [s]; ``hangs`` are the restarts because it hung; ``served`` says whether a run of it has
    ever beaten; ``exit_status`` (negative = a signal) and ``why`` are of the run that ended last.
    """

    service: Service
    state: str
    pid: int
    uptime_s: float
    restarts: int
    hangs: int
    served: bool
    exit_status: int
    why: str


_RECENT_S = 300.0


def recent(processes: Sequence[ProcessState]) -> list[ProcessState]:
    """Processes that were started again in the last minutes, or are being."""
    return [one for one in processes if one.why and one.uptime_s < _RECENT_S]


class Supervisor:
    """The processes of a profile, kept running until ``stop``; the run's folder bears the name.

    Raises:
        ConfigError: The run's folder cannot be made.
        RunDiskError: Its disk is full.
        LinkError: The router's port is in use.
        SupervisorError: supervisord does not start.
    """

    def __init__(self, profile: Profile, name: str) -> None:
        if "router" in profile.processes:
            check_free(profile.router.listen)
        self.profile = profile
        self._mute = False
        with contextlib.ExitStack() as undo:
            self.folder = new_run_folder(name)
            undo.callback(end_run, self.folder)
            # The path of a Unix socket is limited to 107 bytes: a folder there is short enough. In
            # memory, because a heartbeat must never wait for a disk.
            in_memory = _MEMORY if os.access(_MEMORY, os.W_OK) else None
            self._socket_folder = Path(tempfile.mkdtemp(prefix="palpate-", dir=in_memory))
            undo.callback(shutil.rmtree, self._socket_folder, ignore_errors=True)
            self._socket = self._socket_folder / "supervisor.sock"
            text = self._config_text(write_profile(profile, self.folder))
            config = write_run_file(self.folder / "supervisord.conf", text)
            command = [sys.executable, "-m", "palpate_deploy.station.supervisord"]
            command += ["-n", "-s", "-c", str(config)]
            self._process = start_child(
                command, self.logs / "supervisord.out", {WATCH_FOLDER: str(self._socket_folder)}
            )
            undo.callback(self.stop)
            self._rpc = xmlrpc.client.ServerProxy(
                "http://127.0.0.1", transport=_transport(self._socket)
            )
            self._wait_for_rpc()
            undo.pop_all()

    @property
    def logs(self) -> Path:
        """Folder of the logs."""
        return self.folder / "logs"

    @property
    def running(self) -> bool:
        """Whether supervisord itself runs."""
        return self._process.poll() is None

    def processes(self) -> list[ProcessState]:
        """State of each process, in the profile's order.

        Raises:
            SupervisorError: supervisord is gone, or hangs.
        """
        try:
            answers: Any = self._rpc.palpate.processes()
        except _RPC_ERRORS as error:
            if not self.running:
                raise self._gone() from error
            self._mute = True
            raise SupervisorError(
                f"supervisord does not answer: {error}",
                remedy=f"see {self.logs / 'supervisord.log'}; start again with `palpate up`",
            ) from error
        self._mute = False
        states = (
            ProcessState(
                service=info.pop("name"),
                state=getProcessStateDescription(info.pop("state")),
                **info,
            )
            for info in answers
        )
        found = {state.service: state for state in states}
        return [found[name] for name in self.profile.processes]

    def _gone(self) -> SupervisorError:
        return SupervisorError("supervisord is gone", remedy=f"see {self.logs / 'supervisord.log'}")

    def stop(self) -> None:
        """Stop all processes in reverse order of starting, then supervisord; may be repeated."""
        orderly_s = _MUTE_STOP_S if self._mute else STOP_WAIT_S * len(self.profile.processes) + 5
        stop_child(self._process, orderly_s)
        self._end_leftovers()
        shutil.rmtree(self._socket_folder, ignore_errors=True)
        end_run(self.folder)

    def _end_leftovers(self) -> None:
        """End what a supervisord that was killed left behind.

        Its processes get SIGTERM from the kernel (``lifetime.end_with_parent``), but one that
        hangs, or is stopped, does not follow it.
        """
        deadline = time.monotonic() + STOP_WAIT_S
        while left := list(self._leftovers()):
            for pid in left:
                number = signal.SIGCONT if time.monotonic() < deadline else signal.SIGKILL
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, number)
            time.sleep(0.1)

    def _leftovers(self) -> Iterator[int]:
        """Processes of this run that have beaten and still run."""
        for service in self.profile.processes:
            pulse = read_pulse(self._socket_folder / service)
            # Another process may have the id meanwhile: ours names the run's folder.
            if pulse is not None and str(self.folder) in _command_of(pulse.pid):
                yield pulse.pid

    def log_tail(self, service: str) -> str:
        """The last five lines of a process's log."""
        try:
            text = (self.logs / f"{service}.log").read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""
        return "\n".join(text.splitlines()[-5:])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _config_text(self, profile: Path) -> str:
        config = configparser.RawConfigParser()
        config.read_dict(
            {
                "unix_http_server": {"file": _escaped(str(self._socket)), "chmod": "0700"},
                "rpcinterface:supervisor": {
                    "supervisor.rpcinterface_factory": (
                        "supervisor.rpcinterface:make_main_rpcinterface"
                    )
                },
                "rpcinterface:palpate": {
                    "supervisor.rpcinterface_factory": (
                        "palpate_deploy.station.watch:make_interface"
                    )
                },
                "supervisord": {
                    "logfile": _escaped(str(self.logs / "supervisord.log")),
                    "logfile_maxbytes": "5MB",
                    "logfile_backups": "2",
                    "pidfile": _escaped(str(self.folder / "supervisord.pid")),
                    "childlogdir": _escaped(str(self.logs)),
                    "nodaemon": "true",
                    "nocleanup": "true",
                    "minfds": "256",
                    "minprocs": "32",
                    "identifier": "palpate",
                },
            }
        )
        for priority, service in enumerate(START_ORDER, start=1):
            if service in self.profile.processes:
                config.read_dict({f"program:{service}": self._program(service, priority, profile)})
        text = io.StringIO()
        config.write(text)
        return text.getvalue()

    def _program(self, service: Service, priority: int, profile: Path) -> dict[str, str]:
        # A gateway at the end of its recording stays ended; every other process is restarted.
        finite = service == "gateway" and self.profile.gateway.exit_at_end
        return {
            "command": _escaped(shlex.join(command_line(service, profile))),
            "priority": str(priority),
            "autostart": "true",
            "autorestart": "unexpected" if finite else "true",
            # A damaged recording has been delivered as far as it goes.
            "exitcodes": f"0,{DEVICE}",
            "environment": f'{FILE_VARIABLE}="{_escaped(str(self._socket_folder / service))}"',
            "startretries": "1000000",
            "stopsignal": "TERM",
            "stopwaitsecs": str(STOP_WAIT_S),
            "stopasgroup": "false",
            "killasgroup": "true",
            "redirect_stderr": "true",
            # Of this one supervisor expands the text twice.
            "stdout_logfile": _escaped(_escaped(str(self.logs / f"{service}.log"))),
            "stdout_logfile_maxbytes": "10MB",
            "stdout_logfile_backups": "3",
        }

    def _wait_for_rpc(self) -> None:
        deadline = time.monotonic() + _START_WAIT_S
        while time.monotonic() < deadline:
            if self._process.poll() is not None:
                break
            if self._socket.exists():
                try:
                    self.processes()
                except SupervisorError:
                    pass
                else:
                    return
            time.sleep(0.05)
        output = (self.logs / "supervisord.out").read_text(encoding="utf-8", errors="replace")
        raise SupervisorError(
            f"supervisord did not start: {output.strip()[-500:] or 'no answer'}",
            remedy=f"see the logs in {self.logs}",
        )


def _command_of(pid: int) -> str:
    """Command line of a process; empty if it has ended, or if this system does not tell."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace")
    except OSError:
        return ""


def _escaped(text: str) -> str:
    """Text for supervisord's configuration, in which ``%`` starts an expansion."""
    return text.replace("%", "%%")


class _UnixConnection(http.client.HTTPConnection):
    def __init__(self, path: Path) -> None:
        super().__init__("localhost", timeout=_ANSWER_S)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self.timeout)
        self.sock.connect(os.fspath(self._path))


def _transport(path: Path) -> xmlrpc.client.Transport:
    class UnixTransport(xmlrpc.client.Transport):
        def make_connection(self, host: Any) -> http.client.HTTPConnection:
            return _UnixConnection(path)

    return UnixTransport()
