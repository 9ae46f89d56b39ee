"""Experiment and simulation brought to the same displacements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate_training.datasets.assembly import TrialEncoder, common_trajectories, interpolate, mix
from palpate_training.datasets.basis import fit_basis
from palpate_training.datasets.experiment import SkinMesh
from palpate_training.datasets.trials import SimulatedTrial, TrialHeader, TrialRows

HEADER = TrialHeader("biotac-1", "sphere/03/normal", "sphere", "left")


@pytest.fixture
def rows() -> TrialRows:
    """2 mm after 0.5 N, everything linear in travel."""
    travel = np.linspace(0, 2e-3, 21)
    return TrialRows(
        HEADER,
        np.full(19, 3000.0),
        travel,
        np.outer(travel, -100 * np.arange(1, 20)),
        np.outer(0.5 + 1e3 * travel, [0, 0, 1]),
        np.outer(travel, [0, 0, 1]) - [0, 0, 9e-3],
    )


@pytest.fixture
def simulated() -> SimulatedTrial:
    """Force 1 N/mm from an odd origin, in steps of 0.15 mm; the last two steps diverged."""
    travel = 7e-3 + 0.15e-3 * np.arange(15, dtype=np.float64)
    force = np.outer(1e3 * (travel - 7e-3), [0, 0, 1])
    field = (travel - 7e-3)[:, None, None] * np.arange(1, 13).reshape(4, 3)
    force[13:], field[13:] = 1e6, np.nan
    return SimulatedTrial(HEADER.trajectory, travel, force, field.astype(np.float32), 13)


def test_both_start_at_half_a_newton_and_end_at_the_smaller_displacement(
    rows: TrialRows, simulated: SimulatedTrial
) -> None:
    found = mix(rows, simulated)
    # 12 believed steps of 0.15 mm are 1.8 mm; 0.5 N is reached after 0.5 mm of them.
    np.testing.assert_allclose(found.rows.travel_m, np.linspace(0, 1.3e-3, 20), atol=1e-9)
    np.testing.assert_allclose(found.simulated_force[:, 2], np.linspace(0.5, 1.8, 20))
    np.testing.assert_allclose(found.rows.force[:, 2], np.linspace(0.5, 1.8, 20))
    np.testing.assert_allclose(found.rows.tared[-1], -0.13 * np.arange(1, 20))
    np.testing.assert_allclose(found.rows.location[:, 2], -9e-3 + np.linspace(0, 1.3e-3, 20))
    expected = (0.5e-3 + np.linspace(0, 1.3e-3, 20))[:, None, None] * np.arange(1, 13).reshape(4, 3)
    np.testing.assert_allclose(found.displacement, expected, rtol=1e-5)
    assert found.displacement.dtype == np.float32
    np.testing.assert_array_equal(found.rows.rest, rows.rest)


def test_rows_lie_between_steps_and_so_do_their_coefficients(
    rows: TrialRows, simulated: SimulatedTrial
) -> None:
    found, before = mix(rows, simulated), slice(0, simulated.converged)
    assert found.shares is not None
    np.testing.assert_allclose(found.shares.sum(axis=1), 1.0)
    np.testing.assert_allclose(
        np.einsum("rs,svc->rvc", found.shares, simulated.displacement[before]),
        found.displacement,
        atol=1e-9,
    )
    some = np.random.default_rng(0).normal(size=(9, 4, 3)).astype(np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    mesh = SkinMesh(np.zeros((4, 3)), faces, faces, np.arange(4, dtype=np.int32), "ab")
    encode = TrialEncoder(mesh, replace(fit_basis(lambda: [some], count=5), step=2.0**-24))
    direct, by_steps = encode(found), encode(found, encode.steps(simulated))
    assert np.abs(direct.coefficients).max() > 1e-3
    np.testing.assert_allclose(by_steps.coefficients, direct.coefficients, atol=2.0**-24)
    other = replace(simulated, displacement=simulated.displacement[:, :3])
    with pytest.raises(DatasetError, match="displacement has shape"):
        encode.steps(other)


def test_the_experiment_may_be_the_shorter_one(rows: TrialRows, simulated: SimulatedTrial) -> None:
    short = replace(
        rows,
        travel_m=rows.travel_m[:6],
        tared=rows.tared[:6],
        force=rows.force[:6],
        location=rows.location[:6],
    )
    found = mix(short, simulated, count=5)
    np.testing.assert_allclose(found.rows.travel_m, [0, 1.25e-4, 2.5e-4, 3.75e-4, 5e-4])
    np.testing.assert_allclose(found.simulated_force[:, 2], [0.5, 0.625, 0.75, 0.875, 1.0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"trajectory": "cube/00/normal"}, "the simulation is of cube/00/normal"),
        ({"converged": 3}, "reaches 0.3 N in its 3 converged steps"),
        ({"converged": 0}, "reaches 0 N in its 0 converged steps"),
        ({"converged": 15}, "counted as converged is not finite"),
        ({"force": np.full((15, 3), 0.5)}, "begins at 0.866 N"),
        ({"travel_m": np.zeros(15)}, "does not increase"),
    ],
)
def test_what_cannot_be_mixed_is_named(
    rows: TrialRows, simulated: SimulatedTrial, change: dict[str, object], words: str
) -> None:
    with pytest.raises(DatasetError, match=words) as caught:
        mix(rows, replace(simulated, **change))  # type: ignore[arg-type]
    assert "biotac-1 sphere/03/normal" in str(caught.value)


def test_a_single_row_cannot_be_mixed(rows: TrialRows, simulated: SimulatedTrial) -> None:
    one = replace(
        rows,
        travel_m=rows.travel_m[:1],
        tared=rows.tared[:1],
        force=rows.force[:1],
        location=rows.location[:1],
    )
    with pytest.raises(DatasetError, match="the experiment has one row"):
        mix(one, simulated)


def test_common_trajectories_account_for_the_others(rows: TrialRows) -> None:
    other = replace(rows, header=replace(HEADER, trajectory="ring/00/normal"))
    both, dropped = common_trajectories([rows, other], {HEADER.trajectory})
    assert [one.header.trajectory for one in both] == [HEADER.trajectory]
    assert [name for name, _ in dropped] == [f"{HEADER.unit} ring/00/normal"]
    assert "not simulated" in dropped[0][1]


def test_interpolation_is_numpys_along_the_first_axis() -> None:
    where = np.array([0.0, 1.0, 4.0])
    values = np.array([[0.0, 5.0], [2.0, 5.0], [8.0, -1.0]])
    at = np.array([0.0, 0.5, 1.0, 2.0, 4.0])
    expected = np.stack([np.interp(at, where, column) for column in values.T], axis=1)
    np.testing.assert_allclose(interpolate(at, where, values), expected)
