"""The finite-element service: requests in, converged steps out as they come.

A request is checked, then waits for one of a few worker processes. Whatever happens it is answered:
with its steps and how it ended, or with a typed error.
"""

from __future__ import annotations

import threading
from collections import OrderedDict

from palpate.bus import Presence, QueryAnswer, Session, endpoints
from palpate.bus.topics import SIMULATION_PROGRESS, caller_key
from palpate.closing import Closing
from palpate.config import LinkConfig
from palpate.errors import ConfigError, ErrorCode, PalpateError, SimulationError, WireError
from palpate.health import Health, HealthReporter
from palpate.messages import (
    ServiceState,
    SimulationCancelReply,
    SimulationCancelRequest,
    SimulationReply,
    SimulationRequest,
)
from palpate_fem.config import FingertipParameters
from palpate_fem.service.answering import Asked
from palpate_fem.service.config import FemConfig
from palpate_fem.service.fingertips import without_friction
from palpate_fem.service.jobs import Ended, Event, Failed, Setup
from palpate_fem.service.pool import Pool
from palpate_fem.service.request import job_of
from palpate_fem.store.content import StoredFingertip

SERVICE = "fem"

_POLL_S = 0.1
_FINGERTIPS_KNOWN = 16
_REFUSED = (ErrorCode.INVALID_REQUEST, ErrorCode.RESOURCE_EXHAUSTED, ErrorCode.UNAVAILABLE)


class Simulations(Closing):
    """Answers requests with the help of a pool.

    Args:
        session: The bus.
        config: What is served.
        default: Parameters where a request names none.
        health: Hears of every event.
    """

    def __init__(
        self, session: Session, config: FemConfig, default: FingertipParameters, health: Health
    ) -> None:
        self._station = session.station
        self._config = config
        self._default = default
        self._health = health
        self._lock = threading.Lock()
        self._asked: dict[str, Asked] = {}
        self._fingertips: OrderedDict[FingertipParameters, StoredFingertip] = OrderedDict()
        self._progress = session.publisher(SIMULATION_PROGRESS, sensor=config.sensor)
        self.pool = Pool(
            Setup(config.factory, config.options, default, config.keep),
            workers=config.workers,
            threads=config.threads_each(),
            waiting=config.waiting,
            grace_s=config.grace_s,
            on_fingertip=self._know,
        )

    def ask(self, request: SimulationRequest, answer: QueryAnswer[SimulationReply]) -> None:
        """Take a request; it is answered from the pool's threads.

        Raises:
            ConfigError: It is refused; says why.
            RemoteError: There is no place for it.
        """
        self._health.count("requests_received")
        try:
            with self._lock:
                known = dict(self._fingertips)
            job = job_of(request, self._config, self._default, known)
            asked = Asked(request, answer, self._progress)
            with self._lock:
                if request.request_id in self._asked:
                    raise ConfigError(
                        f"request_id {request.request_id!r} is in use by a simulation that waits "
                        "or runs",
                        remedy="choose another, e.g. uuid.uuid4().hex",
                    )
                self._asked[request.request_id] = asked
            try:
                self.pool.submit(job, lambda event: self._on_event(asked, event))
            except PalpateError:
                self._forget(asked)
                raise
        except PalpateError as error:
            if error.code in _REFUSED:
                self._health.count(f"requests_refused_{error.code.name.lower()}")
            raise

    def cancel(self, request: SimulationCancelRequest) -> SimulationCancelReply:
        """Stop a simulation, whoever asked for it."""
        return SimulationCancelReply(self.pool.cancel(request.request_id))

    def caller_gone(self, key: str) -> None:
        """Stop the simulation that nobody waits for any more.

        Args:
            key: The ``caller_key`` that vanished.
        """
        with self._lock:
            ids = [name for name in self._asked if caller_key(self._station, name) == key]
        for name in ids:
            if self.pool.cancel(name):
                self._health.count("callers_gone")

    def take_over(self) -> None:
        """Hand the pool's numbers to health."""
        self._health.gauge("busy_workers", self.pool.busy)
        self._health.gauge("ready_workers", self.pool.ready)
        self._health.gauge("waiting_requests", self.pool.waiting)
        self._health.set_counts({"worker_restarts": self.pool.restarts})

    def close(self) -> None:
        """Answer whatever waits or runs with UNAVAILABLE, and end the workers."""
        self.pool.close()

    def _on_event(self, asked: Asked, event: Event) -> None:
        over = isinstance(event, Ended | Failed)
        if over:
            self._forget(asked)
        try:
            asked.hear(event)
        except WireError as error:  # a result that the contract does not allow
            ours = SimulationError(
                f"the result cannot be sent: {error.problem}",
                remedy="the solver went wrong: report it with this request",
            )
            asked.answer.fail(ours)
            self.pool.cancel(asked.request.request_id)
            self._health.fail(ours, degraded=False)
        if over:
            self._account(event, asked)

    def _account(self, event: Event, asked: Asked) -> None:
        if isinstance(event, Ended):
            self._health.count(f"simulations_{event.outcome.name.lower()}")
            self._health.count("steps_sent", asked.steps_done)
            self._health.gauge("last_simulation_s", asked.elapsed_s)
        elif isinstance(event, Failed):
            self._health.count("simulations_failed")
            self._health.fail(event.error(), degraded=False)

    def _forget(self, asked: Asked) -> None:
        with self._lock:
            self._asked.pop(asked.request.request_id, None)

    def _know(self, fingertip: StoredFingertip) -> None:
        key = without_friction(fingertip.parameters)
        with self._lock:
            self._fingertips.pop(key, None)
            self._fingertips[key] = fingertip
            while len(self._fingertips) > _FINGERTIPS_KNOWN:
                self._fingertips.popitem(last=False)


def run(
    config: FemConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = SERVICE,
) -> None:
    """Serve until ``stop`` is set; then answer what is left with UNAVAILABLE, and leave.

    Args:
        config: What is served, and by how many workers.
        link: How to join the bus.
        station: The station to serve.
        stop: Set it to end.
        instance: Name of this process among several of its kind.

    Raises:
        ConfigError: A parameter is out of range.
        LinkError: The bus cannot be joined.
        RemoteError: The workers do not start; says why.
    """
    default = config.fingertip.parameters()
    health = Health(SERVICE, instance)
    health.set_sensors((config.sensor,))
    with Session.open(link, station=station) as session:
        presence = session.presence(SERVICE, instance=instance)
        with (
            Simulations(session, config, default, health) as simulations,
            HealthReporter(session, health, refresh=simulations.take_over),
        ):
            session.watch_callers(simulations.caller_gone)
            session.queryable(endpoints.CANCEL_SIMULATION, simulations.cancel, sensor=config.sensor)
            served = session.stream_queryable(
                endpoints.SIMULATE, simulations.ask, sensor=config.sensor
            )
            health.set_state(ServiceState.STARTING, "the first fingertip is being pressurised")
            try:
                _serve(simulations.pool, health, presence, stop)
            finally:
                presence.not_ready()
                health.set_state(ServiceState.STOPPING)
                served.close()


def _serve(pool: Pool, health: Health, presence: Presence, stop: threading.Event) -> None:
    """Ready while a worker is; what is asked before waits for one.

    Raises:
        RemoteError: There never will be one.
    """
    while not stop.wait(_POLL_S):
        if pool.broken is not None:
            raise pool.broken
        if pool.ready:
            presence.ready()
            if health.state is not ServiceState.READY:
                health.set_state(ServiceState.READY, "")
        elif health.state is ServiceState.READY:
            presence.not_ready()
            health.set_state(ServiceState.DEGRADED, "no worker is left; they are being started")
