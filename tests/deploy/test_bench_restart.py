"""``palpate bench restart``: what is broken comes back, and is counted; short runs, no figures."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate_deploy.bench.restart import SIGNALS, Trials, measure_restarts
from palpate_deploy.station.host import private_profile


def _trials(*publishing_s: float, failed: int = 0, fault: str = "kill") -> Trials:
    ended_s = tuple(0.1 * time_s for time_s in publishing_s)
    return Trials("features", fault, publishing_s, ended_s, failed, 1.0)  # type: ignore[arg-type]


def test_the_goal_is_for_every_trial() -> None:
    assert _trials(1.0, 2.9).met
    assert not _trials(1.0, 3.1).met
    assert not _trials(1.0, failed=1).met
    assert _trials(7.0, 9.9, fault="hang").met
    assert not _trials(10.1, fault="hang").met
    assert _trials(19.0, fault="end").met, "it has ended after 1.9 s"
    assert not _trials(21.0, fault="end").met


@pytest.mark.slow
def test_a_service_is_killed_and_hung_and_counted(bundle: str, tmp_path: Path) -> None:
    profile = private_profile(
        "virtual",
        gateway={
            "sensors": [
                {
                    "name": "finger",
                    "driver": "virtual",
                    "options": {"model": "formula", "untouched_s": 0.5},
                }
            ]
        },
        features={"bundle": bundle},
        recorder={"out": str(tmp_path / "runs"), "rrd": False},
    ).model_copy(update={"processes": ("router", "gateway", "features", "recorder")})
    results, unprovoked = measure_restarts(profile, ["features"], 1)
    assert {result.fault for result in results} == set(SIGNALS)
    for result in results:
        assert (len(result.publishing_s), result.failed) == (1, 0)
        assert 0.0 < result.process_s[0] < result.publishing_s[0]
        assert result.floor_s > 0.0
    assert unprovoked == {}
