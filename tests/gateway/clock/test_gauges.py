"""What a running gateway tells of its clocks."""

from __future__ import annotations

from typing import Any

from palpate_gateway.clock.stamps import ClockQuality
from palpate_gateway.emulators.kms40 import Kms40Emulator


def test_each_sensors_clock_and_the_wall_clock_are_told(bus: Any) -> None:
    with Kms40Emulator() as kms:
        host, _, port = kms.address.rpartition(":")
        sensors = [
            {"name": "finger", "driver": "virtual", "options": {"rate_hz": 200}},
            {
                "name": "force",
                "driver": "wrench_kms40",
                "options": {"host": host, "port": int(port)},
            },
        ]
        wanted = {"clock_quality", "clock_drift_ppm", "clock_delay_p50_s"}
        with bus.gateway({"sensors": sensors}):
            now = bus.until(
                lambda: (
                    (told := bus.status())
                    and {f"finger.{name}" for name in wanted} <= set(told.gauges)
                    and "force.clock_quality" in told.gauges
                    and told
                )
            )
    assert now.gauges["finger.clock_quality"] in (ClockQuality.SETTLING, ClockQuality.FOLLOWED)
    # It tells no time that we could read, so there is no clock that could drift.
    assert now.gauges["force.clock_quality"] == ClockQuality.ARRIVAL
    assert "force.clock_drift_ppm" not in now.gauges
    assert now.counters["wall_steps"] >= 0
