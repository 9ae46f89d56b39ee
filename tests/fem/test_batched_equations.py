"""Many copies of one fingertip on a device give what the CPU's classes give for each state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray
from tests.fem.batched_cases import (
    BYSTANDERS,
    DEVICE,
    PLACES,
    PRESSES,
    PRESSURE_CHANGE_PA,
    ROUNDING,
    SLOTS,
    TANGENT_ROUNDING,
    Batch,
    Case,
    perturbed,
    press,
    same,
)

from palpate_fem.batched.equations import BatchedEquations
from palpate_fem.batched.state import FIELDS, BatchedState
from palpate_fem.batched.steps import BatchedSteps
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.contact import ContactSettings, PosedIndenter
from palpate_fem.mechanics.iteration import largest_error
from palpate_fem.mechanics.load_stepping import indentation_step
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.result import Convergence

Floats = NDArray[np.float64]
Fill = Callable[..., Fingertip]

RATIOS = (0.7, 0.0, 2.5)  # of extrapolation
SCRATCH = ("_longest", "_fraction")  # of all slots, whichever are listed


@pytest.fixture(scope="module")
def finger(fill: Fill) -> Fingertip:
    """For this module alone: its system keeps what belongs to the last tangent."""
    return fill(strain_stiffening=0.1)


@pytest.fixture(scope="module")
def cases(finger: Fingertip) -> list[Case]:
    return [press(finger, number) for number in range(len(PRESSES))]


@pytest.fixture(scope="module")
def batch(finger: Fingertip, cases: list[Case]) -> Batch:
    return Batch(finger, cases, DEVICE)


def test_the_cases_have_all_kinds_of_contact(cases: list[Case], finger: Fingertip) -> None:
    for case in cases:
        assert set(case.statuses.ravel()) >= {0.0, 3.0}
        assert case.first.on_indenter.spread.nnz > 0
        assert np.abs(case.vectors["coupled"]).max() > 0.0
        assert np.abs(case.vectors["product"]).max() > 0.0
    assert 2.0 in cases[0].statuses
    assert (cases[0].first.core_pressure > 0.0).any()
    assert cases[1].first.on_indenter.held.any()
    assert not cases[2].first.on_indenter.held.any()
    assert all(case.changed[0] for case in cases)
    opened = [(case.second.indenter_pressure > case.moved.indenter_pressure) for case in cases]
    assert any((more & (case.moved.indenter_pressure == 0.0)).any()
               for more, case in zip(opened, cases, strict=True))  # fmt: skip
    assert finger.settings.contact.mortar


def test_states_come_back_as_they_were_put(batch: Batch) -> None:
    batch.put("second")
    for slot, case in zip(PLACES, batch.cases, strict=True):
        found = batch.state.get(slot)
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(found, name), getattr(case.second, name))


def test_steps(batch: Batch, finger: Fingertip) -> None:
    """Made of the states of two slots; a touching corner, forces and stresses are all there."""
    some = batch.equations.listed(np.array(PLACES[1:]))
    batch.run(batch.all, "second")
    steps = BatchedSteps(batch.equations, finger.nodes)
    poses = [np.arange(7.0) + k for k in range(2)]
    blank = Convergence(3, 9, 4, 1e-7, 1e-8, np.nan, 0.5)
    made = steps.make(batch.state, some, poses, [900.0, 800.0], [blank, blank])
    for found, case, pose, fluid in zip(made, batch.cases[1:], poses, (900.0, 800.0), strict=True):
        state, balance = replace(case.second, fluid_pressure=fluid), case.balances[1]
        wanted = indentation_step(
            finger.system, finger.state, state, pose, -balance.indenter, -balance.core, blank
        )
        for one in fields(found):
            if one.name != "convergence":
                same(getattr(found, one.name), getattr(wanted, one.name))
        assert found.contact_area_m2 > 0.0
        deepest = max(state.indenter_pressure.max(), state.core_pressure.max())
        stiffness = finger.system.contact.stiffness
        assert found.convergence.penetration_m == pytest.approx(deepest / stiffness, rel=1e-12)
        assert replace(found.convergence, penetration_m=0.0) == replace(blank, penetration_m=0.0)


def test_a_step_without_contact_has_no_centre(batch: Batch, finger: Fingertip) -> None:
    away = finger.state.copy()
    batch.state.put(PLACES[0], away)
    only = batch.equations.listed(np.array(PLACES[:1]))
    batch.equations.pose(
        only.numbers, np.array([0]), np.array([[0.0, 0.0, -0.05]]), np.eye(3)[None]
    )
    batch.equations.correct_contact(batch.state, only)
    batch.equations.balance(batch.state, only)
    steps = BatchedSteps(batch.equations, finger.nodes)
    blank = Convergence(1, 1, 1, 0.0, 0.0, 0.0, 0.0)
    (found,) = steps.make(batch.state, only, [np.zeros(7)], [1.0], [blank])
    case = batch.cases[0]
    batch.equations.pose(
        only.numbers,
        np.array([len(PRESSES) - 1]),
        case.indenter.tip[None],
        case.indenter.rotation[None],
    )
    assert np.isnan(found.centre_of_pressure).all()
    assert found.contact_area_m2 == 0.0
    assert not found.force.any()
    assert not found.displacement.any()


@pytest.mark.parametrize("stage", ["first", "second", "moved"])
def test_forces_and_errors(batch: Batch, stage: str) -> None:
    numbers = batch.run(batch.all, stage)
    which = ("first", "second", "moved").index(stage)
    equations = batch.equations
    for slot, case, found in zip(PLACES, batch.cases, numbers, strict=True):
        balance, state = case.balances[which], getattr(case, stage)
        same(batch.nodal(equations.outer.force, slot), balance.indenter)
        same(batch.nodal(equations.inner.force, slot), balance.core)
        same(batch.nodal(equations._internal, slot), balance.internal)
        same(batch.nodal(equations._gradient_of_volume, slot), balance.volume_gradient)
        # The largest forces of contact cancel those of the skin, so it is a share of these.
        unbalanced = batch.nodal(equations._unbalanced, slot)[equations.system.pattern.free]
        largest = np.abs(balance.internal).max() + np.abs(balance.indenter).max()
        assert np.abs(unbalanced - balance.unbalanced).max() < 1e-12 * largest
        assert found.residual == pytest.approx(balance.residual, rel=1e-11)
        for name in ("volume", "strain_error", "gap_error_m", "traction_error"):
            assert getattr(found, name) == pytest.approx(getattr(balance, name), rel=1e-11)
        assert found.smallest_jacobian == pytest.approx(balance.smallest_jacobian, rel=1e-12)
        assert found.fluid_pressure == pytest.approx(state.fluid_pressure, rel=1e-15)
        same(found.net_force, -balance.indenter.sum(axis=0), 1e-11)
        if which:
            assert found.sets_changed == case.changed[which - 1]


def test_no_number_has_changed_where_the_tangent_is_that_of_the_state(batch: Batch) -> None:
    batch.run(batch.all, "tangent")
    batch.equations.balance(batch.state, batch.all)
    assert not any(one.sets_changed for one in batch.equations.numbers(batch.state, batch.all))


def test_what_has_not_moved_keeps_the_forces_of_its_skin(batch: Batch) -> None:
    batch.run(batch.all, "moved")
    equations, state, first = batch.equations, batch.state, PLACES[0]
    state.put(first, batch.cases[0].second)
    equations.correct_contact(state, batch.all)
    equations.balance(state, batch.all, moved=equations.listed(np.array([first])))
    numbers, forces = equations._numbers.numpy(), equations._unbalanced.numpy()
    equations.balance(state, batch.all)
    same(equations._numbers.numpy(), numbers)
    same(equations._unbalanced.numpy(), forces)

    kept = equations._internal.numpy()
    state.put(first, batch.cases[0].first)
    equations.balance(state, batch.all, moved=equations.listed(np.zeros(0, int)))
    np.testing.assert_array_equal(kept, equations._internal.numpy())


def test_mortar_corrections(batch: Batch) -> None:
    batch.run(batch.all, "first")
    equations = batch.equations
    for slot, case in zip(PLACES, batch.cases, strict=True):
        outer, inner = case.first.on_indenter, case.first.on_core
        # A gap less its mean: both are as large as the margin.
        for surface, expected in ((equations.outer, outer.gap), (equations.inner, inner.gap)):
            found = batch.nodal(surface.offset, slot).reshape(expected.shape)
            np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-15)
        same(batch.nodal(equations.outer.held, slot), outer.held)


def test_tangents(batch: Batch) -> None:
    batch.run(batch.all, "tangent")
    for slot, case in zip(PLACES, batch.cases, strict=True):
        values_agree(batch, slot, case.values[0])


def test_a_tangent_of_contact_only_keeps_that_of_the_skin(batch: Batch) -> None:
    batch.run(batch.all, "moved")
    none = batch.per_slot((0.0, 0.0, 0.0))
    batch.equations.tangent(batch.state, batch.all, batch.values, elastic=None, viscosity=none)
    for slot, case in zip(PLACES, batch.cases, strict=True):
        values_agree(batch, slot, case.values[1])


def test_skin_is_evaluated_anew_where_it_is_asked_for(batch: Batch) -> None:
    batch.run(batch.all, "moved")
    none = batch.per_slot((0.0, 0.0, 0.0))
    anew = batch.equations.listed(np.array(PLACES[1:2]))
    batch.equations.tangent(batch.state, batch.all, batch.values, elastic=anew, viscosity=none)
    values_agree(batch, PLACES[0], batch.cases[0].values[1])
    values_agree(batch, PLACES[2], batch.cases[2].values[1])
    case, system = batch.cases[1], batch.equations.system
    system.balance(case.moved, case.indenter)
    values_agree(batch, PLACES[1], system.tangent_values())


def values_agree(batch: Batch, slot: int, expected: Floats) -> None:
    """Entry by entry, relative to the diagonal: contact is so much stiffer than skin."""
    pattern = batch.equations.system.pattern
    rows = np.repeat(np.arange(batch.size), np.diff(pattern.indptr))
    diagonal = np.abs(expected[pattern.indptr[:-1]])
    size = np.sqrt(diagonal[rows] * diagonal[pattern.indices])
    apart = np.abs(batch.values.numpy()[slot] - expected)
    assert (apart / np.maximum(size, 1e-3 * np.median(diagonal))).max() < TANGENT_ROUNDING


def test_vectors_of_the_linear_system(batch: Batch) -> None:
    batch.run(batch.all, "second")
    equations, state, listed = batch.equations, batch.state, batch.all
    found = {}
    equations.right_hand_side(state, listed, batch.vectors, 0)
    equations.volume_gradient(listed, batch.vectors, 1)
    found["right"], found["border"] = batch.vectors.numpy().copy().swapaxes(0, 1)
    equations.coupled(state, listed, batch.vectors, 1)
    found["coupled"] = batch.vectors.numpy()[:, 1].copy()
    equations.subtract_unsymmetric_product(state, listed, batch.change, 0, batch.vectors, 1)
    found["product"] = found["coupled"] - batch.vectors.numpy()[:, 1]
    np.testing.assert_array_equal(batch.vectors.numpy()[:, 0], found["right"])
    for slot, case in zip(PLACES, batch.cases, strict=True):
        for name in ("right", "border", "coupled"):
            same(found[name][slot], case.vectors[name], 1e-11)
        largest = max(np.abs(case.vectors[name]).max() for name in ("coupled", "product"))
        apart = np.abs(found["product"][slot] - case.vectors["product"])
        assert apart.max() < ROUNDING * largest


def test_targets_of_the_condensed_unknowns(batch: Batch) -> None:
    batch.run(batch.all, "second")
    equations = batch.equations
    equations.targets(batch.all, batch.change, 0)
    for slot, case in zip(PLACES, batch.cases, strict=True):
        arrays = (
            equations._target,
            equations.inner.target,
            equations.outer.target,
            equations.outer.target_traction,
        )
        for array, expected in zip(arrays, case.targets, strict=True):
            same(batch.nodal(array, slot), expected)


def test_offsets_that_follow(batch: Batch) -> None:
    """In two of three slots; the targets of the third are those of offsets that are kept."""
    batch.run(batch.all, "second")
    equations, following = batch.equations, batch.equations.listed(np.array(PLACES[1:]))
    equations.volume_gradient(batch.all, batch.vectors, 1)
    before = batch.vectors.numpy()[:, 1].copy()
    equations.subtract_offset_force(following, batch.change, 0, batch.vectors, 1)
    found = before - batch.vectors.numpy()[:, 1]
    for surface in (equations.outer, equations.inner):  # of nodes of other surfaces, too: none
        assert np.abs(surface.offset_change.numpy()).max() < 1e-3
    equations.targets(batch.all, batch.change, 0, following=following)
    # The offsets of a flat face, the cube's, do not change.
    largest = [np.abs(case.vectors["offsets"]).max() for case in batch.cases]
    assert min(largest[:2]) > 1e-3
    for number, (slot, case) in enumerate(zip(PLACES, batch.cases, strict=True)):
        expected = case.vectors["offsets"] if number else np.zeros_like(found[slot])
        assert np.abs(found[slot] - expected).max() <= ROUNDING * max(largest)
        targets = case.following if number else case.targets
        arrays = (
            equations._target,
            equations.inner.target,
            equations.outer.target,
            equations.outer.target_traction,
        )
        for array, wanted in zip(arrays, targets, strict=True):
            same(batch.nodal(array, slot), wanted, 1e-11)
    assert np.abs(batch.cases[1].following[2] - batch.cases[1].targets[2]).max() > 1.0


def test_longest_moves(batch: Batch) -> None:
    longest = batch.equations.longest_move(batch.all, batch.change, 0)
    for found, case in zip(longest, batch.cases, strict=True):
        move = np.zeros(batch.equations.system.mesh.nodes.shape)
        move.reshape(-1)[batch.equations.system.pattern.free] = case.change
        assert found == pytest.approx(np.linalg.norm(move, axis=1).max(), rel=1e-14)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_move_that_is_no_number_is_infinite_and_is_that_slots_alone(
    batch: Batch, value: float
) -> None:
    broken = batch.change.numpy().copy()
    broken[PLACES[1], 0, 5] = value
    change = wp.array(broken, dtype=wp.float64, device=batch.device)
    longest = batch.equations.longest_move(batch.all, change, 0)
    np.testing.assert_array_equal(np.isfinite(longest), [True, False, True])


def test_steps_of_newtons_method(batch: Batch) -> None:
    batch.run(batch.all, "moved")
    for slot, case in zip(PLACES, batch.cases, strict=True):
        found = batch.state.get(slot)
        for name in FIELDS:
            same(getattr(found, name), getattr(case.moved, name))
        touches = case.moved.indenter_pressure > 0.0
        np.testing.assert_array_equal(found.indenter_pressure > 0.0, touches)


def test_anchors_and_corrections_after_an_increment(batch: Batch) -> None:
    batch.put("moved")
    batch.equations.update_anchors(batch.state, batch.all)
    batch.equations.correct_contact(batch.state, batch.all)
    for slot, case in zip(PLACES, batch.cases, strict=True):
        same(batch.state.get(slot).anchor, case.corrected.anchor)
        found = batch.nodal(batch.equations.outer.offset, slot)
        expected = case.corrected.on_indenter.gap
        np.testing.assert_allclose(found, expected.ravel(), rtol=0.0, atol=1e-15)
        same(batch.nodal(batch.equations.outer.held, slot), case.corrected.on_indenter.held)


def test_extrapolation_of_the_last_increment(
    batch: Batch, finger: Fingertip, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, before, trial = (BatchedState(finger.geometry.mesh, SLOTS, batch.device) for _ in range(3))
    for slot, case in zip(PLACES, batch.cases, strict=True):
        assert case.run.at.previous is not None
        # Contact goes back at some points, to below zero if it went on.
        less = perturbed(case.run.at.state, 40 + slot, 0.0)
        less.indenter_pressure[::2] *= 0.1
        monkeypatch.setattr(case.run.at, "state", less)
        now.put(slot, less)
        before.put(slot, case.run.at.previous)
    trial.extrapolate(now, before, batch.per_slot(RATIOS), batch.all.slots)
    for slot, case, ratio in zip(PLACES, batch.cases, RATIOS, strict=True):
        expected = case.run._predicted(ratio * case.run.at.previous_length)
        opened = (case.run.at.state.indenter_pressure > 0.0) & (expected.indenter_pressure == 0.0)
        assert opened.any() == (ratio > 0.0)
        found = trial.get(slot)
        for name in FIELDS:
            same(getattr(found, name), getattr(expected, name))
    for slot in BYSTANDERS:
        assert not trial.get(slot).position.any()


def arrays_of(batch: Batch) -> dict[str, wp.array]:
    """All arrays that hold something of each slot."""
    equations, found = batch.equations, {}
    owners = {"": equations, "outer.": equations.outer, "inner.": equations.inner,
              "tangents.": equations.tangents, "state.": batch.state, "start.": batch.start,
              "batch.": batch}  # fmt: skip
    for prefix, owner in owners.items():
        for name, value in vars(owner).items():
            for k, array in enumerate(value if isinstance(value, list) else [value]):
                if isinstance(array, wp.array) and name not in SCRATCH:
                    found[f"{prefix}{name}{k}"] = array
    return found


def test_slots_that_are_not_listed_stay_as_they_are(batch: Batch) -> None:
    equations, state = batch.equations, batch.state
    batch.run(batch.all, "moved")
    batch.put("first")  # later puts are of the same states, in all slots but the one
    arrays = arrays_of(batch)
    before = {name: array.numpy().copy() for name, array in arrays.items()}
    slot = PLACES[1]
    some = equations.listed(np.array([slot]))
    case = batch.cases[1]
    state.put(slot, case.second)
    for _ in range(2):
        equations.pose(
            np.array([slot]), np.array([2]), case.indenter.tip[None], case.indenter.rotation[None]
        )
        equations.correct_contact(state, some)
        equations.balance(state, some)
        equations.tangent(state, some, batch.values, elastic=some, viscosity=batch.viscosity)
        equations.right_hand_side(state, some, batch.vectors, 0)
        equations.volume_gradient(some, batch.vectors, 1)
        equations.coupled(state, some, batch.vectors, 1)
        equations.subtract_unsymmetric_product(state, some, batch.change, 0, batch.vectors, 1)
        equations.targets(some, batch.change, 0)
        batch.start.copy_slots(state, some.slots)
        fraction = wp.full(SLOTS, 0.5, dtype=wp.float64, device=DEVICE)
        pressures = batch.per_slot((PRESSURE_CHANGE_PA,) * len(PLACES))
        equations.move(state, batch.start, some, batch.change, 0, fraction, pressures)
        equations.update_anchors(state, some)
    touched = set()
    for name, array in arrays.items():
        now, was = array.numpy(), before[name]
        if np.array_equal(now, was, equal_nan=True):
            continue
        touched.add(name)
        if len(now) == 9:  # rows of numbers of matrices
            now, was = now.T, was.T
        assert len(now) % SLOTS == 0, name
        others = [k for k in range(SLOTS) if k != slot]
        np.testing.assert_array_equal(
            now.reshape(SLOTS, -1)[others], was.reshape(SLOTS, -1)[others], err_msg=name
        )
    assert len(touched) > 20
    # Back, for the tests that follow.
    equations.pose(
        np.array([slot]), np.array([1]), case.indenter.tip[None], case.indenter.rotation[None]
    )


@pytest.mark.parametrize("places", [(3,), (4, 0)])
def test_slots_do_not_know_of_one_another(batch: Batch, places: tuple[int, ...]) -> None:
    """Alone or in another order: the same to the last bits."""
    together = dict(zip(PLACES, batch.run(batch.all, "moved"), strict=True))
    values = batch.values.numpy().copy()
    some = batch.equations.listed(np.array(places))
    alone = batch.run(some, "moved")
    for slot, found in zip(places, alone, strict=True):
        assert found.residual == pytest.approx(together[slot].residual, rel=1e-11)
        same(found.net_force, together[slot].net_force, 1e-11)
        same(batch.values.numpy()[slot], values[slot])


@pytest.mark.parametrize("mortar", [True, False])
@pytest.mark.parametrize("core", [True, False])
def test_contact_without_mortar_and_without_a_core(
    finger: Fingertip, mortar: bool, core: bool
) -> None:
    mesh, parameters = finger.geometry.mesh, finger.parameters
    system = EquilibriumSystem(
        mesh,
        finger.geometry.core.grid if core else None,
        shear_modulus_pa=parameters.shear_modulus_pa,
        bulk_ratio=parameters.bulk_ratio,
        contact=ContactSettings(mortar=mortar),
    )
    ball, low = make_indenter("sphere_medium"), finger.nodes[:, 2].min()
    pose = np.array([0.0, 0.0, low + 0.2e-3, 1.0, 0.0, 0.0, 0.0])
    indenter = PosedIndenter(ball, pose, parameters.friction_coefficient)
    state = finger.state.copy()
    inside = indenter.distance(state.position)[0][mesh.outer_faces] < 0.0
    state.indenter_pressure[:] = 1e4 * inside
    state.traction[:] = 2e3 * inside[..., None]
    system.update_anchors(state, indenter)
    system.correct_contact(state, indenter)
    expected, values = system.balance(state, indenter), system.tangent_values()
    load = -system.coupled_force()
    equations = BatchedEquations(system, [ball], slots=2, device=DEVICE, friction=indenter.friction)
    batched, listed = BatchedState(mesh, 2, DEVICE), equations.listed(np.array([1]))
    batched.put(1, state)
    equations.pose(listed.numbers, np.array([0]), indenter.tip[None], indenter.rotation[None])
    equations.correct_contact(batched, listed)
    equations.balance(batched, listed)
    (found,) = equations.numbers(batched, listed)
    assert found.residual == pytest.approx(expected.residual, rel=1e-11)
    same(equations.outer.force.numpy().reshape(2, -1, 3)[1], expected.indenter)
    same(equations.inner.force.numpy().reshape(2, -1, 3)[1], expected.core)
    tangent = wp.zeros((2, len(values)), dtype=wp.float64, device=DEVICE)
    none = wp.zeros(2, dtype=wp.float64, device=DEVICE)
    equations.tangent(batched, listed, tangent, elastic=listed, viscosity=none)
    same(tangent.numpy()[1], values, TANGENT_ROUNDING)
    vectors = wp.zeros((2, 1, equations.size), dtype=wp.float64, device=DEVICE)
    equations.coupled(batched, listed, vectors, 0)
    assert np.abs(load).max() > 0.0
    same(vectors.numpy()[1, 0], load)


def test_a_state_without_numbers_stays_in_its_slot(batch: Batch) -> None:
    together = batch.run(batch.all, "second")
    broken = batch.cases[1].second.copy()
    broken.position[7] = np.nan
    batch.state.put(PLACES[1], broken)
    batch.equations.balance(batch.state, batch.all)
    found = batch.equations.numbers(batch.state, batch.all)
    assert not np.isfinite(largest_error(found[1], 1e-7))
    for k in (0, 2):
        assert found[k].residual == pytest.approx(together[k].residual, rel=1e-11)
        assert found[k].smallest_jacobian == pytest.approx(together[k].smallest_jacobian)
