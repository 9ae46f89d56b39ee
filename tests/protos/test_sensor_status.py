"""What a gateway says of its sensors, as part of its status; and the zero of a wrench sensor."""

from __future__ import annotations

import dataclasses
import math
import os
from typing import Any

import numpy as np
import pytest

from palpate.codec import STATUS, WRENCH_ZERO
from palpate.errors import RecordingError, WireError
from palpate.health import Health
from palpate.messages import (
    GAUGE_MAX,
    ChannelFault,
    FaultKind,
    SensorState,
    SensorStatus,
    ServiceState,
    Status,
    SupervisedProcess,
)
from palpate.v1 import service_pb2

STATES = (
    SensorStatus("finger", SensorState.LIVE, 41, (), "ok"),
    SensorStatus(
        "thumb",
        SensorState.WARMING,
        42,
        (ChannelFault(FaultKind.STUCK, ("E7", "PAC")), ChannelFault(FaultKind.DEAD, ("TDC",))),
        "E7, PAC stuck; TDC dead",
    ),
    SensorStatus("ft", SensorState.ZERO_LOST, (1 << 63) - 1),
)


def test_states_of_sensors_travel_with_the_status(examples: dict[str, Any]) -> None:
    status = dataclasses.replace(examples["Status"], sensor_states=STATES)
    assert STATUS.decode(STATUS.encode(status)) == status


def test_a_status_of_an_older_gateway_has_none(examples: dict[str, Any]) -> None:
    found = STATUS.decode(STATUS.encode(examples["Status"]))
    assert found.sensor_states == ()


def test_what_a_newer_gateway_knows_is_unknown_not_wrong(examples: dict[str, Any]) -> None:
    message = service_pb2.Status.FromString(STATUS.encode(examples["Status"]))
    one = message.sensor_states.add(name="finger", message="new")
    one.state = 77  # type: ignore[assignment]
    one.faults.add(kind=88, channels=["E1"])
    (found,) = STATUS.decode(message.SerializeToString()).sensor_states
    assert found == SensorStatus(
        "finger", SensorState.UNKNOWN, 0, (ChannelFault(FaultKind.UNKNOWN, ("E1",)),), "new"
    )


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"name": ""}, "serial"),
        ({"since_monotonic_ns": 1 << 63}, "time"),
    ],
)
def test_a_bad_state_is_refused(
    examples: dict[str, Any], changes: dict[str, Any], reason: str
) -> None:
    bad = dataclasses.replace(STATES[0], **changes)
    with pytest.raises(WireError) as caught:
        STATUS.encode(dataclasses.replace(examples["Status"], sensor_states=(bad,)))
    assert caught.value.reason == reason


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1e308, 2 * GAUGE_MAX])
def test_a_gauge_that_measures_nothing_hides_nothing_else(
    examples: dict[str, Any], value: float
) -> None:
    status = dataclasses.replace(examples["Status"], gauges={"queue_messages": 3.0})
    message = service_pb2.Status.FromString(STATUS.encode(status))
    message.gauges["latency_p50_s"] = value
    assert STATUS.decode(message.SerializeToString()) == status
    with pytest.raises(WireError, match="latency_p50_s") as caught:
        STATUS.encode(dataclasses.replace(status, gauges={"latency_p50_s": value}))
    assert caught.value.reason == "gauge"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        *(({"uptime_s": value}, "uptime") for value in (math.nan, math.inf, -1.0, 1e308)),
        ({"processes": (SupervisedProcess("fem", "fem", "running", 1, 0, math.inf),)}, "uptime"),
        ({"monotonic_ns": 1 << 63}, "time"),
        ({"wall_ns": -1}, "time"),
        ({"counters": {"lost": -1}}, "counter"),
        ({"counters": {"lost": 1 << 64}}, "counter"),
    ],
)
def test_a_status_with_a_number_that_cannot_be_is_not_sent(
    examples: dict[str, Any], changes: dict[str, Any], reason: str
) -> None:
    with pytest.raises(WireError) as caught:
        STATUS.encode(dataclasses.replace(examples["Status"], **changes))
    assert caught.value.reason == reason


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0, 1e308])
def test_nor_is_it_taken_when_it_comes(examples: dict[str, Any], value: float) -> None:
    payload = STATUS.encode(examples["Status"])
    whole = service_pb2.Status.FromString(payload)
    whole.uptime_s = value
    child = service_pb2.Status.FromString(payload)
    child.processes.add(service="fem", instance="fem", state="running", uptime_s=value)
    time = service_pb2.Status.FromString(payload)
    time.monotonic_ns = 1 << 63
    for message in (whole, child, time):
        with pytest.raises(WireError):
            STATUS.decode(message.SerializeToString())


def test_a_file_name_that_is_no_utf_8_keeps_no_status_from_being_sent() -> None:
    name = os.fsdecode(b"/data/m\xfcller/x.mcap")
    health = Health("recorder", "recorder")
    health.set_state(ServiceState.READY, f"writes {name}")
    health.set_sensor_state("finger", SensorState.LOST, message=f"{name} has ended")
    came = STATUS.decode(STATUS.encode(health.status()))
    assert came.message == "writes /data/m\\udcfcller/x.mcap"
    assert came.sensor_states[0].message == "/data/m\\udcfcller/x.mcap has ended"
    health.fail(RecordingError(f"{name}: disk full", remedy=f"move {name}"))
    came = STATUS.decode(STATUS.encode(health.status()))
    assert came.last_error is not None
    assert came.message == came.last_error.message == "/data/m\\udcfcller/x.mcap: disk full"
    assert came.last_error.remedy == "move /data/m\\udcfcller/x.mcap"


def test_long_words_are_cut_when_sent_and_refused_when_they_come(examples: dict[str, Any]) -> None:
    long = dataclasses.replace(STATES[0], message="x" * 5000)
    status = dataclasses.replace(examples["Status"], sensor_states=(long,))
    assert len(STATUS.decode(STATUS.encode(status)).sensor_states[0].message) == 1024
    message = service_pb2.Status.FromString(STATUS.encode(status))
    message.sensor_states[0].message = "x" * 5000
    with pytest.raises(WireError, match="5000 characters"):
        STATUS.decode(message.SerializeToString())


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"readings_averaged": 0}, "readings_averaged"),
        ({"force_after": np.array([0.0, np.nan, 0.0], np.float32)}, "non_finite"),
        ({"torque_before": np.zeros(2, np.float32)}, "shape"),
        ({"sensor_serial": "\n"}, "serial"),
    ],
)
def test_a_bad_zero_is_refused(
    examples: dict[str, Any], changes: dict[str, Any], reason: str
) -> None:
    with pytest.raises(WireError) as caught:
        WRENCH_ZERO.encode(dataclasses.replace(examples["WrenchZero"], **changes))
    assert caught.value.reason == reason


def test_health_tells_a_change_of_state_or_faults_and_nothing_else() -> None:
    health = Health("gateway", "gateway")
    stuck = [ChannelFault(FaultKind.STUCK, ("E7",))]
    told = []
    for state, faults, message in (
        (SensorState.LIVE, [], ""),
        (SensorState.LIVE, [], "drifts"),
        (SensorState.LIVE, stuck, ""),
        (SensorState.LIVE, stuck, ""),
        (SensorState.LOST, [], "silent"),
    ):
        health.changed.clear()
        health.set_sensor_state("finger", state, faults=faults, message=message)
        told.append(health.changed.is_set())
    assert told == [True, False, True, False, True]
    (one,) = health.status().sensor_states
    assert (one.state, one.message) == (SensorState.LOST, "silent")
    assert isinstance(health.status(), Status)
