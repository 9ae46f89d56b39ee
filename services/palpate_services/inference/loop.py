"""What all estimating services share: from the bundle to the loop that publishes estimates.

::

    messages of a topic -> newest of each sensor -> estimate -> topic of the estimates
                                                 -> counter of the reason why there is none
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, NoReturn, TypeVar

import numpy as np

from palpate import clock
from palpate.admin import make_token, token_file
from palpate.bus import Delivery, Publisher, ReceivedMessage, Session, Subscriber, endpoints
from palpate.bus.claims import SETTLE_S
from palpate.bus.topics import Topic
from palpate.bus.zenoh_session import LOSSLESS_STALL_S
from palpate.codec import STAGE_TIMINGS
from palpate.config import LinkConfig
from palpate.errors import ConfigError, ErrorCode, RemoteError, WireError
from palpate.health import Health, HealthReporter
from palpate.heartbeat import LIMIT_S, beat
from palpate.messages import NO_TARE, Origin, ServiceState, StageTimings, Stamp
from palpate.process import avoid_pauses
from palpate_services.config import ElectrodesConfig, EstimatingConfig, ModelsConfig
from palpate_services.inference.estimates import AgeLimit, EstimateRefusal, Estimation, Sample
from palpate_services.inference.input_report import InputReport, StageGauges
from palpate_services.inference.model import BATCH_MOST, Runtime
from palpate_services.inference.remembered import RememberedFile
from palpate_services.inference.repository import Repository
from palpate_services.inference.served import ServedModels, show, take_commands
from palpate_services.inference.standby import Duty

_log = logging.getLogger(__name__)

M = TypeVar("M")
E = TypeVar("E")

Prepare = Callable[[Session, ServedModels, Health], Estimation[M, E]]
"""Declares the endpoints of a service, and returns how it makes estimates."""

SENSORS_MOST = 256
"""Sensors that one service answers; messages of more are counted as ``sensors_refused``."""

_TELL_PERIOD_NS = 200_000_000
_GAUGE_PERIOD_NS = 1_000_000_000
_FORGET_NS = 60_000_000_000  # a sensor that got no estimate for so long is forgotten
_WAIT_S = 0.1  # how long a bus without messages delays the next look at the stop event
_QUIET_S = 0.05  # a stopping service has drained when no message came for this long

# Counters of the subscriber that are reported under another name, and those that are not: the
# publisher below counts these itself.
_RENAMED = {"dropped": "dropped_newest_wins"}
_COUNTED_HERE = frozenset({"received", "delivered"})

_ERRORS: dict[EstimateRefusal, tuple[ErrorCode, str, str]] = {
    EstimateRefusal.UNTARED: (
        ErrorCode.INVALID_REQUEST,
        "the frame was taken before any tare",
        "tare the untouched sensor and send a later frame: palpate tare",
    ),
    EstimateRefusal.WRONG_TARE: (
        ErrorCode.INVALID_REQUEST,
        "the tare that the frame names is of another finger than the frame: their serial numbers "
        "or electrodes differ",
        "ask about the finger that the frame is of; after an exchange tare again: palpate tare",
    ),
    EstimateRefusal.INVALID_CHANNELS: (
        ErrorCode.INVALID_REQUEST,
        "at least one electrode of the frame is marked bad",
        "send another frame; check the sensor: palpate status",
    ),
    EstimateRefusal.WRONG_SENSOR: (
        ErrorCode.INVALID_REQUEST,
        "the served bundle was made for another type of sensor",
        "no bundle is made for this type yet: name the sensors to serve in the table of this "
        "service, sensors = [...]",
    ),
    EstimateRefusal.WRONG_MESH: (
        ErrorCode.WRONG_CONTRACT,
        "the field belongs to another mesh than the served bundle's",
        "serve the bundle of this mesh, or compute the field on the bundle's mesh",
    ),
    EstimateRefusal.NON_FINITE: (
        ErrorCode.INTERNAL,
        "the model has no finite output for this input",
        "serve another bundle, and report this one to its maker",
    ),
    EstimateRefusal.NO_MODEL: (
        ErrorCode.UNAVAILABLE,
        "no bundle serves this sensor",
        "load one: palpate model load NAME",
    ),
    EstimateRefusal.STALE: (
        ErrorCode.INVALID_REQUEST,
        "what comes is older than max_age_s",
        "look at the load of both hosts and at their clocks: palpate top, palpate status",
    ),
    EstimateRefusal.CLOCK_SKEW: (
        ErrorCode.INVALID_REQUEST,
        "what comes is stamped in the future, so that its age is not known",
        "synchronise the clocks of both hosts (docs/time.md); see link.wall_clock_error_s",
    ),
    EstimateRefusal.REPLAYED: (
        ErrorCode.INVALID_REQUEST,
        "what comes was replayed, and this service takes live and simulated frames only",
        "play it with `palpate replay`, or set accept_replayed in the table of this service",
    ),
    EstimateRefusal.TARE_UNKNOWN: (
        ErrorCode.NOT_FOUND,
        "no gateway knows the tare that the frame names",
        "check the sensor's name and that its gateway runs, or tare and send a later frame",
    ),
}


_REFUSED_HERE = frozenset(
    {
        EstimateRefusal.STALE,
        EstimateRefusal.CLOCK_SKEW,
        EstimateRefusal.TARE_UNKNOWN,
        EstimateRefusal.WRONG_SENSOR,
        EstimateRefusal.WRONG_MESH,
        EstimateRefusal.NO_MODEL,
    }
)
"""Reasons of this process or its host; by another one, a standby would not answer either."""


@dataclass(frozen=True, slots=True)
class ServiceRoute(Generic[M, E]):
    """From which topic to which topic a service, named like its task, estimates.

    ``received`` is the name of its counter of received messages.
    """

    service: str
    source: Topic[M]
    target: Topic[E]
    received: str


class RateLimit:
    """Lets the first message of each period pass, by the clock of the messages.

    The clock of this process would not do: a replay at any speed must give the same estimates.
    ``rate_hz`` limits the messages a second and sensor [Hz]; None = all pass.
    """

    def __init__(self, rate_hz: float | None) -> None:
        self._period_ns = None if rate_hz is None else max(1, round(1e9 / rate_hz))
        self._last: dict[str, int] = {}

    def reached(self, sensor: str, stamp: Stamp) -> bool:
        """Whether a message of this period was already answered."""
        if self._period_ns is None:
            return False
        return self._last.get(sensor) == stamp.monotonic_ns // self._period_ns

    def note(self, sensor: str, stamp: Stamp) -> None:
        """A message of this period was answered."""
        if self._period_ns is not None:
            self._last[sensor] = stamp.monotonic_ns // self._period_ns

    def forget(self, sensor: str) -> None:
        """A sensor is gone."""
        self._last.pop(sensor, None)


@dataclass(slots=True)
class _Taken(Generic[M]):
    """A message with its sample, and when [ns, monotonic] that was begun and done."""

    received: ReceivedMessage[M]
    sample: Sample
    taken_ns: int
    sampled_ns: int


def _stamp_of(received: ReceivedMessage[Any]) -> Stamp:
    assert received.stamp is not None, "every message of these topics has a stamp"
    return received.stamp


def arrival_age_s(stamp: Stamp, arrived_ns: int) -> float | None:
    """Time from a reading to an arrival on this host [s]; None where the stamp does not say.

    The stamp of a replay, or of another clock, says nothing of it.
    """
    if stamp.origin is Origin.REPLAYED or stamp.clock_id != clock.CLOCK_ID:
        return None
    return (arrived_ns - stamp.monotonic_ns) * 1e-9


class EstimatePublisher(Generic[M, E]):
    """Publishes an estimate for each message, or counts why there is none. Use from one thread.

    ``health`` gets gauges and troubles; ``models`` are the bundles and ``estimation`` how they are
    used; ``rate_hz`` limits the estimates a second and sensor [Hz], None = no limit. ``duty`` says
    which sensors it publishes for, and for which it stands by; None = all.
    """

    def __init__(
        self,
        route: ServiceRoute[M, E],
        session: Session,
        config: EstimatingConfig,
        health: Health,
        models: ServedModels,
        estimation: Estimation[M, E],
        *,
        rate_hz: float | None = None,
        duty: Duty | None = None,
    ) -> None:
        self._route = route
        self._duty = duty
        self._session = session
        self._health = health
        self._models = models
        self._estimation = estimation
        self._lossless = config.delivery == "every"
        self._turn_s = LIMIT_S + _longest_wait_s(config)
        self._sensors = frozenset(config.sensors)
        self._age_limit = AgeLimit(config, session.wall_clock_error_s)
        self._rate_limit = RateLimit(rate_hz)
        self._publishers: dict[str, Publisher[E]] = {}
        self._used: set[str] = set()
        self._answered: ReceivedMessage[M] | None = None
        self._counts: Counter[str] = Counter()
        self._exchanged = False
        self._input = InputReport(health, _ERRORS, partial(show, models, health))
        self._stages = StageGauges()
        self._latencies_ns: list[int] = []
        self._busy_ns = 0
        self._batches = self._batched = 0
        self._told_ns = self._gauged_ns = self._forgot_ns = time.monotonic_ns()

    def take(self, messages: Sequence[ReceivedMessage[M]]) -> None:
        """Publish the estimates of messages, or count why there are none.

        The model runs once for messages of different sensors that have the same bundle.
        """
        began_ns = time.monotonic_ns()
        ticks = (messages,) if len(messages) == 1 else _without_repetition(messages)
        for tick in ticks:
            samples: dict[Runtime, list[_Taken[M]]] = {}
            for received in tick:
                sensor = received.sensor
                if self._sensors and sensor not in self._sensors:
                    continue
                self._counts[self._route.received] += 1
                if len(self._publishers) >= SENSORS_MOST and sensor not in self._publishers:
                    self._counts["sensors_refused"] += 1
                    continue
                # One bundle makes all of an estimate, whichever is loaded meanwhile.
                runtime = self._models.of(sensor)
                taken_ns = time.monotonic_ns()
                sample = self._sample(received, runtime)
                if isinstance(sample, EstimateRefusal):
                    self._refuse(received, sample.value, runtime)
                elif runtime is not None and self._stands_by(sensor, runtime):
                    self._counts["standby"] += 1
                    self._input.answered(sensor)  # it would have been
                elif runtime is not None:
                    serial = getattr(received.message, "sensor_serial", "")
                    self._exchanged |= self._models.meet(sensor, serial)
                    taken = _Taken(received, sample, taken_ns, time.monotonic_ns())
                    samples.setdefault(runtime, []).append(taken)
                if len(messages) > 1:
                    beat(self._turn_s)
            for runtime, of_runtime in samples.items():
                self._run(runtime, of_runtime)
        beat(self._turn_s)
        if messages:
            self._health.worked()
            self._busy_ns += time.monotonic_ns() - began_ns

    def rehearse(self, last: ReceivedMessage[M]) -> None:
        """Make the estimate of the last message once more, and publish nothing."""
        runtime = self._models.of(last.sensor)
        if last is not self._answered or runtime is None:
            return
        sample = self._sample(last, runtime)
        if isinstance(sample, EstimateRefusal):
            return
        (outputs,) = runtime.run_all([sample.values])
        if outputs is not None:
            estimate = self._estimation.complete(last.message, sample, outputs, runtime)
            self._publishers[last.sensor].encode(estimate)
            STAGE_TIMINGS.encode(StageTimings(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))

    def _sample(
        self, received: ReceivedMessage[M], runtime: Runtime | None
    ) -> Sample | EstimateRefusal:
        """What the model gets of a message, or why it gets nothing."""
        stamp = _stamp_of(received)
        if (refusal := self._age_limit.refusal(stamp)) is not None:
            return refusal
        if self._rate_limit.reached(received.sensor, stamp):
            return EstimateRefusal.SKIPPED_RATE
        if runtime is None:
            return EstimateRefusal.NO_MODEL
        return self._estimation.sample(received.sensor, received.message, runtime)

    def _stands_by(self, sensor: str, runtime: Runtime) -> bool:
        """Whether another service publishes the estimates of a sensor, or may do so."""
        if self._duty is None:
            return False
        self._duty.take(sensor, runtime)
        return not self._duty.holds(sensor)

    def _run(self, runtime: Runtime, taken: Sequence[_Taken[M]]) -> None:
        """Run a model on samples, and publish the estimates or count why there are none."""
        self._batches += 1
        self._batched += len(taken)
        began_ns = time.monotonic_ns()
        outputs_of = runtime.run_all([one.sample.values for one in taken])
        infer_s = (time.monotonic_ns() - began_ns) * 1e-9
        for one, outputs in zip(taken, outputs_of, strict=True):
            received = one.received
            if outputs is None:
                self._refuse(received, EstimateRefusal.NON_FINITE.value, runtime)
                continue
            estimate = self._estimation.complete(received.message, one.sample, outputs, runtime)
            publisher = self._publisher(received.sensor)
            began_ns = time.monotonic_ns()
            try:
                payload = publisher.encode(estimate)
            except WireError as error:  # finite, and still not allowed by the message contract
                self._refuse(received, f"unpublishable_{error.reason}", runtime)
                continue
            encode_s = (time.monotonic_ns() - began_ns) * 1e-9
            stamp, arrived_ns = _stamp_of(received), received.received_monotonic_ns
            age_s = arrival_age_s(stamp, arrived_ns)
            waited_s = (one.taken_ns - arrived_ns) * 1e-9 - received.decode_s
            sample_s = (one.sampled_ns - one.taken_ns) * 1e-9
            timings = StageTimings(
                age_s, max(0.0, waited_s), received.decode_s, sample_s, infer_s, encode_s
            )
            publisher.put_payload(payload, attachment=STAGE_TIMINGS.encode(timings))
            self._answered = received
            self._stages.note(timings)
            self._rate_limit.note(received.sensor, stamp)
            self._counts["estimates_published"] += 1
            self._input.answered(received.sensor)
            # Latency counts from the reading, so that it holds the way through gateway and bus.
            # Only where the stamp says nothing of that it counts from the arrival.
            since_ns = arrived_ns if age_s is None else stamp.monotonic_ns
            self._latencies_ns.append(time.monotonic_ns() - since_ns)

    def _refuse(self, received: ReceivedMessage[M], reason: str, runtime: Runtime | None) -> None:
        """Count why there is no estimate, and remember the message for the log."""
        self._counts[reason] += 1
        self._input.refused(
            received.sensor,
            reason,
            _stamp_of(received),
            tare_id=getattr(received.message, "tare_id", NO_TARE),
            model="" if runtime is None else runtime.label,
        )

    def _publisher(self, sensor: str) -> Publisher[E]:
        publisher = self._publishers.get(sensor)
        if publisher is None:
            target = self._route.target
            publisher = self._session.publisher(target, sensor=sensor, lossless=self._lossless)
            self._publishers[sensor] = publisher
            self._health.set_sensors(tuple(sorted(self._publishers)))
        self._used.add(sensor)
        return publisher

    def _forget_silent(self) -> None:
        """Forget the sensors that got no estimate since the last call."""
        for sensor in [sensor for sensor in self._publishers if sensor not in self._used]:
            self._publishers.pop(sensor).close()
            self._rate_limit.forget(sensor)
            if self._duty is not None:
                self._duty.release(sensor)
            self._health.set_sensors(tuple(sorted(self._publishers)))
        self._used.clear()

    @property
    def counters(self) -> dict[str, int]:
        """What became of the messages, since the start; from any thread."""
        return dict(self._counts)

    def report(self, *, last: bool = False) -> None:
        """Tell health of refusals, and hand it the gauges, at their own periods; ``last`` = now."""
        now_ns = time.monotonic_ns()
        if not last and now_ns - self._told_ns >= _TELL_PERIOD_NS:
            self._told_ns = now_ns
            if self._exchanged:
                self._exchanged = False
                show(self._models, self._health)
            for sensor, reason in self._input.report().items():
                if self._duty is not None and reason in _REFUSED_HERE:
                    self._duty.release(sensor)  # a standby may be able to
        period_ns = now_ns - self._gauged_ns
        if last or period_ns >= _GAUGE_PERIOD_NS:
            self._gauged_ns = now_ns
            self._health.gauge("busy_ratio", self._busy_ns / max(period_ns, 1))
            self._busy_ns = 0
            if self._duty is not None and not last:
                self._duty.report()
            gauges = self._stages.take()
            if self._latencies_ns:
                p50, p99 = np.percentile(self._latencies_ns, (50, 99)) * 1e-9
                gauges["latency_p50_s"], gauges["latency_p99_s"] = float(p50), float(p99)
                self._latencies_ns = []
            if self._batches:
                gauges["batch_mean_samples"] = self._batched / self._batches
                self._batches = self._batched = 0
            # Those of a period without estimates are removed: old ones would pass as present.
            self._health.set_gauges("estimates", gauges)
            if now_ns - self._forgot_ns >= _FORGET_NS:
                self._forgot_ns = now_ns
                self._forget_silent()


def _without_repetition(
    messages: Sequence[ReceivedMessage[M]],
) -> Iterator[Sequence[ReceivedMessage[M]]]:
    """The messages in order, in parts in which no sensor comes twice.

    What is published of a sensor's message decides about its next one (``RateLimit``).
    """
    start, seen = 0, set[str]()
    for at, received in enumerate(messages):
        if received.sensor in seen:
            yield messages[start:at]
            start = at
            seen.clear()
        seen.add(received.sensor)
    yield messages[start:]


def reply(estimate: E | EstimateRefusal, health: Health) -> E:
    """The reply to a request for one estimate.

    Requests are counted as ``asked``, refused ones also as ``asked_<reason>``.

    Raises:
        RemoteError: There is none; it says why and what to do.
    """
    if isinstance(estimate, EstimateRefusal):
        refuse(estimate, health)
    health.count("asked")
    return estimate


def refuse(reason: EstimateRefusal, health: Health) -> NoReturn:
    """Count a request that gets no estimate, and raise the ``RemoteError`` that says why."""
    health.count("asked")
    health.count(f"asked_{reason.value}")
    code, problem, remedy = _ERRORS[reason]
    raise RemoteError(problem, remedy=remedy, code=code)


def serve(
    route: ServiceRoute[M, E],
    config: EstimatingConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str | None,
    prepare: Prepare[M, E],
    kept: ModelsConfig | None = None,
    rate_hz: float | None = None,
) -> None:
    """Serve until ``stop`` is set; then withdraw, answer what has already come, and leave.

    ``route`` says from which topic to which; ``prepare`` returns how estimates are made, and may
    declare endpoints of the service; ``rate_hz`` limits the estimates a second and sensor [Hz]. The
    other arguments and the errors are those of ``run_estimating``.
    """
    instance = instance or route.service
    # Before the bus is joined: no message may wait while the model loads and warms up.
    models, token = _models(route.service, config, kept, station, instance)
    health = Health(route.service, instance)
    with Session.open(link, station=station) as session:
        presence = session.presence(route.service, instance=instance)
        session.queryable(
            endpoints.MODEL, lambda _: models.metadata(), service=route.service, instance=instance
        )
        take_commands(session, models, health, token)
        estimation = prepare(session, models, health)
        # A lossless replay is one run with one service, which must miss no frame.
        duty = None
        if config.delivery != "every":
            duty = Duty(session, route.target.name, health, models, lease_s=link.lease_s)
        publisher = EstimatePublisher(
            route, session, config, health, models, estimation, rate_hz=rate_hz, duty=duty
        )
        messages = session.subscriber(
            route.source,
            sensor=config.sensors[0] if len(config.sensors) == 1 else "*",
            delivery=Delivery(config.delivery),
            depth=config.keep_newest,
            sensors=config.sensors if len(config.sensors) > 1 else (),
            # A lossless replay takes all: its frames may come before the claim is known.
            announced=not (config.sensors or config.unannounced or config.delivery == "every"),
            rehearse=publisher.rehearse,
        )
        refresh = partial(_refresh, messages, publisher, models, health)
        with HealthReporter(session, health, refresh=refresh):
            show(models, health)
            avoid_pauses()
            if duty is not None:
                stop.wait(SETTLE_S)  # by then the claims of others are known
            # Ready only now: clients that wait for readiness must find subscriptions and endpoints.
            presence.ready()
            while not stop.is_set():
                publisher.take(
                    messages.next_batch(_WAIT_S, most=BATCH_MOST, more_s=config.batch_wait_s)
                )
                publisher.report()
            # Withdrawn first, so that no client relies on this service while it drains.
            presence.not_ready()
            health.set_state(ServiceState.STOPPING, "draining")
            # Of a live stream the newest that wait; of a replay all that are still on their way.
            quiet_s = _QUIET_S if config.delivery == "every" else 0.0
            deadline = time.monotonic() + config.drain_s
            while time.monotonic() < deadline and (left := messages.next_batch(quiet_s)):
                publisher.take(left)
            messages.close()
            publisher.report(last=True)
            if duty is not None:
                duty.close()


def _models(
    task: str, config: EstimatingConfig, kept: ModelsConfig | None, station: str, instance: str
) -> tuple[ServedModels, bytes | None]:
    """The bundles of a service, and the token of those who may change them."""
    if kept is None:
        return ServedModels(task, config, Repository(None)), None
    file = RememberedFile(kept.served_file(station, task, instance))
    models = ServedModels(task, config, Repository.of_config(kept), file)
    try:
        return models, make_token(token_file(kept.memory_folder, station))
    except ConfigError as error:
        _log.warning("no commands are taken: %s", error)
        return models, None


def _longest_wait_s(config: EstimatingConfig) -> float:
    """How long the loop may wait for others before it has answered one message [s]."""
    tare_s = config.tare_timeout_s if isinstance(config, ElectrodesConfig) else 0.0
    return tare_s + (LOSSLESS_STALL_S if config.delivery == "every" else 0.0)


def _refresh(
    messages: Subscriber[M],
    publisher: EstimatePublisher[M, E],
    models: ServedModels,
    health: Health,
) -> None:
    """Copy what subscriber and publisher counted, and what is served.

    Rates are differences of counters by the times of two statuses: none may be older than its
    status.
    """
    health.set_counts(publisher.counters)
    health.set_models(models.labels())
    health.gauge("queue_messages", float(messages.waiting))
    if models.problem is not None:
        health.fail(models.problem)
    health.set_counts(
        {
            _RENAMED.get(name, name): count
            for name, count in messages.counters.items()
            if name not in _COUNTED_HERE
        }
    )
