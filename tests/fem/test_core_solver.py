"""A small finger, filled and pressed: balance, constraints, symmetry, repetition, outputs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.fem.numpy_mechanics import Elements, Rubber, cavity, elements, mortar

from palpate.errors import SimulationError
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.indenter.distance import distance
from palpate_fem.mechanics.iteration import NewtonSettings
from palpate_fem.mechanics.load_stepping import VOIGT, LoadStepping, SolverSettings
from palpate_fem.mechanics.newton import NewtonSolver
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.core import RigidCore
from palpate_fem.mesh.solid import FingertipGeometry, SolidMesh
from palpate_fem.result import IndentationOutcome, IndentationResult, IndentationStep

Floats = NDArray[np.float64]
Fill = Callable[..., Fingertip]

BALL = make_indenter("sphere_medium")
FRICTION = FingertipParameters().friction_coefficient
BALANCE = 1e-8  # of the force; ten times Newton's tolerance, whose scale are all forces
COULOMB = 1e-3  # of the limit: a tenth of a micrometre on a sticking point's spring, and some luck
ACROSS = np.array([1.0, -1.0, 1.0])


def press_path(
    tip: Fingertip, depth_m: float, *, steps: int = 5, side_m: float = 0.0, y_m: float = 0.0
) -> Floats:
    """Up into the pad, beside its middle; ``side_m`` farther along x at its end."""
    low = tip.nodes[:, 2].min() - 2e-6
    share = np.linspace(0.0, 1.0, steps + 1)[:, None]
    start, way = np.array([[0.3e-3, y_m, low]]), np.array([[side_m, 0.0, depth_m]])
    return np.hstack([start + share * way, np.tile([1.0, 0.0, 0.0, 0.0], (steps + 1, 1))])


@dataclass
class Pressed:
    """A finished trajectory and the state that it ended in."""

    tip: Fingertip
    run: LoadStepping
    trajectory: IndentationResult

    @property
    def last(self) -> IndentationStep:
        return self.trajectory.steps[-1]

    @property
    def position(self) -> Floats:
        return self.run.at.state.position

    @property
    def skin(self) -> Elements:
        """Its elements by the twin."""
        mesh, state, parameters = self.tip.geometry.mesh, self.run.at.state, self.tip.parameters
        mu = parameters.shear_modulus_pa
        kappa = parameters.bulk_ratio * mu
        return elements(mesh, Rubber(mu), kappa, state.position, state.pressure)


@pytest.fixture(scope="module")
def pressed(finger: Fingertip) -> Pressed:
    """Pressed to the core and dragged, with friction."""
    run = finger.load_stepping(BALL, press_path(finger, 1.5e-3, side_m=0.2e-3))
    return Pressed(finger, run, run.run())


def test_fill_makes_the_volume_and_reports_its_progress(
    finger: Fingertip, shell: Callable[..., SolidMesh], ball: Callable[..., RigidCore]
) -> None:
    mesh = finger.geometry.mesh
    volume = cavity(mesh.inner_faces, finger.nodes).volume.sum()
    assert volume - finger.core_volume == pytest.approx(61e-9, rel=1e-5)
    assert finger.fluid_volume_m3 == pytest.approx(61e-9, rel=1e-12)
    assert 1e4 < finger.fluid_pressure_pa < 2e5
    np.testing.assert_array_equal(finger.nodes[mesh.fixed], mesh.nodes[mesh.fixed])

    large = shell(4, 1, 5.5e-3, 7.07e-3)
    large = replace(large, fixed=np.flatnonzero(large.nodes[:, 2] > 0.5e-3).astype(np.int32))
    geometry, fractions = FingertipGeometry(large, ball(3e-3)), list[float]()
    wanted = FingertipParameters(total_thickness_m=14.6e-3)
    tip = Fingertip.pressurised(geometry, wanted, progress=fractions.append)
    assert tip.total_thickness_m == pytest.approx(14.6e-3, abs=1e-8)
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    with pytest.raises(SimulationError, match=r"14\.14 mm thick already"):
        Fingertip.pressurised(geometry, replace(wanted, total_thickness_m=14.0e-3))


@pytest.fixture(scope="module")
def exact_finger(fill: Fill) -> Fingertip:
    """The same finger, solved until rounding rules."""
    newton = NewtonSettings(
        tolerance=1e-9,
        gap_tolerance_m=1e-15,
        traction_tolerance=1e-7,
        iterations=40,
        mortar_updates=30,
        keep_factor=0.0,
        keep_elastic=0.0,
    )
    return fill(SolverSettings(newton=newton, solver="fronts-double"))


@pytest.fixture(scope="module")
def exact(exact_finger: Fingertip) -> Pressed:
    """Pressed and dragged likewise."""
    run = exact_finger.load_stepping(BALL, press_path(exact_finger, 1.5e-3, side_m=0.2e-3))
    return Pressed(exact_finger, run, run.run())


def test_every_step_comes_in_order(pressed: Pressed) -> None:
    trajectory = pressed.trajectory
    assert (trajectory.outcome, trajectory.reason) == (IndentationOutcome.COMPLETE, "")
    assert trajectory.indenter == BALL.name
    np.testing.assert_array_equal([s.pose for s in trajectory.steps], trajectory.path[1:])
    length = np.linalg.norm(trajectory.path[-1, :3] - trajectory.path[0, :3])
    assert trajectory.travel_m == pytest.approx(length, rel=1e-9)
    assert (np.diff(trajectory.forces[:, 2]) > 0.0).all()
    assert (np.diff([s.fluid_pressure_pa for s in trajectory.steps]) > 0.0).all()


def test_all_forces_and_moments_on_the_skin_cancel(exact: Pressed) -> None:
    """Indenter, core and supports, whose reactions the twins give."""
    mesh, state, last = exact.tip.geometry.mesh, exact.run.at.state, exact.last
    skin = exact.skin
    fluid = state.fluid_pressure * cavity(mesh.inner_faces, state.position).gradient
    left = skin.force - fluid - last.indenter_force - last.core_force
    support = np.zeros_like(left)
    support[mesh.fixed] = left[mesh.fixed]
    size = np.linalg.norm(last.force)
    assert size > 1.0
    assert np.linalg.norm(last.core_force.sum(axis=0)) > 0.1
    net = (last.indenter_force + last.core_force + support).sum(axis=0)
    assert np.linalg.norm(net) < BALANCE * size
    moment = np.cross(state.position, last.indenter_force + last.core_force + support)
    assert np.linalg.norm(moment.sum(axis=0)) < BALANCE * size * 5e-3
    assert np.abs(left - support).max() < BALANCE * size


def test_the_fluid_keeps_its_volume(pressed: Pressed) -> None:
    tip, mesh = pressed.tip, pressed.tip.geometry.mesh
    for step in pressed.trajectory.steps:
        volume = cavity(mesh.inner_faces, tip.nodes + step.displacement).volume.sum()
        assert volume - tip.core_volume == pytest.approx(tip.fluid_volume_m3, rel=1e-5)
        assert abs(volume - tip.cavity_m3) <= 1e-6 * tip.cavity_m3
        assert step.convergence.volume_error <= 1e-6


def test_the_skin_keeps_its_volume_in_every_element(pressed: Pressed) -> None:
    skin = pressed.skin
    assert skin.smallest_jacobian > 0.5
    strain = skin.volume / skin.rest_volume - 1.0
    parameters = pressed.tip.parameters
    kappa = parameters.bulk_ratio * parameters.shear_modulus_pa
    assert np.abs(strain - pressed.run.at.state.pressure / kappa).max() < 1e-6
    assert np.abs(strain).max() < 1e-3


def test_nothing_is_deeper_than_micrometres(pressed: Pressed) -> None:
    """In the mean over the faces around each node."""
    tip, mesh = pressed.tip, pressed.tip.geometry.mesh
    none = np.zeros(len(mesh.nodes))
    for step in pressed.trajectory.steps:
        position = tip.nodes + step.displacement

        def to_ball(points: Floats, tip_at: Floats = step.pose[:3]) -> tuple[Floats, Floats]:
            return distance(BALL, points - tip_at)[:2]

        def to_core(points: Floats) -> tuple[Floats, Floats]:
            return tip.geometry.core.grid.evaluate(points)[:2]

        outside = mortar(mesh.nodes, mesh.outer_faces, position, none, to_ball)[0]
        inside = mortar(mesh.nodes, mesh.inner_faces, position, none, to_core)[0]
        deepest = max(-np.nanmin(outside), -np.nanmin(inside))
        assert 0.0 < deepest < 5e-6
        assert step.convergence.penetration_m == pytest.approx(deepest, abs=0.5e-6)


def test_offsets_of_gaps_are_those_of_the_solution(fill: Fill, settled: SolverSettings) -> None:
    """Not those of an iterate before it: each iteration near the solution evaluates them."""
    tip = fill(settled)
    run = tip.load_stepping(BALL, press_path(tip, 1.5e-3, side_m=0.2e-3))
    run.run()
    again = run.at.state.copy()
    tip.system.correct_contact(again, run.at.indenter)
    for found, wanted in (
        (run.at.state.on_indenter, again.on_indenter),
        (run.at.state.on_core, again.on_core),
    ):
        assert np.abs(wanted.gap).max() > 1e-6
        np.testing.assert_array_equal(found.gap, wanted.gap)


@pytest.mark.parametrize(
    ("which", "tolerance"), [("pressed", COULOMB), ("exact", 1e-9)], ids=["usual", "exact"]
)
def test_friction_obeys_coulomb_at_every_point(
    request: pytest.FixtureRequest, which: str, tolerance: float
) -> None:
    pressed: Pressed = request.getfixturevalue(which)
    assert pressed.trajectory.outcome is IndentationOutcome.COMPLETE
    state, surface = pressed.run.at.state, pressed.tip.system.outer
    traction = np.linalg.norm(state.traction, axis=2)
    limit = FRICTION * state.indenter_pressure
    status = surface.status.numpy()
    assert {2, 3} <= set(status.ravel())
    assert (state.indenter_pressure >= 0.0).all()
    assert (traction <= limit * (1 + tolerance)).all()
    sliding = status == 3
    np.testing.assert_allclose(traction[sliding], limit[sliding], rtol=tolerance)
    points = pressed.position[pressed.tip.geometry.mesh.outer_faces]
    away = points - pressed.run.at.indenter.tip - (0.0, 0.0, -3.5e-3)
    normal = away / np.linalg.norm(away, axis=2, keepdims=True)
    across = np.abs((normal * state.traction).sum(axis=2))
    assert across.max() < tolerance * traction.max()


def test_nodal_forces_are_those_of_pressure_and_friction(exact: Pressed) -> None:
    """Pressure acts on the faces, friction at the nodes and drags the skin along."""
    state, surface, last = exact.run.at.state, exact.tip.system.outer, exact.last
    mesh, faces = exact.tip.geometry.mesh, exact.tip.geometry.mesh.outer_faces
    pressure = np.zeros(len(mesh.nodes))
    pressure[faces] = state.indenter_pressure
    np.testing.assert_allclose(pressure[faces], state.indenter_pressure, rtol=1e-6)
    _, force = mortar(mesh.nodes, faces, state.position, pressure, exact.run.at.indenter.distance)
    np.add.at(force, faces, -surface.area_values[..., None] * state.traction)
    np.testing.assert_allclose(last.indenter_force, force, atol=1e-7 * last.force[2])
    dragged = -(surface.area_values[..., None] * state.traction).sum(axis=(0, 1))
    assert dragged[0] > 0.01 * last.force[2]


def test_step_outputs_agree_with_one_another(pressed: Pressed) -> None:
    tip, mesh = pressed.tip, pressed.tip.geometry.mesh
    whole = tip.system.outer.current_area(tip.nodes).sum()
    areas = []
    for step in pressed.trajectory.steps:
        position, force = tip.nodes + step.displacement, step.indenter_force
        np.testing.assert_allclose(step.force, force.sum(axis=0), atol=1e-15)
        moment = np.cross(position, force).sum(axis=0)
        np.testing.assert_allclose(step.torque, moment, atol=1e-15)
        touched = np.flatnonzero(force.any(axis=1))
        assert np.isin(touched, mesh.outer_nodes).all()
        assert np.isin(np.flatnonzero(step.core_force.any(axis=1)), mesh.inner_nodes).all()
        low, high = position[touched].min(axis=0), position[touched].max(axis=0)
        assert ((low <= step.centre_of_pressure) & (step.centre_of_pressure <= high)).all()
        areas.append(step.contact_area_m2)
        assert step.convergence.residual <= 1e-6
        assert min(step.convergence.iterations, step.convergence.increments) > 0
    assert 0.0 < areas[0] < areas[-1] < whole / 4
    assert areas == sorted(areas)


def test_stress_carries_the_loads(pressed: Pressed) -> None:
    """In any state its integral is the sum of position times nodal force; so it is symmetric."""
    mesh, state = pressed.tip.geometry.mesh, pressed.run.at.state.copy()
    mu, ratio = pressed.tip.parameters.shear_modulus_pa, pressed.tip.parameters.bulk_ratio

    def cauchy() -> Floats:
        stress = pressed.tip.system.skin.stress(state.position, state.pressure)
        return np.asarray(stress.reshape(-1, 9)[:, VOIGT])

    np.testing.assert_array_equal(cauchy(), pressed.last.stress)
    random = np.random.default_rng(0)
    state.position += random.normal(0.0, 2e-5, mesh.nodes.shape)
    for part in (np.arange(len(mesh.elements)), np.arange(5)):
        some = replace(mesh, elements=mesh.elements[part])
        skin = elements(some, Rubber(mu), ratio * mu, state.position, state.pressure[part])
        wanted = state.position.T @ skin.force
        stress = cauchy()[part]
        xx, yy, zz, yz, xz, xy = (stress * skin.volume[:, None]).sum(axis=0)
        found = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        np.testing.assert_allclose(found, wanted, atol=1e-10 * np.abs(wanted).max())
        assert np.abs(wanted[0, 1] - wanted[1, 2]) > 1e-3 * np.abs(wanted).max()


def test_the_same_press_gives_the_same_bits(
    pressed: Pressed, finger: Fingertip, fill: Fill
) -> None:
    """On the same finger after other presses, and on a new one."""
    path = pressed.trajectory.path
    for tip in (finger, fill()):
        again = tip.indent(BALL, path)
        assert len(again.steps) == len(pressed.trajectory.steps)
        for step, other in zip(again.steps, pressed.trajectory.steps, strict=True):
            np.testing.assert_array_equal(step.displacement, other.displacement)
            np.testing.assert_array_equal(step.indenter_force, other.indenter_force)
            np.testing.assert_array_equal(step.core_force, other.core_force)
            np.testing.assert_array_equal(step.stress, other.stress)
            assert step.fluid_pressure_pa == other.fluid_pressure_pa


def test_a_mirrored_press_gives_the_mirror_image(exact_finger: Fingertip) -> None:
    """Exactly solved: what Newton's criterion leaves differs by the kind of processor."""
    finger, mirror = exact_finger, exact_finger.geometry.mesh.mirror
    left, right = (
        finger.indent(BALL, press_path(finger, 0.8e-3, steps=3, y_m=y)).steps
        for y in (0.4e-3, -0.4e-3)
    )
    for step, other in zip(left, right, strict=True):
        assert abs(step.force[1]) > 1e-4
        np.testing.assert_allclose(other.force, ACROSS * step.force, atol=1e-9)
        image = ACROSS * step.displacement[mirror]
        np.testing.assert_allclose(other.displacement, image, atol=1e-12)
        np.testing.assert_allclose(other.torque, -ACROSS * step.torque, atol=1e-12)


def test_a_press_in_the_plane_of_symmetry_stays_in_it(pressed: Pressed) -> None:
    for step in pressed.trajectory.steps:
        assert abs(step.force[1]) < 1e-6
        assert np.abs(step.torque[[0, 2]]).max() < 5e-9


def test_forces_scale_with_the_modulus_and_the_shape_does_not_change(
    finger: Fingertip, fill: Fill
) -> None:
    """So calibration never needs to simulate again for another modulus.

    Four times, as the roots of a Cholesky factor scale without rounding then.
    """
    path = press_path(finger, 0.8e-3, steps=2)
    hard = fill(shear_modulus_pa=4.0 * FingertipParameters().shear_modulus_pa)
    assert hard.fluid_pressure_pa == pytest.approx(4.0 * finger.fluid_pressure_pa, rel=1e-12)
    once, twice = finger.indent(BALL, path).steps, hard.indent(BALL, path).steps
    for step, other in zip(once, twice, strict=True):
        np.testing.assert_allclose(other.displacement, step.displacement, atol=1e-15)
        np.testing.assert_allclose(other.indenter_force, 4 * step.indenter_force, atol=1e-12)
        np.testing.assert_allclose(other.core_force, 4 * step.core_force, atol=1e-12)
        np.testing.assert_allclose(other.stress, 4 * step.stress, rtol=1e-9, atol=1e-6)


def held_at_rest(finger: Fingertip) -> float:
    """Fluid that the unpressurised skin holds [m^3], by the twin's volume."""
    mesh = finger.geometry.mesh
    return float(cavity(mesh.inner_faces, mesh.nodes).volume.sum()) - finger.core_volume


def test_a_fill_that_sucks_the_skin_inwards_is_refused_unsolved(
    finger: Fingertip, fill: Fill, monkeypatch: pytest.MonkeyPatch
) -> None:
    rest = held_at_rest(finger)
    assert 0.0 <= fill(fluid_volume_m3=rest + 1e-12).fluid_pressure_pa < 50.0
    # Solving would take longer than a caller may wait, only to refuse it.
    monkeypatch.setattr(NewtonSolver, "solve", None)
    for less in (0.5e-9, 3e-9):
        with pytest.raises(SimulationError, match="suck the skin inwards") as caught:
            fill(fluid_volume_m3=rest - less)
        assert f"{(rest - less) * 1e6:.3f} ml" in caught.value.problem
        named = float(caught.value.remedy.split()[4])  # fill in at least X ml
        assert named * 1e-6 == pytest.approx(rest, abs=1e-9)
        assert named * 1e-6 >= rest


def test_a_path_on_which_the_fluid_sucks_ends_there(finger: Fingertip, fill: Fill) -> None:
    """A light fill, of which more has gone than the untouched skin knows."""
    tip = fill(fluid_volume_m3=held_at_rest(finger) + 0.2e-9)
    low = float(tip.nodes[:, 2].min())
    path = np.array([[0.0, 0.0, low - 2e-6 + k * 1e-6, 1.0, 0.0, 0.0, 0.0] for k in range(3)])
    assert tip.indent(BALL, path).outcome is IndentationOutcome.COMPLETE
    tip.cavity_m3 -= 1e-9
    ended = tip.indent(BALL, path)
    assert ended.outcome is IndentationOutcome.DIVERGED
    assert ended.steps == ()
    assert ended.reason.startswith("the fluid sucks the skin inwards: -")
    assert f"{tip.fluid_volume_m3 * 1e6:.3f} ml" in ended.reason
