"""What breaks around a station: the account of estimates, and one row tried for real."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from palpate_deploy.bench.fault_station import FORGED_TICK, account_of

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]

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
    assert account_of(rows[:0]).received == 0


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
