"""Gradients of an indentation by the finger's parameters and the indenter's poses.

Two ways, with the same linearised equations (``linearised``), both exact to the tolerances of the
solution:

* `gradients`, the adjoint: from the derivatives of *one* scalar by all outputs of all steps to its
  derivatives by all parameters and poses. One linear solve for each increment, backwards.
* `sensitivities`, forwards: derivatives of the forces of all steps by the few parameters; one
  linear solve for each parameter and increment. For least squares.

An increment knows of earlier ones by its anchors only, so they carry the chain from increment to
increment, back to the pressurised, untouched state. Element pressures and tractions are condensed.

The shear modulus needs no solve: all stresses and pressures are proportional to it, at the same
shape. Poses need no derivative of their own either: moving the indenter is moving the skin the
other way, and turning the forces. The friction coefficient and the fluid's volume stand in one
equation each. The thickness, which moves all nodes, is left to central differences of the residual
at constant displacements, element pressures following their law.

The derivative holds on the branch of the solution and for the contact that it has. A node that is
just about to touch, part, stick or slide makes a kink, on which it is that of one side.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from palpate.errors import ConfigError
from palpate.rigid import interpolate_pose, quaternions_of, rotation_matrices
from palpate_fem.arrays import Floats
from palpate_fem.device import vec3s
from palpate_fem.mechanics.contact import PosedIndenter
from palpate_fem.mechanics.linearised import LinearisedIncrement
from palpate_fem.mechanics.load_stepping import ConvergedIncrement
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.mesh.solid import thickness_direction
from palpate_fem.sparse.blas import one_thread

THICKNESS_STEP_M = 2e-8
"""Step of the residual's differences by thickness [m]; they are good to 1e-8."""

TURN_STEP = 1e-6
"""Step of the differences of a pose between two by their turns [rad]."""


@dataclass(frozen=True, slots=True)
class OutputGradients:
    """Derivatives of a scalar L by the outputs of an indentation with S steps; None = zeros.

    All in the sensor frame. What one output says is not repeated by others: L depends on each
    output through its own field only.

    Attributes:
        force: By the net forces on the skin [1/N], (S, 3).
        fluid_pressure_pa: By the fluid pressures [1/Pa], (S,).
        displacement: By the nodal displacements from the pressurised, untouched state [1/m],
            (S, V, 3).
        position: By the nodal positions [1/m], (S, V, 3); `ElectrodeResponse.to_skin` gives it, and
            `Gap.to_skin` for gaps between core and skin.
        rest_position: By those of the pressurised, untouched state [1/m], (V, 3).
        indenter_force: By the indenter's nodal forces on the skin [1/N], (S, V, 3).
        core_force: By the core's [1/N], (S, V, 3); `ElectrodeResponse.to_core_force` gives it, and
            `Gap.to_core_force` for the contact pressures of the film.
        indenter_pressure: By the contact pressures of the nodes on the indenter [1/Pa], (S, V).
        core_pressure: By those on the core [1/Pa], (S, V).
    """

    force: Floats | None = None
    fluid_pressure_pa: Floats | None = None
    displacement: Floats | None = None
    position: Floats | None = None
    rest_position: Floats | None = None
    indenter_force: Floats | None = None
    core_force: Floats | None = None
    indenter_pressure: Floats | None = None
    core_pressure: Floats | None = None

    def checked(self, steps: int, nodes: int) -> dict[str, Floats]:
        """All of them by name, with zeros for None.

        Raises:
            ConfigError: An array has another shape, or values that are not finite.
        """
        shapes: dict[str, tuple[int, ...]] = {
            "force": (steps, 3),
            "fluid_pressure_pa": (steps,),
            "displacement": (steps, nodes, 3),
            "position": (steps, nodes, 3),
            "rest_position": (nodes, 3),
            "indenter_force": (steps, nodes, 3),
            "core_force": (steps, nodes, 3),
            "indenter_pressure": (steps, nodes),
            "core_pressure": (steps, nodes),
        }
        full = {}
        for name, shape in shapes.items():
            given = getattr(self, name)
            if given is None:
                full[name] = np.broadcast_to(0.0, shape)
                continue
            full[name] = np.asarray(given, np.float64)
            if full[name].shape != shape:
                raise ConfigError(
                    f"derivatives by {name} have the shape {full[name].shape}, not {shape}",
                    remedy=f"the indentation has {steps} steps, the mesh {nodes} nodes",
                )
            if not np.isfinite(full[name]).all():
                raise ConfigError(
                    f"derivatives by {name} are not all finite",
                    remedy="leave out steps without contact where they are not defined",
                )
        return full


@dataclass(frozen=True, slots=True)
class ParameterGradients:
    """Derivatives of a scalar L by what an indentation depends on.

    Either the fluid's volume or the total thickness is prescribed (`FingertipParameters`), and is
    held while the other parameters change; the derivative by the one that is not is None.

    Attributes:
        skin_thickness_m: By the thickness of the skin [1/m].
        shear_modulus_pa: By the shear modulus [1/Pa].
        friction_coefficient: By the Coulomb coefficient.
        fluid_volume_m3: By the fluid's volume [1/m^3].
        total_thickness_m: By the total thickness [1/m].
        poses: By the poses of the path, (K, 6): positions [1/m], and small turns about the tip, as
            rotation vectors in the sensor frame [1/rad]. K counts the poses that an increment of
            the history reached or went towards: fewer than the path has if it ended early.
    """

    skin_thickness_m: float
    shear_modulus_pa: float
    friction_coefficient: float
    fluid_volume_m3: float | None
    total_thickness_m: float | None
    poses: Floats


@dataclass(frozen=True, slots=True)
class ForceSensitivities:
    """Derivatives of forces and of the filling by P parameters.

    As for `ParameterGradients`, either the volume or the total thickness is held.

    Attributes:
        names: The parameters, as in `FingertipParameters`.
        force: Of the net forces on the skin [N/parameter], (S, 3, P).
        fluid_pressure_pa: Of the fluid pressures [Pa/parameter], (S, P).
        total_thickness_m: Of the total thickness, (P,).
        fluid_volume_m3: Of the fluid's volume, (P,).
    """

    names: tuple[str, ...]
    force: Floats
    fluid_pressure_pa: Floats
    total_thickness_m: Floats
    fluid_volume_m3: Floats


@dataclass(frozen=True, slots=True)
class _Derivatives:
    """Derivatives of an increment by thickness, at constant displacements and pressures.

    Attributes:
        equations: Of R_x at all nodes, (3 V,).
        volume: Of R_v [m^2].
        gaps: Of the gaps of the touching nodes, outer, then inner, (m,).
        on_indenter: Of the indenter's force, (3 V,).
        on_core: Of the core's force, (3 V,).
    """

    equations: Floats
    volume: float
    gaps: Floats
    on_indenter: Floats
    on_core: Floats


class _Indentation:
    """A recorded indentation, to be linearised increment by increment."""

    def __init__(self, tip: Fingertip, history: Sequence[ConvergedIncrement]) -> None:
        self.tip, self.history = tip, history
        mesh = tip.geometry.mesh
        self.nodes = len(mesh.nodes)
        if not history or history[0].step != 0 or len(history[0].state.position) != self.nodes:
            raise ConfigError(
                "this is not the history of an indentation of this finger",
                remedy="pass an empty list to `indent` as history, and that list here",
            )
        self.direction = thickness_direction(mesh)
        self.steps = max(record.step for record in history if record.share == 1.0)
        self._beside: tuple[EquilibriumSystem, EquilibriumSystem] | None = None

    def linearised(self, number: int) -> LinearisedIncrement:
        """Increment ``number`` of the history; 0 = the untouched state."""
        record, tip = self.history[number], self.tip
        return LinearisedIncrement(
            tip.system,
            tip.newton.factor,
            record.state,
            record.indenter if number else None,
            self.history[max(number - 1, 0)].state.anchor,
        )

    def by_thickness(self, at: LinearisedIncrement) -> _Derivatives:
        """Central differences of forces and gaps, the tractions being carried along."""
        if self._beside is None:
            mesh, step = self.tip.geometry.mesh, THICKNESS_STEP_M * self.direction
            more, less = (
                self.tip.equations(replace(mesh, nodes=mesh.nodes + way)) for way in (step, -step)
            )
            self._beside = more, less
        still = vec3s(np.zeros((self.nodes, 3)))
        ends = []
        for sign, system in zip((1.0, -1.0), self._beside, strict=True):
            state = at.state.copy()
            state.position += sign * THICKNESS_STEP_M * self.direction
            system.correct_contact(state, at.indenter)
            balance = system.balance(state, at.indenter)
            gaps = [at.outer.at_node(system.outer.gap), at.inner.at_node(system.inner.gap)]
            skin = balance.internal - state.fluid_pressure * balance.volume_gradient
            pressure = system.skin.updated_pressure(still)
            ends.append(
                (
                    skin,
                    -balance.indenter,
                    -balance.core,
                    balance.volume,
                    np.concatenate(gaps),
                    pressure,
                )
            )
        skin, outer, inner, volume, gap, pressure = (
            (np.asarray(more) - np.asarray(less)).reshape(-1) / (2 * THICKNESS_STEP_M)
            for more, less in zip(*ends, strict=True)
        )
        # Element pressures follow their law: add their change as a misfit of that law.
        follow = np.zeros((self.nodes, 3))
        law = at.system.skin.updated_pressure(still)
        at.system.skin.add_misfit(law - pressure, vec3s(follow))
        skin += follow.reshape(-1)
        # With constant anchors the tractions follow the nodes.
        outer += (at.outer_by_position - at.outer.by_position) @ self.direction.reshape(-1)
        return _Derivatives(skin - outer - inner, float(volume[0]), gap, outer, inner)

    @property
    def extent(self) -> Floats:
        """Derivative of the total thickness by the positions of the untouched state, (3 V,)."""
        z = self.history[0].state.position[:, 2]
        gradient = np.zeros((self.nodes, 3))
        gradient[z.argmax(), 2] += 1.0
        gradient[z.argmin(), 2] -= 1.0
        return gradient.reshape(-1)

    def steps_ends(self) -> Iterator[tuple[int, int]]:
        """Number of each record that ends a step, and the number of the step, from 0."""
        for number, record in enumerate(self.history):
            if record.step and record.share == 1.0:
                yield number, record.step - 1


@one_thread()
def gradients(
    tip: Fingertip, history: Sequence[ConvergedIncrement], outputs: OutputGradients
) -> ParameterGradients:
    """From derivatives of a scalar by outputs to its derivatives by parameters and poses.

    Costs about as much as the indentation, however many outputs and parameters there are. The
    tighter the tolerances of the solution, and the more updates of the mortar correction
    (`NewtonSettings`), the closer it is to the solution's own differences.

    Args:
        tip: The finger that was indented.
        history: What `Fingertip.indent` recorded.
        outputs: Derivatives of the scalar by the outputs of the steps that were reached.

    Returns:
        The scalar's derivatives.

    Raises:
        ConfigError: The history is not one of this finger, or the outputs do not fit to it.
        SimulationError: A tangent is singular.
    """
    indentation = _Indentation(tip, history)
    count = indentation.nodes
    sweep = _Backwards(indentation, outputs.checked(indentation.steps, count))
    tip.newton.forget()
    try:
        for number in range(len(history) - 1, 0, -1):
            sweep.increment(number)
        return sweep.at_rest()
    finally:
        tip.newton.forget()


class _Backwards:
    """The adjoint, from the last increment to the first."""

    def __init__(self, indentation: _Indentation, outputs: dict[str, Floats]) -> None:
        self.indentation, self.outputs = indentation, outputs
        history, self._size = indentation.history, 3 * indentation.nodes
        self._step_of = dict(indentation.steps_ends())
        self.poses = np.zeros((max(record.step for record in history) + 1, 6))
        self.by_pose: list[Floats] = [np.zeros(6) for _ in history]
        self.thickness = self.friction = self.volume = self.modulus = 0.0
        self.anchor = np.zeros(self._size)  # by the anchors, in the sensor frame
        self.rest = outputs["rest_position"].reshape(-1).copy()

    def increment(self, number: int) -> None:
        """Pass one increment: from the cotangents of what it gives to those of what it gets."""
        step = self._step_of.get(number)
        position, fluid, on_indenter, on_core, pressures = self._outputs_of(step)
        gets = (position, on_indenter, on_core, *pressures, self.anchor)
        if fluid == 0.0 and not any(np.any(array) for array in gets):
            return
        at = self.indentation.linearised(number)
        free, system = at.system.pattern.free, at.system
        stiff = system.contact.tangential_stiffness
        rub = at.traction_by_position, at.traction_by_pressure, at.traction_by_anchor
        # An anchor is where the node is, less what its traction stretches its spring by.
        stretch = self.anchor / stiff
        outer_pressure = pressures[0][at.outer.nodes] + (
            at.outer_by_pressure.T @ on_indenter - rub[1].T @ stretch
        )
        inner_pressure = pressures[1][at.inner.nodes] + at.inner.by_pressure.T @ on_core
        moved = position + self.anchor - rub[0].T @ stretch
        moved += at.outer_by_position.T @ on_indenter + at.inner.by_position.T @ on_core
        multiplier = at.solve_transposed(
            np.concatenate([moved[free], [fluid], outer_pressure, inner_pressure])
        )
        touching = len(at.outer.nodes)
        nodal = np.zeros(self._size)
        nodal[free] = multiplier[: len(free)]
        by_volume, by_gap = multiplier[len(free)], multiplier[len(free) + 1 :]
        to_outer, to_inner = on_indenter + nodal, on_core + nodal

        self.volume += by_volume
        self.friction += float(at.outer_by_friction @ to_outer - at.traction_by_friction @ stretch)
        self._add_modulus(at, fluid, on_indenter, on_core, pressures)
        way = self.indentation.direction.reshape(-1)
        by = self.indentation.by_thickness(at)
        skin = by.equations + by.on_indenter + by.on_core
        self.thickness += float(
            (position + self.anchor - rub[0].T @ stretch) @ way
            + to_outer @ by.on_indenter
            + to_inner @ by.on_core
            - nodal @ skin
            - by_volume * by.volume
            - by_gap @ by.gaps
        )
        # The indenter that moves is the skin that moves the other way; its forces turn along.
        outer_gap = at.outer.gaps.T @ by_gap[:touching]
        against = outer_gap - self.anchor + rub[0].T @ stretch
        against -= at.outer_by_position.T @ to_outer
        self._add_pose(number, against, at.state.position)
        self.by_pose[number][3:] += np.cross(at.on_indenter, to_outer.reshape(-1, 3)).sum(axis=0)
        before = at.outer_by_anchor.T @ to_outer - rub[2].T @ stretch
        # From the indenter's frame at this pose to the sensor frame at the pose before.
        turn = self.indentation.history[number - 1].indenter.rotation
        self.anchor = (before.reshape(-1, 3) @ turn.T).reshape(-1)

    def _outputs_of(
        self, step: int | None
    ) -> tuple[Floats, float, Floats, Floats, tuple[Floats, Floats]]:
        """Cotangents of positions, fluid pressure, nodal forces and contact pressures of a step."""
        outputs, size = self.outputs, self._size
        if step is None:
            zero, none = np.zeros(size), np.zeros(size // 3)
            return zero, 0.0, zero, zero, (none, none)
        displacement = outputs["displacement"][step].reshape(-1)
        self.rest -= displacement
        return (
            outputs["position"][step].reshape(-1) + displacement,
            float(outputs["fluid_pressure_pa"][step]),
            (outputs["indenter_force"][step] + outputs["force"][step]).reshape(-1),
            outputs["core_force"][step].reshape(-1),
            (outputs["indenter_pressure"][step], outputs["core_pressure"][step]),
        )

    def _add_modulus(
        self,
        at: LinearisedIncrement,
        fluid: float,
        on_indenter: Floats,
        on_core: Floats,
        pressures: tuple[Floats, Floats],
    ) -> None:
        """All forces and pressures are proportional to the modulus, at the same shape."""
        total = fluid * at.state.fluid_pressure
        total += float(on_indenter @ at.on_indenter.reshape(-1))
        total += float(on_core @ at.on_core.reshape(-1))
        for surface, wanted in zip((at.outer, at.inner), pressures, strict=True):
            total += float(wanted[surface.nodes] @ surface.pressure)
        self.modulus += total / at.system.skin.mu

    def _add_pose(self, number: int, against: Floats, position: Floats) -> None:
        """Add a pull on the nodes, (3 V,), as one on the pose of an increment's indenter."""
        indenter = self.indentation.history[number].indenter
        pull = against.reshape(-1, 3)
        self.by_pose[number][:3] += pull.sum(axis=0)
        self.by_pose[number][3:] += np.cross(position - indenter.tip, pull).sum(axis=0)

    def at_rest(self) -> ParameterGradients:
        """Pass the pressurised, untouched state, and sum up."""
        indentation = self.indentation
        history, tip = indentation.history, indentation.tip
        start = history[0].state.position
        # The first anchors are where the nodes are.
        self._add_pose(0, -self.anchor, start)
        position = self.rest + self.anchor
        by_fill = tip.parameters.fluid_volume_m3 is None
        volume: float | None = self.volume
        total: float | None = None
        if by_fill or np.any(position):
            at = indentation.linearised(0)
            by = indentation.by_thickness(at)
            thickness, more = self._through_rest(at, by, position)
            self.thickness += thickness
            volume = total_volume = self.volume + more
            if by_fill:
                # The volume follows from the total thickness.
                by_skin, by_volume = self._through_rest(at, by, indentation.extent)
                self.thickness -= total_volume * by_skin / by_volume
                volume, total = None, total_volume / by_volume
        return ParameterGradients(
            self.thickness,
            self.modulus,
            self.friction,
            volume,
            total,
            self._path_gradient(),
        )

    def _through_rest(
        self, at: LinearisedIncrement, by: _Derivatives, position: Floats
    ) -> tuple[float, float]:
        """Derivatives by thickness and volume from those by positions of the untouched state."""
        free, way = at.system.pattern.free, self.indentation.direction.reshape(-1)
        none = np.zeros(1 + len(by.gaps))
        multiplier = at.solve_transposed(np.concatenate([position[free], none]))
        nodal, by_gap = multiplier[: len(free)], multiplier[len(free) + 1 :]
        by_volume = float(multiplier[len(free)])
        by_thickness = position @ way - nodal @ by.equations[free]
        return float(by_thickness - by_volume * by.volume - by_gap @ by.gaps), by_volume

    def _path_gradient(self) -> Floats:
        """Derivatives by the path's poses, from those by the poses of all increments."""
        history = self.indentation.history
        ends = {record.step: record.indenter for record in history if record.share == 1.0}
        total = np.zeros_like(self.poses)
        for record, gradient in zip(history, self.by_pose, strict=True):
            if record.share == 1.0:
                total[record.step] += gradient
                continue
            end = ends.get(record.step)
            if end is None or not gradient.any():
                continue  # the step was not reached: nothing depends on it
            first, second = (_pose(body) for body in (ends[record.step - 1], end))
            for at, place in ((record.step - 1, 0), (record.step, 1)):
                share = record.share if place else 1.0 - record.share
                total[at, :3] += share * gradient[:3]
                turns = _turn_between(first, second, record.share, place)
                total[at, 3:] += turns.T @ gradient[3:]
        return total


@one_thread()
def sensitivities(
    tip: Fingertip, history: Sequence[ConvergedIncrement], names: Sequence[str] | None = None
) -> ForceSensitivities:
    """Derivatives of all forces by some parameters: for least squares, which want all of them.

    Args:
        tip: The finger that was indented.
        history: What `Fingertip.indent` recorded.
        names: Parameters, named as in `FingertipParameters`; None = all that were prescribed. Each
            but the shear modulus takes one linear solve for each increment.

    Raises:
        ConfigError: The history is not one of this finger, or a parameter is not prescribed.
        SimulationError: A tangent is singular.
    """
    indentation = _Indentation(tip, history)
    fill = "fluid_volume_m3" if tip.parameters.fluid_volume_m3 is not None else "total_thickness_m"
    known = ("skin_thickness_m", "shear_modulus_pa", "friction_coefficient", fill)
    wanted = known if names is None else tuple(names)
    for name in wanted:
        if name not in known:
            raise ConfigError(
                f"no derivative by {name!r}", remedy=f"this finger has {', '.join(known)}"
            )
    tip.newton.forget()
    try:
        return _forwards(indentation, wanted)
    finally:
        tip.newton.forget()


def _forwards(indentation: _Indentation, names: tuple[str, ...]) -> ForceSensitivities:
    """Tangents from the untouched state to the last increment."""
    history, tip, count = indentation.history, indentation.tip, len(names)
    size, way = 3 * indentation.nodes, indentation.direction.reshape(-1)
    column = {name: i for i, name in enumerate(names)}
    by_skin, by_friction, by_volume = np.zeros(count), np.zeros(count), np.zeros(count)
    by_skin[[i for name, i in column.items() if name == "skin_thickness_m"]] = 1.0
    by_friction[[i for name, i in column.items() if name == "friction_coefficient"]] = 1.0

    at = indentation.linearised(0)
    by, free = indentation.by_thickness(at), tip.system.pattern.free
    none = np.zeros(len(free))
    moved, extent = np.zeros((size, 2)), indentation.extent
    moved[free, 0] = -at.solve(np.concatenate([by.equations[free], [by.volume], by.gaps]))[
        : len(free)
    ]
    moved[free, 1] = at.solve(np.concatenate([none, [1.0], 0.0 * by.gaps]))[: len(free)]
    moved[:, 0] += way
    rise = extent @ moved
    if tip.parameters.fluid_volume_m3 is None:
        by_volume = -by_skin * rise[0] / rise[1]
        by_volume[[i for name, i in column.items() if name == "total_thickness_m"]] = 1.0 / rise[1]
    else:
        by_volume[[i for name, i in column.items() if name == "fluid_volume_m3"]] = 1.0
    seeds = np.stack([by_skin, by_volume])
    anchor = moved @ seeds  # moves of the anchors in the sensor frame, (3 V, P)
    total_thickness = rise @ seeds

    step_of = dict(indentation.steps_ends())
    force = np.zeros((indentation.steps, 3, count))
    fluid = np.zeros((indentation.steps, count))
    for number in range(1, len(history)):
        if number > max(step_of, default=0):
            break
        at = indentation.linearised(number)
        before = history[number - 1].indenter.rotation
        local = np.einsum("vip,ij->vjp", anchor.reshape(-1, 3, count), before).reshape(size, count)
        loaded = at.outer_by_anchor @ local + np.outer(at.outer_by_friction, by_friction)
        right = np.zeros((len(free) + 1 + len(at.outer.nodes) + len(at.inner.nodes), count))
        right[: len(free)] = loaded[free]
        right[len(free)] = by_volume
        if by_skin.any():
            by = indentation.by_thickness(at)
            right -= np.outer(np.concatenate([by.equations[free], [by.volume], by.gaps]), by_skin)
            loaded += np.outer(by.on_indenter, by_skin)
        solved = np.stack(
            [at.solve(side) if side.any() else 0.0 * side for side in right.T], axis=1
        )
        change = np.zeros((size, count))
        change[free] = solved[: len(free)]
        pressure = solved[len(free) + 1 :][: len(at.outer.nodes)]
        loaded += at.outer_by_position @ change + at.outer_by_pressure @ pressure
        change += np.outer(way, by_skin)
        rub = (
            at.traction_by_position @ change
            + at.traction_by_pressure @ pressure
            + at.traction_by_anchor @ local
            + np.outer(at.traction_by_friction, by_friction)
        )
        anchor = change - rub / at.system.contact.tangential_stiffness
        if number in step_of:
            step = step_of[number]
            force[step] = loaded.reshape(-1, 3, count).sum(axis=0)
            fluid[step] = solved[len(free)]
            if "shear_modulus_pa" in column:
                place = column["shear_modulus_pa"]
                force[step, :, place] = at.on_indenter.sum(axis=0) / at.system.skin.mu
                fluid[step, place] = at.state.fluid_pressure / at.system.skin.mu
    return ForceSensitivities(names, force, fluid, total_thickness, by_volume)


def _pose(indenter: PosedIndenter) -> Floats:
    return np.concatenate([indenter.tip, quaternions_of(indenter.rotation[None])[0]])


def _turn_between(first: Floats, second: Floats, share: float, place: int) -> Floats:
    """Derivative (3, 3) of the turn of the pose between two by a turn of one of them."""
    turned = []
    for axis in range(3):
        ends = []
        for sign in (1.0, -1.0):
            poses = [first.copy(), second.copy()]
            spin = np.zeros(4)
            spin[0], spin[1 + axis] = np.cos(TURN_STEP / 2), sign * np.sin(TURN_STEP / 2)
            rotation = rotation_matrices(spin) @ rotation_matrices(poses[place][3:])
            poses[place][3:] = quaternions_of(rotation[None])[0]
            ends.append(rotation_matrices(interpolate_pose(poses[0], poses[1], share)[3:]))
        turn = (ends[0] - ends[1]) @ (0.5 * (ends[0] + ends[1])).T / (2 * TURN_STEP)
        turned.append([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return 0.5 * np.transpose(turned)
