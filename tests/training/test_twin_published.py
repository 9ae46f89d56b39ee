"""The published layout: read back what was exported, and name whatever is wrong with a file."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.errors import DatasetError
from palpate_training.cli import data_app, train_app
from palpate_training.datasets.assembly import assemble_experiment
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import ExperimentDataset, MixedDataset
from palpate_training.datasets.export import export_csv, export_published
from palpate_training.datasets.inspect import load
from palpate_training.datasets.published import read_published
from palpate_training.datasets.trials import TrialRows

PLAN = ["cube/00/n", "cube/01/n", "sphere/00/n", "sphere/00/a", "sphere/01/n"]
ON_UNIT = {"biotac-1": PLAN[2:], "biotac-2": PLAN, "biotac-3": PLAN[:4]}


@pytest.fixture
def source(make_rows: Callable[..., TrialRows], provenance: Provenance) -> ExperimentDataset:
    """Three units; the first has one indenter, the last lacks a trajectory."""
    trials = [
        make_rows(unit, trajectory, rows=6 + PLAN.index(trajectory))
        for unit, trajectories in ON_UNIT.items()
        for trajectory in trajectories
    ]
    return assemble_experiment(trials, provenance)


@pytest.fixture
def folder(source: ExperimentDataset, tmp_path: Path) -> Path:
    """As published: without the ids of trajectories, which only files of palpate's own have."""
    for path in export_published(tmp_path / "published", source):
        with h5py.File(path, "r+") as file:
            del file["trajectory"]
    return tmp_path / "published"


def _edit(folder: Path, change: Callable[[Any], None], unit: int = 2) -> None:
    with h5py.File(folder / f"biotac{unit}.hdf5", "r+") as file:
        change(file)


def _scale(group: str, factor: float) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        file[group]["data"][...] = file[group]["data"][()] * factor

    return change


def test_what_was_exported_is_read_back(folder: Path, source: ExperimentDataset) -> None:
    read = read_published(folder)
    assert read.unit_names == source.unit_names
    assert read.trials == source.trials
    assert len(read.trajectories) == len(PLAN), "the same trajectory on two units is one"
    for trial in range(read.trials):
        mine = read.rows_of(trial)
        (other,) = [
            i
            for i in range(source.trials)
            if np.array_equal(source.tared[source.rows_of(i)], read.tared[mine])
        ]
        theirs = source.rows_of(other)
        assert (
            read.unit_names[read.trial_unit[trial]] == (source.unit_names[source.trial_unit[other]])
        )
        np.testing.assert_array_equal(read.force[mine], source.force[theirs])
        np.testing.assert_array_equal(read.location[mine], source.location[theirs])
        np.testing.assert_allclose(read.travel_m[mine], source.travel_m[theirs], atol=1e-8)
        assert (
            read.indenters[read.trial_trajectory[trial]]
            == (source.indenters[source.trial_trajectory[other]])
        )
    assert np.isnan(read.trial_rest).all()
    assert read.provenance.source == source.provenance.source
    assert read.provenance.licence == source.provenance.licence
    assert len(read.provenance.input_sha256) == 64


def test_files_that_say_nothing_are_the_publishers(folder: Path) -> None:
    for path in folder.iterdir():
        with h5py.File(path, "r+") as file:
            for name in list(file.attrs):
                del file.attrs[name]
    said = read_published(folder).provenance
    assert "published experiment of Narang et al.: biotac1.hdf5" in said.source
    assert said.licence.startswith("the publisher's")


def test_trials_of_one_trajectory_share_its_id_over_units(
    folder: Path, source: ExperimentDataset
) -> None:
    read = read_published(folder)
    partners: dict[str, set[str]] = {}
    for trial in range(read.trials):
        first = read.tared[read.rows_of(trial)][0]
        other = int(source.trial[(source.tared == first).all(axis=1)][0])
        partners.setdefault(read.trajectories[read.trial_trajectory[trial]], set()).add(
            source.trajectories[source.trial_trajectory[other]]
        )
    assert sorted(map(len, partners.values())) == [1] * len(PLAN)
    assert {next(iter(names)) for names in partners.values()} == set(PLAN)


def test_an_export_states_its_trajectories(source: ExperimentDataset, tmp_path: Path) -> None:
    """Also those that no sign in the rows tells apart: two rows a trial, and far from one another.

    And also those that look unlike on two specimens: here they begin 4 mm apart.
    """
    rows = np.flatnonzero(np.append(True, source.trial[1:] != source.trial[:-1]))
    rows = np.sort(np.concatenate([rows, rows + 4]))
    moved = source.location.copy()
    moved[source.row_unit == 0, 0] -= np.float32(2e-3)
    moved[source.row_unit == 1, 0] += np.float32(2e-3)
    spread = replace(
        source,
        location=moved[rows],
        **{name: getattr(source, name)[rows] for name in ("trial", "travel_m", "tared", "force")},
    )
    export_published(tmp_path / "out", spread)
    read = read_published(tmp_path / "out")
    assert read.trajectories == source.trajectories
    assert read.indenters == source.indenters
    for name in ("trial", "trial_unit", "trial_trajectory", "tared", "force", "location"):
        np.testing.assert_array_equal(getattr(read, name), getattr(spread, name))
    assert "as the files name them" in read.provenance.notes


@pytest.mark.parametrize("damage", ["names", "rows"])
def test_ids_that_do_not_fit_the_rows_are_named(
    source: ExperimentDataset, tmp_path: Path, damage: str
) -> None:
    export_published(tmp_path / "out", source)

    def change(file: Any) -> None:
        if damage == "names":
            file["trajectory/data"][3] = 7
        else:
            del file["trajectory/data"]
            file["trajectory/data"] = np.zeros(39, np.int64)

    _edit(tmp_path / "out", change)
    with pytest.raises(DatasetError, match=r"biotac2.hdf5: trajectory has .* for 40 rows"):
        read_published(tmp_path / "out")


def test_ids_count_only_where_every_file_states_them(
    source: ExperimentDataset, tmp_path: Path
) -> None:
    export_published(tmp_path / "out", source)
    _edit(tmp_path / "out", lambda file: file.__delitem__("trajectory"))
    read = read_published(tmp_path / "out")
    assert read.trials == source.trials
    assert len(read.trajectories) == len(PLAN), "found, as one file does not state them"


def test_specimens_of_any_number_are_read_back(source: ExperimentDataset, tmp_path: Path) -> None:
    numbered = replace(source, unit_names=("biotac-3", "biotac-4", "biotac-15"))
    files = export_published(tmp_path / "out", numbered)
    (tmp_path / "out" / "biotac4_simulated.hdf5").touch()  # as of a mixed data set
    for read in (read_published(tmp_path / "out"), load(tmp_path / "out")[1]):
        assert isinstance(read, ExperimentDataset)
        assert set(read.unit_names) == set(numbered.unit_names)
        assert len(read) == len(source)
    (_, alone) = load(files[-1])
    assert isinstance(alone, ExperimentDataset)
    assert alone.unit_names == ("biotac-15",)


def test_millimetres_and_metres_are_told_apart(folder: Path, source: ExperimentDataset) -> None:
    for unit in (1, 2, 3):
        _edit(folder, _scale("contact_loc", 1e3), unit)
    read = read_published(folder)
    np.testing.assert_allclose(
        np.sort(read.location, axis=0), np.sort(source.location, axis=0), rtol=1e-6
    )
    assert "mm" in read.provenance.notes


def _turn(file: Any) -> None:
    """Make y dorsal, as in the public mesh: (x, z, -y) of the sensor frame; and turn the force."""
    for group, sign in (("contact_loc", 1.0), ("force_vec", -1.0)):
        x, y, z = file[group]["data"][()].T
        file[group]["data"][...] = sign * np.stack([x, z, -y], axis=1)


def test_other_axes_and_the_force_on_the_indenter(folder: Path, source: ExperimentDataset) -> None:
    for unit in (1, 2, 3):
        _edit(folder, _turn, unit)
    with pytest.raises(DatasetError, match="the pad looks to -z"):
        read_published(folder)
    with pytest.raises(DatasetError, match="the pad looks to -z"):
        read_published(folder, axes=("x", "-z", "y"))
    read = read_published(folder, axes=("x", "-z", "y"), force_on_indenter=True)
    for name in ("location", "force"):
        found, expected = getattr(read, name), getattr(source, name)
        np.testing.assert_array_equal(np.sort(found, axis=0), np.sort(expected, axis=0))


def test_every_command_takes_files_in_other_axes_and_of_the_units_that_are_there(
    make_rows: Callable[..., TrialRows], provenance: Provenance, tmp_path: Path
) -> None:
    trials = [
        make_rows(unit, f"cube/{point}/n") for unit in ("unit-2", "unit-3") for point in range(10)
    ]
    source = assemble_experiment(trials, provenance)
    folder, out = tmp_path / "published", tmp_path / "out"
    export_published(folder, source)
    for unit in (2, 3):
        _edit(folder, _turn, unit)
    report = ("report", "--data", folder, "--out", out, "--splits", "trajectory", "--so-far")
    for app, words, then in (
        (data_app, ("export", folder, out / "exported", "--published"), "None"),
        # Past reading: nothing is trained without the rest, nor to show what is finished.
        (train_app, ("all", folder, out / "models"), "rest of biotac-2 cube/0/n is not known"),
        (train_app, report, "no finished training"),
    ):
        arguments = [*map(str, words)]
        refused = CliRunner().invoke(app, arguments)
        assert "give --axes, and --force-on-indenter" in str(refused.exception)
        told = CliRunner().invoke(app, [*arguments, "--axes", "x,-z,y", "--force-on-indenter"])
        assert then in str(told.exception)
    exported = read_published(out / "exported")
    assert exported.unit_names == ("biotac-2", "biotac-3")
    np.testing.assert_array_equal(np.sort(exported.force, axis=0), np.sort(source.force, axis=0))


@pytest.mark.parametrize(
    ("axes", "words"),
    [(("x", "y", "y"), "are no axes"), (("x", "z", "y"), "mirror image")],
)
def test_axes_that_are_none_are_refused(folder: Path, axes: tuple[str, ...], words: str) -> None:
    with pytest.raises(DatasetError, match=words):
        read_published(folder, axes=axes)


def test_a_folder_of_another_data_set_says_which_files_can_be_named(tmp_path: Path) -> None:
    (tmp_path / "fingertip-01").mkdir()
    (tmp_path / "fingertip-01" / "mixed.h5").touch()
    with pytest.raises(DatasetError, match=r"none of the published .* in it: fingertip-01/mixed"):
        read_published(tmp_path)


def test_units_that_are_there_are_read_and_others_refused(folder: Path) -> None:
    (folder / "biotac2.hdf5").unlink()
    assert read_published(folder).unit_names == ("biotac-1", "biotac-3")
    with pytest.raises(DatasetError, match=r"biotac2.hdf5 is missing.*\[1, 3\]"):
        read_published(folder, units=[1, 2])
    with pytest.raises(DatasetError, match="no unit"):
        read_published(folder, units=[])


def _rename(file: Any) -> None:
    file.move("force_vec", "wrench")


def _drop_column(file: Any) -> None:
    values = file["electrode_vals"]["data"][:, :18]
    del file["electrode_vals/data"]
    file.create_dataset("electrode_vals/data", data=values)


def _drop_row(file: Any) -> None:
    values = file["contact_loc"]["data"][:-1]
    del file["contact_loc/data"]
    file.create_dataset("contact_loc/data", data=values)


def _repeat_first_trajectory(file: Any) -> None:
    for group in ("electrode_vals", "contact_loc", "force_vec", "indenter_type"):
        values = file[group]["data"][()]
        del file[f"{group}/data"]
        file.create_dataset(f"{group}/data", data=np.concatenate([values, values[:6]]))


def _shuffle(file: Any) -> None:
    order = np.random.default_rng(0).permutation(len(file["force_vec"]["data"]))
    for group in ("electrode_vals", "contact_loc", "force_vec", "indenter_type"):
        file[group]["data"][...] = file[group]["data"][()][order]


def _flat(file: Any) -> None:
    del file["force_vec"]
    file.create_dataset("force_vec", data=np.zeros((3, 3)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_rename, "no group force_vec or .*found contact_loc, electrode_vals, indenter_type, wren"),
        (_flat, "no group force_vec"),
        (lambda f: f.__delitem__("electrode_vals"), "no group electrode_vals"),
        (lambda f: f.__delitem__("indenter_type"), "no group indenter_type"),
        (_drop_column, r"electrodes is float32 \(40, 18\)"),
        (_drop_row, r"location is float32 \(39, 3\)"),
        (_scale("electrode_vals", 4095), "electrodes reach"),
        (_scale("electrode_vals", 0), "electrodes reach 0"),
        (_scale("contact_loc", 20), "neither in m nor in mm"),
        (_scale("contact_loc", 0.01), "neither in m nor in mm"),
        (_scale("force_vec", 1000), "not in N"),
        (_scale("force_vec", 0.1), "not in N"),
        (lambda f: f["force_vec/data"].__setitem__((3, 1), np.nan), "force is not finite in row 3"),
        (lambda f: f["indenter_type/data"].__setitem__((3, 0), 7), "indenter_type 7 has no name"),
        (_repeat_first_trajectory, r"row 40 repeats row 0 \(6 repeated rows"),
        (_shuffle, "no order of trajectories"),
    ],
)
def test_a_broken_file_is_named(folder: Path, change: Callable[[Any], None], words: str) -> None:
    _edit(folder, change)
    with pytest.raises(DatasetError, match=words) as caught:
        read_published(folder)
    assert "biotac2.hdf5" in str(caught.value)
    assert caught.value.remedy


def test_a_truncated_file_is_named(folder: Path) -> None:
    path = folder / "biotac3.hdf5"
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(DatasetError, match=r"biotac3.hdf5: not a readable HDF5 file"):
        read_published(folder)


def test_the_same_file_twice_is_named(folder: Path) -> None:
    shutil.copy(folder / "biotac2.hdf5", folder / "biotac3.hdf5")
    with pytest.raises(DatasetError, match=r"biotac3.hdf5 holds the same rows as biotac2.hdf5"):
        read_published(folder)


def test_other_names_of_the_force_and_plain_numbers_of_indenters(folder: Path) -> None:
    for unit in (1, 2, 3):
        _edit(folder, lambda f: f.move("force_vec", "forces"), unit)
        _edit(folder, lambda f: f["indenter_type/data"].attrs.__delitem__("names"), unit)
    read = read_published(folder)
    assert set(read.indenters) == {"indenter-0", "indenter-1"}
    assert len(read.trajectories) == len(PLAN)


def test_mixed_sets_are_exported_with_their_fields(mixed: MixedDataset, tmp_path: Path) -> None:
    files = export_published(tmp_path / "out", mixed)
    assert sorted(file.name for file in files) == [
        "biotac1.hdf5",
        "biotac1_simulated.hdf5",
        "biotac2.hdf5",
        "biotac2_simulated.hdf5",
    ]
    with h5py.File(tmp_path / "out" / "biotac2_simulated.hdf5") as file:
        np.testing.assert_array_equal(file["nodal_res"], mixed.displacement(slice(18, 30)))
        np.testing.assert_array_equal(file["force_res"], mixed.simulated_force[18:])


def test_units_keep_their_numbers(source: ExperimentDataset, tmp_path: Path) -> None:
    object.__setattr__(source, "unit_names", ("finger-2", "finger-7", "finger-1"))
    files = export_published(tmp_path / "out", source)
    assert [file.name for file in files] == ["biotac2.hdf5", "biotac7.hdf5", "biotac1.hdf5"]
    object.__setattr__(source, "unit_names", ("left", "right", "thumb"))
    files = export_published(tmp_path / "again", source)
    assert [file.name for file in files] == ["biotac1.hdf5", "biotac2.hdf5", "biotac3.hdf5"]


def test_a_table_of_text_has_every_row(mixed: MixedDataset, tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    assert export_csv(path, mixed) == 30
    with path.open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 30
    data = mixed.experiment
    assert lines[20]["unit"] == "biotac-2"
    assert lines[20]["trajectory"] == "cube/00/normal"
    assert np.float32(lines[20]["e7_tared"]) == data.tared[20, 6]
    assert np.float32(lines[20]["force_z_n"]) == data.force[20, 2]
    assert np.float32(lines[20]["location_x_m"]) == data.location[20, 0]
    assert np.float32(lines[20]["simulated_force_y_n"]) == mixed.simulated_force[20, 1]


def test_nothing_is_overwritten(folder: Path, source: ExperimentDataset, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="exists"):
        export_published(folder, source)
    (tmp_path / "rows.csv").write_text("mine")
    with pytest.raises(DatasetError, match="exists"):
        export_csv(tmp_path / "rows.csv", source)
    assert (tmp_path / "rows.csv").read_text() == "mine"


def test_a_failed_export_leaves_nothing(source: ExperimentDataset, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match="cannot write"):
        export_csv(tmp_path / "file" / "rows.csv", source)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
