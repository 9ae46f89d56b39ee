"""States that do not flap: bad news at once, the end of a trouble when it has stayed away."""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from itertools import pairwise

import pytest

from palpate import health as health_module
from palpate.bus import Delivery, Session
from palpate.bus.topics import STATUS
from palpate.codec import STATUS as STATUS_CODEC
from palpate.config import LinkConfig
from palpate.errors import DeviceTimeout, StreamTimeout
from palpate.health import Health, HealthReporter
from palpate.messages import SensorState, ServiceState, SupervisedProcess
from palpate.process import ProcessUsage

PATIENCE_S = 20.0
SILENT = DeviceTimeout("sensor 'finger' is lost: silent for 40 ms", remedy="check its cable")


class Time:
    """A monotonic clock that goes on by hand."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(1e9 * self.now_s)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Time:
    clock = Time()
    monkeypatch.setattr(health_module, "time", clock)
    return clock


def test_a_failure_is_told_at_once_and_recovery_takes_its_time(clock: Time) -> None:
    health = Health("gateway", "gateway")
    health.set_state(ServiceState.READY, "all sensors deliver")
    health.changed.clear()
    health.fail(SILENT)
    assert (health.state, health.changed.is_set()) == (ServiceState.DEGRADED, True)
    health.set_state(ServiceState.READY, "all sensors deliver")
    assert health.state is ServiceState.DEGRADED
    due_s = health.settle()
    assert due_s is not None
    clock.now_s += due_s + 1e-6
    status = health.status()
    assert (status.state, status.message) == (ServiceState.READY, "all sensors deliver")
    assert health.settle() is None


def test_every_failure_puts_recovery_off(clock: Time) -> None:
    health = Health("gateway", "gateway")
    for _ in range(10):
        health.fail(SILENT)
        health.set_state(ServiceState.READY)
        clock.now_s += 0.9 * health_module.RECOVERY_S
        assert health.state is ServiceState.DEGRADED
    clock.now_s += 0.2 * health_module.RECOVERY_S
    assert health.state is ServiceState.READY


def test_the_same_failure_again_is_no_news(clock: Time) -> None:
    health = Health("gateway", "gateway")
    health.fail(SILENT)
    health.changed.clear()
    health.fail(SILENT)
    assert not health.changed.is_set()
    health.fail(DeviceTimeout("sensor 'thumb' is lost", remedy="check its cable"))
    assert health.changed.is_set()


def test_an_error_that_does_not_degrade_is_shown_when_the_trouble_is_over(clock: Time) -> None:
    health = Health("features", "features")
    health.fail(SILENT)
    health.fail(DeviceTimeout("'thumb' is of another type", remedy="name it"), degraded=False)
    shown = health.status()
    assert shown.last_error is not None
    assert (shown.message, shown.last_error.message) == (SILENT.problem, SILENT.problem)
    health.set_state(ServiceState.READY, "serves")
    clock.now_s += health_module.RECOVERY_S + 1e-6
    shown = health.status()
    assert shown.last_error is not None
    assert (shown.message, shown.last_error.message) == ("serves", "'thumb' is of another type")


def test_stopping_waits_for_nothing(clock: Time) -> None:
    health = Health("gateway", "gateway")
    health.fail(SILENT)
    health.set_state(ServiceState.READY)
    health.set_state(ServiceState.STOPPING, "draining")
    clock.now_s += 10.0
    assert health.state is ServiceState.STOPPING


@pytest.mark.parametrize("fails", [False, True])
def test_what_stops_is_not_ready_again(clock: Time, fails: bool) -> None:
    """A command that ends meanwhile says what serves, or a disk takes records again."""
    health = Health("features", "features")
    health.set_state(ServiceState.STOPPING, "draining")
    if fails:
        health.changed.clear()
        health.fail(SILENT)
        assert health.changed.is_set()
        error = health.status().last_error
        assert error is not None
        assert error.message == SILENT.problem
    health.set_state(ServiceState.READY, "serves force 3")
    clock.now_s += health_module.RECOVERY_S + 1e-6
    told = SILENT.problem if fails else "draining"
    assert (health.state, health.status().message) == (ServiceState.STOPPING, told)


def test_a_lost_sensor_is_live_when_it_has_delivered_for_a_while(clock: Time) -> None:
    health = Health("gateway", "gateway")

    def shown() -> SensorState:
        return health.status().sensor_states[0].state

    health.set_sensor_state("finger", SensorState.LIVE)
    for _ in range(5):
        health.set_sensor_state("finger", SensorState.LOST)
        assert shown() is SensorState.LOST
        health.set_sensor_state("finger", SensorState.LIVE)
        clock.now_s += 0.9 * health_module.SENSOR_RECOVERY_S
        assert shown() is SensorState.LOST
    back_ns = clock.monotonic_ns()
    health.set_sensor_state("finger", SensorState.LOST)
    health.set_sensor_state("finger", SensorState.LIVE)
    clock.now_s += 0.1
    health.set_sensor_state("finger", SensorState.LIVE)
    clock.now_s += health_module.SENSOR_RECOVERY_S
    assert shown() is SensorState.LIVE
    assert health.status().sensor_states[0].since_monotonic_ns == back_ns
    health.set_sensor_state("finger", SensorState.LOST)
    health.set_sensor_state("finger", SensorState.ENDED)
    assert shown() is SensorState.ENDED


def test_the_end_of_a_trouble_is_told_though_the_reporter_waits(link: LinkConfig) -> None:
    """Reports come once an hour here; the troubles begin to end long after the last one."""
    health = Health("gateway", "gateway")
    with Session.open(link) as session:
        states = session.subscriber(STATUS, delivery=Delivery.QUEUE)
        with HealthReporter(session, health, period_s=3600.0):
            health.set_sensor_state("finger", SensorState.LOST)
            health.fail(SILENT)
            while states.next(PATIENCE_S).message.last_error is None:
                pass
            time.sleep(0.3)
            health.set_sensor_state("finger", SensorState.LIVE)
            while states.next(PATIENCE_S).message.sensor_states[0].state is SensorState.LOST:
                pass
            time.sleep(0.3)
            health.set_state(ServiceState.READY)
            while states.next(PATIENCE_S).message.state is not ServiceState.READY:
                pass


def test_a_trouble_that_often_begins_to_end_hardly_wakes_the_reporter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each time it did, a loaded service had no time left for frames."""
    health, begun = Health("features", "features"), 200
    health.fail(SILENT)
    health.changed.clear()
    settled, settle = [], health.settle

    def counted() -> float | None:
        settled.append(1)
        return settle()

    monkeypatch.setattr(health, "settle", counted)
    waiting = threading.Thread(target=health.await_change, args=(PATIENCE_S,))
    waiting.start()
    for _ in range(begun):
        health.set_state(ServiceState.READY)
        time.sleep(1e-3)
        health.fail(SILENT)
    health.set_state(ServiceState.READY)
    waiting.join(PATIENCE_S)
    assert not waiting.is_alive()
    assert health.status().state is ServiceState.READY
    assert len(settled) < begun / 10


def test_a_station_that_flaps_does_not_flood_the_bus(link: LinkConfig) -> None:
    """A sensor with 40 ms of jitter: its state changed 36 times a second."""
    health = Health("gateway", "gateway")
    stop = threading.Event()

    def flap() -> None:
        while not stop.wait(0.01):
            health.set_sensor_state("finger", SensorState.LOST, message="silent for 40 ms")
            health.fail(DeviceTimeout(f"silent: {time.monotonic_ns()}", remedy="check its cable"))
            health.set_sensor_state("finger", SensorState.LIVE)
            health.set_state(ServiceState.READY)

    with Session.open(link) as session, HealthReporter(session, health, period_s=3600.0):
        states = session.subscriber(STATUS, delivery=Delivery.QUEUE)
        flapping = threading.Thread(target=flap)
        flapping.start()
        began_s = time.monotonic()
        time.sleep(2.0)
        stop.set()
        flapping.join()
        lasted_s = time.monotonic() - began_s
        told = [states.next(PATIENCE_S).message]
        while told[-1].state is not ServiceState.READY:
            told.append(states.next(PATIENCE_S).message)
        with pytest.raises(StreamTimeout):
            states.next(0.3)
    sensors = [one.sensor_states[0].state for one in told if one.sensor_states]
    changes = sum(a is not b for a, b in pairwise(sensors))
    assert (sensors[0], sensors[-1]) == (SensorState.LOST, SensorState.LIVE)
    assert changes == 1, "lost at once, live when it stays live, and nothing between"
    # docs/operations.md promises five, then five a second while it flaps. Then come the ends of
    # both troubles, and one that was on its way.
    assert len(told) <= 5 + 5.0 * lasted_s + 3


def test_a_status_names_processes_and_models() -> None:
    health = Health("supervisor", "supervisor")
    health.set_processes([SupervisedProcess("features", "left", "backoff", 0, 3, 1.5)])
    health.set_models(["features-twin:1"])
    status = health.status()
    assert STATUS_CODEC.decode(STATUS_CODEC.encode(status)) == status


def test_a_process_tells_what_it_uses() -> None:
    usage = ProcessUsage()
    before = usage.gauges()
    assert before["process_rss_bytes"] > 1e6
    assert before["process_threads"] >= 1
    assert before["process_open_files"] >= 1
    deadline = time.monotonic() + PATIENCE_S
    while (share := usage.gauges().get("process_cpu_ratio", 0.0)) == 0.0:
        sum(range(100_000))
        assert time.monotonic() < deadline
    assert share <= (os.cpu_count() or 1) * 1.5
    assert ProcessUsage(2**22 + 5).gauges() == {}, "there is no such process"


def test_a_regular_report_waits_for_the_lull_after_a_message(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(health_module, "_LULL_MOST_S", PATIENCE_S)
    health = Health("features", "features")
    health.worked()  # of a message before: its lull may be over
    order: list[str] = []

    def wait() -> None:
        health.await_lull()
        order.append("lull")

    waiting = threading.Thread(target=wait)
    waiting.start()
    waiting.join(0.1)
    order.append("message")
    health.worked()
    waiting.join(PATIENCE_S)
    assert order == ["message", "lull"]


def test_without_messages_no_report_waits_for_ever(link: LinkConfig) -> None:
    health = Health("features", "features")
    with Session.open(link) as session, HealthReporter(session, health, period_s=0.01):
        states = session.subscriber(STATUS, delivery=Delivery.QUEUE)
        for _ in range(3):
            states.next(PATIENCE_S)


def test_a_defect_in_one_report_does_not_end_the_reports(
    link: LinkConfig, caplog: pytest.LogCaptureFixture
) -> None:
    reports = 0

    def refresh() -> None:
        nonlocal reports
        reports += 1
        if reports == 2:
            raise RuntimeError("dictionary changed size during iteration")

    health = Health("features", "features")
    with (
        Session.open(link) as session,
        HealthReporter(session, health, period_s=0.01, refresh=refresh),
    ):
        states = session.subscriber(STATUS, delivery=Delivery.QUEUE)
        while reports < 3:
            states.next(PATIENCE_S)
    assert "changed size" in caplog.text


def test_a_defect_in_the_last_report_does_not_hinder_the_end(
    link: LinkConfig, caplog: pytest.LogCaptureFixture
) -> None:
    ends = threading.Event()

    def refresh() -> None:
        if ends.is_set():
            raise RuntimeError("dictionary changed size during iteration")

    with Session.open(link) as session:
        reporter = HealthReporter(session, Health("features", "features"), refresh=refresh)
        ends.set()
        reporter.close()
    assert "last status not published" in caplog.text


def test_gauges_that_a_source_has_no_more_are_gone() -> None:
    health = Health("gateway", "gateway")
    health.gauge("wall_error_s", 0.1)
    health.set_gauges("thumb", {"thumb.a": 1.0, "thumb.b": 2.0})
    health.set_gauges("ring", {"ring.a": 3.0})
    health.set_gauges("thumb", {"thumb.b": 4.0})
    told = dict(health.status().gauges)
    assert {k: v for k, v in told.items() if not k.startswith("process_")} == {
        "wall_error_s": 0.1, "thumb.b": 4.0, "ring.a": 3.0,
    }  # fmt: skip


def test_a_gauge_that_measures_nothing_is_left_out_and_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    health = Health("gateway", "gateway")
    health.gauge("wall_error_s", 0.1)
    with caplog.at_level(logging.WARNING):
        for value in (math.nan, math.inf):
            health.gauge("wall_error_s", value)
        health.set_gauges("thumb", {"thumb.a": 1.0, "thumb.b": -math.inf})
    told = health.status()
    assert STATUS_CODEC.decode(STATUS_CODEC.encode(told)) == told
    assert told.gauges["thumb.a"] == 1.0
    assert not {"wall_error_s", "thumb.b"} & told.gauges.keys()
    assert told.counters == {"gauges_not_finite": 3}
    assert [one.getMessage().split()[1] for one in caplog.records] == ["wall_error_s", "thumb.b"]
    health.gauge("wall_error_s", 0.2)
    assert health.status().gauges["wall_error_s"] == 0.2
