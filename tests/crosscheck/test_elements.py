"""The element against felupe's: equal on the same mesh, and no locking beside Taylor-Hood.

The stored figures need no other code; the tests that run felupe itself skip where it is absent.
"""

from __future__ import annotations

import numpy as np
import pytest
from tests.crosscheck import figures, ours, sphere
from tests.crosscheck.cases import CASES, QUICK
from tests.crosscheck.problem import Problem, Solution

# Both codes stop Newton at 1e-9 of the forces; squeezed to that, figures differ by less than this.
SAME = 1e-6
FINER = [name for name, case in CASES.items() if name not in QUICK and case.seconds <= 4]


@pytest.fixture(scope="module", params=QUICK)
def solved(request: pytest.FixtureRequest) -> tuple[str, Problem, Solution]:
    problem = CASES[request.param].make()
    return request.param, problem, ours.deform(problem)


def test_figures_equal_felupes_on_the_same_mesh(solved: tuple[str, Problem, Solution]) -> None:
    name, problem, solution = solved
    assert CASES[name].measure(problem, solution) == pytest.approx(
        figures.elastic("Q1P0", name), rel=SAME
    )


def test_every_node_moves_as_in_felupe(solved: tuple[str, Problem, Solution]) -> None:
    pytest.importorskip("felupe")
    from tests.crosscheck import with_felupe

    name, problem, solution = solved
    theirs = with_felupe.solve(problem)
    assert CASES[name].measure(problem, theirs) == pytest.approx(
        figures.elastic("Q1P0", name), rel=SAME
    ), "felupe no longer gives the stored figures"
    # at the rim of a loaded face, what pressure puts on a held component is the support's affair
    loaded = np.isin(np.arange(len(problem.nodes)), problem.pressure_faces)
    for mine, other in (
        (solution.displacement, theirs.displacement),
        (solution.reaction[~loaded], theirs.reaction[~loaded]),
    ):
        assert np.abs(mine - other).max() < SAME * np.abs(other).max()


@pytest.mark.slow
@pytest.mark.parametrize("name", FINER)
def test_figures_equal_felupes_on_finer_meshes(name: str) -> None:
    problem = CASES[name].make()
    solution = ours.deform(problem)
    assert CASES[name].measure(problem, solution) == pytest.approx(
        figures.elastic("Q1P0", name), rel=SAME
    )


def test_cook_membrane_converges_to_the_literature() -> None:
    problem = CASES["cook 32"].make()
    tip = CASES["cook 32"].measure(problem, ours.deform(problem))["tip_mm"]
    assert tip == pytest.approx(6.92, rel=0.01)


def test_sphere_follows_the_closed_form() -> None:
    problem = CASES["sphere 12x12x4"].make()
    found = sphere.measure(problem, ours.deform(problem))
    assert found["inner_stretch"] == pytest.approx(sphere.STRETCH, rel=1e-3)


@pytest.mark.parametrize(
    ("case", "limit", "figure", "tolerance"),
    [
        # two layers, as in the skin: squeezed by 40 % and bent
        ("squeezed plate 8x8x2", "squeezed plate 32x32x6", "load_n", 0.005),
        ("squeezed plate 16x16x2", "squeezed plate 32x32x6", "load_n", 0.002),
        ("squeezed plate 16x16x2", "squeezed plate 32x32x6", "edge_mm", 0.01),
        # clamped edges are singular: two layers come out 2 % too soft there, four are right
        ("inflated plate 8x8x2", "inflated plate 32x32x8", "rise_mm", 0.01),
        ("inflated plate 16x16x2", "inflated plate 32x32x8", "rise_mm", 0.025),
        ("inflated plate 16x16x4", "inflated plate 32x32x8", "rise_mm", 0.005),
        ("sphere 12x12x4", "sphere 12x12x4", "volume_ratio", 0.002),
    ],
)
def test_element_does_not_lock(case: str, limit: str, figure: str, tolerance: float) -> None:
    """Against quadratic elements with continuous pressure (Taylor-Hood), which cannot lock."""
    problem = CASES[case].make()
    mine = CASES[case].measure(problem, ours.deform(problem))[figure]
    assert mine == pytest.approx(figures.elastic("Taylor-Hood Q2-Q1", limit)[figure], rel=tolerance)


@pytest.mark.parametrize(
    ("coarse", "fine", "figure", "tolerance"),
    [
        ("squeezed plate 24x24x4", "squeezed plate 32x32x6", "load_n", 2e-4),
        ("inflated plate 24x24x6", "inflated plate 32x32x8", "rise_mm", 2e-3),
        ("sphere 8x8x4", "sphere 12x12x4", "volume_ratio", 1e-5),
    ],
)
def test_taylor_hood_figures_have_converged(
    coarse: str, fine: str, figure: str, tolerance: float
) -> None:
    """The limits above are known this well."""
    element = "Taylor-Hood Q2-Q1"
    assert figures.elastic(element, coarse)[figure] == pytest.approx(
        figures.elastic(element, fine)[figure], rel=tolerance
    )
