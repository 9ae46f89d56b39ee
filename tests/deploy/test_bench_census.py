"""The benchmark of ``palpate status``: that it runs, and that an incomplete answer counts."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from palpate_deploy.bench import census
from palpate_deploy.station.processes import FiniteRun

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]

WANTED = frozenset({"router", "gateway", "features"})


@pytest.mark.parametrize(
    ("told", "code", "complete", "ready"),
    [
        (("gateway", "features"), 0, True, True),
        (("gateway", "features"), 1, True, False),
        (("gateway",), 0, False, True),
        (None, 1, False, False),
    ],
)
def test_an_answer_is_complete_if_it_tells_every_state(
    monkeypatch: pytest.MonkeyPatch,
    told: tuple[str, ...] | None,
    code: int,
    complete: bool,
    ready: bool,
) -> None:
    processes: list[dict[str, Any]] = [{"service": "router"}, {"service": "recorder"}]
    processes += [{"service": name, "state": "ready"} for name in told or ()]
    text = json.dumps({"router": True, "troubles": [], "processes": processes})
    answer = SimpleNamespace(stdout="" if told is None else text, stderr="no", returncode=code)
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: answer)
    call = census._call((), WANTED)
    assert (call.complete, call.ready) == (complete, ready)


def test_an_answer_that_never_comes_is_not_complete(monkeypatch: pytest.MonkeyPatch) -> None:
    def hangs(command: list[str], *, timeout: float, **_: object) -> None:
        raise subprocess.TimeoutExpired(command, timeout)

    monkeypatch.setattr(subprocess, "run", hangs)
    call = census._call((), WANTED)
    assert (call.complete, call.ready) == (False, False)
    assert call.missing == ("features", "gateway", "router")
    assert call.troubles == ("no answer within 60 s",)


def test_only_complete_answers_say_that_all_is_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    def call(complete: bool, ready: bool) -> census.StatusCall:
        return census.StatusCall(complete, ready, 1.0)

    start = call(True, True)  # of the station, before the cores are loaded
    calls = iter([start, call(True, True), call(False, True), call(True, False)])
    monkeypatch.setattr(census, "_call", lambda *_: next(calls))
    monkeypatch.setattr(FiniteRun, "start_module", lambda *_: None)
    result = census.measure_status(3, 0)
    assert (result.complete, result.ready) == (2, 1)
    assert len(result.others) == 2


@pytest.mark.slow
def test_it_runs(palpate: Palpate, tmp_path: Path) -> None:
    out = tmp_path / "status.json"
    words = ("bench", "status", "--count", "2", "--out", out, "--json")
    # One core is loaded and not all: other tests run beside this one.
    done = palpate(*words, timeout=300, first="import os; os.cpu_count = lambda: 1")
    assert done.returncode == 0, done.stderr + done.stdout
    told = json.loads(out.read_text(encoding="utf-8"))
    assert told["status"]["calls"] == told["status"]["complete"] == 2
    assert told["status"]["processes"] == 7
    assert json.loads(done.stdout)["status.goal_met"] is True
