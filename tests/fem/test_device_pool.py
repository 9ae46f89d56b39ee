"""The service with a device: requests solved together, and devices that fail, die, hang or stop."""

from __future__ import annotations

import importlib
import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.fem.batched_cases import DEVICE
from typer.testing import CliRunner

from palpate.client import Client
from palpate.config import LinkConfig, parse_config
from palpate.errors import ConfigError, ErrorCode, RemoteError
from palpate.messages import (
    ServiceState,
    SimulationOutcome,
    SimulationPhase,
    SimulationProgress,
    SimulationRequest,
)
from palpate_fem.cli.app import fem_app
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.result import IndentationOutcome, IndentationResult
from palpate_fem.service import device_pool, node
from palpate_fem.service.biotac import biotac
from palpate_fem.service.config import FemConfig
from palpate_fem.service.device_pool import DevicePool
from palpate_fem.service.device_process import wanted_device
from palpate_fem.service.fingertips import skin_of
from palpate_fem.service.jobs import (
    DeviceEvent,
    DeviceReady,
    JobEnded,
    JobEvent,
    JobFailed,
    JobStarted,
    JobWaiting,
    NumberedPress,
    PressEnded,
    PressStep,
    SimulationJob,
    StepConverged,
    WorkerSetup,
)
from palpate_fem.service.pool import WorkerPool
from palpate_fem.service.requests import as_pose
from palpate_fem.trajectory import press_path

fakes: Any = importlib.import_module("fem_fakes")
sweeps: Any = importlib.import_module("test_device_sweep")

PATIENCE_S = 60.0
COMPILING_S = 600.0
"""The first time kernels are compiled, for a minute or more."""


def served_by_device(serving: Any, kind: float, **values: Any) -> Any:
    """A service whose device has the requests of a kind."""
    return serving(
        **{"device": "cpu", "slots": 3, "workers": 1, **values},
        fingertip={"friction_coefficient": kind},
    )


def await_device(service: Any) -> None:
    service.until(lambda: "cpu serves, 3 at once" in service.robot.status()[0].message)


def device_pids() -> list[int]:
    """Processes of devices that this one has started."""
    return [
        pid
        for path in Path(f"/proc/{os.getpid()}/task").glob("*/children")
        for pid in map(int, path.read_text().split())
        if b"palpate_fem.service.device_worker" in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]


def expected(steps: int) -> np.ndarray[Any, Any]:
    """Forces of the fakes' request."""
    tip = fakes.FakeTip(FingertipParameters(), 40)
    poses = fakes.request("x", steps=steps).path[1:]
    return np.array([tip.step(np.array([*p.position, 1, 0, 0, 0]), 0.1).force for p in poses])


def test_two_robots_are_served_at_once(serving: Any) -> None:
    """On the device, with one worker; a third asks for another finger, which the worker has."""
    with served_by_device(serving, fakes.SLOW) as service:
        await_device(service)
        other = Client(service.link.connect[0], timeout_s=5)
        seen: dict[str, list[int]] = {"one": [], "two": []}
        told: dict[str, list[SimulationProgress]] = {"one": [], "two": []}
        replies: dict[str, Any] = {}
        steps = threading.Barrier(2, timeout=PATIENCE_S)

        def ask(robot: Client, name: str) -> None:
            def on_step(index: int, _: object) -> None:
                if index == 1:
                    steps.wait()  # comes only if both run: none of them has ended
                seen[name].append(index)

            replies[name] = robot.simulate(
                fakes.request(name, fakes.SLOW, steps=8, want_displacement=True),
                on_step=on_step,
                on_progress=told[name].append,
            )

        threads = [
            threading.Thread(target=ask, args=(robot, name))
            for robot, name in ((service.robot, "one"), (other, "two"))
        ]
        for thread in threads:
            thread.start()
        quick = service.robot.simulate(fakes.request("quick", fakes.QUICK))
        for thread in threads:
            thread.join(PATIENCE_S)
        assert quick.outcome is SimulationOutcome.COMPLETE
        for name, reply in replies.items():
            assert reply.outcome is SimulationOutcome.COMPLETE
            assert seen[name] == list(range(8))
            np.testing.assert_array_equal([step.force for step in reply.steps], expected(8))
            assert {one.phase for one in told[name]} == {SimulationPhase.INDENTING}
            assert reply.mesh_sha256 == quick.mesh_sha256
        assert len(replies) == 2
        assert service.counters()["simulations_redone"] == 0
        other.close()


def test_cancel_deadline_and_too_many(serving: Any) -> None:
    with served_by_device(serving, fakes.SLOW, slots=1, waiting=1) as service:
        service.until(lambda: "cpu serves, 1 at once" in service.robot.status()[0].message)
        first = threading.Event()
        running, out = service.in_thread(
            fakes.request("runs", fakes.SLOW, steps=199), on_step=lambda *_: first.set()
        )
        assert first.wait(PATIENCE_S)
        told: list[SimulationProgress] = []
        with pytest.raises(RemoteError, match="while it waited") as caught:
            service.robot.simulate(
                fakes.request("late", fakes.SLOW), timeout_s=0.2, on_progress=told.append
            )
        assert caught.value.code is ErrorCode.DEADLINE_EXCEEDED
        assert told[0].phase is SimulationPhase.WAITING
        waiting, waited = service.in_thread(fakes.request("waits", fakes.SLOW))
        service.until(lambda: service.robot.status()[0].gauges["waiting_requests"] == 1)
        with pytest.raises(RemoteError, match="1 wait") as caught:
            service.robot.simulate(fakes.request("one more", fakes.SLOW))
        assert caught.value.code is ErrorCode.RESOURCE_EXHAUSTED
        assert caught.value.retry_after_s > 0
        assert service.robot.cancel_simulation("waits")
        waiting.join(PATIENCE_S)
        assert waited[0].outcome is SimulationOutcome.CANCELLED
        assert service.robot.cancel_simulation("runs")
        running.join(PATIENCE_S)
        assert out[0].outcome is SimulationOutcome.CANCELLED
        assert 1 <= len(out[0].steps) < 199
        assert "did not stop" not in out[0].stopped_because
        reply = service.robot.simulate(fakes.request("slow", fakes.SLOW, steps=199), timeout_s=1.0)
        assert reply.outcome is SimulationOutcome.DEADLINE
        assert 1 <= len(reply.steps) < 199
        assert "did not stop" not in reply.stopped_because
        assert not service.robot.cancel_simulation("slow")


def test_what_the_device_does_not_solve_has_every_step_once(serving: Any) -> None:
    with served_by_device(serving, fakes.UNSOLVED) as service:
        await_device(service)
        seen: list[int] = []
        reply = service.robot.simulate(
            fakes.request("hard", fakes.UNSOLVED), on_step=lambda index, _: seen.append(index)
        )
        assert reply.outcome is SimulationOutcome.COMPLETE
        assert seen == [0, 1, 2, 3, 4]
        np.testing.assert_array_equal([step.force for step in reply.steps], expected(5))
        assert service.counters()["simulations_redone"] == 1


def test_a_result_that_cannot_be_sent_is_an_error(serving: Any) -> None:
    """The service then stops the simulation, from the thread that told it of the step."""
    with served_by_device(serving, fakes.NAN) as service:
        await_device(service)
        asked = fakes.request("wrong", fakes.NAN, steps=100, want_displacement=True)
        with pytest.raises(RemoteError, match="not finite"):
            service.robot.simulate(asked)
        reply = service.robot.simulate(fakes.request("right", fakes.NAN))
        assert reply.outcome is SimulationOutcome.COMPLETE


def test_steps_of_two_equilibria_are_not_joined(serving: Any) -> None:
    with served_by_device(serving, fakes.APART) as service:
        await_device(service)
        with pytest.raises(RemoteError, match="another way than the CPU") as caught:
            service.robot.simulate(fakes.request("hard", fakes.APART))
        assert caught.value.code is ErrorCode.SIMULATION
        again = service.robot.simulate(fakes.request("hard", fakes.APART, steps=4))
        assert again.outcome is SimulationOutcome.COMPLETE


def test_a_killed_device_costs_nobody_an_answer(
    serving: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it had is solved by the worker, the service says so, and the device comes back."""
    monkeypatch.setattr(device_pool, "PAUSE_S", 1.5)
    with served_by_device(serving, fakes.SLOW, waiting=1) as service:
        await_device(service)
        first = threading.Event()
        asked = [
            service.in_thread(
                fakes.request(f"k{k}", fakes.SLOW, steps=6), on_step=lambda *_: first.set()
            )
            for k in range(4)
        ]
        assert first.wait(PATIENCE_S)
        (pid,) = device_pids()
        os.kill(pid, signal.SIGKILL)

        def troubled() -> bool:
            status = service.robot.status()[0]
            return status.state is ServiceState.DEGRADED and "SIGKILL" in status.message

        service.until(troubled)
        assert service.ready()
        for thread, out in asked:
            thread.join(PATIENCE_S)
            (reply,) = out
            assert reply.outcome is SimulationOutcome.COMPLETE
            np.testing.assert_array_equal([step.force for step in reply.steps], expected(6))
        await_device(service)
        service.until(lambda: service.robot.status()[0].state is ServiceState.READY)
        assert service.counters()["device_restarts"] == 1
        reply = service.robot.simulate(fakes.request("after", fakes.SLOW))
        assert reply.outcome is SimulationOutcome.COMPLETE


@contextmanager
def pool_of(kind: float, **more: Any) -> Iterator[DevicePool]:
    """A device in front of one worker."""
    options = more.pop("options", {})
    setup = WorkerSetup(
        "fem_fakes:make", options, FingertipParameters(friction_coefficient=kind), 1
    )
    cpu = WorkerPool(setup, workers=1, threads=1, waiting=more.pop("cpu_waiting", 4), grace_s=0.3)
    given = {"slots": 2, "waiting": 4, "grace_s": 0.3, **more}
    with DevicePool(setup, "cpu", cpu, **given) as pool:
        yield pool


def until(true: Callable[[], Any], patience_s: float = PATIENCE_S) -> None:
    deadline = time.monotonic() + patience_s
    while not true():
        assert time.monotonic() < deadline, "it did not become true in time"
        time.sleep(0.02)


def submit(
    pool: DevicePool,
    name: str,
    kind: float,
    steps: int = 4,
    deadline_s: float = 600.0,
    indenter: str = "sphere_medium",
) -> queue.SimpleQueue[JobEvent]:
    """A job's events."""
    path = np.zeros((steps + 1, 7))
    path[:, 3] = 1.0
    path[:, 2] = np.linspace(-0.009, -0.005, steps + 1)
    events: queue.SimpleQueue[JobEvent] = queue.SimpleQueue()
    parameters = FingertipParameters(friction_coefficient=kind)
    pool.submit(SimulationJob(name, parameters, indenter, path, deadline_s), events.put)
    return events


def ended(events: queue.SimpleQueue[JobEvent]) -> tuple[JobEnded | JobFailed, int]:
    """The end of a job, and its number of steps; nothing comes after it."""
    steps = 0
    while True:
        event = events.get(timeout=PATIENCE_S)
        steps += isinstance(event, StepConverged)
        if isinstance(event, JobEnded | JobFailed):
            assert events.empty()
            return event, steps


def await_ready(pool: DevicePool, patience_s: float = PATIENCE_S) -> None:
    until(lambda: "serves, 2 at once" in pool.serves, patience_s)


pytestmark = pytest.mark.usefixtures("workers_find_fakes")


def test_a_device_that_hangs_is_replaced() -> None:
    with pool_of(fakes.SLOW, hang_s=1.0) as pool:
        await_ready(pool)
        stopped = pool.pid
        assert stopped is not None
        asked = [submit(pool, f"{k}", fakes.SLOW) for k in range(3)]
        assert isinstance(asked[0].get(timeout=PATIENCE_S), JobStarted)
        os.kill(stopped, signal.SIGSTOP)
        for events in asked:
            end, steps = ended(events)
            assert isinstance(end, JobEnded)
            assert (end.outcome, steps) == (IndentationOutcome.COMPLETE, 4)
        until(lambda: pool.restarts == 1)
        await_ready(pool)
        assert pool.pid != stopped
        assert not pool.trouble


def test_what_waits_for_a_worker_goes_back_to_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its process is killed with two jobs on it; what it cannot solve stays with the worker."""
    monkeypatch.setattr(device_pool, "PAUSE_S", 0.1)
    with pool_of(fakes.SLOW, waiting=20, cpu_waiting=20) as pool:
        await_ready(pool)
        asked = [submit(pool, f"{k}", fakes.SLOW, steps=30) for k in range(6)]
        assert isinstance(asked[0].get(timeout=PATIENCE_S), JobStarted)
        assert isinstance(asked[0].get(timeout=PATIENCE_S), StepConverged)
        assert pool.pid is not None
        os.kill(pool.pid, signal.SIGKILL)
        until(lambda: pool.restarts == 1)
        others = [
            submit(pool, "finger", fakes.QUICK),
            submit(pool, "indenter", fakes.SLOW, indenter="plate"),
        ]
        away = submit(pool, "away", fakes.SLOW, steps=30)
        for k, events in enumerate([*asked, away]):
            end, steps = ended(events)
            assert isinstance(end, JobEnded), end
            assert (end.outcome, steps + (k == 0)) == (IndentationOutcome.COMPLETE, 30)
        for events in others:
            assert isinstance(ended(events)[0], JobEnded)
        assert pool.redone == 1, "one ran on the worker, all others came back"
        assert pool.waiting == pool.busy == 0


@pytest.mark.parametrize("name", ["1", "away"])
def test_a_cancel_is_not_lost_while_the_device_takes_jobs_back(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The device had 1 and was killed; the other one came while it was away."""
    monkeypatch.setattr(device_pool, "PAUSE_S", 0.1)
    with pool_of(fakes.SLOW, waiting=20, cpu_waiting=20) as pool:
        await_ready(pool)
        take_back, cancel = pool._take_back, pool._cpu.cancel

        def cancel_too_late(job_id: str) -> bool:
            take_back()
            pool._dispatch()
            return cancel(job_id)

        monkeypatch.setattr(pool, "_take_back", lambda: None)
        asked = {one: submit(pool, one, fakes.SLOW, steps=30) for one in ("0", "1")}
        until(lambda: pool.busy == 2)
        assert pool.pid is not None
        os.kill(pool.pid, signal.SIGKILL)
        until(lambda: pool.restarts == 1)
        asked["away"] = submit(pool, "away", fakes.SLOW, steps=30)
        await_ready(pool)
        monkeypatch.setattr(pool._cpu, "cancel", cancel_too_late)
        assert pool.cancel(name)
        end, steps = ended(asked[name])
        assert isinstance(end, JobEnded)
        assert (end.outcome, steps < 30) == (IndentationOutcome.CANCELLED, True)


class HandDevice:
    """The process of a device, of which the test says what it does."""

    def __init__(self, _: object, __: int, on_event: Callable[..., None], **___: float) -> None:
        self.open: dict[int, Any] = {}
        self.ready, self.hung, self.pid = False, False, 0
        self.tells: Callable[[DeviceEvent | None], None] = lambda event: on_event(self, event)

    def give(self, press: NumberedPress, owner: Any) -> None:
        self.open[press.number] = owner

    def send(self, message: object) -> None:
        return

    def end_if_hung(self) -> None:
        return

    def why_it_ended(self) -> str:
        return "was lost"

    kill = join = end_if_hung


def test_no_job_ends_before_the_last_step_that_was_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its first device is lost after two steps; the next one stops before it has made them anew."""
    devices: list[HandDevice] = []

    def start(*words: Any, **more: Any) -> HandDevice:
        devices.append(HandDevice(*words, **more))
        return devices[-1]

    monkeypatch.setattr(device_pool, "DeviceProcess", start)
    monkeypatch.setattr(device_pool, "PAUSE_S", 0.01)
    tip = fakes.FakeTip(FingertipParameters(friction_coefficient=fakes.QUICK), 8)

    def gets_ready(number: int) -> None:
        until(lambda: len(devices) > number)
        devices[number].tells(JobStarted(tip.describe()))
        devices[number].tells(DeviceReady())

    with pool_of(fakes.QUICK, options={"fill_s": 600.0}) as pool:  # workers are not ready
        gets_ready(0)
        await_ready(pool)
        events = submit(pool, "stopped", fakes.QUICK)
        until(lambda: devices[0].open)
        (number, task), *_ = devices[0].open.items()
        run = tip.run("sphere_medium", task.job.path, fakes.QUICK, None)
        for _ in range(2):
            devices[0].tells(PressStep(number, next(run)))
        devices[0].tells(None)
        gets_ready(1)
        until(lambda: devices[1].open)
        (number,) = devices[1].open
        nothing = IndentationResult(
            "sphere_medium", task.job.path, (), IndentationOutcome.DEADLINE, "too late"
        )
        devices[1].tells(PressEnded(number, nothing))
        end, steps = ended(events)
        assert isinstance(end, JobEnded)
        assert (end.outcome, steps) == (IndentationOutcome.DEADLINE, 2)
        assert end.travel_m == pytest.approx(0.002)


def test_workers_solve_what_indenters_the_device_lacks() -> None:
    with pool_of(fakes.QUICK) as pool:
        await_ready(pool)
        for indenter in ("sphere_7mm", "sphere_5mm", "plate"):
            end, steps = ended(submit(pool, indenter, fakes.QUICK, indenter=indenter))
            assert isinstance(end, JobEnded), end
            assert (end.outcome, steps) == (IndentationOutcome.COMPLETE, 4)
        assert pool.redone == 0


def test_a_job_that_ends_devices_is_left_to_the_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """It goes back once; the worker that it ends, too, costs its owner an error, and no other."""
    monkeypatch.setattr(device_pool, "PAUSE_S", 0.1)
    with pool_of(fakes.DIES, waiting=20) as pool:
        await_ready(pool)
        slow = submit(pool, "slow", fakes.SLOW, steps=199)  # keeps the worker
        until(lambda: pool.busy == 1)
        poison = submit(pool, "poison", fakes.DIES)
        until(lambda: pool.restarts == 2)
        await_ready(pool)
        time.sleep(0.5)
        assert pool.restarts == 2
        harmless = submit(pool, "harmless", fakes.DIES, steps=2)
        assert isinstance(ended(harmless)[0], JobEnded)
        assert pool.cancel("slow")
        assert isinstance(ended(slow)[0], JobEnded)
        failed, steps = ended(poison)
        assert isinstance(failed, JobFailed)
        assert (failed.code, steps) == (ErrorCode.INTERNAL, 2)
        assert pool.restarts == 2


def test_nobody_waits_for_a_device_that_does_not_stop() -> None:
    """The owner has an answer in time; the device is ended as it is silent."""
    with pool_of(fakes.STUBBORN, hang_s=2.0) as pool:
        await_ready(pool)
        late = submit(pool, "late", fakes.STUBBORN, deadline_s=0.3)
        end, steps = ended(late)
        assert isinstance(end, JobEnded)
        assert (end.outcome, steps) == (IndentationOutcome.DEADLINE, 2)
        assert "did not stop" in end.reason
        assert end.travel_m == pytest.approx(0.002)
        until(lambda: pool.restarts == 1)
        assert "silent" in pool.trouble
        await_ready(pool)
        cancelled = submit(pool, "cancelled", fakes.STUBBORN)
        until(lambda: pool.busy == 1)
        assert pool.cancel("cancelled")
        end, _ = ended(cancelled)
        assert isinstance(end, JobEnded)
        assert end.outcome is IndentationOutcome.CANCELLED
        assert pool.redone == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"broken": "no such GPU", "broken_in": "device_worker"}, "no such GPU"),
        ({"broken": "dies", "broken_in": "device_worker"}, "exit status 9"),
    ],
)
def test_a_device_that_does_not_start_is_tried_again_and_again(
    options: dict[str, str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After waits that grow; the worker serves meanwhile."""
    monkeypatch.setattr(device_pool, "PAUSE_S", 0.02)
    with pool_of(fakes.QUICK, options=options) as pool:
        until(lambda: pool.restarts >= 2)
        assert said in pool.trouble
        assert pool._pause_s >= 0.08
        end, steps = ended(submit(pool, "a", fakes.QUICK))
        assert isinstance(end, JobEnded)
        assert steps == 4
        assert pool.broken is None


def test_closing_answers_whoever_waits() -> None:
    with pool_of(fakes.SLOW) as pool:
        await_ready(pool)
        asked = [submit(pool, f"{k}", fakes.SLOW, steps=100) for k in range(3)]
        assert isinstance(asked[2].get(timeout=PATIENCE_S), JobWaiting)
        assert not pool.cancel("unknown")
    for events in asked:
        end, _ = ended(events)
        assert isinstance(end, JobFailed)
        assert end.code is ErrorCode.UNAVAILABLE
    with pytest.raises(RemoteError, match="stopping"):
        submit(pool, "late", fakes.SLOW)


def test_the_real_solver_serves_two_at_once(serving: Any) -> None:
    """Over the wire: steps come as they are made, and are those of the CPU."""
    tip = biotac(**sweeps.REAL.options)(sweeps.REAL.warm, lambda _: None)
    skin = skin_of(tip.describe())
    real = {"factory": sweeps.REAL.factory, "options": sweeps.REAL.options, "grace_s": 60.0}
    with serving(device=DEVICE, slots=2, workers=1, **real) as service:
        until(lambda: "2 at once" in service.robot.status()[0].message, COMPILING_S)
        asked: dict[str, Any] = {}
        for name, depth_m in (("sphere_medium", 0.4e-3), ("cube", 0.2e-3)):
            path = press_path(
                make_indenter(name), (-4e-3, 0.0, -7.5e-3), (0.0, 0.0, 1.0), skin,
                depth_m=depth_m, steps=2,
            )  # fmt: skip
            poses = tuple(as_pose(pose) for pose in path)
            request = SimulationRequest(name, name, poses, want_displacement=True)
            asked[name] = path, *service.in_thread(request, timeout_s=COMPILING_S)
        for name, (path, thread, out) in asked.items():
            wanted = tip.indent(
                name, path, friction_coefficient=sweeps.REAL.warm.friction_coefficient
            )
            thread.join(COMPILING_S)
            (reply,) = out
            assert reply.outcome is SimulationOutcome.COMPLETE
            assert reply.travel_m == pytest.approx(wanted.travel_m)
            size = np.linalg.norm(wanted.forces[-1])
            forces = np.array([step.force for step in reply.steps])
            assert np.abs(forces - wanted.forces).max() < sweeps.SAME * size
            for ours, theirs in zip(reply.steps, wanted.steps, strict=True):
                assert np.abs(ours.displacement - theirs.displacement).max() < 2e-6
        assert service.counters()["simulations_redone"] == 0


def test_a_device_that_there_is_not_is_told_before_the_bus_is_joined() -> None:
    config = parse_config(FemConfig, {"device": "cuda:77"}, where="test")
    with pytest.raises(ConfigError, match="cuda:77"):
        node.run(config, LinkConfig(), "lab", threading.Event())
    for words, said in ((("--device", "cuda:77"), "cuda:77"), (("--slots", "4"), "--slots")):
        with pytest.raises(ConfigError, match=said):
            CliRunner().invoke(fem_app, ["serve", *words], catch_exceptions=False)


def test_auto_is_the_first_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    known = ["cpu"]
    monkeypatch.setattr("palpate_fem.device.known_devices", lambda: tuple(known))
    assert wanted_device("auto") is None
    known += ["cuda:0", "cuda:1"]
    assert wanted_device("auto") == "cuda:0"
    assert wanted_device("cuda:1") == "cuda:1"
    assert wanted_device(None) is None
