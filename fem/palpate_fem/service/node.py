"""The finite-element service: requests in, converged steps out as they come.

A request is checked, then waits for one of a few worker processes or for a slot on a GPU. It always
gets an answer: its steps and how it ended, or a typed error.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from palpate import __version__
from palpate.bus import Presence, QueryAnswer, SensorClaims, Session, endpoints
from palpate.bus.presence import GoneCallers
from palpate.bus.queryable import Queryable
from palpate.bus.topics import SIMULATION_PROGRESS, caller_key, duty_root
from palpate.config import LinkConfig
from palpate.errors import (
    ClaimedElsewhere,
    ConfigError,
    ErrorCode,
    PalpateError,
    SimulationError,
    WireError,
)
from palpate.health import Health, HealthReporter
from palpate.heartbeat import beat
from palpate.messages import (
    ServiceState,
    SimulationCancelReply,
    SimulationCancelRequest,
    SimulationReply,
    SimulationRequest,
)
from palpate.process import Closing
from palpate_fem.config import FingertipParameters
from palpate_fem.service.config import DEFAULT_FACTORY, FemConfig
from palpate_fem.service.device_pool import DevicePool
from palpate_fem.service.device_process import wanted_device
from palpate_fem.service.fingertips import load_factory, without_friction
from palpate_fem.service.jobs import JobEnded, JobEvent, JobFailed, WorkerSetup
from palpate_fem.service.pool import WorkerPool
from palpate_fem.service.replies import ActiveSimulation, EventOutbox
from palpate_fem.service.requests import job_of
from palpate_fem.store.content import StoredFingertip

SERVICE = "fem"

_POLL_S = 0.1
_CLAIM_S = 1.0
"""A key that is free is claimed within this time [s]."""

_CLOSE_S = 5.0
"""Longest time that callers may take to receive how their simulations ended, at the end [s]."""

_FINGERTIPS_KNOWN = 16
_REFUSED = (ErrorCode.INVALID_REQUEST, ErrorCode.RESOURCE_EXHAUSTED, ErrorCode.UNAVAILABLE)


class SimulationService(Closing):
    """Answers simulation requests with a pool of workers, and with a device if there is one.

    Args:
        session: The bus.
        config: What is served.
        default: Parameters where a request gives none.
        health: Counts requests and results.
        device: Solves many requests at once; None = workers alone.
    """

    def __init__(
        self,
        session: Session,
        config: FemConfig,
        default: FingertipParameters,
        health: Health,
        device: str | None,
    ) -> None:
        self._station = session.station
        self._config = config
        self._default = default
        self._health = health
        self._lock = threading.RLock()  # to cancel a job ends it at once if it waits
        self._active: dict[str, ActiveSimulation] = {}
        self._outboxes: list[EventOutbox] = []
        self._gone = GoneCallers()
        self._fingertips: OrderedDict[FingertipParameters, StoredFingertip] = OrderedDict()
        self._progress = session.publisher(SIMULATION_PROGRESS, sensor=config.sensor)
        self.pool = _pool_of(config, default, device, self._remember)

    def simulate(self, request: SimulationRequest, answer: QueryAnswer[SimulationReply]) -> None:
        """Accept a request; a thread of its own sends the answer.

        Raises:
            ConfigError: The request is refused; says why.
            RemoteError: No place is free.
        """
        self._health.count("requests_received")
        try:
            with self._lock:
                known = dict(self._fingertips)
            job = job_of(request, self._config, self._default, known)
            active = ActiveSimulation(request, answer, self._progress)
            with self._lock:
                if request.request_id in self._active:
                    raise ConfigError(
                        f"request_id {request.request_id!r} is in use by a simulation that waits "
                        "or runs",
                        remedy="choose another, e.g. uuid.uuid4().hex",
                    )
                self._active[request.request_id] = active
            outbox: EventOutbox | None = None
            try:
                outbox = EventOutbox(lambda event: self._pass_on(active, event))
                self.pool.submit(job, partial(self._on_event, active, outbox))
            except BaseException:
                if outbox is not None:
                    outbox.drop()
                self._forget(active)
                raise
            with self._lock:
                self._outboxes = [one for one in self._outboxes if one.is_open] + [outbox]
            key = caller_key(self._station, request.request_id)
            if (gone_s := self._gone.since(key)) is not None:  # while the question waited
                self.caller_gone(key, gone_s)
        except PalpateError as error:
            if error.code in _REFUSED:
                self._health.count(f"requests_refused_{error.code.name.lower()}")
            raise

    def cancel(self, request: SimulationCancelRequest) -> SimulationCancelReply:
        """Stop a simulation, no matter who requested it."""
        return SimulationCancelReply(self.pool.cancel(request.request_id))

    def caller_gone(self, key: str, when_s: float) -> None:
        """Stop the simulations of a caller that has left.

        Args:
            key: The ``caller_key`` that vanished.
            when_s: When it vanished [s, monotonic]; a request with the same id that arrives later
                is another call.
        """
        self._gone.add(key, when_s)
        with self._lock:
            left = [
                active
                for name, active in self._active.items()
                if active.answer.arrived_ns * 1e-9 <= when_s
                and caller_key(self._station, name) == key
            ]
        for active in left:
            if self._stop(active):
                self._health.count("callers_gone")

    def refresh_health(self) -> None:
        """Copy the pool's numbers into the health report."""
        self._health.gauge("busy_workers", self.pool.busy)
        self._health.gauge("ready_workers", self.pool.ready)
        self._health.gauge("waiting_requests", self.pool.waiting)
        self._health.set_counts(self.pool.counts)

    def close(self) -> None:
        """Answer whatever waits or runs with UNAVAILABLE, and end the workers."""
        self.pool.close()
        end_s = time.monotonic() + _CLOSE_S
        with self._lock:
            outboxes = self._outboxes
        for outbox in outboxes:
            outbox.join(max(0.0, end_s - time.monotonic()))

    def _on_event(self, active: ActiveSimulation, outbox: EventOutbox, event: JobEvent) -> None:
        """Take an event of a job, in a thread of the pool that serves others, too."""
        # Forgotten before the last reply, so that the caller may use the same request_id again.
        if isinstance(event, JobEnded | JobFailed):
            self._forget(active)
        if not outbox.put(event):
            self._health.count("callers_too_slow")
            self._stop(active)

    def _pass_on(self, active: ActiveSimulation, event: JobEvent) -> None:
        """Send what an event means, in the thread of its outbox."""
        try:
            active.on_event(event)
        except WireError as error:  # a result that the contract does not allow
            ours = SimulationError(
                f"the result cannot be sent: {error.problem}",
                remedy="the solver went wrong: report it with this request",
            )
            active.answer.fail(ours)
            self._stop(active)
            self._health.fail(ours, degraded=False)
        if isinstance(event, JobEnded):
            self._health.count(f"simulations_{event.outcome.name.lower()}")
            self._health.count("steps_sent", active.steps_done)
            self._health.gauge("last_simulation_s", active.elapsed_s)
        elif isinstance(event, JobFailed):
            self._health.count("simulations_failed")
            self._health.fail(event.error(), degraded=False)

    def _stop(self, active: ActiveSimulation) -> bool:
        """Cancel the job of a request, and not of a later one with its id; whether it was there."""
        name = active.request.request_id
        with self._lock:
            return self._active.get(name) is active and self.pool.cancel(name)

    def _forget(self, active: ActiveSimulation) -> None:
        with self._lock:
            self._active.pop(active.request.request_id, None)

    def _remember(self, fingertip: StoredFingertip) -> None:
        """Keep a fingertip, so that later requests can be checked against its skin at once."""
        key = without_friction(fingertip.parameters)
        with self._lock:
            self._fingertips.pop(key, None)
            self._fingertips[key] = fingertip
            while len(self._fingertips) > _FINGERTIPS_KNOWN:
                self._fingertips.popitem(last=False)


def _pool_of(
    config: FemConfig,
    default: FingertipParameters,
    device: str | None,
    on_fingertip: Callable[[StoredFingertip], None],
) -> WorkerPool | DevicePool:
    """The pool of a configuration; it starts its processes.

    Args:
        config: Numbers, limits, and how fingertips are made.
        default: Parameters of the warm fingertip.
        device: Device in front of the workers; None = workers alone.
        on_fingertip: Called with every fingertip that a process has built.
    """
    setup = WorkerSetup(config.factory, config.options, default, config.keep)
    threads = config.threads_each()
    workers = WorkerPool(
        setup,
        workers=config.workers,
        threads=threads,
        waiting=config.waiting,
        grace_s=config.grace_s,
        on_fingertip=on_fingertip,
    )
    if device is None:
        return workers
    return DevicePool(
        setup,
        device,
        workers,
        slots=config.slots,
        waiting=config.waiting,
        threads=threads,
        grace_s=config.grace_s,
        on_fingertip=on_fingertip,
    )


def run(
    config: FemConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = SERVICE,
    on_ready: Callable[[], None] | None = None,
    on_refusal: Callable[[ClaimedElsewhere], None] | None = None,
) -> None:
    """Serve until ``stop`` is set; then answer what is left with UNAVAILABLE, and end.

    Args:
        config: What is served, and by how many workers.
        link: How to join the bus.
        station: The station to serve.
        stop: Set it to end.
        instance: Name of this process among several of its kind.
        on_ready: Called once, when it answers and a worker waits for requests.
        on_refusal: Called with why it does not answer, as another service does that differs.

    Raises:
        ConfigError: A parameter is out of range, or there is no such device.
        LinkError: The bus cannot be joined.
        RemoteError: The workers do not start; says why.
    """
    default, device = config.fingertip.parameters(), wanted_device(config.device)
    health = Health(SERVICE, instance)
    health.set_sensors((config.sensor,))
    with Session.open(link, station=station) as session:
        presence = session.presence(SERVICE, instance=instance)
        claims = session.claims(
            instance=instance, lease_s=link.lease_s, root=duty_root("simulate"), shared=True
        )
        claims.want(config.sensor, answers_digest(config))
        with (
            SimulationService(session, config, default, health, device) as service,
            HealthReporter(session, health, refresh=service.refresh_health),
            _Doors(session, claims, service, config, instance) as doors,
        ):
            session.watch_callers(service.caller_gone)
            session.queryable(endpoints.CANCEL_SIMULATION, service.cancel, sensor=config.sensor)
            health.set_state(ServiceState.STARTING, "the first fingertip is being pressurised")
            claims.wait(config.sensor, _CLAIM_S)
            try:
                _serve(service.pool, health, presence, stop, doors, on_ready, on_refusal)
            finally:
                presence.not_ready()
                health.set_state(ServiceState.STOPPING)


def answers_digest(config: FemConfig) -> str:
    """Digest of all that the answers of a service depend on beside the request, in hex."""
    told = {
        "version": __version__,
        "factory": config.factory,
        "options": _all_options(config),
        "fingertip": asdict(config.fingertip.parameters()),
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()


def _all_options(config: FemConfig) -> dict[str, Any]:
    """Arguments of the factory, those at their defaults included."""
    try:
        bound = inspect.signature(load_factory(config.factory)).bind(**config.options)
        bound.apply_defaults()
        if config.factory == DEFAULT_FACTORY:
            from palpate_fem.mesh.nvlabs import files_digest
            from palpate_fem.service.biotac import PARAMETRIC  # with all of the solver

            mesh = bound.arguments["mesh"]
            if mesh != PARAMETRIC:
                # A replica may have the same files elsewhere, or others in a folder of that name.
                bound.arguments["mesh"] = files_digest(Path(mesh))
    except (ConfigError, TypeError):  # the workers say what is wrong with it
        return config.options
    return bound.arguments


class _Doors(Closing):
    """The keys at which a service is asked, while no replica that would answer otherwise has them.

    Those are the key that all replicas share, and one of its own, by which callers choose.
    """

    def __init__(
        self,
        session: Session,
        claims: SensorClaims,
        service: SimulationService,
        config: FemConfig,
        instance: str,
    ) -> None:
        self._session, self._claims, self._service = session, claims, service
        self._sensor, self._instance = config.sensor, instance
        # The pool refuses what is too much, and says when to ask again; the door must not be
        # narrower, for many robots may ask in the same instant: as many as run and wait on a
        # device, and with the workers.
        self._capacity = max(16, 2 * config.waiting + config.slots + config.workers)
        self._open: list[Queryable] = []

    def check(self) -> ClaimedElsewhere | None:
        """Open or close them; why they are closed, if they are. Call it often."""
        holds = self._claims.holds(self._sensor)
        if holds and not self._open:
            simulate, name = self._service.simulate, self._instance
            self._open = [
                self._session.stream_queryable(
                    endpoints.SIMULATE, simulate, sensor=self._sensor, capacity=self._capacity
                ),
                self._session.stream_queryable(
                    endpoints.SIMULATE_AT,
                    simulate,
                    service=SERVICE,
                    instance=name,
                    capacity=self._capacity,
                ),
            ]
        elif not holds:
            self.close()
        return None if holds else self._claims.refusal(self._sensor)

    @property
    def are_open(self) -> bool:
        """Whether callers find it."""
        return bool(self._open)

    def close(self) -> None:
        """Close them; what was accepted is still answered."""
        doors, self._open = self._open, []
        for door in doors:
            door.close()


def _serve(
    pool: WorkerPool | DevicePool,
    health: Health,
    presence: Presence,
    stop: threading.Event,
    doors: _Doors,
    on_ready: Callable[[], None] | None,
    on_refusal: Callable[[ClaimedElsewhere], None] | None,
) -> None:
    """Show as ready while a worker is; requests that come earlier wait for one.

    Raises:
        RemoteError: No worker will ever be ready.
    """
    told: tuple[ServiceState, str] | None = None
    while not stop.wait(_POLL_S):
        if not pool.hangs():
            beat()
        if pool.broken is not None:
            raise pool.broken
        if (refusal := doors.check()) is not None:
            presence.not_ready()
            found = ServiceState.DEGRADED, refusal.problem
            if found != told and on_refusal is not None:
                on_refusal(refusal)
            told = found
            health.fail(refusal)
            continue
        if pool.ready:
            presence.ready()
            if on_ready is not None and doors.are_open:
                on_ready()
                on_ready = None
            trouble = pool.trouble
            state = ServiceState.DEGRADED if trouble else ServiceState.READY
            found = state, trouble or pool.serves
        elif told is None:
            continue
        else:
            presence.not_ready()
            found = ServiceState.DEGRADED, "no worker is left; they are being started"
        if found != told:
            told = found
            health.set_state(*found)
