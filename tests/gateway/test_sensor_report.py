"""What a sensor's thread tells of it."""

from __future__ import annotations

import logging

import pytest

from palpate.errors import DeviceError, DeviceLost
from palpate.health import Health
from palpate.messages import ServiceState
from palpate_gateway.service.sensor_report import SensorReport


def test_a_sensor_that_stays_away_is_logged_once_for_each_reason(
    caplog: pytest.LogCaptureFixture,
) -> None:
    report = SensorReport("thumb", Health("gateway", "a"))
    pulled = DeviceLost("the line is gone", remedy="plug it in")
    with caplog.at_level(logging.WARNING):
        for _ in range(20):
            report.is_lost(pulled, 0.4)
        assert caplog.text.count("the line is gone -> plug it in") == 1
        report.is_lost(DeviceLost("nobody answers", remedy="wait"), 0.4)
        assert caplog.text.count("nobody answers") == 1
        report.is_lost(pulled, 0.4)
        report.delivers(None, zero_lost=False)
        report.is_lost(pulled, 0.4)
    assert caplog.text.count("the line is gone") == 3


def test_the_present_reason_of_a_refused_tare_is_told_and_the_first_is_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    health = Health("gateway", "a")
    report = SensorReport("thumb", health)
    health.set_state(ServiceState.READY, "all sensors deliver")
    for reason in ("E7 varies", "E7 varies", "PDC is invalid"):
        report.tare_refused(DeviceError(reason, remedy="let go"))
        now = health.status()
        assert now.last_error is not None
        assert (now.message, now.last_error.message) == (reason, reason)
    assert [record.getMessage() for record in caplog.records] == [
        "sensor thumb: E7 varies -> let go"
    ]
    report.tare_refused(None)
    assert health.status().message == "all sensors deliver"


def test_a_refused_tare_is_the_message_until_one_succeeds() -> None:
    health = Health("gateway", "a")
    report = SensorReport("thumb", health)
    health.set_state(ServiceState.READY, "all sensors deliver")
    for _ in range(2):
        report.tare_refused(None)
        report.tare_refused(DeviceError("the finger is touched", remedy="let go"))
        assert health.status().message == "the finger is touched"
        report.tare_refused(None)
        assert health.status().message == "all sensors deliver"
    report.tare_refused(DeviceError("the finger is touched", remedy="let go"))
    health.fail(DeviceLost("the line is gone", remedy="plug it in"))
    report.tare_refused(None)
    assert health.status().message == "the line is gone"


def test_a_refused_tare_hides_no_other_trouble() -> None:
    """Attempts follow closely, and each tells other numbers."""
    health = Health("gateway", "a")
    finger, force = SensorReport("thumb", health), SensorReport("ft", health)
    health.set_state(ServiceState.READY, "all sensors deliver")
    finger.tare_refused(DeviceError("PAC varies by 21 counts", remedy="let go"))
    force.delivers(None, zero_lost=True)

    def told() -> tuple[str, str]:
        now = health.status()
        assert now.state is ServiceState.DEGRADED
        assert now.last_error is not None
        return now.message, now.last_error.remedy

    problem, remedy = told()
    assert "zero" in problem
    assert remedy.endswith("palpate tare ft")
    finger.tare_refused(DeviceError("PAC varies by 23 counts", remedy="let go"))
    assert told() == (problem, remedy)
    finger.tare_refused(None)
    assert told() == (problem, remedy)
