"""What ``palpate up`` tells of the processes that it keeps running, as a status on the bus.

From it ``palpate status`` and ``palpate top`` know, on any host, what should run.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from palpate.bus import Session
from palpate.census import ROUTER, SUPERVISOR
from palpate.errors import PalpateError
from palpate.health import Health, HealthReporter
from palpate.messages import ServiceState, SupervisedProcess
from palpate.process import Closing
from palpate.usage import ProcessUsage
from palpate_deploy.station.supervision import ProcessState, recent

_FINE = frozenset({"RUNNING", "EXITED"})
"""EXITED is the state of a finite source at its end; any other process is started again."""


class ProcessDown(PalpateError, RuntimeError):
    """A process of the station does not run at present."""


class SupervisorReport(Closing):
    """Publishes the state of the supervised processes; ``logs`` is the folder of their logs."""

    def __init__(self, session: Session, logs: Path) -> None:
        self._logs = logs
        self._health = Health(*SUPERVISOR)
        self._router: tuple[int, ProcessUsage] | None = None
        self._presence = session.presence(SUPERVISOR[0], instance=SUPERVISOR[1])
        self._reporter = HealthReporter(session, self._health)
        self._presence.ready()

    def tell(self, processes: Sequence[ProcessState]) -> None:
        """Take over what supervisord says; call it a few times a second."""
        self._health.set_processes(
            [
                SupervisedProcess(
                    one.service,
                    one.service,
                    one.state.lower(),
                    one.pid,
                    one.restarts,
                    max(0.0, one.uptime_s),
                )
                for one in processes
            ]
        )
        self._health.set_counts({f"{one.service}.hung": one.hangs for one in processes})
        self._measure_router(processes)
        down = [one for one in processes if one.state not in _FINE]
        # A process is "starting" until its first heartbeat.
        if any(one.state != "STARTING" or one.restarts for one in down):
            first = next(one for one in down if one.state != "STARTING" or one.restarts)
            self._health.fail(
                ProcessDown(
                    f"{first.service} does not run: {first.why or first.state.lower()}",
                    remedy=f"it is started again by itself; see {self._logs / first.service}.log",
                )
            )
        elif not down:
            said = [f"{len(processes)} processes run"]
            said += [f"{one.service} was started again: {one.why}" for one in recent(processes)]
            self._health.set_state(ServiceState.READY, "; ".join(said))

    def _measure_router(self, processes: Sequence[ProcessState]) -> None:
        """The router has no status of its own: its memory and processor time are told here."""
        pid = next((one.pid for one in processes if one.service == ROUTER[0]), 0)
        if not pid:
            return
        if self._router is None or self._router[0] != pid:
            self._router = pid, ProcessUsage(pid)
        for name, value in self._router[1].gauges().items():
            self._health.gauge(f"{ROUTER[0]}.{name}", value)

    def close(self) -> None:
        """Report a last time and withdraw."""
        self._presence.not_ready()
        self._health.set_state(ServiceState.STOPPING, "the station stops")
        self._reporter.close()
        self._presence.close()
