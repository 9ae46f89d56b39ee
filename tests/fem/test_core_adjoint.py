"""Gradients of whole indentations against central differences of whole simulations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.errors import ConfigError
from palpate.rigid import interpolate_pose, quaternions_of, rotation_matrices
from palpate_fem.config import FingertipParameters
from palpate_fem.electrodes.model import ElectrodeModel, ElectrodeResponse
from palpate_fem.indenter.approach import OuterSurface
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics import solver
from palpate_fem.mechanics.adjoint import OutputGradients, gradients, sensitivities
from palpate_fem.mechanics.contact import ContactSettings
from palpate_fem.mechanics.iteration import NewtonSettings
from palpate_fem.mechanics.load_stepping import ConvergedIncrement, SolverSettings
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.core import RigidCore
from palpate_fem.mesh.parametric import biotac
from palpate_fem.mesh.solid import FingertipGeometry, SolidMesh, thickness_direction
from palpate_fem.result import IndentationOutcome, IndentationResult
from palpate_fem.trajectory import pad_point, press_path

Floats = NDArray[np.float64]
Shell = Callable[..., SolidMesh]
Ball = Callable[..., RigidCore]
History = list[ConvergedIncrement]

WITHIN = 1e-5
"""Relative; the differences are good to about 1e-6 of the largest part of a sum."""

BALL = make_indenter("sphere_medium")
# So tight, and with as many updates of the mortar correction as it takes, that a state depends on
# nothing but its equations; on these coarse faces an update leaves up to 0.8 of its error.
TIGHT = NewtonSettings(
    tolerance=1e-10,
    volume_tolerance=1e-10,
    gap_tolerance_m=1e-12,
    traction_tolerance=1e-8,
    iterations=300,
    patience=300,
    mortar_updates=300,
)

STEPS = {
    "skin_thickness_m": 1e-7,
    "shear_modulus_pa": 30.0,
    "friction_coefficient": 1e-5,
    "fluid_volume_m3": 1e-12,
    "poses": 1e-8,
}
"""Steps of the differences."""


@dataclass(frozen=True)
class Scene:
    """What is pressed how: radius of the core [m], fluid [m^3], friction, poses, and what skin.

    Each pose is a depth of the tip beyond the untouched skin, its place beside the axis [m], and
    its turn about the axis of the finger and its own [rad].
    """

    core_m: float
    fluid_m3: float
    friction: float
    poses: tuple[tuple[float, float, float, float, float], ...]
    stiffening: float | None = None


SCENES = {
    # Some points stick and some slide.
    "press": Scene(2.5e-3, 61e-9, 0.12, (
        (-2e-6, 0.3e-3, 0.1e-3, 0.0, 0.0),
        (0.3e-3, 0.31e-3, 0.1e-3, 0.0, 0.01),
        (0.6e-3, 0.32e-3, 0.11e-3, 0.01, 0.0),
    )),
    "slide": Scene(2.5e-3, 61e-9, 0.2, (
        (-2e-6, 0.3e-3, 0.1e-3, 0.0, 0.0),
        (0.4e-3, 0.35e-3, 0.0, 0.0, 0.0),
        (0.4e-3, 0.7e-3, 0.2e-3, 0.05, 0.1),
    )),
    "pinch": Scene(2.85e-3, 30e-9, 0.186, (
        (-2e-6, 0.3e-3, 0.0, 0.0, 0.0),
        (0.6e-3, 0.4e-3, 0.05e-3, 0.0, 0.0),
        (0.85e-3, 0.5e-3, 0.1e-3, 0.0, 0.0),
    ), stiffening=0.1),
}  # fmt: skip


class Simulations:
    """Runs one scene with changed parameters."""

    def __init__(self, scene: Scene, shell: Shell, ball: Ball, *, mortar: bool) -> None:
        self.scene = scene
        mesh = shell(8, 2, 3e-3, 4.5e-3)
        held = np.flatnonzero(mesh.nodes[:, 2] > 0.2e-3).astype(np.int32)
        self.geometry = FingertipGeometry(replace(mesh, fixed=held), ball(scene.core_m))
        self.settings = SolverSettings(
            newton=TIGHT, contact=ContactSettings(mortar=mortar), solver="fronts-double"
        )
        low = self.filled().nodes[:, 2].min()
        self.path = np.array(
            [[x, y, low + depth, *turned(pitch, spin)] for depth, x, y, pitch, spin in scene.poses]
        )
        self.tip, self.history = self.run()
        self.weights = self._weights()

    def filled(self, **changes: float) -> Fingertip:
        """A finger with changes of its parameters."""
        scene, mesh = self.scene, self.geometry.mesh
        thicker = changes.pop("skin_thickness_m", 0.0) * thickness_direction(mesh)
        geometry = replace(self.geometry, mesh=replace(mesh, nodes=mesh.nodes + thicker))
        plain = {
            "fluid_volume_m3": scene.fluid_m3,
            "friction_coefficient": scene.friction,
            "shear_modulus_pa": 2.8e5,
        }
        values = {name: value + changes.get(name, 0.0) for name, value in plain.items()}
        parameters = FingertipParameters(**values, strain_stiffening=scene.stiffening)
        return Fingertip.pressurised(geometry, parameters, self.settings)

    def run(self, path: Floats | None = None, **changes: float) -> tuple[Fingertip, History]:
        """The same indentation; the last step of the slide, which turns, in two increments."""
        tip, history = self.filled(**changes), History()
        path = self.path if path is None else path
        stepping = tip.load_stepping(BALL, path, history=history)
        for step in range(1, len(path)):
            cut = self.scene is SCENES["slide"] and step == len(path) - 1
            parts = (0.4, 1.0) if cut else (1.0,)
            for share, length in zip(parts, np.diff((0.0, *parts)), strict=True):
                pose = interpolate_pose(path[step - 1], path[step], share)
                report, _ = stepping.increment(pose, float(length))
                assert report.converged, report
                history.append(
                    ConvergedIncrement(step, share, stepping.at.state, stepping.at.indenter)
                )
        return tip, history

    def outputs(self, tip: Fingertip, history: History) -> dict[str, Floats]:
        """Everything that gradients can be taken of."""
        mesh, system = self.geometry.mesh, tip.system
        ends = [record for record in history if record.step and record.share == 1.0]
        states = [record.state for record in ends]
        balances = []
        for record in ends:
            state = record.state.copy()
            system.correct_contact(state, record.indenter)
            balances.append(system.balance(state, record.indenter))
        position = np.array([state.position for state in states])
        rest = history[0].state.position
        on_indenter = np.array([-balance.indenter for balance in balances])
        return {
            "force": on_indenter.sum(axis=1),
            "fluid_pressure_pa": np.array([state.fluid_pressure for state in states]),
            "displacement": position - rest,
            "position": position,
            "rest_position": rest,
            "indenter_force": on_indenter,
            "core_force": np.array([-balance.core for balance in balances]),
            "indenter_pressure": np.array(
                [nodal(mesh, mesh.outer_faces, state.indenter_pressure) for state in states]
            ),
            "core_pressure": np.array(
                [nodal(mesh, mesh.inner_faces, state.core_pressure) for state in states]
            ),
        }

    def _weights(self) -> dict[str, Floats]:
        """Weights at random, of one sign, which make a scalar of each output."""
        random = np.random.default_rng(0)
        return {
            name: random.uniform(0.5, 1.5, value.shape)
            for name, value in self.outputs(self.tip, self.history).items()
        }

    def values(self, tip: Fingertip, history: History) -> dict[str, float]:
        """The scalars."""
        found = self.outputs(tip, history)
        return {name: float((weight * found[name]).sum()) for name, weight in self.weights.items()}

    def differences(self, parameter: str, direction: Floats) -> dict[str, float]:
        """Central differences of the scalars; of poses, along a direction (K, 6)."""
        step, ends = STEPS[parameter], []
        for sign in (1.0, -1.0):
            if parameter == "poses":
                path = moved(self.path, sign * step * direction)
                ends.append(self.values(*self.run(path)))
            else:
                ends.append(self.values(*self.run(None, **{parameter: sign * step})))
        return {name: (ends[0][name] - ends[1][name]) / (2 * step) for name in ends[0]}


def turned(pitch: float, spin: float) -> Floats:
    """Quaternion of two small turns."""
    quaternion = np.array([1.0, 0.5 * pitch, 0.0, 0.5 * spin])
    return np.asarray(quaternion / np.linalg.norm(quaternion))


def moved(path: Floats, change: Floats) -> Floats:
    """Poses after small moves and turns (K, 6); the turns of `change` are in radian."""
    new = path.copy()
    new[:, :3] += change[:, :3]
    for pose, turn in zip(new, change[:, 3:], strict=True):
        angle = np.linalg.norm(turn)
        spin = np.append(np.cos(angle / 2), np.sin(angle / 2) * turn / angle)
        rotation = rotation_matrices(spin) @ rotation_matrices(pose[3:])
        pose[3:] = quaternions_of(rotation[None])[0]
    return new


def nodal(mesh: SolidMesh, faces: NDArray[np.int32], values: Floats) -> Floats:
    """Values of the corners of faces, by node."""
    found = np.zeros(len(mesh.nodes))
    found[faces] = values
    return found


CASES = [*((name, True) for name in SCENES), ("slide", False), ("pinch", False)]


@pytest.fixture(
    scope="module",
    params=CASES,
    ids=[name + (", mortar" if mortar else ", at nodes") for name, mortar in CASES],
)
def scene(request: pytest.FixtureRequest, shell: Shell, ball: Ball) -> Simulations:
    name, mortar = request.param
    return Simulations(SCENES[name], shell, ball, mortar=mortar)


@pytest.mark.slow
def test_gradients_are_those_of_differences(scene: Simulations) -> None:
    direction = np.random.default_rng(1).normal(size=(len(scene.path), 6))
    direction[:, 3:] *= 100.0  # a turn of 1 mrad is as much as a move of some micrometres
    found = {
        name: gradients(scene.tip, scene.history, OutputGradients(**{name: weight}))
        for name, weight in scene.weights.items()
    }
    wrong = []
    for parameter in STEPS:
        if parameter == "shear_modulus_pa" and scene.scene is not SCENES["pinch"]:
            continue  # one proportionality is as good as three
        wanted = scene.differences(parameter, direction)
        for name, gradient in found.items():
            value = getattr(gradient, parameter)
            if parameter == "poses":
                value = float((value * direction).sum())
            if value != pytest.approx(wanted[name], rel=WITHIN, abs=1e-12):
                wrong.append(f"{name} by {parameter}: {value:.9g}, differences {wanted[name]:.9g}")
    assert not wrong, "\n".join(wrong)


def test_the_scenes_stick_slide_and_pinch(scene: Simulations) -> None:
    """So that the gradients above are those of every law of contact."""
    state = scene.history[-1].state
    pressed = state.indenter_pressure > 0.0
    traction = np.linalg.norm(state.traction, axis=-1)[pressed]
    slides = traction > 0.999 * scene.scene.friction * state.indenter_pressure[pressed]
    assert slides.any()
    if scene.scene is SCENES["press"]:
        assert not slides.all()
    if scene.scene is SCENES["pinch"]:
        assert (state.core_pressure > 0.0).any()


def test_forwards_and_backwards_agree(scene: Simulations) -> None:
    forward = sensitivities(scene.tip, scene.history)
    backward = gradients(
        scene.tip,
        scene.history,
        OutputGradients(
            force=scene.weights["force"], fluid_pressure_pa=scene.weights["fluid_pressure_pa"]
        ),
    )
    total = np.einsum("sip,si->p", forward.force, scene.weights["force"])
    total += scene.weights["fluid_pressure_pa"] @ forward.fluid_pressure_pa
    for name, value in zip(forward.names, total, strict=True):
        assert value == pytest.approx(getattr(backward, name), rel=1e-6), name


def test_gradients_leave_the_finger_as_it_was(finger: Fingertip) -> None:
    """Factor and tangent are those of its solver."""
    low, history = finger.nodes[:, 2].min(), History()
    path = np.array([[0.3e-3, 0.0, low + z, 1.0, 0.0, 0.0, 0.0] for z in (-2e-6, 0.2e-3, 0.4e-3)])
    first = finger.indent(BALL, path, history=history)
    gradients(finger, history, OutputGradients(force=np.ones((2, 3))))
    second = finger.indent(BALL, path)
    for step, other in zip(first.steps, second.steps, strict=True):
        np.testing.assert_array_equal(step.displacement, other.displacement)
        np.testing.assert_array_equal(step.indenter_force, other.indenter_force)


class Sensor:
    """A coarse finger, filled to its total thickness, pressed until the film closes."""

    EDGE_M = 1.4e-3

    def __init__(self) -> None:
        self.geometry = biotac(edge_m=self.EDGE_M, layers=1)
        self.electrodes = ElectrodeModel(self.geometry)
        # Here the correction is at rest to 1e-9 after 40 updates, but never to the last digit.
        self.settings = SolverSettings(newton=replace(TIGHT, mortar_updates=40))
        self.fluid_m3: float | None = None
        tip = self.filled(0.0)
        self.filled_m3 = tip.fluid_volume_m3
        surface = OuterSurface(tip.nodes, self.geometry.mesh.outer_faces)
        target, normal = pad_point(surface, -4e-3, 0.3e-3)
        self.path = press_path(BALL, target, -normal, surface, depth_m=3.4e-3, steps=2)
        self.weight = np.random.default_rng(0).normal(size=19)

    def filled(self, thicker_m: float) -> Fingertip:
        mesh = self.geometry.mesh
        nodes = mesh.nodes + thicker_m * thickness_direction(mesh)
        geometry = replace(self.geometry, mesh=replace(mesh, nodes=nodes))
        parameters = FingertipParameters(fluid_volume_m3=self.fluid_m3)
        return Fingertip.pressurised(geometry, parameters, self.settings)

    def pressed(self, thicker_m: float = 0.0) -> tuple[Fingertip, History, IndentationResult]:
        tip, history = self.filled(thicker_m), History()
        result = tip.indent(BALL, self.path, history=history)
        assert result.outcome is IndentationOutcome.COMPLETE
        return tip, history, result

    def response(self, tip: Fingertip, result: IndentationResult) -> ElectrodeResponse:
        step = result.steps[-1]
        return self.electrodes.respond(tip.nodes + step.displacement, step.core_force)

    def differences(
        self, outputs: Callable[[Fingertip, IndentationResult], list[float]], step_m: float
    ) -> Floats:
        """Central differences by the thickness."""
        more, less = (
            np.array(outputs(tip, result))
            for tip, _, result in (self.pressed(step_m), self.pressed(-step_m))
        )
        return np.asarray((more - less) / (2 * step_m))


@pytest.fixture(scope="module")
def sensor() -> Sensor:
    return Sensor()


@pytest.mark.slow
def test_at_constant_total_thickness_the_fluid_follows(
    sensor: Sensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(solver, "THICKNESS_TOLERANCE_M", 2e-12)
    monkeypatch.setattr(sensor, "fluid_m3", None)
    tip, history, result = sensor.pressed()
    forward = sensitivities(tip, history, ["skin_thickness_m", "total_thickness_m"])
    assert forward.total_thickness_m == pytest.approx([0.0, 1.0], abs=1e-9)
    force = np.zeros((len(result.steps), 3))
    force[-1, 2] = 1.0
    backward = gradients(tip, history, OutputGradients(force=force))
    assert backward.fluid_volume_m3 is None
    assert backward.total_thickness_m == pytest.approx(forward.force[-1, 2, 1], rel=WITHIN)
    wanted = sensor.differences(
        lambda tip, result: [result.forces[-1, 2], tip.fluid_volume_m3], 5e-7
    )
    found = [backward.skin_thickness_m, forward.fluid_volume_m3[0]]
    np.testing.assert_allclose(found, wanted, rtol=WITHIN)


@pytest.mark.slow
def test_counts_gaps_and_contact_pressures_of_the_film(
    sensor: Sensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the electrodes' own gradients."""
    monkeypatch.setattr(sensor, "fluid_m3", sensor.filled_m3)
    tip, history, result = sensor.pressed()
    response, count = sensor.response(tip, result), len(tip.nodes)
    assert (response.gap.pressure > 0.0).sum() > 5
    wave = np.sin(1e3 * sensor.electrodes.film.nodes[:, 0])
    by_state = [
        (response.to_skin(sensor.weight, count), response.to_core_force(sensor.weight, count)),
        (response.gap.to_skin(wave, count), np.zeros((count, 3))),
        (response.gap.to_skin(0.0 * wave, count, wave), response.gap.to_core_force(wave, count)),
    ]
    found = []
    for by_position, by_force in by_state:
        last = np.zeros((2, len(result.steps), count, 3))
        last[0, -1], last[1, -1] = by_position, by_force
        gradient = gradients(tip, history, OutputGradients(position=last[0], core_force=last[1]))
        found.append(gradient.skin_thickness_m)

    def sums(tip: Fingertip, result: IndentationResult) -> list[float]:
        response = sensor.response(tip, result)
        gap = response.gap
        products = sensor.weight @ response.counts, wave @ gap.gap, wave @ gap.pressure
        return [float(product) for product in products]

    # So short that hardly a normal of the core meets another triangle of the skin; and so long that
    # what the correction leaves in each increment does not count.
    np.testing.assert_allclose(found, sensor.differences(sums, 5e-9), rtol=WITHIN)


def test_what_does_not_fit_is_refused(scene: Simulations) -> None:
    tip, history = scene.tip, scene.history
    good = OutputGradients(force=scene.weights["force"])
    with pytest.raises(ConfigError, match=r"force have the shape \(3, 2\), not \(2, 3\)"):
        gradients(tip, history, OutputGradients(force=np.zeros((3, 2))))
    with pytest.raises(ConfigError, match="not all finite"):
        gradients(tip, history, OutputGradients(fluid_pressure_pa=np.full(2, np.nan)))
    for other in ([], history[1:]):
        with pytest.raises(ConfigError, match="not the history"):
            gradients(tip, other, good)
    with pytest.raises(ConfigError, match="no derivative by 'colour'"):
        sensitivities(tip, history, ["colour"])
    with pytest.raises(ConfigError, match="no derivative by 'total_thickness_m'"):
        sensitivities(tip, history, ["total_thickness_m"])


def test_a_block_has_no_thickness(block: Shell) -> None:
    with pytest.raises(ConfigError, match="no columns between two surfaces"):
        thickness_direction(block((2, 2, 2)))


def test_thickness_moves_the_nodes_of_the_parametric_finger() -> None:
    thin, thick = (biotac(thickness_m=t, edge_m=1.4e-3) for t in (1.4e-3, 1.6e-3))
    moved = thin.mesh.nodes + 0.2e-3 * thickness_direction(thin.mesh)
    np.testing.assert_allclose(moved, thick.mesh.nodes, atol=1e-10)
