"""Where the time of estimates goes, as gauges."""

from __future__ import annotations

import pytest

from palpate.messages import StageTimings
from palpate_services.inference.input_report import StageGauges


def test_percentiles_of_each_stage_since_the_last_look() -> None:
    gauges = StageGauges()
    assert gauges.take() == {}
    for k in range(101):
        gauges.note(StageTimings(1e-3, 1e-5, 2e-5, 3e-5, k * 1e-4, 4e-5))
    found = gauges.take()
    assert found["infer_p50_s"] == pytest.approx(5e-3)
    assert found["infer_p99_s"] == pytest.approx(9.9e-3)
    assert found["arrival_age_p50_s"] == pytest.approx(1e-3)
    assert found["waiting_p99_s"] == pytest.approx(1e-5)
    assert {name.rpartition("_p")[0] for name in found} == {
        "arrival_age", "waiting", "decode", "tare", "infer", "encode",
    }  # fmt: skip
    assert gauges.take() == {}


def test_an_age_that_is_not_known_is_left_out() -> None:
    gauges = StageGauges()
    gauges.note(StageTimings(None, 1e-5, 2e-5, 3e-5, 1e-4, 4e-5))
    found = gauges.take()
    assert "arrival_age_p50_s" not in found
    assert found["encode_p50_s"] == pytest.approx(4e-5)
