"""Sweeps over worker processes into a store: resumed, stopped, with workers that die."""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import DatasetError, RemoteError
from palpate_fem.calibration.runs import PlannedPath
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.approach import OuterSurface
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.indenter.distance import signed_distance
from palpate_fem.result import IndentationOutcome, IndentationResult
from palpate_fem.service import pool
from palpate_fem.service.batch import BatchReport, OnReport, SimulationBatch, sweep_into_store
from palpate_fem.service.jobs import JobEvent, JobStarted, Pressurising, WorkerSetup
from palpate_fem.store.content import StoredFingertip
from palpate_fem.store.read import SimulationStore
from palpate_fem.trajectory import PlannedIndentation

fakes: Any = importlib.import_module("fem_fakes")

STEPS = 4
KEPT_M = 2e-9
"""Outlines are kept as float32, which rounds 18 mm to 1 nm."""


def plans(count: int, name: str = "sphere_medium") -> list[PlannedPath]:
    path = np.zeros((STEPS + 1, 7))
    path[:, 3] = 1.0
    path[:, 2] = np.linspace(-0.009, -0.005, STEPS + 1)
    return [PlannedPath(f"{name}/{k:02}/normal", name, path) for k in range(count)]


def batch_of(kind: float, **more: Any) -> SimulationBatch:
    parameters = FingertipParameters(friction_coefficient=kind)
    setup = WorkerSetup("fem_fakes:make", more.pop("options", {}), parameters, 1)
    return SimulationBatch(setup, **{"workers": 1, "threads": 1, "grace_s": 0.3, **more})


pytestmark = pytest.mark.usefixtures("workers_find_fakes")


def run(kind: float, count: int, **more: Any) -> tuple[BatchReport, list[IndentationResult]]:
    kept: list[IndentationResult] = []
    batch = batch_of(kind, **more)
    try:
        report = batch.run(
            plans(count),
            count,
            stop=threading.Event(),
            on_trajectory=lambda _, trajectory: kept.append(trajectory),
        )
    finally:
        batch.close()
    return report, kept


def test_all_are_run() -> None:
    report, kept = run(fakes.QUICK, 7, workers=2)
    assert (report.done, report.outcomes["complete"], report.early) == (7, 7, [])
    assert all(len(trajectory.steps) == STEPS for trajectory in kept)


def test_one_fingertip_is_kept_of_all_that_workers_report() -> None:
    def held() -> int:
        gc.collect()
        return sum(type(one) is StoredFingertip for one in gc.get_objects())

    before = held()
    with batch_of(fakes.QUICK) as batch:
        first = batch.fingertip(threading.Event())
        batch.run(plans(9), 9, stop=threading.Event(), on_trajectory=lambda *_: None)
        assert batch.fingertip(threading.Event()) is first
        assert held() <= before + 2  # one may still be on its way


@pytest.mark.parametrize(
    ("kind", "how", "steps"),
    [("DIVERGES", "diverged", 2), ("PINCHES", "force limit", 2), ("STUBBORN", "deadline", 2)],
)
def test_every_early_end_is_told_and_kept(kind: str, how: str, steps: int) -> None:
    report, kept = run(getattr(fakes, kind), 2, limit_s=0.5)
    assert report.outcomes[how] == 2
    assert [(early.how, early.steps, early.steps_total) for early in report.early] == [
        (how, steps, STEPS)
    ] * 2
    assert all(early.reason for early in report.early)
    assert [len(trajectory.steps) for trajectory in kept] == [steps, steps]


@pytest.mark.parametrize(("kind", "said"), [("DIES", "exit status 7"), ("REFUSES", "folded")])
def test_what_fails_does_not_stop_the_others(kind: str, said: str) -> None:
    report, kept = run(getattr(fakes, kind), 3)
    assert (report.failed, kept) == (3, [])
    assert all(said in early.reason for early in report.early)


def test_a_solver_that_does_not_start_ends_the_sweep() -> None:
    with pytest.raises(RemoteError, match="no such mesh"):
        run(fakes.QUICK, 2, options={"broken": "no such mesh"})


def test_a_solver_that_hangs_before_it_is_ready_ends_the_sweep(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pool, "START_S", 0.5)
    monkeypatch.setattr(pool, "_PAUSE_S", 0.0)
    with batch_of(fakes.QUICK, options={"broken": "hangs"}) as batch:
        with pytest.raises(RemoteError, match=r"silent for 0\.5 s before it was ready"):
            batch.fingertip(threading.Event())


def test_a_solver_that_starts_slowly_says_that_it_lives() -> None:
    events: queue.SimpleQueue[JobEvent] = queue.SimpleQueue()
    setup = WorkerSetup("fem_fakes:make", {"fill_s": 1.0}, FingertipParameters(), 1)
    worker = pool.WorkerProcess(setup, 1, lambda _, event: events.put(event), lambda _: None)
    try:
        assert isinstance(events.get(timeout=60.0), Pressurising)
        while isinstance(last := events.get(timeout=60.0), Pressurising):
            pass
        assert isinstance(last, JobStarted)
    finally:
        worker.kill()
        worker.join()


def run_batch(
    batch: Any, plans: Any, on_report: OnReport | None = None
) -> tuple[BatchReport, dict[str, IndentationResult]]:
    """Run and close; each trajectory is answered no more than once."""
    kept: dict[str, IndentationResult] = {}

    def keep(plan: Any, result: IndentationResult) -> None:
        assert plan.name not in kept
        kept[plan.name] = result

    with batch:
        report = batch.run(
            plans, len(plans), stop=threading.Event(), on_trajectory=keep, on_report=on_report
        )
    return report, kept


def store_batch(path: Path, batch: Any, plans: Any, **more: Any) -> tuple[BatchReport, int]:
    """Run into a store and close."""
    with batch:
        return sweep_into_store(
            batch, plans, path, **{"stop": threading.Event(), "packers": 1, **more}
        )


def into_store(path: Path, kind: float, count: int, stop: threading.Event) -> Any:
    batch = batch_of(kind, workers=2)
    try:
        return sweep_into_store(batch, plans(count), path, stop=stop)
    finally:
        batch.close()


def test_a_path_that_cannot_be_made_does_not_stop_the_others(tmp_path: Path) -> None:
    """Campaigns make each path when its turn comes."""
    nodes = 0.01 * np.array(
        [(1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (-1.0, -1.0, 0.0), (-1.0, 1.0, 0.0)]
    )
    skin = OuterSurface(nodes, np.array([[0, 1, 2, 3]], np.int32))
    up = np.array([0.0, 0.0, 1.0])
    beside = PlannedIndentation(
        "sphere_medium/09/normal", "sphere_medium", np.full(3, 0.1), -up, up, 1e-3, STEPS, skin
    )
    report, _ = store_batch(
        tmp_path / "a.sim", batch_of(fakes.QUICK), [beside, *plans(2)], packers=0
    )
    assert report.outcomes == {"complete": 2, "failed": 1}
    assert (report.done, report.total) == (3, 3)
    (early,) = report.early
    assert (early.name, early.how) == (beside.name, "failed")
    assert "passes the fingertip" in early.reason


def test_a_store_is_filled_and_resumed(tmp_path: Path) -> None:
    path = tmp_path / "a.sim"
    report, there = into_store(path, fakes.QUICK, 3, threading.Event())
    assert (report.done, there) == (3, 0)
    report, there = into_store(path, fakes.QUICK, 5, threading.Event())
    assert (report.done, there) == (2, 3)
    store = SimulationStore.open(path)
    assert len(store.ids()) == 5
    assert store.trajectory(store.ids()[0]).outcome is IndentationOutcome.COMPLETE
    for name in store.ids():
        outline = store.outline(name)
        assert outline is not None, "pictures show the indenter"
        gaps = signed_distance(make_indenter("sphere_medium"), np.asarray(outline[0]))
        np.testing.assert_allclose(gaps, 0.0, atol=KEPT_M)
    with pytest.raises(DatasetError, match="friction_coefficient"):
        into_store(path, fakes.SLOW, 5, threading.Event())


def test_trajectories_of_the_same_names_along_other_paths_are_not_mixed(tmp_path: Path) -> None:
    """As of another seed of the points, or of other steps."""
    path, stop = tmp_path / "a.sim", threading.Event()
    into_store(path, fakes.QUICK, 2, stop)
    other = [replace(plan, path=plan.path + 1e-4) for plan in plans(3)]
    with pytest.raises(DatasetError, match="another path"):
        store_batch(path, batch_of(fakes.QUICK), other)
    assert len(SimulationStore.open(path).ids()) == 2


def test_stopping_keeps_what_has_ended(tmp_path: Path) -> None:
    path = tmp_path / "a.sim"
    stop = threading.Event()
    batch = batch_of(fakes.SLOW)
    try:
        report, _ = sweep_into_store(
            batch,
            plans(20),
            path,
            stop=stop,
            on_report=lambda report: stop.set() if report.done >= 2 else None,
        )
    finally:
        batch.close()
    assert report.stopped
    assert 2 <= report.done < 20
    assert len(SimulationStore.open(path).done()) == report.done
    again, there = into_store(path, fakes.SLOW, report.done + 1, threading.Event())
    assert (again.done, there) == (1, report.done)


KILLED = """
import threading, sys
sys.path.insert(0, {folder!r})
from test_sweep import into_store, fakes
from pathlib import Path
into_store(Path({store!r}), fakes.SLOW, 40, threading.Event())
"""


def test_a_killed_sweep_leaves_no_process_and_a_good_store(tmp_path: Path) -> None:
    """Written without a guard for the main module, as a robot programmer would."""
    store = tmp_path / "a.sim"
    script = tmp_path / "script.py"
    script.write_text(KILLED.format(folder=str(Path(__file__).parent), store=str(store)))
    with group_of(sys.executable, str(script)) as process:
        deadline = time.monotonic() + 60
        while len(list(store.rglob("*normal.h5"))) < 2:
            assert time.monotonic() < deadline, "nothing was written"
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        while _members(process.pid):
            assert time.monotonic() < deadline, "workers outlive the one who started them"
            time.sleep(0.02)
    done = len(SimulationStore.open(store).done())
    assert done >= 2
    report, there = into_store(store, fakes.SLOW, done + 1, threading.Event())
    assert (report.done, there) == (1, done)


@contextlib.contextmanager
def group_of(*command: str) -> Iterator[subprocess.Popen[bytes]]:
    """A process with a group of its own, of which nothing is left at the end."""
    process = subprocess.Popen(command, start_new_session=True)
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):  # all have ended
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _members(group: int) -> list[int]:
    """Processes of a group that still run."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[2]) == group and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found
