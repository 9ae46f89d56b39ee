"""READY means: what came was answered, or nothing came."""

from __future__ import annotations

import logging

import pytest

from palpate import health as health_module
from palpate.health import RECOVERY_S, Health
from palpate.messages import Origin, ServiceState, Stamp
from palpate_services.inference import input_report as input_report_module
from palpate_services.inference.estimates import EstimateRefusal
from palpate_services.inference.input_report import REFUSED_S, InputReport
from palpate_services.inference.loop import _ERRORS

TICK_S = 0.01


class Service:
    """A service that gets frames of sensors, by a clock that goes on by hand."""

    def __init__(self) -> None:
        self.now_s = 50.0
        self.health = Health("features", "features")
        self.health.set_state(ServiceState.READY, "serving features-twin:1")
        self.report = InputReport(self.health, _ERRORS, self.recovered)

    def recovered(self) -> None:
        self.health.set_state(ServiceState.READY, "serving features-twin:2")

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(1e9 * self.now_s)

    def run(self, seconds: float, **reasons: str | None) -> ServiceState:
        """Every sensor sends; a reason is why its frames are refused, None = they are answered."""
        for _ in range(round(seconds / TICK_S)):
            self.now_s += TICK_S
            for sensor, reason in reasons.items():
                if reason is None:
                    self.report.answered(sensor)
                else:
                    self.report.refused(sensor, reason)
            self.report.report()
        return self.health.state


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch) -> Service:
    made = Service()
    monkeypatch.setattr(health_module, "time", made)
    monkeypatch.setattr(input_report_module, "time", made)
    return made


def test_a_service_that_refuses_everything_is_degraded_and_says_why(service: Service) -> None:
    assert service.run(REFUSED_S / 2, finger="tare_unknown") is ServiceState.READY
    assert service.run(REFUSED_S, finger="tare_unknown") is ServiceState.DEGRADED
    error = service.health.status().last_error
    assert error is not None
    assert "'finger' is refused (tare_unknown): no gateway knows the tare" in error.message
    assert "palpate" in error.remedy or "tare" in error.remedy


def test_it_is_ready_again_when_it_has_answered_for_a_while(service: Service) -> None:
    service.run(2 * REFUSED_S, finger="untared")
    assert service.run(RECOVERY_S / 2, finger=None) is ServiceState.DEGRADED
    assert service.run(RECOVERY_S, finger=None) is ServiceState.READY
    assert service.health.status().message == "serving features-twin:2"


def test_nothing_to_answer_is_ready(service: Service) -> None:
    assert service.run(5.0) is ServiceState.READY
    service.run(2 * REFUSED_S, finger="untared")
    assert service.run(5.0) is ServiceState.READY


def test_some_refusals_among_estimates_are_no_trouble(service: Service) -> None:
    for _ in range(20):
        service.run(REFUSED_S / 2, finger="stale")
        assert service.run(TICK_S, finger=None) is ServiceState.READY


def test_what_is_skipped_for_its_rate_is_no_refusal(service: Service) -> None:
    assert service.run(5.0, finger=EstimateRefusal.SKIPPED_RATE) is ServiceState.READY


def test_one_sensor_of_several_is_named(service: Service) -> None:
    assert service.run(2.0, finger=None, thumb="wrong_sensor") is ServiceState.DEGRADED
    error = service.health.status().last_error
    assert error is not None
    assert "'thumb' is refused (wrong_sensor)" in error.message
    service.run(2.0, finger="untared", thumb="wrong_sensor")
    error = service.health.status().last_error
    assert error is not None
    assert "'finger' and 1 more" in error.message


@pytest.mark.parametrize(
    "reason", [*(str(one) for one in EstimateRefusal if one is not EstimateRefusal.SKIPPED_RATE),
               "unpublishable_range"],
)  # fmt: skip
def test_every_refusal_has_words(service: Service, reason: str) -> None:
    assert service.run(2.0, finger=reason) is ServiceState.DEGRADED
    error = service.health.status().last_error
    assert error is not None
    assert error.remedy
    if not reason.startswith("unpublishable"):
        assert "break the message contract" not in error.message


def test_the_reason_is_that_of_most_frames_not_of_the_last_one(service: Service) -> None:
    for _ in range(20):
        service.run(0.18, finger="invalid_channels")
        service.run(0.02, finger="stale")
    error = service.health.status().last_error
    assert error is not None
    assert "'finger' is refused (mostly invalid_channels): " in error.message
    assert "load" not in error.remedy
    service.run(REFUSED_S + TICK_S, finger="stale")  # and it follows what is refused now
    error = service.health.status().last_error
    assert error is not None
    assert "'finger' is refused (stale): " in error.message


def test_invented_names_take_no_memory(service: Service) -> None:
    for number in range(5000):
        service.report.refused(f"s{number}", "untared")
    assert len(service.report._refused) <= input_report_module._SENSORS_MOST


def test_the_log_names_the_first_frame_that_was_refused_and_not_every_frame(
    service: Service, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    for sequence in range(41, 1041):
        service.now_s += TICK_S
        stamp = Stamp(sequence, 1000 + sequence, 0, 0, 1, Origin.LIVE)
        service.report.refused("finger", "tare_unknown", stamp, tare_id=0xFEED, model="twin:2")
        service.report.report()
    service.report.answered("finger")
    refused, again = caplog.records
    fields = ("sensor", "sequence", "device_tick", "origin", "tare_id", "model", "reason")
    assert [getattr(refused, name) for name in fields] == [
        "finger", 41, 1041, "live", "000000000000feed", "twin:2", "tare_unknown",
    ]  # fmt: skip
    assert "finger" in refused.getMessage()
    assert again.getMessage() == "sensor finger is answered again"


def test_reasons_that_alternate_are_each_logged_once(
    service: Service, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(50):
        service.run(0.1, finger="stale")
        service.run(0.1, finger="untared")
    assert len(caplog.records) == 2
