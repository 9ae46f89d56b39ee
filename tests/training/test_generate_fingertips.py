"""Experiments of several fingertips on several devices: all made, stopped, failing, killed."""

from __future__ import annotations

import os
import signal
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pytest

from palpate.cluster import WorkerLostError
from palpate.errors import DatasetError
from palpate_training.experiment.generate import fingertips
from palpate_training.experiment.generate.fingertips import FingertipShare, SharedExperiment
from palpate_training.experiment.generate.pipeline import OnStage
from palpate_training.experiment.generate.simulator import ExperimentSpec, TwinSimulator

LONG_S = 60.0


@pytest.fixture(autouse=True)
def _found_by_new_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))  # they import this module


@dataclass(frozen=True, slots=True)
class Scripted(SharedExperiment[str]):
    """Does what the names of its shares say, and writes down which device did it."""

    def one(
        self,
        share: FingertipShare,
        devices: tuple[str, ...],
        workers: int,
        stop: threading.Event,
        on_stage: OnStage,
    ) -> str | None:
        on_stage("mechanics", 1, 2, share.name)
        if "pressed" in share.name:
            on_stage("trials", 0, 1, "")
            wait_for(self.out / "next.begun", stop)
        (self.out / share.name).with_suffix(".begun").write_text(" ".join(devices))
        if "damaged" in share.name:
            raise DatasetError(f"{share.name} is damaged", remedy="remove it")
        if "killed" in share.name:
            os.kill(os.getpid(), signal.SIGKILL)
        if "leaving" in share.name:  # after its end is told
            threading.Timer(1.0, os._exit, [1]).start()
        if "long" in share.name and stop.wait(LONG_S):
            return None
        if "hanging" in share.name:
            os.kill(os.getpid(), signal.SIGSTOP)
        if "signalled" in share.name:  # as every process of a group is
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGINT)
        return f"{share.name}: {workers} workers"


def wait_for(path: Path, stop: threading.Event) -> None:
    end = time.monotonic() + LONG_S
    while not path.exists() and not stop.is_set():
        if time.monotonic() > end:
            raise DatasetError(f"{path} has not come", remedy="none")
        time.sleep(0.01)


def scripted(out: Path, *devices: str) -> Scripted:
    nothing = cast("TwinSimulator", None)
    return Scripted(out, nothing, cast("Any", None), workers=6, devices=devices)


def shares(*names: str) -> list[FingertipShare]:
    return [FingertipShare(name, ExperimentSpec(presses=1), ()) for name in names]


def test_all_are_made_each_on_one_device_with_progress(tmp_path: Path) -> None:
    told: list[tuple[Any, ...]] = []
    experiment = scripted(tmp_path, "cuda:0", "cuda:1", "cuda:1")
    found = experiment.made(
        shares("a", "b", "signalled", "c", "d"), threading.Event(), lambda *one: told.append(one)
    )
    summaries = {share.name: summary for share, summary in found}
    assert summaries == {n: f"{n}: 2 workers" for n in ("a", "b", "signalled", "c", "d")}
    assert sorted(told) == [(n, "mechanics", 1, 2, n) for n in ("a", "b", "c", "d", "signalled")]
    for name in summaries:
        assert (tmp_path / f"{name}.begun").read_text() in ("cuda:0", "cuda:1")


@pytest.mark.parametrize("devices", [("cuda:0",), ("cuda:0", "cuda:1")])
def test_a_device_presses_the_next_while_trials_are_made(
    tmp_path: Path, devices: tuple[str, ...]
) -> None:
    """All devices are free though what they have pressed is not done."""
    names = {*(f"pressed-{device[-1]}" for device in devices), "next"}
    found = scripted(tmp_path, *devices).made(
        shares(*sorted(names, reverse=True)), threading.Event()
    )
    assert {share.name for share, _ in found} == names


def test_without_devices_all_are_made_here_one_after_the_other(tmp_path: Path) -> None:
    found = scripted(tmp_path).made(shares("a", "b"), threading.Event())
    assert [summary for _, summary in found] == ["a: 6 workers", "b: 6 workers"]


@pytest.mark.parametrize(
    ("name", "error", "said"),
    [
        ("damaged", DatasetError, "damaged is damaged"),
        ("killed", WorkerLostError, "the process that made killed died"),
    ],
)
def test_one_that_fails_stops_the_others_and_is_named(
    tmp_path: Path, name: str, error: type[Exception], said: str
) -> None:
    experiment, began = scripted(tmp_path, "cuda:0", "cuda:1"), time.monotonic()
    with pytest.raises(error, match=said):
        list(experiment.made(shares("long", name, "never", "begun"), threading.Event()))
    assert time.monotonic() - began < LONG_S
    assert not (tmp_path / "begun.begun").exists()


def test_one_that_dies_while_it_waits_is_named(tmp_path: Path) -> None:
    """The only device is still busy with another, so nothing is given to it."""
    experiment = scripted(tmp_path, "cuda:0")
    with pytest.raises(WorkerLostError, match="the process that made pressed-leaving died"):
        list(experiment.made(shares("pressed-leaving", "next.long", "never"), threading.Event()))
    assert not (tmp_path / "never.begun").exists()


def test_stopped_they_end_early_and_are_not_told_as_made(tmp_path: Path) -> None:
    stop, experiment = threading.Event(), scripted(tmp_path, "cuda:0", "cuda:1")

    def on_stage(name: str, *_: object) -> None:
        if name == "long-2":
            stop.set()

    began = time.monotonic()
    names = ("a", "long-1", "long-2", "never")
    assert [share.name for share, _ in experiment.made(shares(*names), stop, on_stage)] == ["a"]
    assert time.monotonic() - began < LONG_S
    assert not (tmp_path / "never.begun").exists()


def test_one_that_hangs_does_not_keep_a_stop_waiting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fingertips, "_END_S", 0.5)
    stop, experiment = threading.Event(), scripted(tmp_path, "cuda:0", "cuda:1")

    def on_stage(name: str, *_: object) -> None:
        if name == "hanging":
            stop.set()

    assert not list(experiment.made(shares("long", "hanging"), stop, on_stage))


def test_who_asks_for_no_more_ends_them(tmp_path: Path) -> None:
    experiment, began = scripted(tmp_path, "cuda:0", "cuda:1"), time.monotonic()
    found = experiment.made(shares("a", "long"), threading.Event())
    next(found)
    found.close()  # type: ignore[attr-defined]
    assert time.monotonic() - began < LONG_S
