"""The soak finds what grows, and only that; how much a station needs is not a test."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar, cast

import numpy as np
import pytest

from palpate.bus import Session
from palpate.errors import StreamTimeout
from palpate_deploy.bench import soak
from palpate_deploy.bench.growth import (
    BINS,
    Growth,
    History,
    Use,
    Verdict,
    processes_below,
    slope_of,
    use_of,
    verdict_of,
)
from palpate_deploy.bench.soak import SoakResult, _Client, _Watch

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]

PATIENCE_S = 20.0

# Ends by itself: it must not outlive a test that is killed.
_PROGRAM = """
import os, sys, time
kept = []
for _ in range(600):
    if sys.argv[1] == "leaks":
        kept.append(bytearray(os.urandom(1 << 20)))
    elif sys.argv[1] == "opens":
        kept.append(open(os.devnull))
    time.sleep(0.05)
"""


@pytest.fixture(scope="module")
def watched() -> dict[str, History]:
    """Four seconds of a process of each kind, all of them at the same time."""
    kinds = ("leaks", "opens", "sleeps")
    children = {kind: subprocess.Popen([sys.executable, "-c", _PROGRAM, kind]) for kind in kinds}
    histories = {kind: History() for kind in kinds}
    try:
        time.sleep(0.5)
        begun = time.monotonic()
        while (gone := time.monotonic() - begun) < 4.0:
            for kind, child in children.items():
                use = use_of(child.pid)
                assert use is not None
                histories[kind].add(gone, child.pid, use)
            time.sleep(0.05)
    finally:
        for child in children.values():
            child.kill()
            child.wait()
    return histories


def test_a_process_that_leaks_is_found(watched: dict[str, History]) -> None:
    growth = watched["leaks"].growth(0.5)
    assert growth.verdict is Verdict.GROWS
    assert not growth.fine


def test_a_process_that_opens_files_is_found(watched: dict[str, History]) -> None:
    growth = watched["opens"].growth(0.5)
    assert not growth.constant
    assert not growth.fine


def test_a_process_that_keeps_still_is_not(watched: dict[str, History]) -> None:
    growth = watched["sleeps"].growth(0.5)
    assert growth.constant
    assert growth.slope_mb_per_h == pytest.approx(0.0, abs=1e-6)
    assert growth.verdict is Verdict.STEADY


def test_a_process_that_was_replaced_is_not_fine() -> None:
    history = History()
    for number in range(10 * BINS):
        history.add(float(number), 1 if number < 50 else 2, Use(100 << 20, 3, 10))
    growth = history.growth(0.0)
    assert growth.restarts == 1
    assert not growth.fine


def test_what_is_given_back_is_no_growth() -> None:
    """A sawtooth of 3 MB, as of a record that is written and closed, beside a real growth."""
    hours = np.linspace(0, 1 / 3, 600)
    noise = np.random.default_rng(1).uniform(0, 0.05, 600)
    sawtooth = 100 + 3 * (hours * 60 % 1) + noise
    slope, half = slope_of(hours, sawtooth)
    assert verdict_of(slope, half) is Verdict.STEADY
    slope, half = slope_of(hours, sawtooth + 6 * hours)
    assert slope == pytest.approx(6, abs=1)
    assert verdict_of(slope, half) is Verdict.GROWS


def test_a_slope_that_is_not_known_is_no_verdict() -> None:
    assert verdict_of(0.0, 0.9) is Verdict.STEADY
    assert verdict_of(0.9, 0.2) is Verdict.UNDECIDED
    assert verdict_of(50.0, 60.0) is Verdict.UNDECIDED
    assert verdict_of(3.0, 1.5) is Verdict.GROWS


def soaked(slope_mb_per_h: float, half: float) -> SoakResult:
    """A run of one process with such a slope, in which nothing was lost."""
    verdict = verdict_of(slope_mb_per_h, half)
    growth = Growth(100.0, slope_mb_per_h, half, (3, 3), (10, 10), 0, verdict)
    return SoakResult(40.0, 10.0, 1, {"gateway": growth}, {}, {}, 1.0, 2.0, 1.0, 0)


def test_a_run_that_is_too_short_to_tell_does_not_meet_the_goal() -> None:
    assert soaked(0.2, 0.1).met
    short = soaked(0.2, 1.3)
    assert short.fine
    assert not short.met


class NumberedStream:
    """Messages of one finger, with such sequence numbers."""

    counters: ClassVar[dict[str, int]] = {}

    def __init__(self, sequences: Iterable[int]) -> None:
        self._left = list(sequences)

    def next(self, timeout_s: float) -> SimpleNamespace:
        if not self._left:
            raise StreamTimeout("no more", remedy="none")
        stamp = SimpleNamespace(sequence=self._left.pop(0))
        return SimpleNamespace(sensor="finger", message=SimpleNamespace(source=stamp, stamp=stamp))


def taken(**sequences: Iterable[int]) -> _Client:
    """A client that has taken these messages of each topic."""
    streams = {name: NumberedStream(numbers) for name, numbers in sequences.items()}
    count = sum(len(stream._left) for stream in streams.values())
    subscriber = lambda topic, **_: streams.get(topic.name, NumberedStream([]))  # noqa: E731
    client = _Client(cast(Session, SimpleNamespace(subscriber=subscriber)))
    deadline = time.monotonic() + PATIENCE_S
    while sum(client.received.values()) < count and time.monotonic() < deadline:
        time.sleep(0.01)
    client.close()
    assert sum(client.received.values()) == count
    return client


def lost(client: _Client) -> dict[str, int]:
    return {name: count for name, count in client.lost().items() if count}


def test_frames_without_features_are_lost() -> None:
    client = taken(electrodes=range(5, 11), features=[5, 6, 9, 10], field=[5, 10])
    assert lost(client) == {"client frames without features": 2}


@pytest.mark.parametrize(
    ("features", "without"),
    [
        (range(5, 1000), 0),  # one is on its way
        (range(5, 201), 800),  # they end
        ([*range(5, 101), *range(151, 201)], 850),
        ([], 996),  # they never come
    ],
)
def test_frames_after_the_last_features_are_lost(features: Iterable[int], without: int) -> None:
    client = taken(electrodes=range(5, 1001), features=features)
    assert lost(client).get("client frames without features", 0) == without


def test_frames_that_end_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """By their rate: 1000 in 10 s."""
    now_s = 10.0
    monkeypatch.setattr(soak, "time", SimpleNamespace(monotonic=lambda: now_s))
    client = taken(electrodes=range(1001), features=range(1001))
    client.begun_s = 0.0
    assert lost(client) == {}
    now_s = 12.0
    assert lost(client) == {}
    now_s = 40.0
    assert lost(client) == {"client electrodes ended": 3000}


def test_too_few_samples_are_no_answer() -> None:
    history = History()
    for number in range(2 * BINS):
        history.add(float(number), 1, Use(1, 1, 1))
    with pytest.raises(ValueError, match="samples after the warm-up"):
        history.growth(1.0)


def test_ended_processes_are_none() -> None:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    assert use_of(child.pid) is None
    assert processes_below(os.getpid())["up"] == os.getpid()


# The minute that is the least takes half of that, with the samples of two.
_HALF = """
from palpate_deploy.bench import soak

measure = soak.measure_soak
soak.measure_soak = lambda minutes, *given, **more: measure(minutes / 2, *given, **more)
soak.SAMPLE_S = 0.5
"""


@pytest.mark.slow
def test_soak_watches_a_whole_station(palpate: Palpate, tmp_path: Path) -> None:
    out = tmp_path / "soak.json"
    words = ("--minutes", "1", "--fingers", "1", "--out", str(out), "--json")
    result = palpate("bench", "soak", *words, timeout=400, first=_HALF)
    assert out.exists(), result.stderr
    values = json.loads(out.read_text())["soak"]
    names = {"up", "supervisord", "router", "gateway", "features", "field", "recorder", "synthesis"}
    assert names <= set(values["processes"])
    assert values["received"]["electrodes"] > 1000
    assert 0 < values["disk_peak_mb"] <= values["disk_limit_mb"]
    assert out.with_suffix(".png").stat().st_size > 10_000


class WatchedStation:
    """A station of two fingers whose processes and client are a test's."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.profile = soak.soak_profile(folder, 2, fem=False)
        self.names = set(self.profile.processes) - {"router"}
        monkeypatch.setattr(
            soak,
            "ask_status",
            lambda *_, **__: [SimpleNamespace(service=one, counters={}) for one in self.names],
        )
        self.received: Counter[tuple[str, str]] = Counter()
        client = SimpleNamespace(received=self.received, lost=lambda: Counter[str]())
        self.watch = _Watch(
            os.getpid(), self.profile, cast("Session", None), cast("_Client", client), 0.0
        )

    def come(self, *, without: Iterable[tuple[str, str]] = ()) -> None:
        """A message of each topic and finger, but some."""
        for topic in ("electrodes", "features", "field", "synthesis"):
            for finger in ("finger1", "finger2"):
                self.received[topic, finger] += (topic, finger) not in without

    def look(self, looks: int = 2 * BINS + 2, **changes: Iterable[tuple[str, str]]) -> None:
        for _ in range(looks):
            self.watch.look()
            self.come(**changes)
            time.sleep(0.01)


@pytest.fixture
def station(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> WatchedStation:
    return WatchedStation(tmp_path, monkeypatch)


def test_counters_that_are_not_told_at_the_end_are_lost_and_the_rest_of_the_run_is_kept(
    station: WatchedStation,
) -> None:
    station.look()
    assert station.watch.result(2).lost == {}
    station.names.remove("features")
    result = station.watch.result(2)
    assert result.lost == {"features counters lost: no answer": 1}
    assert result.received["field"] == sum(station.received.values()) / 4
    assert not result.met


def test_a_stream_of_which_nothing_comes_is_lost(station: WatchedStation) -> None:
    """Of a service that is ready and does nothing, or a finger that stops in the warm-up."""
    station.come()  # before the verdicts begin
    station.look(without=[("synthesis", "finger1"), ("field", "finger2")])
    result = station.watch.result(2)
    assert result.lost == {
        "client all synthesis of finger1": 1,
        "client all field of finger2": 1,
    }
    assert not result.fine


@pytest.mark.parametrize("samples", [3, 2 * BINS])
def test_a_process_that_ends_for_good_is_lost_and_the_rest_of_the_run_is_kept(
    station: WatchedStation, samples: int
) -> None:
    history = station.watch.histories["router"] = History()
    for _ in range(samples):
        history.add(station.watch.look(), 1, Use(100 << 20, 3, 10))
    station.look()
    result = station.watch.result(2)
    assert result.lost == {"router not there all the time": 1}
    assert "up" in result.processes
    assert not result.fine
