"""The gateway's process: a thread for each sensor, one status, one presence."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from functools import partial

from palpate.bus import Presence, Session, endpoints
from palpate.bus.topics import ELECTRODES, FIELD_TRUTH, POSE, TARE, WRENCH
from palpate.bus.zenoh_session import LOSSLESS_STALL_S
from palpate.config import LinkConfig
from palpate.errors import ConfigError, PalpateError, StreamTimeout
from palpate.health import Health, HealthReporter
from palpate.heartbeat import LIMIT_S, beat
from palpate.messages import ServiceRequest, ServiceState
from palpate.process import avoid_pauses
from palpate_gateway.clock.stamps import PacedStart, new_session_id
from palpate_gateway.clock.wall_clock import WallClock, wall_discipline
from palpate_gateway.condition.condition import RetareRules
from palpate_gateway.condition.stillness import StillLimits
from palpate_gateway.config import GatewayConfig, SensorConfig
from palpate_gateway.device import BusDevice, Device
from palpate_gateway.drivers import make_device
from palpate_gateway.kept_tare import KeptTare, KeptZero
from palpate_gateway.service.pipeline import Pipeline
from palpate_gateway.service.requests import with_caller
from palpate_gateway.service.sensor_key import ClaimedKey
from palpate_gateway.service.worker import SensorWorker
from palpate_gateway.wrench.device import WrenchDevice

_log = logging.getLogger(__name__)

SERVICE = "gateway"

_POLL_S = 0.2
_JOIN_S = 2.0
_ANSWER_S = 2.0
_SETTLE_S = 0.3
"""Wait between a consumer's presence and the first frame of a lossless replay [s]: its subscription
may arrive after its presence, and a frame before the subscription would be lost."""


def run(
    config: GatewayConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = SERVICE,
) -> None:
    """Serve the configured sensors until ``stop`` is set, or with ``exit_at_end`` until they end.

    Args:
        config: Sensors, pace, tare.
        link: How to join the bus.
        station: Name of the station.
        stop: Set it to end.
        instance: Name of this gateway among several.

    Raises:
        ConfigError: An unknown driver or option; before the bus is joined.
        LinkError: The bus cannot be joined.
        RecordingError: With ``exit_at_end``, a recording was damaged; all before it was published.
    """
    devices = _devices(config)
    for device in devices:
        if isinstance(device, BusDevice):
            device.join(link, station)
    sources: dict[tuple[str, str], str] = {}
    wall = WallClock()
    session_id = new_session_id()
    health = Health(SERVICE, instance)
    health.set_sensors(tuple(sensor.name for sensor in config.sensors))
    with Session.open(link, station=station) as session:
        workers: list[SensorWorker] = []
        readers = Counter(_source(sensor) for sensor in config.sensors)
        starts = {source: PacedStart(sensors) for source, sensors in readers.items()}
        fingers = sum(device.info.sensor_type is not None for device in devices)
        claims = session.claims(session_id=session_id, instance=instance, lease_s=link.lease_s)
        for sensor, device in zip(config.sensors, devices, strict=True):
            # A live source must never wait for a slow subscriber, whatever the pace of others.
            lossless = config.pace == "fast" and not device.info.live
            key = ClaimedKey(claims, sensor, sources)
            worker = SensorWorker(
                sensor.name,
                device,
                _pipeline(config, sensor.name, device, session_id),
                {
                    topic.name: session.publisher(topic, sensor=sensor.key_name, lossless=lossless)
                    for topic in (ELECTRODES, WRENCH, POSE, FIELD_TRUTH, TARE)
                },
                health,
                pace=config.pace,
                stop=stop,
                wall=wall,
                key=key,
                fingers=fingers,
                start=starts[_source(sensor)],
            )
            workers.append(worker)
            answer = partial(session.stream_queryable, sensor=sensor.name)
            if isinstance(device, WrenchDevice):  # without electrodes there is no baseline
                zero = with_caller(station, worker.answer_zero)
                key.answer_by(partial(answer, endpoints.ZERO, zero))
            elif sensor.of is None:  # else its finger answers such requests
                tare = with_caller(station, worker.answer_tare)
                key.answer_by(partial(answer, endpoints.TARE, tare))

        def caller_gone(caller: str, when_s: float) -> None:
            for worker in workers:
                worker.caller_gone(caller, when_s)

        session.watch_callers(caller_gone)
        refresh = partial(_refresh, health, workers, wall)
        presence = session.presence(SERVICE, instance=instance)
        with HealthReporter(session, health, refresh=refresh):
            try:
                _serve(config, session, workers, health, presence, stop, refresh)
            finally:
                if not all(worker.ended.is_set() for worker in workers):
                    health.set_state(ServiceState.STOPPING)
                stop.set()
                presence.not_ready()
                deadline_s = time.monotonic() + _JOIN_S
                for worker in workers:
                    worker.join(max(deadline_s - time.monotonic(), 0.0))
                refresh()


def _devices(config: GatewayConfig) -> list[Device]:
    devices: list[Device] = []
    at: dict[tuple[str, str], str] = {}
    for sensor in config.sensors:
        device = _device(sensor)
        devices.append(device)
        # Otherwise each would take the stream away from the other, for ever.
        other = at.setdefault((sensor.driver, device.address or sensor.name), sensor.name)
        if other != sensor.name:
            raise ConfigError(
                f"sensors {other!r} and {sensor.name!r} are both at {device.address}",
                remedy="give each its own address; if they are one sensor, leave one of them out",
            )
    return devices


def _device(sensor: SensorConfig) -> Device:
    device = make_device(sensor.driver, sensor.options, where=f"options of sensor {sensor.name!r}")
    if sensor.of is not None and device.info.sensor_type is not None:
        raise ConfigError(
            f"sensor {sensor.name!r} is of {sensor.of!r}, and a tactile sensor itself",
            remedy="`of` is for force/torque sensors and poses of the indenter: leave it out",
        )
    kept = KeptZero.of(sensor.name)
    if isinstance(device, WrenchDevice) and kept is not None:
        device.keep_zero(kept.keep, kept.find())
    return device


def _source(sensor: SensorConfig) -> tuple[str, str]:
    """What the sensors of one file have in common; a device has no path."""
    path = sensor.options.get("path")
    return sensor.driver, sensor.name if path is None else str(path)


def _pipeline(config: GatewayConfig, sensor: str, device: Device, session_id: int) -> Pipeline:
    again_s = config.retare_after_s
    return Pipeline(
        device.info,
        tare=config.tare,
        tare_frames=config.tare_frames,
        limits=StillLimits(config.tare_max_sd_counts, config.tare_max_pac_sd_counts),
        retare=None if again_s is None else RetareRules(again_s, config.retare_drift_counts),
        session_id=session_id,
        kept=KeptTare.of(sensor),
    )


def _serve(
    config: GatewayConfig,
    session: Session,
    workers: list[SensorWorker],
    health: Health,
    presence: Presence,
    stop: threading.Event,
    refresh: Callable[[], None],
) -> None:
    if config.wait_for and not _wait_for(config.wait_for, session, health, stop):
        return
    avoid_pauses()
    for worker in workers:
        worker.start()
    finished = False
    while not stop.is_set():
        for worker in workers:
            if worker.crash is not None:
                raise worker.crash
        _beat_for(workers)
        _update(health, workers, presence)
        if not finished and all(worker.ended.is_set() for worker in workers):
            finished = True
            refresh()
            _finish(health, workers)
            if config.exit_at_end:
                beat(config.linger_s + LIMIT_S)
                stop.wait(config.linger_s)
                if config.pace == "fast":
                    _await_readers(session, stop)
                for worker in workers:
                    if worker.error is not None:
                        raise worker.error
                return
        stop.wait(_POLL_S)


def _await_readers(session: Session, stop: threading.Event) -> None:
    """Wait until every process has read what was sent to it: a closed connection loses the rest.

    Connections keep order, so that whoever answers a question has read all before it.
    """
    until_s = time.monotonic() + LOSSLESS_STALL_S
    while not stop.is_set() and time.monotonic() < until_s:
        beat(_ANSWER_S + LIMIT_S)
        answers = session.query_all(endpoints.STATUS, ServiceRequest(), timeout_s=_ANSWER_S)
        if not any(isinstance(answer, StreamTimeout) for answer in answers):
            return


def _beat_for(workers: list[SensorWorker]) -> None:
    """Beat while the thread of every sensor goes on: one that hangs must not stay unnoticed."""
    if not any(worker.hangs() for worker in workers):
        beat()


def _update(health: Health, workers: list[SensorWorker], presence: Presence) -> None:
    """Ready while every sensor delivers or has ended."""
    if all(worker.ended.is_set() for worker in workers):
        return
    if all(worker.serving or worker.ended.is_set() for worker in workers):
        presence.ready()
        fine = all(worker.sound for worker in workers)
        if fine and health.state is not ServiceState.READY:
            health.set_state(ServiceState.READY, "all sensors deliver")
    else:
        presence.not_ready()


def _finish(health: Health, workers: list[SensorWorker]) -> None:
    """Every source has ended: report the result in the status."""
    frames = sum(worker.pipeline.counters["frames_published"] for worker in workers)
    failed = [worker for worker in workers if worker.error is not None]
    if failed:
        error = failed[0].error
        assert error is not None
        health.fail(error)
        return
    health.set_state(ServiceState.FINISHED, f"all sources have ended, {frames} frames published")
    _log.info("all sources have ended, %d frames published", frames)


def _refresh(health: Health, workers: list[SensorWorker], wall: WallClock) -> None:
    """Copy counters and gauges of the sensors to the status; of several, with a prefix."""
    for worker in workers:
        prefix = f"{worker.name}." if len(workers) > 1 else ""
        health.set_counts({prefix + name: value for name, value in worker.counters().items()})
        gauges = {prefix + name: measured for name, measured in worker.gauges().items()}
        health.set_gauges(worker.name, gauges)
    wall.look()
    health.set_counts({"wall_steps": wall.steps})
    kept = wall_discipline()
    if kept is not None:
        health.gauge("wall_synchronised", float(kept.synchronised))
        health.gauge("wall_error_s", kept.error_s)


def _wait_for(
    names: tuple[str, ...], session: Session, health: Health, stop: threading.Event
) -> bool:
    """Wait until each service is ready; False if stopped meanwhile."""
    health.set_state(ServiceState.STARTING, f"waiting for {', '.join(names)}")
    told_s = time.monotonic()
    while not stop.is_set():
        beat()
        try:
            ready = {item.service for item in session.alive() if item.ready}
        except PalpateError as error:
            health.fail(error, degraded=False)
            ready = set()
        missing = [name for name in names if name not in ready]
        if not missing:
            return not stop.wait(_SETTLE_S)
        if time.monotonic() - told_s > 5.0:
            told_s = time.monotonic()
            _log.info("waiting for %s to be ready", ", ".join(missing))
        stop.wait(_POLL_S)
    return False
