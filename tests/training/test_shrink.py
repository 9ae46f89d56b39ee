"""A small version of a mixed data set: which trials, rows and modes it keeps, and what it loses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.errors import ConfigError, DatasetError
from palpate_training.cli import data_app
from palpate_training.datasets.experiment import (
    MixedDataset,
    content_sha256,
    read_mixed,
    write_experiment,
    write_mixed,
)
from palpate_training.datasets.shrink import SmallSize, shrink


def test_trials_are_whole_and_even_over_the_indenters(large: MixedDataset) -> None:
    small = shrink(large, SmallSize(trials=8, rows=4)).experiment
    kinds = [small.indenters[t] for t in small.trial_trajectory]
    assert {kind: kinds.count(kind) for kind in kinds} == {"cube": 2, "ring": 3, "sphere": 3}
    names = [small.trial_name(k) for k in range(8)]
    assert names == sorted(names)
    again = shrink(large, SmallSize(trials=8, rows=4)).experiment
    assert [again.trial_name(k) for k in range(8)] == names
    other = shrink(large, SmallSize(trials=8, rows=4, seed=1)).experiment
    assert [other.trial_name(k) for k in range(8)] != names


def test_rows_are_evenly_spaced_from_first_to_last(large: MixedDataset) -> None:
    small = shrink(large, SmallSize(trials=5, rows=3))
    whole = large.experiment
    names = [whole.trial_name(k) for k in range(whole.trials)]
    assert len(small) == 15
    assert small.contact is not None
    assert large.contact is not None
    for trial in range(5):
        kept = small.experiment.rows_of(trial)
        rows = whole.rows_of(names.index(small.experiment.trial_name(trial))).start + np.array(
            [0, 5, 10]
        )
        for name in ("travel_m", "tared", "force", "location"):
            np.testing.assert_array_equal(
                getattr(small.experiment, name)[kept], getattr(whole, name)[rows]
            )
        np.testing.assert_array_equal(small.simulated_force[kept], large.simulated_force[rows])
        np.testing.assert_array_equal(small.contact.centre[kept], large.contact.centre[rows])
        np.testing.assert_array_equal(small.contact.normal[kept], large.contact.normal[rows])


def test_the_loss_is_what_its_numbers_lose_beside_the_given_data_set(large: MixedDataset) -> None:
    small = shrink(large, SmallSize(rows=11, modes=5, force_modes=2))
    assert small.contact is not None
    assert large.contact is not None
    np.testing.assert_array_equal(small.basis.modes, large.basis.modes[:5])
    np.testing.assert_array_equal(small.contact.basis.modes, large.contact.basis.modes[:2])
    every = slice(0, len(large))
    moved = small.displacement(every) - large.displacement(every)
    forces = (
        one.basis.decode(one.coefficients).astype(float) for one in (small.contact, large.contact)
    )
    pressed = next(forces) - next(forces)
    for basis, rest in ((small.basis, moved), (small.contact.basis, pressed)):
        distance = np.linalg.norm(rest, axis=2)
        assert basis.loss_mean == pytest.approx(distance.mean(), rel=1e-4)
        assert basis.loss_max == pytest.approx(distance.max(), rel=1e-4)
        assert basis.step > 0.0
    steps = small.coefficients / small.basis.step
    np.testing.assert_array_equal(steps, np.rint(steps))


def test_it_says_what_it_is_of(large: MixedDataset) -> None:
    where = shrink(large, SmallSize(trials=3, rows=2), command="palpate data shrink").experiment
    assert where.provenance.input_sha256 == content_sha256(large)
    assert where.provenance.command == "palpate data shrink"
    assert where.provenance.source == large.experiment.provenance.source
    assert "3 of 18 trials" in where.provenance.notes
    assert "relative to that data set" in where.provenance.notes
    assert f"loses {large.basis.loss_mean:.3g} m" in where.provenance.notes


def test_all_of_less_is_kept(large: MixedDataset, mixed: MixedDataset) -> None:
    same = shrink(large, SmallSize())
    assert same.experiment.trials == 18
    assert len(same) == 18 * 8
    assert same.basis.loss_mean == 0.0
    whole = shrink(mixed, SmallSize(rows=20))
    assert whole.contact is None
    np.testing.assert_array_equal(whole.coefficients, mixed.coefficients)


@pytest.mark.parametrize("wrong", [{"trials": 0}, {"rows": 1}, {"modes": 0}, {"force_modes": -1}])
def test_sizes_that_keep_nothing_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match="keeps nothing"):
        replace(SmallSize(), **wrong)


def test_the_command_writes_a_small_file_and_overwrites_none(
    large: MixedDataset, tmp_path: Path
) -> None:
    path, out = tmp_path / "mixed.h5", tmp_path / "small.h5"
    write_mixed(path, large)
    words = ["shrink", str(path), str(out), "--trials", "6", "--rows", "5", "--modes", "4"]
    result = CliRunner().invoke(data_app, [*words, "--force-modes", "3"], env={"COLUMNS": "250"})
    assert result.exit_code == 0, result.output
    assert "6 trials, 30 rows" in result.output
    assert "in 4 modes" in result.output
    small = read_mixed(out)
    assert small.contact is not None
    assert (len(small), len(small.basis.modes), len(small.contact.basis.modes)) == (30, 4, 3)
    before = out.read_bytes()
    refused = CliRunner().invoke(data_app, words)
    assert isinstance(refused.exception, DatasetError)
    assert "small.h5 exists" in str(refused.exception)
    assert out.read_bytes() == before


def test_what_is_no_mixed_data_set_is_refused(large: MixedDataset, tmp_path: Path) -> None:
    write_experiment(tmp_path / "e.h5", large.experiment)
    for name in ("e.h5", "none.h5"):
        words = ["shrink", str(tmp_path / name), str(tmp_path / "small.h5")]
        assert isinstance(CliRunner().invoke(data_app, words).exception, DatasetError)
    assert not (tmp_path / "small.h5").exists()
