"""Sweeps over devices into a store: the real solver on the CPU, and processes that die or hang."""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.fem.batched_cases import DEVICE
from typer.testing import CliRunner

from palpate.errors import ConfigError, DatasetError, RemoteError
from palpate_fem.calibration.runs import PlannedPath
from palpate_fem.cli import model as cli_model
from palpate_fem.cli.app import fem_app
from palpate_fem.cli.run import show_report
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.result import IndentationOutcome, IndentationResult
from palpate_fem.service import channel, device_batch
from palpate_fem.service import packing as packing_module
from palpate_fem.service.batch import (
    BatchReport,
    SimulationBatch,
    allow_open_files,
    sweep_into_store,
)
from palpate_fem.service.channel import Channel, ChildProcess, Outbox
from palpate_fem.service.device_batch import DeviceBatch, threads_and_packers
from palpate_fem.service.device_process import check_devices
from palpate_fem.service.fingertips import skin_of
from palpate_fem.service.jobs import WorkerSetup
from palpate_fem.service.packing import PackingProcesses
from palpate_fem.store.content import StoredFingertip
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter
from palpate_fem.trajectory import press_path

fakes: Any = importlib.import_module("fem_fakes")
sweeps: Any = importlib.import_module("test_sweep")
run, into_store = sweeps.run_batch, sweeps.store_batch

PATIENCE_S = 60.0
SAME = 2e-3
"""Share of the largest force: two ways to one equilibrium, within tolerances on a coarse mesh."""
REAL = WorkerSetup(
    "palpate_fem.service.biotac:biotac", {"edge_m": 1.4e-3}, FingertipParameters(), 1
)
INSIDE = "sphere_medium/99/inside"

pytestmark = pytest.mark.usefixtures("workers_find_fakes")


def short(count: int) -> list[PlannedPath]:
    """Plans of two steps."""
    return [PlannedPath(one.name, one.indenter, one.path[:3]) for one in sweeps.plans(count)]


def rest(path: Path, plans: list[PlannedPath], more: int) -> list[PlannedPath]:
    """Of some plans those that a store holds, and some that it does not."""
    done = SimulationStore.open(path).done()
    left = [plan for plan in plans if plan.name not in done]
    return [plan for plan in plans if plan.name in done] + left[:more]


def batch_of(kind: float, devices: int = 1, **more: Any) -> DeviceBatch:
    parameters = FingertipParameters(friction_coefficient=kind)
    setup = WorkerSetup("fem_fakes:make", more.pop("options", {}), parameters, 1)
    return DeviceBatch(setup, ["cpu"] * devices, **{"slots": 3, **more})


def three_presses(tip: StoredFingertip) -> list[PlannedPath]:
    """Shallow ones on the real finger."""
    plans: list[PlannedPath] = []
    for name, x in (("sphere_medium", -4e-3), ("cube", -4e-3), ("sphere_medium", -5e-3)):
        path = press_path(
            make_indenter(name), (x, 0.0, -7.5e-3), (0.0, 0.0, 1.0), skin_of(tip),
            depth_m=0.4e-3, steps=2,
        )  # fmt: skip
        plans.append(PlannedPath(f"{name}/{len(plans):02}/normal", name, path))
    return plans


def check_same(ours: Path, theirs: Path, plans: list[PlannedPath]) -> None:
    """Two stores hold the same trajectories, and just these."""
    found, wanted = SimulationStore.open(ours), SimulationStore.open(theirs)
    assert sorted(found.ids()) == sorted(plan.name for plan in plans)
    assert found.fingertip().key == wanted.fingertip().key
    for name in found.ids():
        one, other = found.trajectory(name), wanted.trajectory(name)
        assert (one.outcome, one.indenter) == (other.outcome, other.indenter)
        size = np.linalg.norm(other.forces[-1])
        assert np.abs(one.forces - other.forces).max() < SAME * size
        assert found.outline(name) is not None


def test_the_store_of_a_device_is_that_of_the_cpu(tmp_path: Path) -> None:
    """The real solver, on two devices; both share the work, and one press begins in the skin."""
    with DeviceBatch(REAL, [DEVICE, DEVICE], slots=2, threads=1) as batch:
        tip = batch.fingertip(threading.Event())
        assert tip is not None
        plans = three_presses(tip)
        inside = PlannedPath(INSIDE, "sphere_medium", plans[0].path[::-1])
        report, _ = sweep_into_store(
            batch, [*plans, inside], tmp_path / "a.sim", stop=threading.Event(), packers=1
        )
    assert dict(report.outcomes) == {"complete": 3, "failed": 1}
    (early,) = report.early
    assert (early.name, "inside the skin" in early.reason) == (INSIDE, True)
    with SimulationBatch(REAL, workers=1, threads=1) as one_by_one:
        sweep_into_store(one_by_one, plans, tmp_path / "b.sim", stop=threading.Event())
    check_same(tmp_path / "a.sim", tmp_path / "b.sim", plans)


def hard(count: int) -> list[PlannedPath]:
    """Plans of three steps, which devices of the kind UNSOLVED do not solve."""
    return [
        PlannedPath(f"hard/{k}", one.indenter, one.path[:4])
        for k, one in enumerate(sweeps.plans(count))
    ]


@pytest.mark.parametrize(
    ("limit_s", "outcomes", "steps"),
    [(600.0, {"complete": 7}, [3, 3, 3]), (0.0, {"complete": 4, "deadline": 3}, [0, 0, 0])],
)
def test_what_devices_do_not_solve_the_cpu_does(
    limit_s: float, outcomes: dict[str, int], steps: list[int]
) -> None:
    """Once, from its first step on, and in the time that it may take."""
    told: list[int] = []
    report, kept = run(
        batch_of(fakes.UNSOLVED, devices=2, limit_s=limit_s),
        [*hard(3), *short(4)],
        lambda report: told.append(report.done),
    )
    assert (dict(report.outcomes), report.on_cpu) == (outcomes, 3)
    assert told == [1, 2, 3, 4, 5, 6, 7]
    assert [len(kept[f"hard/{k}"].steps) for k in range(3)] == steps
    assert len(kept) == 7


def test_what_devices_do_not_solve_may_end_there() -> None:
    """With the steps that were found, and without a worker."""
    report, kept = run(batch_of(fakes.UNSOLVED, devices=2, gives_up=True), [*hard(3), *short(4)])
    assert dict(report.outcomes) == {"complete": 4, "diverged": 3}
    assert report.on_cpu == 0
    assert [len(kept[f"hard/{k}"].steps) for k in range(3)] == [2, 2, 2]
    assert [early.reason for early in report.early] == ["no equilibrium"] * 3


@pytest.mark.parametrize(
    ("broken", "said"), [("no such mesh", "no such mesh"), ("dies", "exit status 9")]
)
def test_only_what_needs_the_cpu_fails_without_it(broken: str, said: str) -> None:
    batch = batch_of(fakes.UNSOLVED, options={"broken": broken, "broken_in": "worker"})
    report, kept = run(batch, [*hard(2), *short(3)])
    assert (report.failed, report.outcomes["complete"], len(kept)) == (2, 3, 3)
    assert report.on_cpu == 0
    assert all(said in early.reason for early in report.early)


def test_hard_ones_do_not_pile_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Devices get no new ones while too many wait for the CPU: each has a file open."""
    monkeypatch.setattr(device_batch, "ON_CPU_MOST", 1)
    batch, taken, most = batch_of(fakes.UNSOLVED, slots=1), 0, 0

    def supplied() -> Any:
        nonlocal taken
        for plan in hard(9):
            taken += 1
            yield plan

    def on_report(report: BatchReport) -> None:
        nonlocal most
        most = max(most, taken - report.done)

    with batch:
        report = batch.run(
            supplied(),
            9,
            stop=threading.Event(),
            on_trajectory=lambda *_: None,
            on_report=on_report,
        )
    assert report.on_cpu == 9
    assert most <= batch.ahead == 3


def test_several_devices_share_the_work() -> None:
    report, kept = run(batch_of(fakes.SLOW, devices=2), short(8))
    assert (report.outcomes["complete"], len(kept), report.early) == (8, 8, [])
    assert all(len(result.steps) == 2 for result in kept.values())
    assert report.wall_s > 0.0


def test_a_batch_may_run_again_and_early_ends_are_kept() -> None:
    batch = batch_of(fakes.DIVERGES)
    with batch:
        for count in (2, 5):
            kept: list[IndentationResult] = []

            def keep(_: Any, result: IndentationResult, into: Any = kept) -> None:
                into.append(result)

            report = batch.run(
                sweeps.plans(count), count, stop=threading.Event(), on_trajectory=keep
            )
            assert report.outcomes["diverged"] == len(report.early) == len(kept) == count
            assert all(len(result.steps) == 2 for result in kept)


def test_what_cannot_be_run_fails_alone() -> None:
    plans = sweeps.plans(4)
    wrong = plans[1].path * np.nan
    inside = plans[1].path.copy()
    inside[:, 2] += 0.009
    plans[1:1] = [
        PlannedPath("a/wrong/path", "sphere_medium", wrong),
        PlannedPath("a/inside/path", "sphere_medium", inside),
        PlannedPath("a/unknown/path", "spoon", plans[1].path),
    ]
    report, kept = run(batch_of(fakes.QUICK), plans)
    assert (report.failed, report.outcomes["complete"], len(kept)) == (3, 4, 4)
    reasons = {early.name: early.reason for early in report.early}
    assert "inside" in reasons["a/inside/path"]
    assert "spoon" in reasons["a/unknown/path"]
    assert reasons["a/wrong/path"]


def signalled(
    batch: DeviceBatch, number: int, after: int
) -> tuple[Callable[[BatchReport], None], list[int]]:
    """Send a signal to the first device when so many trajectories have ended; once."""
    sent: list[int] = []

    def on_report(report: BatchReport) -> None:
        if report.done >= after and not sent:
            sent.append(batch.pids[0])
            os.kill(sent[0], number)

    return on_report, sent


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("devices", [1, 2])
def test_a_lost_device_loses_nothing(number: int, devices: int) -> None:
    """Killed or stopped; what it had is solved by the other, or by itself, started once more."""
    # A busy machine stands still for a second or two: a solver must not pass for hung by that.
    batch = batch_of(fakes.SLOW, devices=devices, hang_s=20.0 if number == signal.SIGKILL else 5.0)
    on_report, sent = signalled(batch, number, 3)
    report, kept = run(batch, short(9), on_report)
    assert sent
    assert (report.outcomes["complete"], report.done, len(kept)) == (9, 9, 9)


def test_what_the_only_device_had_last_is_not_forgotten() -> None:
    """It is lost when all have been handed out: then nothing is open, but not all is done."""
    batch = batch_of(fakes.SLOW)
    on_report, sent = signalled(batch, signal.SIGKILL, 4)
    report, kept = run(batch, short(7), on_report)
    assert sent
    assert (report.outcomes["complete"], report.done, len(kept)) == (7, 7, 7)


@pytest.mark.parametrize("devices", [1, 2])
def test_one_that_ends_devices_costs_itself_only(devices: int) -> None:
    """It goes to the CPU in the end, which it ends, too; those beside it are solved."""
    (one,) = sweeps.plans(1)
    poison = PlannedPath("a/poison/path", one.indenter, one.path)
    plans = short(20)  # too short to do any harm
    plans[1:1] = [poison]
    report, _ = run(batch_of(fakes.DIES, devices=devices), plans)
    assert (report.outcomes["complete"], report.failed) == (20, 1)
    assert report.early[0].name == poison.name
    assert "exit status 7" in report.early[0].reason


@pytest.mark.parametrize(
    ("kind", "said"),
    [("DIES", "exit status 7, again"), ("STUBBORN", "silent"), ("DEFECTIVE", "a defect")],
)
def test_a_solver_that_dies_again_ends_the_batch(kind: str, said: str) -> None:
    batch = batch_of(getattr(fakes, kind), start_s=60.0, hang_s=2.0 if kind == "STUBBORN" else 20.0)
    with pytest.raises(RemoteError, match=said):
        run(batch, sweeps.plans(20))


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"options": {"broken": "no such mesh"}}, "no such mesh"),
        ({"options": {"broken": "dies"}}, "exit status 9, again"),
        ({"slots": 101}, "101 slots cannot be had on cpu"),
    ],
)
def test_a_device_that_does_not_start_says_why(more: dict[str, Any], said: str) -> None:
    with pytest.raises(RemoteError, match=said):
        run(batch_of(fakes.QUICK, **more), sweeps.plans(2))


def test_a_fingertip_for_the_cpu_only_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    setup = WorkerSetup("fem_fakes:without_device", {}, FingertipParameters(), 1)
    with pytest.raises(RemoteError, match="cannot be put on a device"):
        run(DeviceBatch(setup, ["cpu"]), sweeps.plans(1))


def test_a_store_is_filled_stopped_and_resumed(tmp_path: Path) -> None:
    path, stop = tmp_path / "a.sim", threading.Event()
    report, _ = into_store(
        path,
        batch_of(fakes.SLOW),
        short(20),
        stop=stop,
        on_report=lambda report: stop.set() if report.done >= 2 else None,
    )
    assert report.stopped
    assert 2 <= report.done < 20
    store = SimulationStore.open(path)
    assert len(store.done()) == report.done, "what was reported is on the disk"
    assert not list(path.rglob("*.part")), "nothing is half written"
    again, there = into_store(path, batch_of(fakes.SLOW, 2), rest(path, short(20), 3))
    assert (again.done, there) == (3, report.done)
    for name in store.ids():
        assert store.trajectory(name).outcome is IndentationOutcome.COMPLETE
        assert store.outline(name) is not None
    with pytest.raises(DatasetError, match="friction_coefficient"):
        into_store(path, batch_of(fakes.QUICK), sweeps.plans(1))


def test_what_was_done_before_the_last_device_died_is_kept(tmp_path: Path) -> None:
    path, batch = tmp_path / "a.sim", batch_of(fakes.SLOW)

    def on_report(report: BatchReport) -> None:
        with contextlib.suppress(ProcessLookupError):  # it is gone, and that is not noticed yet
            os.kill(batch.pids[0], signal.SIGKILL)

    with pytest.raises(RemoteError, match="SIGKILL"):
        into_store(path, batch, short(20), on_report=on_report)
    assert not list(path.rglob("*.part"))
    done = len(SimulationStore.open(path).done())
    assert done < 20
    report, there = into_store(path, batch_of(fakes.SLOW), rest(path, short(20), 1))
    assert (report.done, there) == (1, done)


KILLED = """
import sys
sys.path[:0] = {folders!r}
from test_device_sweep import batch_of, fakes, into_store, short
from pathlib import Path
into_store(Path({store!r}), batch_of(fakes.SLOW, 2), short(90))
"""


def test_a_killed_sweep_leaves_no_process_and_a_good_store(tmp_path: Path) -> None:
    """Written without a guard for the main module, as a robot programmer would."""
    store, script = tmp_path / "a.sim", tmp_path / "script.py"
    folders = [str(Path(__file__).parents[up]) for up in (0, 2)]
    script.write_text(KILLED.format(folders=folders, store=str(store)))
    with sweeps.group_of(sys.executable, str(script)) as process:
        deadline = time.monotonic() + PATIENCE_S
        while len(list(store.rglob("*normal.h5"))) < 3:
            assert time.monotonic() < deadline, "nothing was written"
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        while sweeps._members(process.pid):
            assert time.monotonic() < deadline, "processes outlive the one who started them"
            time.sleep(0.02)
    done = len(SimulationStore.open(store).done())
    assert 3 <= done < 90
    report, there = into_store(store, batch_of(fakes.SLOW), rest(store, short(90), 2))
    assert (report.done, there) == (2, done)


def test_a_channel_carries_what_is_large_and_what_is_small() -> None:
    one, other = (Channel(end.detach()) for end in socket.socketpair())
    large = np.arange(3 * 50_001.0).reshape(-1, 3)
    sent = [
        {"large": large, "again": large[::2], "small": np.arange(3), "none": np.zeros((0, 3))},
        "word",
        [large.astype(np.float32)] * 2,
        np.frombuffer(bytes(range(256)) * 999, np.uint8),
    ]
    outbox = Outbox(one)
    for value in sent:
        outbox.put(value)
    found = [other.receive() for _ in sent]
    outbox.close()
    for name, array in sent[0].items():  # type: ignore[attr-defined]
        np.testing.assert_array_equal(found[0][name], array)
    assert found[1] == "word"
    np.testing.assert_array_equal(found[2], sent[2])
    np.testing.assert_array_equal(found[3], sent[3])
    found[0]["large"][0] = 7.0  # the receiver's own
    assert large[0, 1] == 1.0
    one.close()
    with pytest.raises(EOFError):
        other.receive()
    with pytest.raises(BrokenPipeError):
        other.send("word")
    other.close()


def results(count: int) -> list[tuple[str, IndentationResult]]:
    tip = fakes.FakeTip(FingertipParameters(), 4000)  # so many nodes that arrays are shared
    return [
        (plan.name, tip.indent(plan.indenter, plan.path, friction_coefficient=0.1))
        for plan in sweeps.plans(count)
    ]


@pytest.mark.parametrize("killed", [0, 1, 2])
def test_files_are_the_same_whoever_packs_them(tmp_path: Path, killed: int) -> None:
    """Also if processes that pack are killed: then this one does it."""
    tip = fakes.FakeTip(FingertipParameters(), 4000).describe()
    path = tmp_path / "a.sim"
    with StoreWriter(path, tip) as store, PackingProcesses(store.images, 2) as packing:
        for number, (name, result) in enumerate(results(6)):
            packing.put(store.claim(name), result)
            if number == 2:
                for pid in packing.pids[:killed]:
                    os.kill(pid, signal.SIGKILL)
        packing.finish()
    there = SimulationStore.open(path)
    assert len(there.ids()) == 6
    for name, result in results(6):
        found = there.trajectory(name)
        np.testing.assert_array_equal(found.forces, result.forces)
        np.testing.assert_array_equal(
            found.steps[1].displacement, result.steps[1].displacement.astype(np.float32)
        )


def pack_all(path: Path, then: Callable[[PackingProcesses], None] = lambda _: None) -> None:
    """Six trajectories through two processes; ``then`` is called when two have been given."""
    tip = fakes.FakeTip(FingertipParameters(), 4000).describe()

    def pack() -> None:
        with StoreWriter(path, tip) as store, PackingProcesses(store.images, 2) as packing:
            for number, (name, result) in enumerate(results(6)):
                packing.put(store.claim(name), result)
                if number == 1:
                    then(packing)
            packing.finish()

    thread = threading.Thread(target=pack, daemon=True)
    thread.start()
    thread.join(PATIENCE_S)
    assert not thread.is_alive(), "it waits without end"
    assert SimulationStore.open(path).check() == 6


def test_a_process_that_packs_and_stands_still_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packing_module, "HANG_S", 2.0)
    pack_all(tmp_path / "a.sim", lambda packing: os.kill(packing.pids[0], signal.SIGSTOP))


def test_a_process_that_cannot_be_sent_anything_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Descriptors have run out in this process."""

    def refuse(_: object) -> int:
        raise OSError(errno.EMFILE, "too many open files")

    pack_all(tmp_path / "a.sim", lambda _: monkeypatch.setattr(channel, "_shared", refuse))


def test_a_process_that_cannot_be_heard_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Memory has run out in this process."""

    def refuse(_: object) -> object:
        raise MemoryError

    monkeypatch.setattr(Channel, "receive", refuse)
    pack_all(tmp_path / "a.sim")


def test_a_process_for_which_there_is_no_thread_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is refused like one for which there is no memory: who starts it tries again later."""
    start, popen = threading.Thread.start, subprocess.Popen
    made: list[Any] = []

    def refuse(thread: threading.Thread) -> None:
        if thread.name.startswith("child"):
            raise RuntimeError("can't start new thread")
        start(thread)

    def noted(*words: Any, **more: Any) -> Any:
        made.append(popen(*words, **more))
        return made[-1]

    monkeypatch.setattr(threading.Thread, "start", refuse)
    monkeypatch.setattr(subprocess, "Popen", noted)
    with pytest.raises(OSError, match="no thread"):
        ChildProcess(
            "palpate_fem.service.packing",
            None,
            threads=1,
            on_message=lambda *_: None,
            on_gone=lambda _: None,
        )
    assert made[0].returncode is not None


def test_a_full_disk_ends_the_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise DatasetError("the disk is full", remedy="free some space")

    tip = fakes.FakeTip(FingertipParameters(), 4000).describe()
    path = tmp_path / "a.sim"
    with StoreWriter(path, tip) as store, PackingProcesses(store.images, 1) as packing:
        monkeypatch.setattr("palpate_fem.store.writer.TrajectoryClaim.commit", refuse)
        (name, result), *_ = results(1)
        packing.put(store.claim(name), result)
        with pytest.raises(DatasetError, match="disk is full"):
            packing.finish()
    assert not list(path.rglob("*.part"))


def command(*words: object) -> Any:
    return CliRunner().invoke(fem_app, ["run", *map(str, words)], catch_exceptions=False)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--device", "cpu"), "--device without --sweep"),
        (("--slots", 4), "--slots without --sweep"),
        (("--sweep", "--store", "a.sim", "--slots", 4), "--slots without --device"),
        (("--sweep", "--store", "a.sim", "--device", "cuda:77"), "cuda:77"),
        (("--sweep", "--store", "a.sim", "--device", "cpu", "--device", "gpu"), "'gpu'"),
    ],
)
def test_what_cannot_be_meant_is_refused_at_once(
    words: tuple[object, ...], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_batch, "DeviceProcess", None)  # nothing may be started
    with pytest.raises(ConfigError, match=said):
        command(*words)


def test_devices_that_there_are_are_listed() -> None:
    with pytest.raises(ConfigError) as refused:
        check_devices(["cpu", "cuda:77"])
    assert "cpu" in refused.value.remedy
    with pytest.raises(ConfigError, match="0 slots"):
        batch_of(fakes.QUICK, slots=0)


def test_the_command_says_what_ran_where(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With an indenter that is not one of the nine."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(cli_model, "DEFAULT_FACTORY", "fem_fakes:round_finger")
    words = (
        "--sweep", "--points", 1, "--steps", 3, "--store", tmp_path / "a.sim",
        "--indenter", "sphere_5mm", "--device", "cpu", "--device", "cpu", "--slots", 4,
        "--friction", fakes.QUICK,
    )  # fmt: skip
    done = command(*words)
    assert done.exit_code == 0
    said = " ".join(done.stdout.split())
    assert "5 of 5 run: 5 complete;" in said
    assert "ms a trajectory on cpu, cpu" in said
    assert "on the CPU" not in said
    again = " ".join(command(*words).stdout.split())
    assert "5 were there already" in again
    assert "ms a trajectory" not in again


def test_the_summary_says_what_the_cpu_had_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    show_report(BatchReport(5, Counter(complete=5), on_cpu=2, wall_s=1.0), 0, None, ["cuda:0"])
    said = " ".join(capsys.readouterr().out.split())
    assert "200 ms a trajectory on cuda:0; 2 of them on the CPU" in said


def test_as_many_files_may_be_open_as_trajectories_run() -> None:
    import resource

    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (300, before[1]))
        allow_open_files(600)
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] >= 600
        with pytest.raises(ConfigError, match="open files"):
            allow_open_files(before[1] + 1)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_processes_are_as_many_as_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 32)
    assert threads_and_packers(["cuda:0"]) == (4, 8)
    assert threads_and_packers(["cuda:0"] * 8) == (4, 32)
    assert threads_and_packers(["cuda:0"], 3) == (4, 3)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    assert threads_and_packers(["cuda:0"] * 4) == (1, 2)
