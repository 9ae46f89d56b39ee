"""Gauges of clocks in words."""

from __future__ import annotations

import pytest

from palpate.messages import ServiceState, Status
from palpate_deploy.station.status import clock_lines, duration_words, wall_words
from palpate_gateway.clock.stamps import ClockQuality
from palpate_gateway.clock.wall_clock import WallDiscipline


def status(gauges: dict[str, float], counters: dict[str, int] | None = None) -> Status:
    return Status(
        "gateway",
        "gateway",
        ServiceState.READY,
        monotonic_ns=1,
        wall_ns=2,
        uptime_s=3.0,
        version="1",
        counters=counters or {},
        gauges=gauges,
        sensors=("finger",),
        message="",
        last_error=None,
    )


def test_every_sensor_and_the_wall_clock_have_a_line() -> None:
    lines = clock_lines(
        status(
            {
                "a.clock_quality": ClockQuality.FOLLOWED,
                "a.clock_drift_ppm": -41.6,
                "a.clock_delay_p50_s": 0.0104,
                "b.clock_quality": ClockQuality.ARRIVAL,
                "c.clock_quality": ClockQuality.ODD,
                "c.clock_drift_ppm": 5000.0,
                "d.clock_quality": 17.0,
                "wall_synchronised": 1.0,
                "wall_error_s": 0.0032,
            },
            {"wall_steps": 2, "a.clock_steps": 1, "c.clock_steps": 3},
        )
    )
    assert lines == [
        "clock of a: followed, 42 ppm slow, frames arrive 10.4 ms after their stamps, "
        "it stopped and went on once",
        "clock of b: the device sends none; stamps are times of arrival",
        "clock of c: followed, 5000 ppm fast, too much for a quartz: check the configured rate, "
        "it stopped and went on 3 times",
        "clock of d: quality 17",
        "wall clock: synchronised to 3.2 ms, by the kernel's estimate",
        "wall clock: it was set 2 times since the start of gateway",
    ]


def test_one_sensor_has_no_prefix_and_a_service_no_clock() -> None:
    settling = {"clock_quality": float(ClockQuality.SETTLING), "clock_drift_ppm": 0.0}
    assert clock_lines(status(settling)) == ["clock of finger: settling"]
    assert clock_lines(status({"age_p50_s": 1.0})) == []


def test_nobody_is_told_more_than_is_known() -> None:
    assert "not known" in wall_words(None)
    assert "not synchronised" in wall_words(WallDiscipline(False, 16.0))


@pytest.mark.parametrize(
    ("seconds", "words"), [(12e-6, "12 us"), (3.44e-3, "3.4 ms"), (1.25, "1.2 s")]
)
def test_durations(seconds: float, words: str) -> None:
    assert duration_words(seconds) == words
