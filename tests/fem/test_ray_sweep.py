"""Sweeps over a Ray cluster of this host: actors and machines that are lost, CPUs, the commands."""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
from typer.testing import CliRunner, Result

from palpate.cluster import RayCluster
from palpate.errors import ConfigError, RemoteError
from palpate_fem.cli import model as cli_model
from palpate_fem.cli.app import fem_app
from palpate_fem.config import FingertipParameters
from palpate_fem.service import ray_batch
from palpate_fem.service.batch import BatchReport, SimulationBatch, sweep_into_store
from palpate_fem.service.jobs import PressUnsolved, WorkerSetup
from palpate_fem.service.ray_actor import _Gone
from palpate_fem.service.ray_batch import RayBatch
from palpate_fem.store.read import SimulationStore

pytest.importorskip("ray", reason="needs palpate[cluster]")

fakes: Any = importlib.import_module("fem_fakes")
sweeps: Any = importlib.import_module("test_sweep")
run, into_store = sweeps.run_batch, sweeps.store_batch
on_host: Any = importlib.import_module("test_device_sweep")
short, hard, rest = on_host.short, on_host.hard, on_host.rest

PATIENCE_S = 60.0
CPUS = 3
"""Of the first machine: two for devices, one for other tasks."""


@pytest.fixture(scope="module")
def machines() -> Iterator[Any]:
    """A cluster whose machines are processes of this host."""
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        found = Cluster(initialize_head=True, head_node_args={"num_cpus": CPUS})
        yield found
        found.shutdown()


@pytest.fixture(scope="module")
def cluster(machines: Any) -> Iterator[RayCluster]:
    on_term = signal.getsignal(signal.SIGTERM)
    with RayCluster(machines.address) as joined:
        assert signal.getsignal(signal.SIGTERM) is on_term, "commands stop in their own way"
        yield joined


def batch_of(cluster: RayCluster, kind: float, device: str | None = "cpu", **more: Any) -> RayBatch:
    parameters = FingertipParameters(friction_coefficient=kind)
    setup = WorkerSetup("fem_fakes:make", more.pop("options", {}), parameters, 1)
    return RayBatch(cluster, setup, device=device, **{"slots": 3, "look_s": 0.2, **more})


def test_the_store_of_a_cluster_is_that_of_the_cpu(cluster: RayCluster, tmp_path: Path) -> None:
    """The real solver on two actors."""
    with RayBatch(cluster, on_host.REAL, device="cpu", slots=2) as batch:
        tip = batch.fingertip(threading.Event())
        assert tip is not None
        plans = on_host.three_presses(tip)
        report, _ = sweep_into_store(
            batch, plans, tmp_path / "a.sim", stop=threading.Event(), packers=1
        )
    assert dict(report.outcomes) == {"complete": 3}
    with SimulationBatch(on_host.REAL, workers=1, threads=1) as one_by_one:
        sweep_into_store(one_by_one, plans, tmp_path / "b.sim", stop=threading.Event())
    on_host.check_same(tmp_path / "a.sim", tmp_path / "b.sim", plans)


def test_cpus_of_a_cluster_solve_one_at_a_time(cluster: RayCluster, tmp_path: Path) -> None:
    """What cannot be run fails alone."""
    plans = short(5)
    plans[1:1] = [type(plans[0])("a/wrong/path", "sphere_medium", plans[1].path[::-1] + 0.004)]
    report, there = into_store(tmp_path / "a.sim", batch_of(cluster, fakes.QUICK, None), plans)
    assert (report.outcomes["complete"], report.failed, report.on_cpu, there) == (5, 1, 0, 0)
    assert report.early[0].name == "a/wrong/path"
    assert "inside" in report.early[0].reason
    report, there = into_store(tmp_path / "a.sim", batch_of(cluster, fakes.QUICK, None), short(6))
    assert (report.done, there) == (1, 5)


def test_a_solver_that_dies_on_a_cpu_costs_its_trajectory_only(cluster: RayCluster) -> None:
    report, kept = run(batch_of(cluster, fakes.DIES, None), sweeps.plans(1))
    assert (report.failed, kept) == (1, {})
    assert "exit status 7" in report.early[0].reason


def test_what_devices_do_not_solve_cpus_do(cluster: RayCluster) -> None:
    report, kept = run(batch_of(cluster, fakes.UNSOLVED), [*hard(3), *short(4)])
    assert (dict(report.outcomes), report.on_cpu) == ({"complete": 7}, 3)
    assert [len(kept[f"hard/{k}"].steps) for k in range(3)] == [3, 3, 3]


def test_only_what_needs_the_cpu_fails_without_it(cluster: RayCluster) -> None:
    options = {"broken": "no such mesh", "broken_in": "worker"}
    report, kept = run(batch_of(cluster, fakes.UNSOLVED, options=options), [*hard(2), *short(3)])
    assert (report.failed, report.outcomes["complete"], len(kept)) == (2, 3, 3)
    assert all("no such mesh" in early.reason for early in report.early)


def until(enough: Callable[[], object]) -> Iterator[Any]:
    """Plans until something has happened."""
    for plan in short(600):
        if enough():
            return
        yield plan


def useful(batch: RayBatch) -> list[Any]:
    """Actors that have solved something."""
    return [device for device in batch._devices if device.useful]


def run_all(
    batch: RayBatch, plans: Iterator[Any], on_report: Callable[[BatchReport], None]
) -> None:
    """Run plans that all complete, each once."""
    taken: list[str] = []
    kept: list[str] = []

    def noted() -> Iterator[Any]:
        for plan in plans:
            taken.append(plan.name)
            yield plan

    with batch:
        report = batch.run(
            noted(),
            600,
            stop=threading.Event(),
            on_trajectory=lambda plan, _: kept.append(plan.name),
            on_report=on_report,
        )
    assert report.outcomes["complete"] == report.done == len(taken)
    assert sorted(kept) == sorted(taken)


def test_lost_actors_lose_nothing(cluster: RayCluster) -> None:
    """One is killed, one whose device's process is, one falls silent: all is solved once."""
    batch = batch_of(cluster, fakes.SLOW, silent_s=4.0)
    lost: list[Any] = []
    signals = [(0, signal.SIGKILL), (1, signal.SIGKILL), (0, signal.SIGSTOP)]
    silent = 0

    def on_report(report: BatchReport) -> None:
        nonlocal silent
        there = [one for one in useful(batch) if one not in lost]
        if len(there) == 2 and signals:
            lost.append(there[0])
            which, number = signals.pop(0)
            silent = cluster.ray.get(there[0].actor.pids.remote())[which]
            os.kill(silent, number)

    run_all(batch, until(lambda: not signals), on_report)
    assert len(lost) == 3
    with contextlib.suppress(ProcessLookupError):
        os.kill(silent, signal.SIGKILL)


def test_machines_come_and_go(machines: Any, cluster: RayCluster) -> None:
    """One that joins gets trajectories; when it is lost, the others do what it had."""
    batch = batch_of(cluster, fakes.SLOW)
    joined: list[Any] = []
    lost: list[Any] = []

    def on_report(report: BatchReport) -> None:
        if report.done >= 3 and not joined:
            joined.append(machines.add_node(num_cpus=1))
        elif len(useful(batch)) == CPUS and not lost:
            lost.extend(joined)
            machines.remove_node(lost[0], allow_graceful=False)

    run_all(batch, until(lambda: lost), on_report)


def test_a_store_is_filled_stopped_and_resumed(
    cluster: RayCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """First it is stopped, then the cluster loses all machines; what is done is kept."""
    path, stop = tmp_path / "a.sim", threading.Event()
    report, _ = into_store(
        path,
        batch_of(cluster, fakes.SLOW),
        short(60),
        stop=stop,
        on_report=lambda report: stop.set() if report.done >= 2 else None,
    )
    assert report.stopped
    assert 2 <= report.done < 60
    assert len(SimulationStore.open(path).done()) == report.done
    assert not list(path.rglob("*.part")), "nothing is half written"

    batch = batch_of(cluster, fakes.SLOW)

    def lose_all(report: BatchReport) -> None:
        if report.done == 4:
            monkeypatch.setattr(RayCluster, "count", lambda *_: 0)
            batch._wait_s = 0.5
            for device in batch._devices:
                device.kill()

    with pytest.raises(RemoteError, match="has had no machine"):
        into_store(path, batch, short(60), on_report=lose_all)
    monkeypatch.undo()
    done = len(SimulationStore.open(path).done())
    assert report.done + 4 <= done < 60
    again, there = into_store(path, batch_of(cluster, fakes.SLOW), rest(path, short(60), 3))
    assert (again.done, there) == (3, done)


@pytest.mark.parametrize(
    ("kind", "device", "more", "said"),
    [
        ("DIES", "cpu", {}, "no solver on the cluster works.*exit status 7"),
        ("QUICK", "cpu", {"options": {"broken": "no such mesh"}}, "no such mesh"),
        ("QUICK", None, {"options": {"broken": "no such mesh"}}, "no such mesh"),
        ("STUBBORN", "cpu", {"hang_s": 1.5}, "silent"),
    ],
)
def test_solvers_that_do_not_work_end_the_batch(
    cluster: RayCluster,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    device: str | None,
    more: dict[str, Any],
    said: str,
) -> None:
    """A device has a second attempt, unless it says why it does not start."""
    monkeypatch.setattr(RayCluster, "count", lambda *_: 1)
    batch = batch_of(cluster, getattr(fakes, kind), device, **more)
    with pytest.raises(RemoteError, match=said):
        run(batch, sweeps.plans(2))


class GpuCluster:
    """A cluster that has only the number of its GPUs; what it is asked comes to nothing."""

    def __init__(self, gpus: int) -> None:
        self.gpus, self.ray = gpus, MagicMock()
        self.ray.exceptions.RayError = RuntimeError
        start = self.ray.remote.return_value.options.return_value.remote
        start.side_effect = lambda *_: MagicMock(**{"events.remote.side_effect": lambda: object()})
        self.ray.wait = lambda wanted, **_: (self.answered & {*wanted}, [])
        self.answered: set[Any] = set()

    def count(self, what: str) -> int:
        return self.gpus


def idle_batch(gpus: int) -> tuple[RayBatch, GpuCluster]:
    cluster: Any = GpuCluster(gpus)
    batch = RayBatch(
        cluster, WorkerSetup("", {}, FingertipParameters(), 1), device="cuda", look_s=0
    )
    batch._next()
    assert len(batch._devices) == gpus
    return batch, cluster


def answer(batch: RayBatch, cluster: GpuCluster, devices: list[Any], answers: Any) -> None:
    """Ray has the answers of some actors."""
    cluster.ray.get = MagicMock(side_effect=answers)
    for device in devices:
        cluster.answered = {device.answer}
        batch._next()
    cluster.answered = set()


@pytest.mark.parametrize("silent", [False, True])
def test_a_machine_that_was_lost_early_gets_all_its_actors_again(silent: bool) -> None:
    """However often, and although it had not solved anything."""
    batch, cluster = idle_batch(16)
    for _ in range(3):
        lost = batch._devices[8:]
        answer(batch, cluster, lost, [[]] * 8)  # placed; its kernels are being compiled
        cluster.gpus = 8
        if silent:
            for device in lost:
                device._turns.next(-1.0)
                batch._next()
        else:
            answer(batch, cluster, lost, RuntimeError("the node died"))
        assert len(batch._devices) == 8
        cluster.gpus = 16
        batch._next()
        assert len(batch._devices) == 16


def test_a_gpu_on_which_nothing_works_is_left_out() -> None:
    """Its machine is there; it is tried again when another GPU solves for the first time."""
    batch, cluster = idle_batch(2)
    (good, _) = batch._devices

    def solves(number: int) -> None:
        good.open[number] = sweeps.plans(1)[0]
        answer(batch, cluster, [good], [[PressUnsolved(number)]])
        batch._next()

    for number in (0, 1):
        for _ in range(2):
            assert len(batch._devices) == 2
            bad = batch._devices[1]
            answer(batch, cluster, [bad], [[]])
            answer(batch, cluster, [bad], [[_Gone("the GPU is broken")]])
            batch._next()
        assert batch._devices == [good]
        solves(number)
    assert batch._devices == [good], "no more than once"


def test_a_cluster_without_gpus_is_refused(cluster: RayCluster) -> None:
    with pytest.raises(ConfigError, match="no GPU"):
        batch_of(cluster, fakes.QUICK, "cuda")


def fem(*words: object) -> Result:
    return CliRunner().invoke(fem_app, [*map(str, words)], catch_exceptions=False)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--ray", "auto"), "--ray without --sweep"),
        (("--sweep", "--store", "a.sim", "--ray", "auto", "--slots", 4), "--slots without"),
        (("--sweep", "--store", "a.sim", "--ray", "auto", "--device", "cuda:0"), "give cuda"),
        (
            ("--sweep", "--store", "a.sim", "--ray", "auto", "--device", "cuda", "--device", "cpu"),
            "cuda and cpu with --ray",
        ),
    ],
)
def test_what_cannot_be_meant_is_refused_at_once(words: tuple[object, ...], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        fem("run", *words)


def test_the_command_says_what_ran_where(
    cluster: RayCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(cli_model, "DEFAULT_FACTORY", "fem_fakes:round_finger")
    asked: list[str] = []

    def join(address: str) -> Any:
        asked.append(address)
        return contextlib.nullcontext(cluster)

    monkeypatch.setattr(ray_batch, "RayCluster", join)
    words = (
        "--sweep", "--points", 1, "--steps", 3, "--indenter", "sphere_5mm", "--friction",
        fakes.QUICK, "--workers", 1, "--store", tmp_path / "a.sim", "--ray", "head:6379",
    )  # fmt: skip
    done = fem("run", *words, "--device", "cpu", "--slots", 4)
    assert done.exit_code == 0
    said = " ".join(done.stdout.split())
    assert "5 of 5 run: 5 complete;" in said
    assert "ms a trajectory on the CPUs of the Ray cluster" in said
    assert "5 were there already" in " ".join(fem("run", *words).stdout.split())
    assert asked == ["head:6379"] * 2
