"""Many indentations at once are those of the solver for one."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from tests.fem.batched_cases import DEVICE, REPEATED, same

from palpate.errors import ConfigError, SimulationError
from palpate_fem.batched.fingertip import BatchedFingertip, BatchedPress
from palpate_fem.indenter.approach import OuterSurface
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac
from palpate_fem.result import IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.trajectory import press_path

TARGET_M = (-4e-3, 0.0, -7.5e-3)
KINDS = [
    ("sphere_medium", (0.0, 0.0, 1.0)),
    ("texture", (0.0, 0.0, 1.0)),
    ("cube", (0.5, 0.0, 0.8)),
]
APART = (2e-3, 2e-2, 2e-3)
"""How far forces of two ways to an equilibrium may be apart, within the solver's tolerances on a
coarse mesh. On the texture's edges a point that sticks on one kind of processor slides on another.
"""


@pytest.fixture(scope="module")
def tip() -> Fingertip:
    return Fingertip.pressurised(biotac(edge_m=1.4e-3))


@pytest.fixture(scope="module")
def presses(tip: Fingertip) -> list[BatchedPress]:
    surface = OuterSurface(tip.nodes, tip.geometry.mesh.outer_faces)
    return [
        BatchedPress(
            k,
            press_path(make_indenter(name), TARGET_M, way, surface, depth_m=1.5e-3, steps=10)[:4],
        )
        for k, (name, way) in enumerate(KINDS)
    ]


def test_three_presses_in_two_slots_are_those_of_the_solver_for_one(
    tip: Fingertip, presses: list[BatchedPress]
) -> None:
    indenters = [make_indenter(name) for name, _ in KINDS]
    batched = BatchedFingertip(tip, indenters, slots=2, device=DEVICE)
    at_work: list[int] = []
    results = dict(batched.indent(presses, on_sweep=at_work.append))
    assert sorted(results) == [0, 1, 2]
    assert max(at_work) == 2
    for k, press in enumerate(presses):
        wanted, found = tip.indent(indenters[k], press.path), results[k]
        assert found.outcome is wanted.outcome is IndentationOutcome.COMPLETE
        assert (found.indenter, found.travel_m) == (wanted.indenter, wanted.travel_m)
        size = np.linalg.norm(wanted.forces[-1])
        assert np.abs(found.forces - wanted.forces).max() < APART[k] * size
        for ours, theirs in zip(found.steps, wanted.steps, strict=True):
            assert np.abs(ours.displacement - theirs.displacement).max() < 1e-3 * APART[k]
            assert ours.fluid_pressure_pa == pytest.approx(theirs.fluid_pressure_pa, rel=1e-3)
            assert np.array_equal(ours.pose, theirs.pose)
            assert ours.convergence.residual < tip.settings.newton.tolerance
    again = dict(batched.indent(presses[2:]))
    same(again[0].forces, results[2].forces, REPEATED)  # slots keep nothing of the past


def test_what_has_no_equilibrium_on_the_device_is_computed_on_the_cpu(
    tip: Fingertip, presses: list[BatchedPress]
) -> None:
    """With one iteration there is none; the CPU says so in its own words, for that press alone."""
    settings = replace(
        tip.settings,
        newton=replace(tip.settings.newton, iterations=1, pseudo_transient_iterations=1),
        smallest_increment=0.5,
    )
    hasty = Fingertip(tip.geometry, tip.parameters, settings)
    hasty.state, hasty.cavity_m3 = tip.state, tip.cavity_m3
    batched = BatchedFingertip(hasty, [make_indenter("sphere_medium")], slots=1, device=DEVICE)
    ((number, found),) = batched.indent(presses[:1])
    wanted = hasty.indent(make_indenter("sphere_medium"), presses[0].path)
    assert number == 0
    assert found.outcome is wanted.outcome is IndentationOutcome.DIVERGED
    assert found.reason == wanted.reason


def test_steps_are_told_presses_come_late_and_one_is_stopped(
    tip: Fingertip, presses: list[BatchedPress]
) -> None:
    """The iterator ends after each press, and has more when it is asked again."""
    batched = BatchedFingertip(
        tip, [make_indenter(name) for name, _ in KINDS], slots=2, device=DEVICE
    )
    late = [presses[0], None, presses[2], presses[0]]
    told: dict[int, list[IndentationStep]] = defaultdict(list)

    class Late:
        def __iter__(self) -> Late:
            return self

        def __next__(self) -> BatchedPress:
            if not late or (press := late.pop(0)) is None:
                raise StopIteration
            return press

    def stop_the_second(number: int) -> IndentationOutcome | None:
        return IndentationOutcome.CANCELLED if number == 1 and told[1] else None

    results = dict(
        batched.solve(
            Late(), on_step=lambda k, step: told[k].append(step), should_stop=stop_the_second
        )
    )
    found = {k: one for k, one in results.items() if isinstance(one, IndentationResult)}
    assert sorted(found) == [0, 1, 2]
    assert found[1].outcome is IndentationOutcome.CANCELLED
    assert len(found[1].steps) == 1
    assert found[0].outcome is found[2].outcome is IndentationOutcome.COMPLETE
    assert all(tuple(told[k]) == found[k].steps for k in found)
    same(found[0].forces, found[2].forces, REPEATED)


def test_no_slots_are_refused(tip: Fingertip) -> None:
    with pytest.raises(ConfigError, match="0 slots"):
        BatchedFingertip(tip, [make_indenter("cube")], slots=0, device=DEVICE)


def test_a_press_that_is_wrong_is_named(tip: Fingertip, presses: list[BatchedPress]) -> None:
    batched = BatchedFingertip(tip, [make_indenter("sphere_medium")], slots=1, device=DEVICE)
    with pytest.raises(ConfigError, match="press 0 has indenter 1"):
        next(batched.indent(presses[1:]))
    with pytest.raises(ConfigError, match="the path of press 0"):
        next(batched.indent([BatchedPress(0, presses[0].path * np.nan)]))
    inside = presses[0].path.copy()
    inside[0] = inside[-1]
    with pytest.raises(SimulationError):
        next(batched.indent([BatchedPress(0, inside)]))
