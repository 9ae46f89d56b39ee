"""What a gateway says of its sensors, with emulated ones that fail: on a real bus over loopback."""

from __future__ import annotations

import contextlib
import json
import random
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import pytest

from palpate.bus import Delivery
from palpate.bus.topics import STATUS
from palpate.client.estimates import ask_tare
from palpate.errors import RemoteError, StreamTimeout
from palpate.health import Health, HealthReporter
from palpate.messages import (
    ChannelFault,
    FaultKind,
    SensorState,
    SensorStatus,
    ServiceState,
    Status,
)
from palpate_deploy.station.status import show_status
from palpate_gateway.emulators.biotac_bridge import BiotacBridgeEmulator

PAC, PDC = 22, 19
PATIENCE_S = 30.0
STARTING = SensorState.STARTING


class Finger:
    """Counts of one emulated BioTac; attributes may be changed while it runs."""

    def __init__(self) -> None:
        self.fixed: dict[int, int] = {}
        self.pressed = False
        noise = random.Random(5)
        self._rounds = [
            [3000 + 10 * k + noise.randint(-8, 8) for k in range(19)] for _ in range(64)
        ]

    def __call__(self, t: float, finger: int) -> Sequence[int]:
        # Asked 4400 times a second, so that it must not do much.
        counts = [*self._rounds[int(t * 100.0) % 64], 2400, 2050, 1900, 2035 + int(t * 4400.0) % 11]
        if self.pressed:
            counts[:6] = [count - 400 for count in counts[:6]]
            counts[PDC] += 500
        for place, value in self.fixed.items():
            counts[place] = value
        return counts


@pytest.fixture
def finger() -> Finger:
    return Finger()


@pytest.fixture
def emulator(finger: Finger) -> Iterator[BiotacBridgeEmulator]:
    with BiotacBridgeEmulator(fingers=1, counts=finger, hello_s=0.2) as running:
        yield running


@pytest.fixture
def served(bus: Any, emulator: BiotacBridgeEmulator) -> Iterator[Callable[..., SensorStatus]]:
    """A gateway that reads it; waits for what it says of the sensor."""
    options = {"line": emulator.address}
    sensor = {"name": "thumb", "driver": "biotac_bridge", "options": options}

    def says(true: Callable[[SensorStatus, Status], Any]) -> SensorStatus:
        def found() -> SensorStatus | None:
            now = bus.status()
            if now is None or not now.sensor_states or not true(now.sensor_states[0], now):
                return None
            one = now.sensor_states[0]
            assert isinstance(one, SensorStatus)
            return one

        one = bus.until(found)
        assert isinstance(one, SensorStatus)
        return one

    with bus.gateway({"sensors": [sensor]}):
        one = says(lambda one, now: one.state is SensorState.LIVE and now.counters["tares"])
        assert (one.name, tuple(one.faults)) == ("thumb", ())
        yield says


def has(kind: FaultKind, *channels: str) -> Callable[[SensorStatus, Status], bool]:
    return lambda one, now: ChannelFault(kind, channels) in one.faults


def test_a_stuck_electrode_is_named_and_recovers(
    bus: Any,
    finger: Finger,
    served: Callable[..., SensorStatus],
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    # The errors are looked for in the log: the last one of a busy host may be a short silence.
    finger.fixed = {6: 3061}
    one = served(has(FaultKind.STUCK, "E7"))
    assert one.state is SensorState.LIVE
    assert one.message == "E7 stuck"
    now = bus.state(ServiceState.DEGRADED)
    bus.until(lambda: "sensor 'thumb': E7 stuck -> power the sensor off and on" in caplog.text)
    assert now.gauges["stuck_channels"] == 1.0
    assert now.counters["channels_stuck"] == 1

    def processes() -> list[dict[str, Any]]:
        assert show_status(bus.link, "lab", as_json=True) == 1
        return list(json.loads(capsys.readouterr().out)["processes"])

    (process,) = bus.until(processes)
    (told,) = process["sensor_states"]
    assert (told["name"], told["state"], told["faults"]) == ("thumb", "live", {"stuck": ["E7"]})
    show_status(bus.link, "lab", as_json=False)
    assert "thumb" in capsys.readouterr().out
    finger.fixed = {}
    served(lambda one, now: not one.faults)
    assert bus.state(ServiceState.READY).gauges["stuck_channels"] == 0.0


def test_saturation_under_load_is_told_without_a_cry(
    bus: Any, finger: Finger, served: Callable[..., SensorStatus]
) -> None:
    finger.pressed, finger.fixed = True, {2: 0}
    one = served(has(FaultKind.SATURATED, "E3"))
    assert one.message.startswith("E3 saturated")
    # On a busy host the sensor may have been lost a moment ago, but never for its saturation.
    error = bus.state(ServiceState.READY).last_error
    assert error is None or "E3" not in error.message
    finger.pressed, finger.fixed = False, {}
    served(lambda one, now: not one.faults)


def test_an_electrode_that_dies_at_rest_is_dead(
    bus: Any,
    finger: Finger,
    served: Callable[..., SensorStatus],
    caplog: pytest.LogCaptureFixture,
) -> None:
    finger.fixed = {18: 0}
    served(has(FaultKind.DEAD, "E19"))
    bus.state(ServiceState.DEGRADED)
    bus.until(lambda: "E19 dead -> check plug and cable" in caplog.text)
    finger.fixed = {}
    served(lambda one, now: not one.faults and now.state is ServiceState.READY)


def test_a_line_that_repeats_itself_is_noticed(
    bus: Any, emulator: BiotacBridgeEmulator, finger: Finger, served: Callable[..., SensorStatus]
) -> None:
    still = finger(0.0, 0)
    finger.fixed = dict(enumerate(still))
    every = (*(f"E{k}" for k in range(1, 20)), "PAC")
    one = served(has(FaultKind.STUCK, *every))
    assert one.message == "E1, E2, E3, E4 and 16 more stuck"
    finger.fixed = {}
    served(lambda one, now: not one.faults)


@pytest.mark.parametrize("fault", ["silence", "unplug", "restart"])
def test_a_sensor_that_is_gone_is_lost_and_comes_back(
    bus: Any, emulator: BiotacBridgeEmulator, served: Callable[..., SensorStatus], fault: str
) -> None:
    emulator.inject(fault, 1.0)
    lost = served(lambda one, now: one.state is SensorState.LOST)
    assert lost.message
    live = served(lambda one, now: one.state is SensorState.LIVE)
    assert live.since_monotonic_ns > lost.since_monotonic_ns
    assert live.message == ""
    now = bus.state(ServiceState.READY)
    assert now.counters.get("silences", 0) + now.counters.get("device_lost", 0) >= 1
    assert now.counters["tares"] == 1, "a tare outlives a restart of the line"


def test_a_held_finger_is_tared_only_if_it_is_insisted(
    bus: Any, finger: Finger, served: Callable[..., SensorStatus]
) -> None:
    finger.pressed = True
    served(lambda one, now: one.message.startswith("still, but not where it rested"))
    with pytest.raises(RemoteError, match=r"still, but E\d is 400 counts from where") as caught:
        ask_tare(bus.session, "thumb", frames=0, timeout_s=PATIENCE_S)
    assert "palpate tare NAME --anyway" in caught.value.remedy
    tare = ask_tare(bus.session, "thumb", frames=0, timeout_s=PATIENCE_S, anyway=True)
    assert tare.pdc == pytest.approx(2900.0)
    served(lambda one, now: one.message == "" and now.counters["tares"] == 2)


def test_a_finger_without_frames_is_lost_though_its_device_measures_forces(bus: Any) -> None:
    """It was live, at 0 frames a second, for as long as any reading of the device came."""
    options = {"model": "formula", "faults": [{"kind": "lost", "at_s": 2.0, "for_s": 1.0}]}
    states = bus.session.subscriber(STATUS, service="gateway", delivery=Delivery.QUEUE)
    wanted = [SensorState.LIVE, SensorState.LOST, SensorState.LIVE]
    with bus.gateway({"sensors": [{"driver": "virtual", "options": options}]}):
        told: list[SensorState] = []
        while told[-3:] != wanted:
            (now,) = states.next(PATIENCE_S).message.sensor_states or [SensorStatus("", STARTING)]
            if now.state not in (STARTING, *told[-1:]):
                told.append(now.state)
        assert bus.state(ServiceState.READY).counters["silences"] >= 1


def test_a_sensor_that_stutters_does_not_flap(
    bus: Any, emulator: BiotacBridgeEmulator, served: Callable[..., SensorStatus]
) -> None:
    """Silences of 60 ms, many a second: it was lost and live again with each of them."""
    states = bus.session.subscriber(STATUS, service="gateway", delivery=Delivery.QUEUE)
    before = bus.status().counters.get("silences", 0)
    began_s = time.monotonic()
    while bus.status().counters.get("silences", 0) < before + 25:
        assert time.monotonic() < began_s + 60.0
        emulator.inject("silence", 0.06)
        time.sleep(0.1)
    lasted_s = time.monotonic() - began_s
    served(lambda one, now: one.state is SensorState.LIVE)
    told: list[SensorStatus] = []
    with contextlib.suppress(StreamTimeout):
        while True:
            told += states.next(0.2).message.sensor_states
    assert SensorState.LOST in {one.state for one in told}
    # A host that is busy may let it rest for half a second between two silences.
    assert sum(a.state is not b.state for a, b in pairwise(told)) < 25
    # Five, then five a second (docs/operations.md), and a regular report a second.
    assert len(told) <= 5 + (5.0 + 1.0) * (lasted_s + 5.0)


def test_age_and_drift_of_the_tare_are_gauged(
    bus: Any, finger: Finger, served: Callable[..., SensorStatus]
) -> None:
    before = bus.status().gauges
    assert before["warm_up"] == 0.0
    now = bus.until(
        lambda: (now := bus.status()) and now.gauges["tare_age_s"] > before["tare_age_s"] and now
    )
    assert now.gauges["tare_drift_counts"] < 10.0


def test_a_silent_sensor_has_no_latency_and_its_tare_ages(
    bus: Any, emulator: BiotacBridgeEmulator, served: Callable[..., SensorStatus]
) -> None:
    before = bus.until(lambda: (now := bus.status()) and "publish_p50_s" in now.gauges and now)
    emulator.inject("silence", 30.0)
    served(lambda one, now: one.state is SensorState.LOST and "publish_p50_s" not in now.gauges)
    age_s = before.gauges["tare_age_s"]
    served(lambda one, now: one.state is SensorState.LOST and now.gauges["tare_age_s"] > age_s + 3)


def test_a_change_is_told_at_once_not_with_the_next_report(bus: Any) -> None:
    """Reports come once an hour here, so whatever comes meanwhile came by itself."""
    health = Health("gateway", "gateway")
    states = bus.session.subscriber(STATUS, delivery=Delivery.QUEUE)
    with HealthReporter(bus.session, health, period_s=3600.0):
        for state in (SensorState.LIVE, SensorState.LOST, SensorState.LIVE):
            health.set_sensor_state("thumb", state)
            while not (said := states.next(timeout_s=20.0).message.sensor_states) or (
                said[0].state is not state
            ):
                pass
        faults = [ChannelFault(FaultKind.STUCK, ("E7",))]
        health.set_sensor_state("thumb", SensorState.LIVE, faults=faults, message="E7 stuck")
        while not (said := states.next(timeout_s=20.0).message.sensor_states)[0].faults:
            pass
        since_ns = said[0].since_monotonic_ns
        health.set_sensor_state("thumb", SensorState.LIVE, faults=faults, message="E7 still stuck")
        with pytest.raises(StreamTimeout):
            states.next(timeout_s=0.3)
        assert health.status().sensor_states[0].message == "E7 still stuck"
        assert health.status().sensor_states[0].since_monotonic_ns == since_ns
