"""Newton: quadratic, exact in volume, and honest about what it cannot do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.fem.numpy_mechanics import Rubber, cavity, elements

from palpate.errors import SimulationError
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics import iteration as iteration_module
from palpate_fem.mechanics.contact import ContactSettings, PosedIndenter
from palpate_fem.mechanics.iteration import NewtonSettings, damping_after, has_converged
from palpate_fem.mechanics.newton import NewtonSolver
from palpate_fem.mechanics.state import SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.sparse.factor import make_factor

Floats = NDArray[np.float64]
Mesh = Callable[..., SolidMesh]

MU, BULK_RATIO = 2.8e5, 1e4
# Always a fresh factor, whole steps, and on to where rounding rules.
PURE = NewtonSettings(
    tolerance=1e-12,
    volume_tolerance=1e-13,
    gap_tolerance_m=1e-14,
    traction_tolerance=1e-7,
    largest_move_m=1.0,
    keep_factor=0.0,
    keep_elastic=0.0,
    iterations=12,
)


def newton_of(
    mesh: SolidMesh, settings: NewtonSettings | None = None, **options: object
) -> NewtonSolver:
    arguments = {"shear_modulus_pa": MU, "bulk_ratio": BULK_RATIO, "contact": ContactSettings()}
    system = EquilibriumSystem(mesh, None, **{**arguments, **options})  # type: ignore[arg-type]
    factor = make_factor(
        system.pattern.indptr,
        system.pattern.indices,
        groups=system.pattern.free // 3,
        solver="fronts-double",
    )
    return NewtonSolver(system, factor, settings or NewtonSettings())


@pytest.fixture(scope="module")
def cup(shell: Mesh) -> SolidMesh:
    """A sphere whose upper half is held."""
    mesh = shell(5, 1, 3e-3, 4e-3)
    return replace(mesh, fixed=np.flatnonzero(mesh.nodes[:, 2] > 0.1e-3).astype(np.int32))


def assert_quadratic(residuals: list[float]) -> None:
    """The last two errors above rounding are below ten times the square of the one before."""
    last = [k for k in range(1, len(residuals)) if residuals[k] > 1e-13][-2:]
    assert residuals[-1] < 1e-9, residuals
    assert all(residuals[k] < 10.0 * residuals[k - 1] ** 2 for k in last), residuals


@pytest.mark.parametrize("held_volume", [True, False])
def test_convergence_is_quadratic(cup: SolidMesh, held_volume: bool) -> None:
    newton, state = newton_of(cup, PURE), SolutionState.at_rest(cup)
    volume = 1.15 * newton.system.balance(state, None).volume if held_volume else None
    state.fluid_pressure = 0.0 if held_volume else 3e4
    report, _ = newton.solve(state, None, volume=volume)
    assert report.iterations == report.factorisations
    assert_quadratic(report.residuals)


@pytest.mark.parametrize("mortar", [False, True], ids=["nodes", "mortar"])
@pytest.mark.parametrize("friction", [0.0, 0.5], ids=["smooth", "sticking"])
def test_convergence_is_fast_in_contact(cup: SolidMesh, friction: float, mortar: bool) -> None:
    """Quadratic at nodes; with mortar's loads, whose matrix is that of the start, nearly so."""
    settings = replace(PURE, largest_move_m=0.25e-3, iterations=20, mortar_updates=0)
    newton = newton_of(cup, settings, contact=ContactSettings(mortar=mortar))
    state, surface = SolutionState.at_rest(cup), newton.system.outer
    volume = 1.1 * newton.system.balance(state, None).volume
    newton.solve(state, None, volume=volume)
    low = state.position[:, 2].min()
    press = PosedIndenter(
        make_indenter("sphere_medium"), np.array([1e-4, 0, low, 1, 0, 0, 0]), friction
    )
    for depth in (0.2e-3, 0.3e-3):
        stretch = state.traction / newton.system.contact.tangential_stiffness
        state.anchor[:] = press.to_local(state.position[cup.outer_faces] - stretch)
        press = press.at(np.array([1e-4, 0, low + depth, 1, 0, 0, 0]))
        report, balance = newton.solve(state, press, volume=volume)
    assert (2 if friction else 1) in surface.status.numpy()
    assert np.linalg.norm(balance.indenter.sum(axis=0)) > 0.1
    if not mortar:
        assert_quadratic(report.residuals)
    last = [pair for pair in pairwise(report.residuals) if pair[1] > 1e-13][-2:]
    assert all(after < 0.03 * before for before, after in last)


def test_volume_is_met_exactly_by_the_border(cup: SolidMesh) -> None:
    newton, state = newton_of(cup), SolutionState.at_rest(cup)
    rest = newton.system.balance(state, None).volume
    for ratio in (1.05, 1.1, 1.08):
        report, balance = newton.solve(state, None, volume=ratio * rest)
        assert report.converged
        assert balance.volume == pytest.approx(ratio * rest, rel=1e-6)
        found = cavity(cup.inner_faces, state.position).volume.sum()
        assert found == pytest.approx(balance.volume, rel=1e-12)


def test_a_given_pressure_and_the_volume_it_makes_are_one_state(cup: SolidMesh) -> None:
    newton, by_volume = newton_of(cup, PURE), SolutionState.at_rest(cup)
    rest = newton.system.balance(by_volume, None).volume
    newton.solve(by_volume, None, volume=1.08 * rest)
    by_pressure = SolutionState.at_rest(cup)
    by_pressure.fluid_pressure = by_volume.fluid_pressure
    assert by_pressure.fluid_pressure > 1e3
    _, balance = newton.solve(by_pressure, None, volume=None)
    assert balance.volume == pytest.approx(1.08 * rest, rel=1e-8)
    np.testing.assert_allclose(by_pressure.position, by_volume.position, atol=1e-11)


def test_kept_and_fresh_factors_agree(cup: SolidMesh) -> None:
    positions, costs = [], []
    for keep in (0.0, 0.9):
        newton = newton_of(cup, NewtonSettings(keep_factor=keep, tolerance=1e-9))
        state = SolutionState.at_rest(cup)
        volume = 1.1 * newton.system.balance(state, None).volume
        report, _ = newton.solve(state, None, volume=volume)
        assert report.converged
        positions.append(state.position)
        costs.append(report.factorisations)
    np.testing.assert_allclose(positions[0], positions[1], atol=1e-10)
    assert costs[1] < costs[0]


def test_a_body_at_rest_is_in_equilibrium(cup: SolidMesh) -> None:
    """Also without any force to measure the unbalanced ones against."""
    newton, state = newton_of(cup), SolutionState.at_rest(cup)
    volume = newton.system.balance(state, None).volume
    for target in (None, volume):
        report, _ = newton.solve(state, None, volume=target)
        assert report.converged
        assert report.iterations == 0
        np.testing.assert_array_equal(state.position, cup.nodes)


def test_prescribed_displacements_alone_stretch_a_block(block: Mesh) -> None:
    """Uniaxial tension: mu (l^2 - 1/l) times the current area; rollers on three sides."""
    mesh, stretch = block((2, 2, 3), 1e-3), 1.3
    held = np.isclose(mesh.nodes, 0.0)
    top = np.isclose(mesh.nodes[:, 2], 3e-3)
    held[top, 2] = True
    # One layer has all of the stretch at first: far into the barrier, which is not of this test.
    newton = newton_of(mesh, held=held, bulk_ratio=1e6, volume_barrier=0.0)
    state = SolutionState.at_rest(mesh)
    state.position[top, 2] *= stretch
    report, balance = newton.solve(state, None, volume=None)
    assert report.converged, report.reason
    assert report.iterations < 12
    load = balance.internal[top, 2].sum()
    stress = MU * (stretch**2 - 1 / stretch)
    assert load == pytest.approx(stress * 4e-6 / stretch, rel=1e-5)
    np.testing.assert_allclose(
        state.position, mesh.nodes * [stretch**-0.5, stretch**-0.5, stretch], atol=1e-8
    )


@pytest.mark.parametrize("faces", ["outer_faces", "inner_faces"])
@pytest.mark.parametrize("corners", [8, 6])
def test_a_solid_may_lack_a_surface(shell: Mesh, corners: int, faces: str) -> None:
    mesh = shell(2, 1, 3e-3, 4e-3, corners=corners)
    none: dict[str, NDArray[np.int32]] = {faces: getattr(mesh, faces)[:0]}
    mesh = replace(mesh, **none, fixed=np.arange(8, dtype=np.int32))  # type: ignore[arg-type]
    newton, state = newton_of(mesh), SolutionState.at_rest(mesh)
    state.position[0, 0] += 1e-5
    report, balance = newton.solve(state, None, volume=None)
    assert report.converged
    assert np.abs(balance.internal[0]).max() > 0.0


def test_dead_loads_are_borne_by_what_is_held(block: Mesh) -> None:
    mesh = block((2, 2, 2))
    mesh = replace(mesh, fixed=np.flatnonzero(mesh.nodes[:, 2] == 0.0).astype(np.int32))
    newton = newton_of(mesh)
    newton.system.load[-1] = (0.01, -0.02, 0.03)
    state = SolutionState.at_rest(mesh)
    report, balance = newton.solve(state, None, volume=None)
    assert report.converged
    borne = balance.internal[mesh.fixed].sum(axis=0)
    np.testing.assert_allclose(borne, (-0.01, 0.02, -0.03), atol=1e-7)
    twin = elements(mesh, Rubber(MU), BULK_RATIO * MU, state.position, state.pressure)
    np.testing.assert_allclose(twin.force, balance.internal, atol=1e-9)


def test_no_node_moves_farther_than_it_may(cup: SolidMesh) -> None:
    newton = newton_of(cup, NewtonSettings(largest_move_m=1e-5, iterations=1))
    state = SolutionState.at_rest(cup)
    volume = 1.5 * newton.system.balance(state, None).volume
    report, _ = newton.solve(state, None, volume=volume)
    assert not report.converged
    assert report.reason == "no equilibrium after 1 iterations"
    moved = np.linalg.norm(state.position - cup.nodes, axis=1).max()
    assert moved == pytest.approx(1e-5, rel=1e-9)


def test_asks_whether_to_stop_once_an_iteration(cup: SolidMesh) -> None:
    newton, state = newton_of(cup, PURE), SolutionState.at_rest(cup)
    volume = 1.1 * newton.system.balance(state, None).volume
    asked = 0

    def stop() -> bool:
        nonlocal asked
        asked += 1
        return asked == 3

    report, _ = newton.solve(state, None, volume=volume, should_stop=stop)
    assert (asked, report.iterations) == (3, 2)
    assert (report.converged, report.reason) == (False, "stopped")


@pytest.mark.parametrize("culprit", ["factorise", "solve"])
def test_a_solver_that_fails_ends_the_increment_not_the_program(
    cup: SolidMesh, monkeypatch: pytest.MonkeyPatch, culprit: str
) -> None:
    """So that a smaller increment can be tried; the next one starts afresh."""
    newton, state = newton_of(cup), SolutionState.at_rest(cup)
    volume = 1.1 * newton.system.balance(state, None).volume

    def fail(_: Floats) -> Floats:
        raise SimulationError("no memory left", remedy="buy some")

    with monkeypatch.context() as patch:
        patch.setattr(newton.factor, culprit, fail)
        report, _ = newton.solve(state, None, volume=volume)
        assert (report.converged, report.reason) == (False, "no memory left")
    report, _ = newton.solve(SolutionState.at_rest(cup), None, volume=volume)
    assert report.converged


def test_a_body_that_nothing_holds_is_reported(block: Mesh) -> None:
    mesh = block((2, 2, 1))
    newton = newton_of(mesh, held=np.zeros(mesh.nodes.shape, bool))
    newton.system.load[0, 2] = 0.1
    report, _ = newton.solve(SolutionState.at_rest(mesh), None, volume=None)
    assert not report.converged
    assert report.reason


def test_an_inverted_start_is_reported(cup: SolidMesh) -> None:
    newton, state = newton_of(cup), SolutionState.at_rest(cup)
    inside = np.setdiff1d(np.arange(len(cup.nodes)), cup.fixed)
    state.position[inside[0]] = 0.0
    report, _ = newton.solve(state, None, volume=None)
    assert not report.converged
    assert report.reason


def test_gives_up_after_as_many_iterations_as_it_says(cup: SolidMesh) -> None:
    never = NewtonSettings(tolerance=-1.0)
    newton = newton_of(cup, never)
    for continued, limit in ((False, 20), (True, 40)):
        state = SolutionState.at_rest(cup)
        report, _ = newton.solve(state, None, volume=None, pseudo_transient=continued)
        assert (report.iterations, report.converged) == (limit, False)
        assert report.reason == f"no equilibrium after {limit} iterations"


def test_continuation_factorises_once_where_nothing_is_unstable(cup: SolidMesh) -> None:
    newton, state = newton_of(cup), SolutionState.at_rest(cup)
    volume = 1.05 * newton.system.balance(state, None).volume
    report, _ = newton.solve(state, None, volume=volume, pseudo_transient=True)
    assert report.converged
    assert report.factorisations == report.iterations


def test_what_is_forgotten_leaves_no_trace(cup: SolidMesh) -> None:
    """Solved after another increment, and by a solver that never did anything."""
    fresh, used = newton_of(cup), newton_of(cup)
    rest = fresh.system.balance(SolutionState.at_rest(cup), None).volume
    used.solve(SolutionState.at_rest(cup), None, volume=1.15 * rest)
    used.forget()
    states = [SolutionState.at_rest(cup), SolutionState.at_rest(cup)]
    for newton, state in zip((fresh, used), states, strict=True):
        newton.solve(state, None, volume=1.05 * rest)
    np.testing.assert_array_equal(states[0].position, states[1].position)
    assert states[0].fluid_pressure == states[1].fluid_pressure


def test_the_skins_share_is_made_anew_once_an_iteration_has_come_near(
    cup: SolidMesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    newton, state = newton_of(cup, NewtonSettings(keep_factor=0.0)), SolutionState.at_rest(cup)
    rest = newton.system.balance(state, None).volume
    anew: list[bool] = []
    values = newton.system.tangent_values

    def watched(*, elastic: bool = True, **more: float) -> Floats:
        anew.append(elastic)
        return values(elastic=elastic, **more)

    monkeypatch.setattr(newton.system, "tangent_values", watched)
    newton.solve(state, None, volume=1.05 * rest)
    first = list(anew)
    anew.clear()
    newton.solve(state, None, volume=1.055 * rest)
    assert first[:2] == [True, True], "none yet, then the error is large"
    assert anew[:3] == [False, False, True], "that of the last increment, until it is near"


@pytest.mark.parametrize(
    ("last", "factor"),
    [
        ([1.0] * 6, 1.0),  # five iterations: too early to tell
        ([1.0] * 7, 0.75),
        ([1.0] * 8, 0.5),
        ([1.0] * 6 + [0.29], 1.0),  # it falls
        ([1.0] * 6 + [0.3], 0.75),
        ([1.0] * 3 + [0.5, 1.0, 1.0, 0.2], 0.75),  # not below 0.3 of each of the last three
        ([1.0] * 3 + [0.5, 0.7, 0.7, 0.1], 1.0),
        ([1.0] * 2 + [0.1, 1.0, 1.0, 1.0, 0.2], 1.0),  # the one before these does not count
        ([1.0] * 5 + [0.01, 1.0], 0.75),
    ],
)
def test_steps_are_shortened_where_the_error_goes_round_in_circles(
    last: list[float], factor: float
) -> None:
    assert damping_after(last) == factor


@pytest.mark.parametrize(("strength", "left"), [(0.02, None), (1.0, 0.1)])
def test_frictions_unsymmetric_share_is_answered(strength: float, left: float | None) -> None:
    """By one correction where it is small, else until a tenth of it is left over."""
    rng = np.random.default_rng(4)
    size = 30
    symmetric = np.eye(size) * 4.0 + 0.1 * np.ones((size, size))
    unsymmetric = strength * rng.normal(size=(size, size)) / np.sqrt(size)
    solver = NewtonSolver(
        SimpleNamespace(unsymmetric_product=lambda v: unsymmetric @ v),  # type: ignore[arg-type]
        SimpleNamespace(solve=lambda v: np.linalg.solve(symmetric, v)),
        NewtonSettings(),
    )
    # Moves of micrometres, as in an increment.
    answer, coupled = 1e-6 * rng.normal(size=(2, size)) * [[1.0], [6.0 if left else 0.1]]
    more = solver._correction(answer, coupled, whole=True)
    before = np.linalg.solve(symmetric, coupled - unsymmetric @ answer)
    if left is None:
        np.testing.assert_allclose(more, before, rtol=1e-12)
        return
    after = before - more - np.linalg.solve(symmetric, unsymmetric @ more)
    assert np.linalg.norm(before) > 0.3 * np.linalg.norm(answer)
    assert np.linalg.norm(after) <= left * np.linalg.norm(before)


def test_a_nearly_singular_symmetric_part_is_solved_with_its_unsymmetric_share() -> None:
    """One correction would leave over more than the right-hand side, a whole solution a hundredth.

    That share resists the soft direction of the symmetric part, which is even a little unstable.
    """
    rng = np.random.default_rng(4)
    size = 30
    basis = np.linalg.qr(rng.normal(size=(size, size)))[0]
    symmetric = basis @ np.diag([-1e-3, *np.linspace(1.0, 1e3, size - 1)]) @ basis.T
    turn = rng.normal(size=(size, size))
    unsymmetric = 0.5 * np.outer(basis[:, 0], basis[:, 0]) + 0.02 * (turn - turn.T)
    rows, columns = np.triu_indices(size)
    starts = np.concatenate([[0], np.cumsum(np.arange(size, 0, -1))])
    pattern = SimpleNamespace(indices=columns, indptr=starts, free=np.arange(size))
    solver = NewtonSolver(
        SimpleNamespace(unsymmetric_product=lambda v: unsymmetric @ v, pattern=pattern),  # type: ignore[arg-type]
        SimpleNamespace(solve=lambda v: np.linalg.solve(symmetric, v)),
        NewtonSettings(),
    )
    right, gradient = rng.normal(size=(2, size))
    missing = 3.0
    change, pressure = solver._whole_solution(
        symmetric[rows, columns],
        right,
        SimpleNamespace(volume_gradient=gradient.reshape(-1, 3), volume=0.0),  # type: ignore[arg-type]
        missing,
    )
    left = right + pressure * gradient - (symmetric + unsymmetric) @ change
    assert np.linalg.norm(left) < 0.02 * np.linalg.norm(right)
    assert gradient @ change == pytest.approx(missing, rel=0.02)
    once = np.linalg.solve(symmetric, right)
    once += np.linalg.solve(symmetric, -unsymmetric @ once)
    left = right - (symmetric + unsymmetric) @ once
    assert np.linalg.norm(left) > 10.0 * np.linalg.norm(right)


def test_settings_are_those_that_results_were_made_with() -> None:
    settings = NewtonSettings()
    assert (settings.tolerance, settings.volume_tolerance) == (1e-6, 1e-6)
    assert (settings.gap_tolerance_m, settings.traction_tolerance) == (1e-9, 0.01)
    assert (settings.iterations, settings.pseudo_transient_iterations) == (20, 40)
    assert (settings.largest_move_m, settings.keep_factor, settings.keep_elastic) == (
        0.25e-3, 0.3, 0.15,
    )  # fmt: skip
    assert (iteration_module.FIRST_VISCOSITY, iteration_module.NO_VISCOSITY) == (1.0, 3e-3)
    assert (iteration_module.LEAST_VISCOSITY, iteration_module.MOST_VISCOSITY) == (1e-2, 100.0)
    assert (
        iteration_module.VISCOSITY_FALL,
        iteration_module.VISCOSITY_RISE,
        iteration_module.STALLED,
    ) == (
        0.3,
        3.0,
        0.8,
    )


@pytest.mark.parametrize("wrong", ["residual", "volume", "strain_error"])
def test_what_is_not_a_number_has_not_converged(wrong: str) -> None:
    errors = {
        "residual": 0.0, "volume": 1.0, "strain_error": 0.0, "gap_error_m": 0.0,
        "traction_error": 0.0,
    }  # fmt: skip
    assert has_converged(SimpleNamespace(**errors), 1.0, NewtonSettings())
    assert not has_converged(SimpleNamespace(**{**errors, wrong: np.nan}), 1.0, NewtonSettings())
