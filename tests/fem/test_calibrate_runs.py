"""What a calibration is asked and how it runs its simulations: once each, some at a time."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from palpate.errors import ConfigError, SimulationError
from palpate.rigid import path_lengths
from palpate_fem.arrays import Floats
from palpate_fem.calibration.measured import MeasuredIndentation
from palpate_fem.calibration.runs import FingertipSimulator, SimulatedRun, SimulationRuns
from palpate_fem.calibration.settings import FRICTION, PAPER_BOUNDS, THICKNESS, CalibrationSettings
from palpate_fem.cli.identify import slope_simulator_for
from palpate_fem.cli.model import FingertipModel
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.approach import OuterSurface
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac
from palpate_fem.result import IndentationOutcome, IndentationResult
from palpate_fem.trajectory import angled_direction, pad_point, press_path

TRUTH = FingertipParameters()


class Spring:
    """Force = depth times modulus."""

    def simulate(
        self, parameters: FingertipParameters, indenter: str, path: Floats
    ) -> SimulatedRun:
        if indenter == "unknown":
            raise ConfigError("no such indenter", remedy="none")
        if indenter == "defect":
            raise ZeroDivisionError("somewhere")
        way = path_lengths(path)
        force = np.outer(way * parameters.shear_modulus_pa, np.array([0.0, 0.0, 1.0]))
        return SimulatedRun(force, way, 0.0151, 8e-7, IndentationOutcome.COMPLETE)


def press(
    name: str = "cube/00/normal", sensor: str = "biotac1", depth_m: float = 1e-3
) -> MeasuredIndentation:
    pose = np.zeros((5, 7))
    pose[:, 2], pose[:, 3] = np.linspace(0.0, depth_m, 5), 1.0
    return MeasuredIndentation(f"{name}/{sensor}", "cube", sensor, pose, np.ones((5, 3)))


def test_each_run_is_made_once_whatever_the_sensor() -> None:
    runs = SimulationRuns(Spring())
    twin = replace(press(sensor="biotac2"), force=np.zeros((5, 3)))
    first, second = runs.run([(TRUTH, press()), (TRUTH, twin)])
    assert first is second
    assert runs.count == 1
    runs.run([(TRUTH, press()), (replace(TRUTH, friction_coefficient=0.3), press())])
    assert runs.count == 2
    runs.run([(TRUTH, press(depth_m=1.1e-3)), (TRUTH, replace(press(), indenter="ring"))])
    assert runs.count == 4


@pytest.mark.parametrize(
    ("indenter", "why", "traceback"),
    [("unknown", "no such indenter", False), ("defect", "ZeroDivisionError: somewhere", True)],
)
def test_a_refused_run_is_that_runs_trouble_only(
    indenter: str, why: str, traceback: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    bad, good = SimulationRuns(Spring()).run(
        [(TRUTH, replace(press(), indenter=indenter)), (TRUTH, press())]
    )
    assert (len(bad.forces), bad.outcome) == (0, IndentationOutcome.DIVERGED)
    assert why in bad.reason
    assert len(good.forces) == 5
    assert ("Traceback" in capsys.readouterr().err) is traceback


class Stub:
    """A pressurised finger whose force grows by 1 N from step to step."""

    total_thickness_m, fluid_volume_m3 = 15.1e-3, 8e-7
    parameters = TRUTH

    def indent(self, indenter: object, path: Floats, history: object) -> IndentationResult:
        steps = cast("Any", [SimpleNamespace(force=np.array([0, 0, k])) for k in range(1, 5)])
        return IndentationResult("cube", path, tuple(steps), IndentationOutcome.COMPLETE)


def test_a_run_that_cannot_be_derived_keeps_its_forces(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise SimulationError("the linearised equations are not solved", remedy="none")

    monkeypatch.setattr("palpate_fem.calibration.runs._filled", lambda *_: Stub())
    monkeypatch.setattr("palpate_fem.calibration.runs.sensitivities", fail)
    (run,) = SimulationRuns(FingertipSimulator()).run([(TRUTH, press())], (FRICTION,))
    assert (run.outcome, run.reason) == (IndentationOutcome.COMPLETE, "")
    np.testing.assert_array_equal(run.forces[:, 2], np.arange(5))
    assert run.slopes is None


def test_a_solvers_steps_begin_at_the_second_pose() -> None:
    path = press().pose
    stopped = IndentationResult("cube", path, (), IndentationOutcome.DIVERGED, "at once")
    run = SimulatedRun.of(stopped, thickness_m=0.0151, fluid_volume_m3=8e-7)
    np.testing.assert_array_equal(run.forces, np.zeros((1, 3)))
    np.testing.assert_array_equal(run.travel, [0.0])
    assert run.reason == "at once"


def test_an_executor_changes_nothing_but_the_order_of_reports() -> None:
    jobs = [(TRUTH, press(depth_m=depth)) for depth in (1e-3, 2e-3, 3e-3)]
    told: list[tuple[int, int]] = []
    with ThreadPoolExecutor(2) as executor:
        parallel = SimulationRuns(Spring(), executor, lambda *now: told.append(now)).run(jobs)
    for one, other in zip(parallel, SimulationRuns(Spring()).run(jobs), strict=True):
        np.testing.assert_array_equal(one.forces, other.forces)
    assert told == [(1, 3), (2, 3), (3, 3)]


class Dying(Executor):
    """An executor whose process dies."""

    def submit(self, *_: object, **__: object) -> Future[SimulatedRun]:  # type: ignore[override]
        future: Future[SimulatedRun] = Future()
        future.set_exception(BrokenProcessPool("killed"))
        return future


def test_a_dying_process_is_named() -> None:
    with pytest.raises(SimulationError, match="died: killed"):
        SimulationRuns(Spring(), Dying()).run([(TRUTH, press())])


@pytest.mark.parametrize(
    ("bounds", "says"),
    [
        ({THICKNESS: (1e-3, 2e-3)}, "no bounds for"),
        (PAPER_BOUNDS | {THICKNESS: (2e-3, 1e-3)}, "bounds of skin_thickness_m"),
        (PAPER_BOUNDS | {FRICTION: (0.0, 1.0)}, "bounds of friction_coefficient"),
        (PAPER_BOUNDS | {THICKNESS: (1.0, 2.0)}, "bounds of skin_thickness_m"),
        (PAPER_BOUNDS | {"temperature": (25.0, 35.0)}, "cannot be calibrated"),
    ],
)
def test_impossible_bounds_are_refused(bounds: dict[str, tuple[float, float]], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        CalibrationSettings(bounds=bounds)


SIMULATOR = FingertipSimulator(edge_m=1.4e-3, layers=1)


@pytest.fixture(scope="module")
def pad_press() -> MeasuredIndentation:
    """Into the pad of the coarse finger, aslant, so that the force depends on friction."""
    tip = Fingertip.pressurised(biotac(edge_m=SIMULATOR.edge_m, layers=SIMULATOR.layers))
    surface = OuterSurface(tip.nodes, tip.geometry.mesh.outer_faces)
    target, normal = pad_point(surface, -4e-3, 0.0)
    direction = angled_direction(normal, 0.5, 0.0)
    path = press_path(
        make_indenter("sphere_medium"), target, direction, surface, depth_m=1e-3, steps=3,
        clearance_m=0.2e-3,
    )  # fmt: skip
    return MeasuredIndentation("pad", "sphere_medium", "-", path, np.zeros((len(path), 3)))


@pytest.mark.slow
def test_a_finger_in_this_process_derives_its_runs(pad_press: MeasuredIndentation) -> None:
    runs = SimulationRuns(SIMULATOR)
    assert runs.knows_slopes
    names, step = (THICKNESS, FRICTION), 1e-3
    plain, derived = (runs.run([(TRUTH, pad_press)], wanted)[0] for wanted in ((), names))
    assert plain.slopes is None
    assert derived.slopes is not None
    np.testing.assert_array_equal(plain.forces, derived.forces)
    assert derived.slopes.force.shape == (*derived.forces.shape, 2)
    assert derived.slopes.thickness_m == pytest.approx([0.0, 0.0], abs=1e-9)
    more, less = (
        SIMULATOR.simulate(
            replace(TRUTH, friction_coefficient=TRUTH.friction_coefficient * (1 + way)),
            pad_press.indenter,
            pad_press.pose,
        )
        for way in (step, -step)
    )
    wanted = (more.forces - less.forces) / (2 * step)
    found = derived.curve_slopes(np.array([TRUTH.skin_thickness_m, TRUTH.friction_coefficient]))
    assert found is not None
    # The tolerances of the solver leave 1e-4 of the forces.
    np.testing.assert_allclose(found[1], wanted, atol=0.02 * np.abs(wanted).max())


@pytest.mark.slow
def test_runs_in_a_process_of_their_own_are_derived_too(pad_press: MeasuredIndentation) -> None:
    model = FingertipModel("", {"edge_m": SIMULATOR.edge_m, "layers": SIMULATOR.layers}, TRUTH)
    with slope_simulator_for(model, 1, 1) as (simulator, executor, _):
        assert simulator == SIMULATOR
        (run,) = SimulationRuns(simulator, executor).run([(TRUTH, pad_press)], (FRICTION,))
    (here,) = SimulationRuns(SIMULATOR).run([(TRUTH, pad_press)], (FRICTION,))
    np.testing.assert_array_equal(run.forces, here.forces)
    assert run.slopes is not None
    assert run.slopes.names == (FRICTION,)


BUSY = """
import multiprocessing, time
from palpate_fem.cli.identify import slope_simulator_for
from palpate_fem.cli.model import model_of

if __name__ == "__main__":
    model = model_of(mesh="biotac", edge_mm=None, layers=2)
    with slope_simulator_for(model, 2, 2) as (_, executor, _):
        list(executor.map(time.sleep, [0.5, 0.5]))
        one = executor.submit(time.sleep, 600)
        print(*(worker.pid for worker in multiprocessing.active_children()), flush=True)
        one.result()
"""
"""One worker is busy, the other waits for its next run."""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_workers_of_slopes_end_with_their_command(tmp_path: Path, number: signal.Signals) -> None:
    """Ctrl-C goes to the whole group, and is told once; nothing catches SIGKILL."""
    script, told = tmp_path / "busy.py", tmp_path / "stderr"
    script.write_text(BUSY, encoding="utf-8")
    with told.open("w", encoding="utf-8") as stderr:
        command = subprocess.Popen(
            [sys.executable, str(script)],
            stdout=subprocess.PIPE, stderr=stderr, text=True, start_new_session=True,
        )  # fmt: skip
    assert command.stdout is not None
    workers = [int(word) for word in command.stdout.readline().split()]
    assert len(workers) == 2
    try:
        if number == signal.SIGINT:
            os.killpg(command.pid, number)
        else:
            command.send_signal(number)
        command.wait(60)
        deadline = time.monotonic() + 20.0
        while any(_lives(worker) for worker in workers):
            assert time.monotonic() < deadline, "a worker lives on"
            time.sleep(0.05)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(command.pid, signal.SIGKILL)
        command.wait(60)
        command.stdout.close()
    assert "SpawnProcess" not in told.read_text(encoding="utf-8")


def _lives(pid: int) -> bool:
    try:
        words = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except FileNotFoundError:
        return False
    return words[0] != "Z"


def test_slopes_of_another_mesh_are_refused() -> None:
    model = FingertipModel("", {"layers": 2, "mesh": "somewhere"}, TRUTH)
    with pytest.raises(ConfigError, match="parametric mesh"), slope_simulator_for(model, 1, 1):
        pass
