"""Data sets of several fingertips as one: nothing is lost, mixed up or called the same."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.errors import DatasetError
from palpate_training.cli import data_app
from palpate_training.datasets.basis import fit_basis, subset
from palpate_training.datasets.experiment import MixedDataset, read_mixed, write_mixed
from palpate_training.datasets.export import features
from palpate_training.datasets.features import FeatureDataset, joined, open_dataset
from palpate_training.datasets.join import join_files, join_mixed
from palpate_training.datasets.shrink import SmallSize, shrink_file


def other_skin(data: MixedDataset) -> MixedDataset:
    """The same presses on a thicker skin, whose fields are twice as large and turned."""
    basis = replace(data.basis, modes=data.basis.modes[:, :, ::-1].copy())
    return replace(
        data,
        basis=basis,
        coefficients=2.0 * data.coefficients,
        mesh=replace(data.mesh, nodes=data.mesh.nodes * np.float32(1.1)),
    )


def test_fields_and_rows_are_those_of_the_parts(large: MixedDataset) -> None:
    parts = [large, other_skin(large)]
    both = join_mixed(parts, ["a", "b"], modes=1000, force_modes=1000)
    rows = len(large)
    assert len(both) == 2 * rows
    assert both.experiment.unit_names == large.experiment.unit_names
    assert both.experiment.trials == 2 * large.experiment.trials
    ours, theirs = (set(both.experiment.trajectories[k::2]) for k in range(2))
    assert len(ours | theirs) == 2 * len(large.experiment.trajectories)
    for k, part in enumerate(parts):
        own = slice(k * rows, (k + 1) * rows)
        there = part.displacement(slice(None))
        np.testing.assert_allclose(both.displacement(own), there, atol=2e-6 * np.abs(there).max())
        np.testing.assert_array_equal(both.experiment.force[own], part.experiment.force)
        assert both.contact is not None
        assert part.contact is not None
        np.testing.assert_array_equal(both.contact.centre[own], part.contact.centre)
        bears = part.contact.basis.decode(part.contact.coefficients)
        found = both.contact.basis.decode(both.contact.coefficients[own])
        np.testing.assert_allclose(found, bears, atol=2e-6 * np.abs(bears).max())
        for trial in range(part.experiment.trials):
            name = both.experiment.trial_name(trial + k * part.experiment.trials)
            assert name == part.experiment.trial_name(trial).replace(" ", f" {'ab'[k]}/")
    few = join_mixed(parts, ["a", "b"], modes=2, force_modes=1)
    assert len(few.basis.modes) == 2
    assert few.basis.loss_mean > both.basis.loss_mean


def test_what_the_parts_had_lost_is_said(large: MixedDataset) -> None:
    def lossy(data: MixedDataset, mean: float, most: float) -> MixedDataset:
        return replace(data, basis=replace(data.basis, loss_mean=mean, loss_max=most))

    parts = [lossy(large, 0.92e-6, 57.7e-6), lossy(other_skin(large), 0.86e-6, 101.8e-6)]
    both = join_mixed(parts, ["a", "b"], modes=1000, force_modes=1000)
    said = both.experiment.provenance.notes
    assert "themselves lose up to 9.2e-07 m of the displacement on average, 0.000102 at" in said
    assert "N of the contact forces on average" in said
    # The losses of a join of joins are beside the joins', whose own stay said.
    more = join_mixed([both, parts[0]], ["ab", "c"], modes=1000, force_modes=1000)
    assert said in more.experiment.provenance.notes


def test_common_modes_are_those_of_the_whole_fields(large: MixedDataset) -> None:
    parts = [large, subset(other_skin(large), range(3))]
    few = join_mixed(parts, ["a", "b"], modes=4, force_modes=3)
    fields = [part.displacement(slice(None)) for part in parts]
    whole = fit_basis(lambda: fields, count=4)
    np.testing.assert_allclose(few.basis.mean, whole.mean, atol=1e-6 * np.abs(whole.mean).max())
    ours, theirs = (one.modes.reshape(4, -1) for one in (few.basis, whole))
    np.testing.assert_allclose(ours @ theirs.T, np.eye(4), atol=1e-3)
    assert few.basis.loss_mean == pytest.approx(whole.loss_mean, rel=1e-3)
    assert few.basis.loss_max == pytest.approx(whole.loss_max, rel=1e-2)
    assert few.basis.step == whole.step > 0.0


def test_parts_that_do_not_fit_together_are_refused(large: MixedDataset, tmp_path: Path) -> None:
    faces = replace(large.mesh, outer_faces=large.mesh.outer_faces[:, ::-1].copy())
    with pytest.raises(DatasetError, match="b has another mesh than a"):
        join_mixed([large, replace(large, mesh=faces)], ["a", "b"], modes=2, force_modes=1)
    own = replace(large.experiment, provenance=replace(large.experiment.provenance, licence="mine"))
    with pytest.raises(DatasetError, match="only one of them knows"):
        join_mixed([large, replace(large, contact=None)], ["a", "b"], modes=2, force_modes=1)
    with pytest.raises(DatasetError, match="licences differ"):
        join_mixed([large, replace(large, experiment=own)], ["a", "b"], modes=2, force_modes=1)

    files = [tmp_path / folder / "mixed.h5" for folder in ("one", "two")]
    elsewhere = large.experiment.location + np.array([0.0, 0.003, 0.0], np.float32)
    tared = large.experiment.tared * np.float32(1.1)
    unlike = replace(large.experiment, tared=tared, location=elsewhere)
    for file, one in zip(files, (large, replace(large, experiment=unlike)), strict=True):
        file.parent.mkdir()
        write_mixed(file, one)
    out, command = tmp_path / "both.h5", ["join", *map(str, files)]
    twice = CliRunner().invoke(data_app, [*command, str(files[0]), str(out)])
    assert isinstance(twice.exception, DatasetError)
    assert "parts are called one, two, one" in str(twice.exception)
    assert not out.exists()
    done = CliRunner().invoke(data_app, [*command, str(out)])
    assert done.exit_code == 0, done.output
    assert {name.split("/")[0] for name in read_mixed(out).experiment.trajectories} == {
        "one",
        "two",
    }
    again = CliRunner().invoke(data_app, [*command, str(out)])
    assert "both.h5 exists" in str(again.exception)


def test_joined_features_keep_presses_apart(press_data: Callable[..., FeatureDataset]) -> None:
    one, other = press_data(3, 20, 1), press_data(2, 20, 2)
    other = replace(other, sensor_names=("second",))
    both = joined([one, other])
    assert len(np.unique(both.group)) == 5
    assert both.sensor_names == ("finger", "second")
    np.testing.assert_array_equal(both.sensor, np.repeat([0, 1], [60, 40]))
    np.testing.assert_array_equal(both.electrodes[60:], other.electrodes)
    with_notes = [
        replace(part, provenance=replace(part.provenance, notes=note))
        for part, note in ((one, "axes x,-z,y"), (other, "rest assumed"))
    ]
    said = joined(with_notes).provenance.notes
    assert said.endswith("; of parts: axes x,-z,y; of parts: rest assumed")
    same = joined([one, press_data(2, 20, 2)])
    assert same.sensor_names == ("finger",)
    with pytest.raises(DatasetError, match="does not say contact_location"):
        joined([one, replace(other, contact_location=None)])
    paid = replace(other, provenance=replace(other.provenance, licence="other"))
    with pytest.raises(DatasetError, match="licences differ"):
        joined([one, paid])
    with pytest.raises(DatasetError, match="hold the same presses: "):
        joined([one, other, replace(one, sensor_names=("third",))])


@pytest.mark.parametrize("changed", ["paired otherwise", "tared otherwise", "another rest assumed"])
def test_features_of_one_recording_are_not_joined_whatever_was_made_of_them(
    press_data: Callable[..., FeatureDataset], changed: str
) -> None:
    data = press_data(3, 20, 1)
    rest = data.baseline + np.float32(3.0)
    again: dict[str, dict[str, Any]] = {
        "paired otherwise": {"force": np.roll(data.force, 2, axis=0)},
        "tared otherwise": {"baseline": rest},
        "another rest assumed": {"baseline": rest, "electrodes": data.electrodes + np.uint16(3)},
    }
    with pytest.raises(DatasetError, match="hold the same presses: "):
        joined([data, replace(data, **again[changed])])


def test_features_with_the_same_rows_of_rest_are_joined(
    press_data: Callable[..., FeatureDataset],
) -> None:
    """Simulated electrodes have no noise, the force of an untouched finger may have some."""
    data, other = (press_data(2, 200, seed) for seed in (1, 2))
    other.baseline[:] = data.baseline[:1]
    for number, one in enumerate((data, other)):
        one.electrodes[100:200] = np.rint(data.baseline[0]).astype(np.uint16)
        one.force[100:200] = np.float32(0.001 * (1 + number))
    assert len(joined([data, other])) == 800


def test_one_plan_on_two_specimens_is_held_out_together(
    large: MixedDataset, tmp_path: Path
) -> None:
    """Also where each specimen has a file of its own."""
    rows = replace(
        large.experiment,
        unit_names=tuple(f"other-{name}" for name in large.experiment.unit_names),
        tared=large.experiment.tared * np.float32(1.1),
        location=large.experiment.location + np.array([0.0, 0.001, 0.0], np.float32),
    )
    files = [tmp_path / "one.h5", tmp_path / "two.h5"]
    for file, one in zip(files, (large, replace(large, experiment=rows)), strict=True):
        write_mixed(file, one)
    with pytest.raises(DatasetError, match="the same trajectories, pressed on different specimens"):
        join_files(files, tmp_path / "both.h5", modes=2, force_modes=2, command="")
    done = CliRunner().invoke(data_app, ["features", *map(str, files), str(tmp_path / "rows.h5")])
    assert done.exit_code == 0, done.output
    both, alone = open_dataset(tmp_path / "rows.h5"), features(large).group
    np.testing.assert_array_equal(both.group, np.concatenate([alone, alone]))


def test_one_plan_is_known_again_after_a_part_was_joined(
    large: MixedDataset, tmp_path: Path
) -> None:
    """Its trajectories are called after the part then; those of the other part are others."""
    move = np.array([0.0, 0.02, 0.0], np.float32)

    def pressed(unit: str, gain: float, by_m: np.ndarray) -> MixedDataset:
        own = large.experiment
        rows = replace(
            own,
            unit_names=tuple(f"{unit}-{name}" for name in own.unit_names),
            tared=own.tared * np.float32(gain),
            location=own.location + by_m,
        )
        return replace(large, experiment=rows)

    one, elsewhere, again = (
        pressed("one", 1.0, 0.0 * move),
        pressed("elsewhere", 1.1, move),
        pressed("again", 1.2, 0.05 * move),
    )
    both = join_mixed([elsewhere, one], ["elsewhere", "one"], modes=2, force_modes=2)
    files = [tmp_path / "both.h5", tmp_path / "again.h5"]
    for file, data in zip(files, (both, again), strict=True):
        write_mixed(file, data)
    with pytest.raises(DatasetError, match="the same trajectories, pressed on different specimens"):
        join_files(files, tmp_path / "all.h5", modes=2, force_modes=2, command="")
    done = CliRunner().invoke(data_app, ["features", *map(str, files), str(tmp_path / "rows.h5")])
    assert done.exit_code == 0, done.output
    group, rows = open_dataset(tmp_path / "rows.h5").group, len(features(large))
    of_elsewhere, of_one, of_again = (group[k * rows : (k + 1) * rows] for k in range(3))
    np.testing.assert_array_equal(of_one, of_again)
    assert not set(of_elsewhere) & set(of_one)


def test_a_part_and_what_it_is_of_are_not_joined(large: MixedDataset, tmp_path: Path) -> None:
    write_mixed(tmp_path / "whole.h5", large)
    shrink_file(tmp_path / "whole.h5", tmp_path / "few.h5", SmallSize(4, 3, 2, 2), command="")
    paths = [tmp_path / "whole.h5", tmp_path / "few.h5"]
    with pytest.raises(DatasetError, match="hold the same presses"):
        join_files(paths, tmp_path / "both.h5", modes=2, force_modes=2, command="")
    assert not (tmp_path / "both.h5").exists()
