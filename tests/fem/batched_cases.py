"""Presses of one small finger, evaluated by the CPU's classes, and the same on a device."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from palpate_fem.batched.equations import BatchedEquations
from palpate_fem.batched.launches import Listed
from palpate_fem.batched.state import BatchedState, SlotNumbers
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.contact import PosedIndenter
from palpate_fem.mechanics.iteration import NewtonSettings, Step
from palpate_fem.mechanics.load_stepping import LoadStepping
from palpate_fem.mechanics.newton import NewtonSolver
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mechanics.state import ForceBalance, SolutionState

Floats = NDArray[np.float64]

DEVICE = os.environ.get("PALPATE_TEST_DEVICE", "cpu")
"""Where the batches of these tests run: also ``cuda:0``, where there is one."""

REPEATED = 0.0 if DEVICE == "cpu" else 1e-6
"""How far forces computed twice may be apart: a GPU adds up in whatever order, and a factor in
single precision leads from there to another place within the tolerances."""

ROUNDING = 1e-12 if DEVICE == "cpu" else 1e-10

TANGENT_ROUNDING = 1e-12 if DEVICE == "cpu" else 1e-6
"""A GPU keeps what elements give to a tangent in single precision."""

SLOTS = 5
PLACES = (3, 0, 4)  # of the cases; slots 1 and 2 stay as they are
BYSTANDERS = (1, 2)
VISCOSITIES = (0.0, 0.3, 2.0)
DAMPINGS = (1.0, 0.4, 0.7)
PRESSURE_CHANGE_PA = 120.0
LARGEST_MOVE_M = 0.02e-3
UNTOUCHED = 7.0  # what bystanders hold

# Indenter, and how far it goes aside and in [m].
PRESSES = (
    ("sphere_medium", 0.0, 1.2e-3),  # down to the core; some points stick, some slide
    ("texture", 0.2e-3, 0.6e-3),  # with valleys, over which directions are held
    ("cube", 0.3e-3, 0.4e-3),
)


@dataclass
class Case:
    """A press on the CPU: two states near its end, and what the CPU's classes say of them.

    The tangent is that of ``first``; all that Newton's method does with it happens at ``second``,
    which ends at ``moved``. ``following`` are targets with offsets that follow.
    """

    run: LoadStepping
    indenter: PosedIndenter
    first: SolutionState
    second: SolutionState
    moved: SolutionState
    change: Floats
    balances: tuple[ForceBalance, ForceBalance, ForceBalance]
    changed: tuple[bool, bool]
    values: tuple[Floats, Floats]
    vectors: dict[str, Floats]
    targets: tuple[Floats, Floats, Floats, Floats]
    following: tuple[Floats, Floats, Floats, Floats]
    statuses: Floats
    corrected: SolutionState


def perturbed(state: SolutionState, seed: int, move_m: float) -> SolutionState:
    """A copy of a state, out of balance; some points that touch let go, and others begin."""
    random, other = np.random.default_rng(seed), state.copy()
    other.position += random.uniform(-move_m, move_m, state.position.shape)
    other.pressure *= random.uniform(0.9, 1.1, state.pressure.shape)
    other.fluid_pressure *= 1.0 + 0.1 * random.random()
    for pressure in (other.core_pressure, other.indenter_pressure):
        pressure *= random.uniform(0.5, 1.5, pressure.shape)
        pressure[random.random(pressure.shape) < 0.1] = 0.0
    other.traction *= random.uniform(0.5, 1.5, state.traction.shape)
    return other


def press(finger: Fingertip, number: int) -> Case:
    """Press on the CPU and evaluate."""
    name, aside, deep = PRESSES[number]
    system, free = finger.system, finger.system.pattern.free
    low = finger.nodes[:, 2].min()
    ways = ((0.0, -0.6e-3), (0.0, deep / 2), (0.0, deep), (aside, deep))
    path = np.array([[x, 0.1e-3, low + depth, 1.0, 0.05, 0.03, 0.0] for x, depth in ways])
    path[:, 3:] /= np.linalg.norm(path[:, 3:], axis=1)[:, None]
    run = finger.load_stepping(make_indenter(name), path)
    run.run()
    indenter = run.at.indenter
    first = perturbed(run.at.state, 10 + number, 0.2e-6)
    system.correct_contact(first, indenter)
    at_first = system.balance(first, indenter)
    values = system.tangent_values(viscosity=VISCOSITIES[number])
    second = perturbed(first, 20 + number, 1e-6)
    at_second = system.balance(second, indenter)
    changed = system.sets_changed
    statuses = system.outer.status.numpy().copy()
    move = np.random.default_rng(30 + number).normal(0.0, 3e-6, system.mesh.nodes.shape)
    change = move.reshape(-1)[free].copy()
    move[finger.geometry.mesh.fixed] = 0.0
    vectors = {
        "right": -(at_second.unbalanced + system.misfit_force(second)),
        "border": at_second.volume_gradient.reshape(-1)[free],
        "coupled": -system.coupled_force(),
        "product": system.unsymmetric_product(change),
    }
    offsets = system.offset_changes(change)
    vectors["offsets"] = system.offset_force(offsets)
    targets = system.updated_pressures(move)
    following = system.updated_pressures(move, offsets)
    moved = second.copy()
    at_moved = step(finger, moved, indenter, at_second, change, DAMPINGS[number])
    changed_again = system.sets_changed
    kept = system.tangent_values(elastic=False)
    corrected = moved.copy()
    system.update_anchors(corrected, indenter)
    system.correct_contact(corrected, indenter)
    return Case(
        run=run,
        indenter=indenter,
        first=first,
        second=second,
        moved=moved,
        change=change,
        balances=(at_first, at_second, at_moved),
        changed=(changed, changed_again),
        values=(values, kept),
        vectors=vectors,
        targets=targets,
        following=following,
        statuses=np.asarray(statuses, np.float64),
        corrected=corrected,
    )


def step(
    finger: Fingertip,
    state: SolutionState,
    indenter: PosedIndenter,
    balance: ForceBalance,
    change: Floats,
    damping: float,
) -> ForceBalance:
    """The step of `NewtonSolver` with a given solution of its linear system."""
    settings = NewtonSettings(largest_move_m=LARGEST_MOVE_M)
    newton = NewtonSolver(finger.system, finger.newton.factor, settings)
    with pytest.MonkeyPatch.context() as patch:
        solution = (change, PRESSURE_CHANGE_PA, None)
        patch.setattr(newton, "_linear_solution", lambda *_, **__: solution)
        return newton._step(state, indenter, balance, None, Step(damping))


class Batch:
    """The same on a device."""

    def __init__(self, finger: Fingertip, cases: list[Case], device: str) -> None:
        mesh = finger.geometry.mesh
        self.cases, self.device = cases, device
        self.indenters = [make_indenter(name) for name, _, _ in reversed(PRESSES)]
        self.equations = BatchedEquations(
            finger.system,
            self.indenters,
            slots=SLOTS,
            device=device,
            friction=finger.parameters.friction_coefficient,
        )
        self.size = len(finger.system.pattern.free)
        self.entries = len(finger.system.pattern.gather)
        self.state, self.start = (BatchedState(mesh, SLOTS, device) for _ in range(2))
        for slot in range(SLOTS):
            self.state.put(slot, finger.state)
        self.values = self.full(SLOTS, self.entries)
        self.vectors = self.full(SLOTS, 2, self.size)
        self.change = self.full(SLOTS, 2, self.size)
        self.viscosity = self.per_slot(VISCOSITIES)
        self.all = self.equations.listed(np.array(PLACES))
        number = [len(PRESSES) - 1 - k for k in range(len(PRESSES))]
        self.equations.pose(
            np.array(PLACES),
            np.array(number),
            np.array([case.indenter.tip for case in cases]),
            np.array([case.indenter.rotation for case in cases]),
        )
        found = self.change.numpy()
        for slot, case in zip(PLACES, cases, strict=True):
            found[slot, 0] = case.change
        self.change.assign(found)

    def full(self, *shape: int) -> wp.array:
        return wp.full(shape, UNTOUCHED, dtype=wp.float64, device=self.device)

    def per_slot(self, values: tuple[float, ...]) -> wp.array:
        every = np.full(SLOTS, UNTOUCHED)
        every[list(PLACES)] = values
        return wp.array(every, dtype=wp.float64, device=self.device)

    def put(self, name: str) -> None:
        for slot, case in zip(PLACES, self.cases, strict=True):
            self.state.put(slot, getattr(case, name))

    def run(self, listed: Listed, upto: str) -> list[SlotNumbers]:
        """What Newton's method does, up to a stage, for the listed slots; the last numbers."""
        equations, state = self.equations, self.state
        self.put("first")
        equations.correct_contact(state, listed)
        equations.balance(state, listed)
        if upto == "first":
            return equations.numbers(state, listed)
        equations.tangent(state, listed, self.values, elastic=listed, viscosity=self.viscosity)
        if upto == "tangent":
            return equations.numbers(state, listed)
        self.put("second")
        equations.balance(state, listed)
        if upto == "second":
            return equations.numbers(state, listed)
        equations.targets(listed, self.change, 0)
        self.start.copy_slots(state, listed.slots)
        longest = np.zeros(SLOTS)
        longest[listed.numbers] = equations.longest_move(listed, self.change, 0)
        damping = self.per_slot(DAMPINGS).numpy()
        share = np.minimum(damping, LARGEST_MOVE_M / np.maximum(longest, 1e-300))
        fraction = wp.array(share, dtype=wp.float64, device=DEVICE)
        pressures = self.per_slot((PRESSURE_CHANGE_PA,) * len(PLACES))
        equations.move(state, self.start, listed, self.change, 0, fraction, pressures)
        equations.balance(state, listed)
        return equations.numbers(state, listed)

    def nodal(self, array: wp.array, slot: int) -> Floats:
        """Values of one slot."""
        return np.asarray(array.numpy().reshape(SLOTS, -1)[slot])


def same(found: Any, expected: Any, tolerance: float = 1e-12) -> None:
    """Equal up to a share of the largest value."""
    expected = np.asarray(expected)
    size = float(np.abs(expected).max(initial=0.0))
    found = np.asarray(found).reshape(expected.shape)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=tolerance * size)
