"""The processes of a station under supervisord, which restarts one that ends."""

from __future__ import annotations

import configparser
import http.client
import io
import os
import shlex
import shutil
import socket
import sys
import tempfile
import time
import xmlrpc.client
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from palpate.errors import PalpateError
from palpate_deploy.station.host import check_free, new_run_folder, write_profile
from palpate_deploy.station.lifetime import start_child, stop_child
from palpate_deploy.station.processes import START_ORDER, command_line
from palpate_deploy.station.profile import Profile, Service

STOP_WAIT_S = 10
"""A process that still runs this long after SIGTERM is killed [s]."""

_START_WAIT_S = 10.0
_RPC_ERRORS = (OSError, http.client.HTTPException, xmlrpc.client.Error)


class SupervisorError(PalpateError, RuntimeError):
    """supervisord itself does not work."""


@dataclass(frozen=True, slots=True)
class ProcessState:
    """One supervised process.

    ``state`` is named by supervisord: ``RUNNING``, ``STARTING``, ``BACKOFF``, ``EXITED``, ...;
    ``pid`` is 0 if it does not run; ``uptime_s`` counts from its last start [s]; ``restarts`` are
    those that were observed; ``exit_status`` is that of its last run.
    """

    service: Service
    state: str
    pid: int
    uptime_s: float
    restarts: int
    exit_status: int


class Supervisor:
    """The processes of a profile, kept running until ``stop``; the run's folder bears the name.

    Raises:
        LinkError: The router's port is in use.
        SupervisorError: supervisord does not start.
    """

    def __init__(self, profile: Profile, name: str) -> None:
        if "router" in profile.processes:
            check_free(profile.router.listen)
        self.profile = profile
        self.folder = new_run_folder(name)
        self._pids: dict[str, int] = {}
        self._restarts: dict[str, int] = {}
        # The path of a Unix socket is limited to 107 bytes: a folder in /tmp is short enough.
        self._socket_folder = Path(tempfile.mkdtemp(prefix="palpate-"))
        self._socket = self._socket_folder / "supervisor.sock"
        config = self.folder / "supervisord.conf"
        config.write_text(self._config_text(write_profile(profile, self.folder)), encoding="utf-8")
        command = [sys.executable, "-m", "palpate_deploy.station.supervisord"]
        command += ["-n", "-s", "-c", str(config)]
        self._process = start_child(command, self.logs / "supervisord.out")
        self._rpc = xmlrpc.client.ServerProxy(
            "http://127.0.0.1", transport=_transport(self._socket)
        )
        try:
            self._wait_for_rpc()
        except BaseException:
            self.stop()
            raise

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
            SupervisorError: supervisord is gone.
        """
        try:
            answers: Any = self._rpc.supervisor.getAllProcessInfo()
        except _RPC_ERRORS as error:
            raise SupervisorError(
                f"supervisord does not answer: {error}",
                remedy=f"see {self.logs / 'supervisord.log'}; start again with `palpate up`",
            ) from error
        found = {info["name"]: self._state(info) for info in answers}
        return [found[name] for name in self.profile.processes]

    def _state(self, info: dict[str, Any]) -> ProcessState:
        name, pid = info["name"], int(info["pid"])
        # supervisord does not count restarts; a new process id between two looks is one.
        if pid and pid != self._pids.get(name, pid):
            self._restarts[name] = self._restarts.get(name, 0) + 1
        if pid:
            self._pids[name] = pid
        uptime_s = float(info["now"] - info["start"]) if pid else 0.0
        return ProcessState(
            name,
            str(info["statename"]),
            pid,
            uptime_s,
            self._restarts.get(name, 0),
            int(info["exitstatus"]),
        )

    def stop(self) -> None:
        """Stop all processes in reverse order of starting, then supervisord; may be repeated."""
        # If it has to be killed, its processes notice that and end (lifetime.end_with_parent).
        stop_child(self._process, STOP_WAIT_S * len(self.profile.processes) + 5)
        shutil.rmtree(self._socket_folder, ignore_errors=True)

    def log_tail(self, service: str, lines: int = 5) -> str:
        """The last lines of a process's log."""
        try:
            text = (self.logs / f"{service}.log").read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""
        return "\n".join(text.splitlines()[-lines:])

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
            "directory": _escaped(str(Path.cwd())),
            "priority": str(priority),
            "autostart": "true",
            "autorestart": "unexpected" if finite else "true",
            "exitcodes": "0",
            # A process that ends within a second is restarted after pauses that grow.
            "startsecs": "1",
            "startretries": "1000000",
            "stopsignal": "TERM",
            "stopwaitsecs": str(STOP_WAIT_S),
            "stopasgroup": "false",
            "killasgroup": "true",
            "redirect_stderr": "true",
            "stdout_logfile": _escaped(str(self.logs / f"{service}.log")),
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


def _escaped(text: str) -> str:
    """Text for supervisord's configuration, in which ``%`` starts an expansion."""
    return text.replace("%", "%%")


class _UnixConnection(http.client.HTTPConnection):
    def __init__(self, path: Path) -> None:
        super().__init__("localhost", timeout=5)
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
