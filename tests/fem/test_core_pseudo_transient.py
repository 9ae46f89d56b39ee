"""Pseudo-transient continuation: from an unstable state to a stable one, without added forces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.contact import ContactSettings, PosedIndenter
from palpate_fem.mechanics.iteration import (
    FIRST_VISCOSITY,
    LEAST_VISCOSITY,
    MOST_VISCOSITY,
    Correct,
    Factorise,
    NewtonReport,
    NewtonSettings,
    PseudoTransient,
    Step,
    newton_iterations,
)
from palpate_fem.mechanics.load_stepping import SolverSettings, moves_in
from palpate_fem.mechanics.newton import NewtonSolver
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mechanics.state import ForceBalance, SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.result import IndentationOutcome
from palpate_fem.sparse.factor import make_factor

Floats = NDArray[np.float64]
Mesh = Callable[..., SolidMesh]
Fill = Callable[..., Fingertip]

BALL = make_indenter("sphere_medium")


def test_viscosity_falls_to_none_and_comes_back_where_nothing_is_won() -> None:
    continuation = PseudoTransient()
    viscosities = [continuation.viscosity]
    for residual in (1.0, 3.0, 0.5, 2.0, 0.3, 0.1):  # leaving an unstable state, forces may grow
        continuation.after(residual)
        viscosities.append(continuation.viscosity)
    assert viscosities[0] == FIRST_VISCOSITY
    assert all(later < earlier or later == 0.0 for earlier, later in pairwise(viscosities))
    assert continuation.viscosity == 0.0
    continuation.after(0.29)
    assert continuation.viscosity == FIRST_VISCOSITY  # two iterations ago it was as good


def test_viscosity_rises_from_none_as_far_as_it_may() -> None:
    continuation = PseudoTransient(viscosity=0.0)
    continuation.rise()
    assert continuation.viscosity == LEAST_VISCOSITY
    while continuation.can_rise:
        continuation.rise()
    assert continuation.viscosity == MOST_VISCOSITY


@pytest.mark.parametrize("continuation", [None, PseudoTransient()])
def test_offsets_rest_before_an_increment_ends(continuation: PseudoTransient | None) -> None:
    # Each evaluation finds the offsets off by a tenth of what the last one did; a step meets them.
    misfit = 1e-3
    errors = {"volume": 1.0, "strain_error": 0.0, "gap_error_m": 0.0, "traction_error": 0.0}
    requests = newton_iterations(
        report := NewtonReport(), SimpleNamespace(residual=0.5, **errors), None, NewtonSettings(),
        has_elastic=False, continuation=continuation,
    )  # fmt: skip
    wanted = next(requests)
    for _ in range(200):
        residual = 1e-9
        if isinstance(wanted, Correct) or (isinstance(wanted, Step) and wanted.renews):
            residual, misfit = misfit, 0.1 * misfit
        found: object = (SimpleNamespace(residual=residual, **errors), False)
        try:
            wanted = requests.send(True if isinstance(wanted, Factorise) else found)
        except StopIteration:
            break
    assert report.converged
    assert misfit <= 1e-6


def newton_of(
    mesh: SolidMesh, held: NDArray[np.bool_], solver: str = "fronts-double"
) -> NewtonSolver:
    system = EquilibriumSystem(
        mesh, None, shear_modulus_pa=2.8e5, bulk_ratio=1e3, contact=ContactSettings(), held=held
    )
    pattern = system.pattern
    factor = make_factor(pattern.indptr, pattern.indices, groups=pattern.free // 3, solver=solver)
    return NewtonSolver(system, factor, NewtonSettings(pseudo_transient_iterations=100))


@pytest.fixture(scope="module")
def column(block: Mesh) -> tuple[SolidMesh, NDArray[np.bool_], SolutionState]:
    """A slender column with clamped ends, shortened far beyond Euler's load, and straight."""
    mesh = block((1, 1, 12))
    held = np.zeros(mesh.nodes.shape, bool)
    held[(mesh.nodes[:, 2] < 1e-9) | (mesh.nodes[:, 2] > 12e-3 - 1e-9)] = True
    state = SolutionState.at_rest(mesh)
    state.position[:, 2] *= 0.85
    return mesh, held, state


@pytest.mark.parametrize("solver", ["fronts", "fronts-double", "superlu"])
def test_a_column_stays_straight_by_newton_and_buckles_by_continuation(
    column: tuple[SolidMesh, NDArray[np.bool_], SolutionState], solver: str
) -> None:
    """Newton finds the unstable straight column; nothing real would stay there."""
    mesh, held, start = column
    straight, newton = start.copy(), newton_of(mesh, held, solver)
    report, _ = newton.solve(straight, None, volume=None)
    assert report.converged
    newton.factor.factorise(newton.system.tangent_values())
    assert newton.factor.negative > 0
    middle = np.abs(mesh.nodes[:, 2] - 6e-3) < 1e-9
    axis = straight.position[middle].mean(axis=0)
    assert np.abs(axis[:2] - 0.5e-3).max() < 1e-9

    bent = start.copy()
    # Continuation follows the least disturbance, not the straight column.
    bent.position[middle, 0] += 1e-6
    report, balance = newton.solve(bent, None, volume=None, pseudo_transient=True)
    assert report.converged, report.residuals
    assert bent.position[middle, 0].mean() - 0.5e-3 > 0.5e-3
    newton.system.balance(bent, None)
    newton.factor.factorise(newton.system.tangent_values())
    assert newton.factor.negative == 0
    # An equilibrium of the column itself: plain Newton has nothing to do there.
    report, plain = newton.solve(bent.copy(), None, volume=None)
    assert report.iterations == 0
    assert plain.residual == balance.residual


def test_continuation_arrives_where_plain_steps_do(fill: Fill, settled: SolverSettings) -> None:
    finger = fill(settled)
    low = finger.nodes[:, 2].min()
    answers = []
    for continued in (False, True):
        state = finger.state.copy()
        press = PosedIndenter(BALL, np.array([0.0, 0.0, low + 0.4e-3, 1.0, 0.0, 0.0, 0.0]), 0.0)
        finger.newton.forget()
        report, balance = finger.newton.solve(
            state, press, volume=finger.cavity_m3, pseudo_transient=continued
        )
        assert report.converged
        answers.append((state.position, balance.indenter.sum(axis=0)))
    np.testing.assert_allclose(answers[0][0], answers[1][0], atol=1e-8)
    np.testing.assert_allclose(answers[0][1], answers[1][1], atol=1e-5)


def test_a_point_that_lets_go_does_so_at_once(finger: Fingertip) -> None:
    """However short the step: half of a pressure again and again is never none."""
    low = finger.nodes[:, 2].min()
    state = finger.state.copy()
    deep = np.array([0.0, 0.0, low + 0.4e-3, 1.0, 0.0, 0.0, 0.0])
    press = PosedIndenter(BALL, deep, 0.3)
    assert finger.newton.solve(state, press, volume=finger.cavity_m3)[0].converged
    touching = state.indenter_pressure > 0.0
    assert touching.sum() > 4
    short = NewtonSolver(
        finger.system, finger.newton.factor, NewtonSettings(iterations=1, largest_move_m=1e-6)
    )
    away = press.at(deep - np.array([0.0, 0.0, 0.3e-3, 0.0, 0.0, 0.0, 0.0]))
    short.solve(state, away, volume=finger.cavity_m3)
    gone = touching & (state.indenter_pressure <= 0.0)
    assert gone.any()
    assert not state.traction[gone].any()
    assert (state.indenter_pressure >= 0.0).all()


def test_a_snap_ends_the_trajectory_before_it(fill: Fill) -> None:
    """Where only continuation finds an answer, and one that bears much less."""
    finger = fill()
    finger.newton.settings = NewtonSettings(iterations=1)
    low = finger.nodes[:, 2].min()
    path = np.array([[0.0, 0.0, low + depth, 1.0, 0.0, 0.0, 0.0] for depth in (-2e-6, 0.2e-3)])
    run = finger.load_stepping(BALL, path)
    report, balance = run.increment(path[1], 1.0)
    assert report.converged
    force = float(np.linalg.norm(balance.indenter.sum(axis=0)))
    load = run.at.load
    assert np.linalg.norm(load.sum(axis=0)) == pytest.approx(force)

    run = finger.load_stepping(BALL, path)
    run.at.load, before = 2.0 * load, run.at.state.copy()
    snap = f"the skin snaps: {2 * force:.1f} N fall to {force:.1f} N"
    report, _ = run.increment(path[1], 1.0)
    assert not report.converged
    assert report.reason == snap
    assert run.outcome is None  # a shorter increment may not snap
    np.testing.assert_array_equal(run.at.state.position, before.position)

    run.settings = replace(run.settings, smallest_increment=1.0)
    result = run.run()
    assert result.outcome is IndentationOutcome.DIVERGED
    assert result.reason == f"{snap}, 0.000 mm along the path"
    assert not result.steps


def test_where_a_shorter_increment_does_not_snap_the_trajectory_goes_on(fill: Fill) -> None:
    finger = fill()
    low = finger.nodes[:, 2].min()
    path = np.array([[0.0, 0.0, low + depth, 1.0, 0.0, 0.0, 0.0] for depth in (-2e-6, 0.2e-3)])
    run = finger.load_stepping(BALL, path)
    assert run.increment(path[1], 1.0)[0].converged
    pressed = run.at.load

    run = finger.load_stepping(BALL, path)
    increment, lengths = run.increment, []

    def first_snaps(pose: Floats, length: float) -> tuple[NewtonReport, ForceBalance]:
        lengths.append(length)
        if len(lengths) > 1:
            return increment(pose, length)
        usual, untouched = finger.newton.settings, run.at.load
        finger.newton.settings = NewtonSettings(iterations=1)  # only continuation converges
        run.at.load = 1.2 * pressed
        answer = increment(pose, length)
        finger.newton.settings, run.at.load = usual, untouched
        assert answer[0].reason.startswith("the skin snaps")
        return answer

    run.increment = first_snaps  # type: ignore[method-assign]
    result = run.run()
    assert lengths[:2] == [1.0, 0.5]
    assert result.outcome is IndentationOutcome.COMPLETE
    assert result.steps[-1].convergence.increments > 1


def test_shorter_increments_together_lose_no_more_than_a_long_one_may(fill: Fill) -> None:
    """Else a snap in pieces would pass, also where Newton's method converges."""
    finger = fill()
    low = finger.nodes[:, 2].min()
    path = np.array([[0.0, 0.0, low + depth, 1.0, 0.0, 0.0, 0.0] for depth in (-2e-6, 0.2e-3)])
    run = finger.load_stepping(BALL, path)
    assert run.increment(path[1], 1.0)[0].converged
    pressed = run.at.load

    run = finger.load_stepping(BALL, path)
    finger.newton.settings = NewtonSettings(iterations=1)  # only continuation converges
    run.at.load = 2.0 * pressed
    assert run.increment(path[1], 1.0)[0].reason.startswith("the skin snaps")
    finger.newton.settings = NewtonSettings()
    run.at.load = 1.05 * pressed  # the last loss alone would pass
    assert run.increment(path[1], 0.5)[0].reason.startswith("the skin snaps")


@pytest.mark.parametrize(
    ("move", "inwards"),
    [
        ((0.0, 0.0, 0.1e-3), True),
        ((0.05e-3, 0.0, 0.0866e-3), True),  # 30 degrees to the normal, as the paper presses
        ((0.0, 0.0, -0.1e-3), False),
        ((0.1e-3, 0.0, 0.0), False),
        ((0.0, -0.1e-3, 0.01e-3), False),
    ],
)
def test_less_force_is_a_snap_on_the_way_in_only(
    fill: Fill, move: tuple[float, float, float], inwards: bool
) -> None:
    finger = fill()
    low = finger.nodes[:, 2].min()
    path = np.array([[0.0, 0.0, low + depth, 1.0, 0.0, 0.0, 0.0] for depth in (-2e-6, 0.3e-3)])
    run = finger.load_stepping(BALL, path)
    assert run.increment(path[1], 1.0)[0].converged
    finger.newton.settings = NewtonSettings(iterations=1)  # only continuation converges
    run.at.load = 3.0 * run.at.load
    there = path[1].copy()
    there[:3] += move
    report, _ = run.increment(there, 1.0)
    assert report.converged is not inwards
    assert report.reason.startswith("the skin snaps") is inwards


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)])
def test_a_turn_on_the_spot_does_not_go_into_the_skin(fill: Fill, axis: tuple[float, ...]) -> None:
    """Neither a twist about the normal, nor a turn about a tangent through the tip."""
    finger = fill()
    low = finger.nodes[:, 2].min()
    path = np.array([[0.0, 0.0, low + depth, 1.0, 0.0, 0.0, 0.0] for depth in (-2e-6, 0.3e-3)])
    run = finger.load_stepping(BALL, path)
    assert run.increment(path[1], 1.0)[0].converged
    turned = path[1].copy()
    turned[3:] = np.cos(0.05), *(np.sin(0.05) * np.array(axis))
    at = run.at
    assert not moves_in(at.state.position, at.load, at.indenter, at.indenter.at(turned))
