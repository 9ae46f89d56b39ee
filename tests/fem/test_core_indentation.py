"""How a trajectory goes on and ends: steps, cut-backs, limits, and requests to stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.errors import SimulationError
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.iteration import NewtonSettings
from palpate_fem.mechanics.load_stepping import ConvergedIncrement, SolverSettings
from palpate_fem.mechanics.newton import NewtonSolver
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mechanics.state import SolutionState
from palpate_fem.result import IndentationOutcome, IndentationResult, IndentationStep

Floats = NDArray[np.float64]
Fill = Callable[..., Fingertip]

BALL = make_indenter("sphere_medium")
HELD_M = 1e-8  # what the criterion of Newton leaves of 0.6 mm; it differs by the kind of processor
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
FRICTION = FingertipParameters().friction_coefficient


def press_path(tip: Fingertip, *depths_m: float, side_m: float = 0.0) -> Floats:
    """From just below the pad to each depth."""
    low = tip.nodes[:, 2].min()
    return np.array(
        [
            [0.3e-3 + side_m * k / len(depths_m), 0.0, low + depth, *UPRIGHT]
            for k, depth in enumerate((-2e-6, *depths_m))
        ]
    )


@pytest.fixture(scope="module")
def path(finger: Fingertip) -> Floats:
    return press_path(finger, 0.2e-3, 0.4e-3, 0.6e-3)


@pytest.fixture(scope="module")
def whole(finger: Fingertip, path: Floats) -> IndentationResult:
    """All of it."""
    trajectory = finger.indent(BALL, path)
    assert trajectory.outcome is IndentationOutcome.COMPLETE
    return trajectory


def assert_same_steps(
    found: tuple[IndentationStep, ...], wanted: tuple[IndentationStep, ...]
) -> None:
    for step, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(step.displacement, other.displacement)
        np.testing.assert_array_equal(step.indenter_force, other.indenter_force)


def test_a_start_within_the_skin_is_refused(finger: Fingertip) -> None:
    path = press_path(finger, 0.4e-3)
    path[0, 2] += 0.2e-3
    with pytest.raises(SimulationError, match="inside the skin"):
        finger.indent(BALL, path)


def test_steps_are_told_as_they_come(
    finger: Fingertip, path: Floats, whole: IndentationResult
) -> None:
    told: list[IndentationStep] = []
    trajectory = finger.indent(BALL, path, on_step=told.append)
    assert_same_steps(tuple(told), whole.steps)
    assert all(step is other for step, other in zip(told, trajectory.steps, strict=True))


def test_without_contact_nothing_happens(finger: Fingertip) -> None:
    path = press_path(finger, -1e-3, -2e-3, side_m=1e-3)
    trajectory = finger.indent(BALL, path)
    assert trajectory.outcome is IndentationOutcome.COMPLETE
    for step in trajectory.steps:
        assert not step.force.any()
        assert not step.torque.any()
        assert not step.displacement.any()
        assert step.contact_area_m2 == 0.0
        assert np.isnan(step.centre_of_pressure).all()
        assert step.fluid_pressure_pa == finger.fluid_pressure_pa
        assert step.convergence.penetration_m == 0.0


def test_an_indenter_meets_the_skin_that_lies_between_two_poses(
    finger: Fingertip, fill: Fill, settled: SolverSettings
) -> None:
    """Through the finger in one step, and along it without a touch at either end."""
    through = press_path(finger, -1e-3, 40e-3)[1:]
    stopped = finger.indent(BALL, through)
    assert stopped.outcome is not IndentationOutcome.COMPLETE
    assert 1e-3 < stopped.travel_m < 10e-3
    smooth = fill(settled, friction_coefficient=0.0)
    along = press_path(smooth, 0.3e-3, 0.3e-3)[1:]
    along[0, 0], along[1, 0] = -0.02, 0.02
    told: list[ConvergedIncrement] = []
    run = smooth.load_stepping(BALL, along, history=told)
    assert run.run().outcome is IndentationOutcome.COMPLETE
    assert not told[0].state.indenter_pressure.any()
    assert not told[-1].state.indenter_pressure.any()
    assert any(one.state.indenter_pressure.any() for one in told)


def test_pressing_leaves_the_fingertip_as_it_was(finger: Fingertip) -> None:
    before = finger.state.copy()
    elsewhere = press_path(finger, 0.3e-3)
    elsewhere[:, 0] += 0.2e-3
    finger.indent(BALL, elsewhere)
    for name in SolutionState.__slots__:
        np.testing.assert_array_equal(getattr(finger.state, name), getattr(before, name))


def test_a_smooth_press_and_return_undoes_itself(fill: Fill, settled: SolverSettings) -> None:
    """Without friction a state depends on the pose alone, not on the way or its increments."""
    smooth = fill(settled, friction_coefficient=0.0)
    path = press_path(smooth, 0.3e-3, 0.6e-3, 0.3e-3, -0.1e-3)
    steps = smooth.indent(BALL, path).steps
    assert steps[1].force[2] > 0.3
    np.testing.assert_allclose(steps[2].force, steps[0].force, atol=1e-6)
    np.testing.assert_allclose(steps[3].displacement, 0.0, atol=1e-9)
    at_once = smooth.indent(BALL, path[[0, 2]]).steps[0]
    np.testing.assert_allclose(at_once.force, steps[1].force, atol=1e-6)
    np.testing.assert_allclose(at_once.displacement, steps[1].displacement, atol=1e-8)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_the_skin_is_dragged_held_and_dragged_back(
    fill: Fill, settled: SolverSettings, sense: float
) -> None:
    """A point that slid sticks where it came to, so the way back begins there."""
    finger = fill(settled)
    path = press_path(finger, *[0.6e-3] * 4)
    path[2:4, 0] += sense * 0.3e-3
    still, along, held, back = finger.indent(BALL, path).steps
    friction = [(s.force[0] - still.force[0]) * sense for s in (along, held, back)]
    assert friction[0] > 0.05 * along.force[2]
    assert friction[1] == pytest.approx(friction[0], rel=5e-5)
    np.testing.assert_allclose(held.displacement, along.displacement, atol=HELD_M)
    assert friction[2] < -0.02 * back.force[2]


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_the_skin_turns_with_the_indenter(finger: Fingertip, sense: float) -> None:
    path = press_path(finger, 0.6e-3, 0.6e-3)
    half = np.deg2rad(15.0) * sense
    path[2, 3:] = (np.cos(half), 0.0, 0.0, np.sin(half))
    still, turned = finger.indent(BALL, path).steps
    middle = np.array([0.3e-3, 0.0, 0.0])
    twist = (turned.torque - np.cross(middle, turned.force))[2] * sense
    assert 1e-5 < twist < FRICTION * turned.force[2] * 1.5e-3
    assert turned.force[2] == pytest.approx(still.force[2], rel=0.02)


def test_a_force_limit_ends_it_with_the_step_that_passed_it(
    finger: Fingertip, path: Floats, whole: IndentationResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    forces = np.linalg.norm(whole.forces, axis=1)
    limit = SolverSettings(force_limit_n=float(forces[1] * 0.95))
    monkeypatch.setattr(finger, "settings", limit)
    trajectory = finger.indent(BALL, path)
    assert trajectory.outcome is IndentationOutcome.FORCE_LIMIT
    assert_same_steps(trajectory.steps, whole.steps[:2])
    assert trajectory.travel_m == pytest.approx(0.402e-3, rel=1e-9)
    assert trajectory.reason == f"{forces[1]:.1f} N, 0.402 mm along the path"


def test_an_increment_that_goes_far_past_the_limit_is_cut_back(
    finger: Fingertip, path: Floats, whole: IndentationResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends between the limit and a tenth more, and says where."""
    forces = np.linalg.norm(whole.forces, axis=1)
    limit = float(forces[0] + 0.4 * (forces[1] - forces[0]))
    assert forces[1] > 1.2 * limit
    monkeypatch.setattr(finger, "settings", SolverSettings(force_limit_n=limit))
    trajectory = finger.indent(BALL, path)
    assert trajectory.outcome is IndentationOutcome.FORCE_LIMIT
    assert_same_steps(trajectory.steps, whole.steps[:1])
    assert 0.201e-3 < trajectory.travel_m < 0.402e-3
    assert limit < float(trajectory.reason.split()[0]) < 1.1 * limit + 0.05


@pytest.fixture(scope="module")
def hasty(fill: Fill) -> Fingertip:
    """Gives up soon."""
    return fill(
        SolverSettings(
            newton=NewtonSettings(iterations=8, pseudo_transient_iterations=8),
            smallest_increment=0.6,
        )
    )


def test_what_cannot_be_solved_is_reported_with_what_could(hasty: Fingertip) -> None:
    """Three millimetres at once, onto the core."""
    path = press_path(hasty, 0.2e-3, 0.4e-3, 3.4e-3, 3.5e-3)
    trajectory = hasty.indent(BALL, path)
    assert trajectory.outcome is IndentationOutcome.DIVERGED
    assert_same_steps(trajectory.steps, hasty.indent(BALL, path[:3]).steps)
    assert len(trajectory.steps) == 2
    assert 0.4e-3 < trajectory.travel_m < 3.4e-3
    where = f", {trajectory.travel_m * 1e3:.3f} mm along the path"
    assert trajectory.reason.endswith(where)
    assert len(trajectory.reason) > len(where)
    # and it can be used again
    assert hasty.indent(BALL, path[:3]).outcome is IndentationOutcome.COMPLETE


def test_an_increment_that_fails_changes_nothing(hasty: Fingertip) -> None:
    path = press_path(hasty, 0.2e-3, 3.4e-3)
    run = hasty.load_stepping(BALL, path)
    report, _ = run.increment(path[1], 1.0)
    assert report.converged
    before, press = run.at.state.copy(), run.at.indenter
    report, _ = run.increment(path[2], 1.0)
    assert not report.converged
    assert run.at.indenter is press
    for name in SolutionState.__slots__:
        np.testing.assert_array_equal(getattr(run.at.state, name), getattr(before, name))


def test_a_step_is_cut_until_it_goes(finger: Fingertip, hasty: Fingertip) -> None:
    path = press_path(finger, 1.4e-3)
    hasty_settings = replace(hasty.settings, smallest_increment=1 / 64)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hasty, "settings", hasty_settings)
        patch.setattr(
            hasty.newton, "settings", NewtonSettings(iterations=7, pseudo_transient_iterations=7)
        )
        cut = hasty.indent(BALL, path)
    assert cut.outcome is IndentationOutcome.COMPLETE
    assert cut.steps[0].convergence.increments > 1
    wanted = finger.indent(BALL, path).steps[0].force[2]
    assert cut.steps[0].force[2] == pytest.approx(wanted, rel=0.05)  # friction knows the way


@pytest.mark.parametrize("outcome", [IndentationOutcome.CANCELLED, IndentationOutcome.DEADLINE])
@pytest.mark.parametrize("patience", [1, 2, 4, 9])
def test_a_request_to_stop_is_honoured_within_an_iteration(
    finger: Fingertip,
    path: Floats,
    whole: IndentationResult,
    monkeypatch: pytest.MonkeyPatch,
    outcome: IndentationOutcome,
    patience: int,
) -> None:
    asked = iterations = 0
    step = NewtonSolver._step

    def should_stop() -> IndentationOutcome | None:
        nonlocal asked
        asked += 1
        return outcome if asked == patience else None

    def count(*args: object) -> object:
        nonlocal iterations
        iterations += 1
        assert asked < patience, "goes on after it was told to stop"
        return step(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(NewtonSolver, "_step", count)
    trajectory = finger.indent(BALL, path, should_stop=should_stop)
    assert asked == patience
    assert trajectory.outcome is outcome
    assert iterations < patience
    assert_same_steps(trajectory.steps, whole.steps[: len(trajectory.steps)])
    assert len(trajectory.steps) < len(whole.steps)


def test_the_skin_is_back_once_the_indenter_has_left(finger: Fingertip) -> None:
    path = press_path(finger, 0.4e-3, 0.9e-3, 0.4e-3, -2e-6, -0.1e-3)
    result = finger.indent(BALL, path)
    assert result.outcome is IndentationOutcome.COMPLETE
    left = np.linalg.norm(result.steps[-1].displacement, axis=1).max()
    assert left < 0.01e-6


def test_a_request_to_stop_is_honoured_before_the_skin_is_touched(finger: Fingertip) -> None:
    """Where no increment needs an iteration."""
    path = press_path(finger, *[-2e-6 - 1e-5 * k for k in range(20)])
    told: list[IndentationStep] = []

    def should_stop() -> IndentationOutcome | None:
        return IndentationOutcome.CANCELLED if len(told) == 3 else None

    trajectory = finger.indent(BALL, path, on_step=told.append, should_stop=should_stop)
    assert trajectory.outcome is IndentationOutcome.CANCELLED
    assert len(trajectory.steps) == 3


def test_superlu_gives_the_same_forces(fill: Fill, settled: SolverSettings) -> None:
    finger, other = fill(settled), fill(replace(settled, solver="superlu"))
    assert (finger.newton.factor.name, other.newton.factor.name) == ("fronts", "superlu")
    path = press_path(finger, 0.4e-3, 0.8e-3)
    first, second = finger.indent(BALL, path), other.indent(BALL, path)
    np.testing.assert_allclose(second.forces, first.forces, atol=1e-6)
    np.testing.assert_allclose(other.nodes, finger.nodes, atol=1e-10)
