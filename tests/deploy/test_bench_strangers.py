"""Rows of ``palpate bench faults`` whose goal needs what a station tells of a stranger."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from palpate.bus import ReceivedMessage
from palpate.codec import ELECTRODE_FRAME
from palpate.errors import StreamTimeout
from palpate_deploy.bench import faults, strangers
from palpate_deploy.bench.codec import bench_frame
from palpate_deploy.bench.fault_station import EstimateAccount

SECONDS = 0.02
NOTHING_LOST = EstimateAccount(100, 0, 0, 0, 2e-3, 1e-3, 0.02)


class ToldStation:
    """A station that loses nothing, and tells of so many messages that it refused."""

    profile = SimpleNamespace(station="bench")

    def __init__(self, told: int) -> None:
        self._told = told
        self._asked = 0
        frame = bench_frame(0)
        self._frames = [ReceivedMessage(frame, ELECTRODE_FRAME.encode(frame), "", "finger", 0)]
        session = SimpleNamespace(subscriber=lambda *_, **__: self, has_router=lambda: True)
        self.observer = SimpleNamespace(
            session=session, mark=lambda: 0, account=lambda _: NOTHING_LOST
        )

    def next(self, timeout_s: float) -> Any:
        if not self._frames:
            raise StreamTimeout("none", remedy="none")
        return self._frames.pop()

    def close(self) -> None:
        pass

    def counters(self, service: str) -> dict[str, int]:
        """Those of before at first."""
        self._asked += 1
        return {"frames_received": 100, "rejected_parse": self._told if self._asked > 1 else 0}

    def refusals(self) -> str:
        return f"rejected_parse {self.counters('features')['rejected_parse']}"

    def pid(self, name: str) -> int:
        return os.getpid()

    def kill(self, *_: object) -> None:
        pass

    start = check = kill


@pytest.mark.parametrize("row", [strangers.hostile_payloads, strangers.bad_sequences])
def test_a_station_that_tells_of_no_refusal_does_not_meet_the_goal(
    monkeypatch: pytest.MonkeyPatch, row: Any
) -> None:
    stranger = SimpleNamespace(put=lambda *_, **__: None)
    monkeypatch.setattr(strangers, "_stranger", lambda _: nullcontext(stranger))
    for told in (0, 7):
        station = ToldStation(told)
        monkeypatch.setattr(strangers, "FaultStation", lambda one=station: nullcontext(one))
        met, _ = row(SECONDS)
        assert met is (told > 0)


@pytest.mark.parametrize("join_s", [0.1, 2.5])
def test_the_time_in_which_a_robot_joins_counts(
    monkeypatch: pytest.MonkeyPatch, join_s: float
) -> None:
    """From the router's return until all are found, by one clock."""
    now_s = 0.0

    def passes(seconds: float) -> None:
        nonlocal now_s
        now_s += seconds

    def seconds_until(_: object) -> float:
        passes(0.3)
        return 0.3

    @contextmanager
    def fresh_session() -> Iterator[None]:
        passes(join_s)
        yield

    station = ToldStation(0)
    monkeypatch.setattr(station, "fresh_session", fresh_session, raising=False)
    monkeypatch.setattr(faults, "FaultStation", lambda: nullcontext(station))
    monkeypatch.setattr(faults, "seconds_until", seconds_until)
    clock = SimpleNamespace(monotonic=lambda: now_s, sleep=passes)
    monkeypatch.setattr(faults, "time", clock)
    met, figures = faults.router_killed(SECONDS)
    assert figures["all_found_s"] == pytest.approx(0.6 + join_s)
    assert met is (join_s < 1.0)
