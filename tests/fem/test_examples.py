"""docs/examples runs as it stands, against a service that solves a formula."""

from __future__ import annotations

import functools
import runpy
from pathlib import Path
from typing import Any

import pytest

from palpate.client import Client


@pytest.fixture
def example(root: Path) -> str:
    return str(root / "docs" / "examples" / "simulate.py")


def test_a_press_is_shown_step_by_step(
    example: str, service: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ours = functools.partial(Client, service.link.connect[0])  # not a station's usual port
    monkeypatch.setattr("palpate.client.Client", ours)
    runpy.run_path(example, run_name="__main__")
    *steps, last = capsys.readouterr().out.splitlines()
    assert [int(line.split()[0]) for line in steps] == list(range(20))
    assert all(line.endswith("kPa") for line in steps)
    assert last.strip() == "complete"


def test_a_simulation_is_watched_and_stopped(
    root: Path, service: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PALPATE_CONNECT", service.link.connect[0])
    runpy.run_path(str(root / "docs/examples/simulate_cancel.py"), run_name="__main__")
    *progress, last = capsys.readouterr().out.splitlines()
    assert any(line.startswith("indenting") for line in progress)
    outcome, steps = last.split(": ")
    assert outcome in ("cancelled", "complete")
    assert 0 < int(steps.split()[0]) <= 40


def test_without_a_station_it_says_what_to_do(
    example: str, free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    nowhere = functools.partial(Client, f"tcp/127.0.0.1:{free_port}", timeout_s=0.2)
    monkeypatch.setattr("palpate.client.Client", nowhere)
    with pytest.raises(SystemExit, match="palpate up"):
        runpy.run_path(example, run_name="__main__")
