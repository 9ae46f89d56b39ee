"""A recorder that loses messages because they come too fast says so, and when it is over."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from palpate.health import Health
from palpate.messages import ServiceState
from palpate_services.config import RecorderConfig
from palpate_services.recorder.service import QueueReport
from palpate_services.recorder.writer import RecordFiles

Until = Callable[[Callable[[], bool]], None]


@pytest.fixture
def recorder(tmp_path: Path) -> tuple[Any, QueueReport, Health]:
    health = Health("recorder", "recorder")
    files = RecordFiles(RecorderConfig(out=tmp_path, rrd=False), "lab", health)
    files.start()
    tap: Any = SimpleNamespace(counters={"received": 5}, waiting=3)
    return tap, QueueReport(tap, files, health), health


def test_lost_messages_are_a_trouble_until_no_more_are_lost(
    recorder: tuple[Any, QueueReport, Health], until: Until
) -> None:
    tap, report, health = recorder
    report.refresh()
    assert health.status().state is ServiceState.READY
    assert health.status().gauges["queue_messages"] == 3.0
    for lost in (1, 7):
        tap.counters = {"received": 5, "overflow": lost}
        report.refresh()
        assert health.state is ServiceState.DEGRADED
    status = health.status()
    assert status.last_error is not None
    assert "not recorded" in status.last_error.message
    assert status.counters["overflow"] == 7
    report.refresh()
    assert health.settle() is None, "the recorder's own thread says so"

    def ready() -> bool:
        report._files.tick()
        return health.state is ServiceState.READY

    until(ready)
    assert health.status().message.startswith("recording to ")


def test_the_end_of_a_loss_does_not_hide_a_full_disk(
    recorder: tuple[Any, QueueReport, Health],
) -> None:
    tap, report, health = recorder
    tap.counters = {"overflow": 1}
    report.refresh()
    report._files._pause("the disk is full")
    report.refresh()
    report._files._checked_s = float("-inf")
    report._files.tick()
    assert health.settle() is None, "nothing is about to recover"
    assert health.state is ServiceState.DEGRADED
