"""What breaks around a station: the account of estimates, and one row tried for real."""

from __future__ import annotations

import json
import queue
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from itertools import count, repeat
from pathlib import Path
from types import SimpleNamespace
from typing import TypeVar, cast

import numpy as np
import pytest

from palpate.errors import LinkError, StreamTimeout
from palpate_deploy.bench import fault_station, faults
from palpate_deploy.bench.fault_station import FORGED_TICK, EstimateObserver, account_of
from palpate_deploy.station.profile import Profile

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]
Result = TypeVar("Result")

MS = 1_000_000


def test_every_frame_is_accounted_for() -> None:
    ticks = [1, 2, 3, FORGED_TICK, 6, 5, 7]
    taken = [10, 20, 30, 30, 60, 50, 70]
    arrived = [11, 22, 31, 35, 90, 91, 92]
    rows = np.array([ticks, np.array(taken) * MS, np.array(arrived) * MS], np.int64).T
    account = account_of(rows)
    assert (account.received, account.forged, account.disordered) == (6, 1, 1)
    assert account.lost == 3  # 4 and 5 before the step back, 6 after it
    assert account.youngest_s == pytest.approx(1e-3)
    assert account.longest_gap_s == pytest.approx(59e-3)
    future = rows - np.array([0, -5 * MS, 0])
    assert account_of(future).youngest_s == pytest.approx(-4e-3)


@pytest.mark.parametrize("good", [0, 1])
def test_a_part_without_two_estimates_is_an_error(good: int) -> None:
    forged = [[FORGED_TICK, 15 * MS, 17 * MS]] * 3
    rows = np.array([[1, 10 * MS, 12 * MS]][:good] + forged, np.int64)
    with pytest.raises(LinkError, match=f"{good} estimates of 'finger'"):
        account_of(rows)


class Estimates:
    """A stream of estimates that come when a test says so, in the place of a station's."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._queue: queue.Queue[tuple[int, int]] = queue.Queue()
        session = SimpleNamespace(subscriber=lambda *_, **__: self, close=lambda: None)
        monkeypatch.setattr(fault_station, "join", lambda *_, **__: session)

    def come(self, tick: int, *, later_ns: int = 0) -> None:
        """An estimate of a frame that is taken now, or later."""
        self._queue.put((tick, time.monotonic_ns() + later_ns))

    def come_until(
        self, what: Callable[[], Result], ticks: Iterable[int], *, later_ns: int = 0
    ) -> tuple[Result, int]:
        """Estimates one after another until a call has ended; its result and the last tick."""
        with ThreadPoolExecutor() as pool:
            call = pool.submit(what)
            for tick in ticks:
                self.come(tick, later_ns=later_ns)
                if wait([call], timeout=0.05).done:
                    break
            return call.result(), tick

    def next(self, timeout_s: float) -> SimpleNamespace:
        try:
            tick, taken_ns = self._queue.get(timeout=timeout_s)
        except queue.Empty:
            raise StreamTimeout("none", remedy="none") from None
        source = SimpleNamespace(device_tick=tick, monotonic_ns=taken_ns)
        return SimpleNamespace(
            message=SimpleNamespace(source=source), received_monotonic_ns=time.monotonic_ns()
        )


@pytest.fixture
def estimates(monkeypatch: pytest.MonkeyPatch) -> Estimates:
    return Estimates(monkeypatch)


@pytest.fixture
def observer(estimates: Estimates) -> Iterator[EstimateObserver]:
    one = EstimateObserver(cast(Profile, None))
    yield one
    one.close()


def test_a_stall_is_a_hole(estimates: Estimates, observer: EstimateObserver) -> None:
    """One that begins with the part and lasts beyond its end, too."""
    mark, last = estimates.come_until(observer.mark, count(7))
    part = partial(observer.account, mark)
    account, _ = estimates.come_until(part, count(last + 23), later_ns=10**9)
    assert account.lost == 22


def test_a_stream_that_stops_is_an_error(
    estimates: Estimates, observer: EstimateObserver, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark, last = estimates.come_until(observer.mark, count(7))
    estimates.come(last + 1)
    monkeypatch.setattr(fault_station, "_PATIENCE_S", 0.3)
    part = partial(observer.account, mark)
    with pytest.raises(LinkError, match="no estimate of 'finger'"):
        estimates.come_until(part, repeat(FORGED_TICK), later_ns=10**12)


def test_a_row_that_breaks_off_is_not_met_and_named(capsys: pytest.CaptureFixture[str]) -> None:
    def run(seconds: float) -> tuple[bool, fault_station.Figures]:
        raise LinkError("no estimate of 'finger' for 30 s", remedy="see the logs")

    result = faults._tried(faults.FaultTrial("router killed", "0 lost", run), 1.0)
    assert (result.met, result.figures) == (False, {})
    assert "no estimate" in result.why
    assert "router killed: no estimate" in capsys.readouterr().err


def test_an_unknown_fault_is_named(palpate: Palpate) -> None:
    result = palpate("bench", "faults", "--only", "earthquake")
    assert result.returncode == 2
    assert "no fault is named 'earthquake'" in result.stderr
    assert "router killed" in result.stderr


@pytest.mark.slow
def test_a_killed_router(palpate: Palpate, bundle: str, tmp_path: Path) -> None:
    out = tmp_path / "faults.json"
    result = palpate(
        *("bench", "faults", "--only", "router", "--seconds", "0.5", "--out", out), timeout=120
    )
    assert result.returncode in (0, 1), result.stderr  # how soon it is over is not a test
    (row,) = json.loads(out.read_text())["faults"]
    assert not row["why"]
    assert row["figures"]["estimates"] > 50
    assert row["figures"]["all_found_s"] < 20
