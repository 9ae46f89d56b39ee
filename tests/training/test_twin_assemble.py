"""Trials put together: order, duplicates and damage; and rows of features made of them."""

from __future__ import annotations

import importlib
import itertools
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate_training.datasets.assembly import assemble_experiment, assemble_mixed
from palpate_training.datasets.basis import encode, subset
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import ExperimentDataset, MixedDataset, content_sha256
from palpate_training.datasets.export import features
from palpate_training.datasets.trials import MixedRows, TrialRows
from palpate_training.experiment.generate import data_sets
from palpate_training.experiment.generate.trials import TrialsDone, file_of, pack
from palpate_training.experiment.generate.workers import WorkerProcesses

sys.path.append(str(Path(__file__).parent))  # worker processes import the store by name
stores: Any = importlib.import_module("plane_store")
PlaneStore, PRESSES = stores.PlaneStore, stores.PRESSES

MakeRows = Callable[..., TrialRows]


def test_rows_belong_to_the_trials_they_came_from(
    experiment: ExperimentDataset, make_rows: MakeRows
) -> None:
    assert experiment.unit_names == ("biotac-1", "biotac-2")
    assert experiment.trajectories == ("cube/00/normal", "sphere/00/normal", "sphere/01/angled-2")
    assert experiment.indenters == ("cube", "sphere", "sphere")
    assert len(experiment) == 5 + 6 + 7 + 8 + 9
    assert experiment.trial_name(4) == "biotac-2 sphere/01/angled-2"
    assert experiment.rows_of(4) == slice(26, 35)
    source = make_rows("biotac-2", "sphere/01/angled-2", rows=9)
    np.testing.assert_array_equal(experiment.tared[26:35], source.tared.astype(np.float32))
    np.testing.assert_array_equal(experiment.trial_rest[4], source.rest.astype(np.float32))
    np.testing.assert_array_equal(experiment.row_unit[26:35], 1)
    np.testing.assert_array_equal(experiment.row_trajectory[26:35], 2)


def test_the_order_in_which_trials_finish_does_not_matter(
    make_rows: MakeRows, provenance: Provenance
) -> None:
    trials = [
        make_rows(unit, trajectory)
        for unit, trajectory in itertools.product(("b", "a"), ("ring/1/n", "cube/0/n"))
    ]
    hashes = {
        content_sha256(assemble_experiment(order, provenance))
        for order in itertools.permutations(trials)
    }
    assert len(hashes) == 1


def _broken(rows: TrialRows, name: str, shape: tuple[int, ...] | None) -> TrialRows:
    values = getattr(rows, name).copy()
    if shape is None:
        values[2] = np.nan
    else:
        values = np.zeros(shape)
    return replace(rows, **{name: values})


@pytest.mark.parametrize(
    ("name", "shape", "words"),
    [
        ("tared", (6, 18), r"tared has shape \(6, 18\)"),
        ("force", (5, 3), r"force has shape \(5, 3\)"),
        ("travel_m", (0,), "at least one row"),
        ("rest", (18,), r"rest has shape \(18,\)"),
        ("location", None, "location is not finite in row 2"),
        ("travel_m", None, "travel_m is not finite in row 2"),
    ],
)
def test_a_damaged_trial_is_named(
    make_rows: MakeRows,
    provenance: Provenance,
    name: str,
    shape: tuple[int, ...] | None,
    words: str,
) -> None:
    trials = [make_rows("a", "cube/0/n"), _broken(make_rows("b", "cube/0/n"), name, shape)]
    with pytest.raises(DatasetError, match=words) as caught:
        assemble_experiment(trials, provenance)
    assert caught.value.problem.startswith("b cube/0/n")


def test_what_does_not_fit_together_is_refused(make_rows: MakeRows, provenance: Provenance) -> None:
    one = make_rows("a", "cube/0/n")
    with pytest.raises(DatasetError, match="a cube/0/n is there twice"):
        assemble_experiment([one, make_rows("b", "cube/0/n"), one], provenance)
    other = make_rows("b", "cube/0/n")
    other = replace(other, header=replace(other.header, indenter="ring"))
    with pytest.raises(DatasetError, match="b cube/0/n: indenter ring, on another unit cube"):
        assemble_experiment([one, other], provenance)
    with pytest.raises(DatasetError, match="not among c"):
        assemble_experiment([one], provenance, unit_names=("c",))
    with pytest.raises(DatasetError, match="no trials"):
        assemble_experiment([], provenance)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"trial": np.zeros(35, np.int32)}, "each of 0..4"),
        ({"force": np.zeros((35, 3))}, "force is float64"),
        ({"trial_unit": np.array([0, 0, 0, 1, 2], np.int32)}, "trial_unit holds 0..2"),
        ({"trial_trajectory": np.array([0, 1, 2, 0, 0], np.int32)}, "cube/00/normal is there twic"),
        ({"indenters": ("cube",)}, "1 indenters for 3 trajectories"),
        ({"unit_names": ("same", "same")}, "'same' is named twice"),
        ({"tared": np.full((35, 19), np.nan, np.float32)}, "trial biotac-1 cube/00/normal"),
        ({"trial_rest": np.full((5, 19), np.inf, np.float32)}, "trial_rest is infinite"),
        ({"travel_m": np.zeros(34, np.float32)}, "travel_m is float32"),
    ],
)
def test_content_that_breaks_the_contract_is_refused(
    experiment: ExperimentDataset, change: dict[str, object], words: str
) -> None:
    with pytest.raises(DatasetError, match=words):
        replace(experiment, **change)  # type: ignore[arg-type]


def test_rows_out_of_order_are_refused(experiment: ExperimentDataset) -> None:
    trial = experiment.trial.copy()
    trial[[4, 5]] = trial[[5, 4]]
    with pytest.raises(DatasetError, match="row 5 belongs to an earlier trial"):
        replace(experiment, trial=trial)


def test_mixed_rows_keep_their_fields(mixed: MixedDataset, mixed_rows: list[MixedRows]) -> None:
    assert len(mixed) == 30
    for trial, source in enumerate(mixed_rows):
        rows = mixed.experiment.rows_of(trial)
        np.testing.assert_allclose(mixed.displacement(rows), source.displacement, atol=2e-6)
        np.testing.assert_allclose(mixed.simulated_force[rows], source.simulated_force, rtol=1e-6)
    assert mixed.basis.loss_mean < 1e-6
    assert len(mixed.basis.modes) <= 3


def test_fields_follow_their_trial_when_sorted(
    mixed: MixedDataset, mixed_rows: list[MixedRows]
) -> None:
    again = assemble_mixed(mixed_rows[::-1], mixed.basis, mixed.mesh, mixed.experiment.provenance)
    assert content_sha256(again) == content_sha256(mixed)


def test_a_field_of_another_mesh_is_refused(
    mixed: MixedDataset, mixed_rows: list[MixedRows]
) -> None:
    wrong = replace(mixed_rows[1], displacement=mixed_rows[1].displacement[:, :-1])
    with pytest.raises(
        DatasetError, match=r"sphere/00/normal: displacement has shape \(6, 11, 3\)"
    ):
        assemble_mixed([wrong], mixed.basis, mixed.mesh, mixed.experiment.provenance)
    with pytest.raises(DatasetError, match="basis mean is"):
        replace(mixed, basis=replace(mixed.basis, mean=mixed.basis.mean[:-1]))


def test_features_have_the_tared_values_back(experiment: ExperimentDataset) -> None:
    rows = features(experiment, untouched_rows=2)
    assert rows.in_contact is not None
    assert rows.contact_location is not None
    touching = rows.in_contact
    assert len(rows) == len(experiment) + 2 * 5
    # Half a count of rounding.
    np.testing.assert_allclose(
        rows.tared_counts[touching] / 4095, experiment.tared, atol=0.5001 / 4095
    )
    np.testing.assert_array_equal(rows.force[touching], experiment.force)
    np.testing.assert_array_equal(rows.contact_location[touching], experiment.location)
    np.testing.assert_array_equal(rows.sensor[touching], experiment.row_unit)
    np.testing.assert_array_equal(rows.group[touching], experiment.row_trajectory)
    np.testing.assert_array_equal(rows.block, rows.group)
    assert rows.sensor_names == experiment.unit_names


def test_untouched_rows_are_at_rest_before_each_trial(experiment: ExperimentDataset) -> None:
    rows = features(experiment, untouched_rows=2)
    assert rows.in_contact is not None
    assert rows.contact_location is not None
    np.testing.assert_array_equal(
        np.flatnonzero(~rows.in_contact), [0, 1, 7, 8, 15, 16, 24, 25, 34, 35]
    )
    untouched = ~rows.in_contact
    np.testing.assert_array_equal(rows.electrodes[untouched], rows.baseline[untouched])
    np.testing.assert_array_equal(rows.baseline[untouched][::2], experiment.trial_rest)
    np.testing.assert_array_equal(rows.force[untouched], 0)
    assert np.isnan(rows.contact_location[untouched]).all()
    np.testing.assert_array_equal(rows.sensor[untouched], [0] * 6 + [1] * 4)
    assert features(experiment, untouched_rows=0).in_contact is not None


def test_features_clip_to_what_the_converter_can_say(experiment: ExperimentDataset) -> None:
    tared = experiment.tared.copy()
    tared[3, :2] = [-0.99, 0.99]
    rows = features(replace(experiment, tared=tared), untouched_rows=0)
    np.testing.assert_array_equal(rows.electrodes[3, :2], [0, 4095])


def test_an_unknown_rest_must_be_assumed_by_the_user(experiment: ExperimentDataset) -> None:
    rest = experiment.trial_rest.copy()
    rest[1] = np.nan
    data = replace(experiment, trial_rest=rest)
    with pytest.raises(DatasetError, match=r"biotac-1 sphere/00/normal is not known \(1 of 5"):
        features(data)
    rows = features(data, assumed_rest=3300)
    np.testing.assert_array_equal(rows.baseline[rows.group == 1], 3300)
    np.testing.assert_array_equal(rows.baseline[:4], np.tile(rest[0], (4, 1)))
    with pytest.raises(
        DatasetError, match="with a rest of 100 counts electrodes read from -"
    ) as no:
        features(data, assumed_rest=100)
    lowest = int(no.value.remedy.split()[4])
    assert features(data, assumed_rest=lowest).electrodes.min() == 0
    with pytest.raises(DatasetError, match="with a rest of"):
        features(data, assumed_rest=lowest - 1)


def test_a_subset_holds_these_trials_alone(experiment: ExperimentDataset) -> None:
    few = subset(experiment, [4, 1])
    assert few.trials == 2
    assert few.unit_names == ("biotac-1", "biotac-2")
    assert few.trajectories == ("sphere/00/normal", "sphere/01/angled-2")
    assert [few.trial_name(i) for i in range(2)] == [
        "biotac-1 sphere/00/normal",
        "biotac-2 sphere/01/angled-2",
    ]
    for new, old in enumerate((1, 4)):
        for name in ("tared", "force", "location", "travel_m"):
            np.testing.assert_array_equal(
                getattr(few, name)[few.rows_of(new)],
                getattr(experiment, name)[experiment.rows_of(old)],
            )
        np.testing.assert_array_equal(few.trial_rest[new], experiment.trial_rest[old])
    assert subset(experiment, [3]).unit_names == ("biotac-2",)
    with pytest.raises(DatasetError, match="no trial 5"):
        subset(experiment, [0, 5])
    with pytest.raises(DatasetError, match="no trials"):
        subset(experiment, [])


def test_a_mixed_subset_keeps_its_fields(mixed: MixedDataset) -> None:
    few = subset(mixed, [0, 4])
    np.testing.assert_array_equal(
        few.displacement(slice(6, 12)), mixed.displacement(mixed.experiment.rows_of(4))
    )


Assemble = Callable[..., data_sets.AssembledSets]


@pytest.fixture
def executed(tmp_path: Path, make_rows: MakeRows, provenance: Provenance) -> Assemble:
    """Assembles trials of two units on all presses, one of which gave no rows on one unit."""
    folder, store = tmp_path / "trials", PlaneStore(tmp_path / "store")
    folder.mkdir()
    store.path.write_text("")
    for name in PRESSES:
        lost = (("b", "not found"),) if name == "cube/00/normal" else ()
        rows = tuple(make_rows(unit, name) for unit in ("a", "b")[: 2 - len(lost)])
        done = TrialsDone(name, rows, lost, {"a": np.zeros((9, 19))}, believed=8)
        file_of(folder, name).write_bytes(pack(done))
    return partial(
        data_sets.assemble,
        store,
        folder,
        ("a", "b"),
        provenance,
        clearance_m=0.0,
        on_progress=lambda *_: None,
    )


@pytest.fixture(scope="module")
def processes() -> Iterator[WorkerProcesses]:
    pool = WorkerProcesses(2)
    yield pool
    pool.close()


def test_trials_that_cannot_be_mixed_are_dropped_with_a_reason(executed: Assemble) -> None:
    done = executed()
    assert [trial for trial, _ in done.dropped] == [
        "a cube/03/normal",
        "b cube/00/normal",
        "b cube/03/normal",
    ]
    reasons = dict(done.dropped)
    assert reasons["b cube/00/normal"] == "not found"
    assert reasons["a cube/03/normal"].startswith("the simulation reaches 0.1 N")
    assert done.experiment.trials == 2 * len(PRESSES) - 1
    assert done.mixed.experiment.trials == 2 * len(PRESSES) - 3
    assert done.mixed.basis.loss_mean < 1e-6


def test_processes_make_the_same_data_sets(
    executed: Assemble, processes: WorkerProcesses, tmp_path: Path
) -> None:
    here = executed()
    there = executed(runner=processes, open_store=PlaneStore)
    assert content_sha256(there.experiment) == content_sha256(here.experiment)
    assert content_sha256(there.mixed) == content_sha256(here.mixed)
    assert there.dropped == here.dropped
    assert all(path.suffix == ".npz" for path in (tmp_path / "trials").iterdir()), "left behind"


@pytest.mark.parametrize(
    ("open_store", "sees_files"), [(None, True), (PlaneStore, False)], ids=["store", "files"]
)
def test_workers_that_cannot_read_do_nothing(
    executed: Assemble, open_store: Any, *, sees_files: bool
) -> None:
    class Elsewhere:
        def __init__(self) -> None:
            self.sees_files = sees_files

        def run(self, function: Any, tasks: Any) -> Any:
            raise AssertionError("asked to work")

    done = executed(runner=Elsewhere(), open_store=open_store)
    assert content_sha256(done.mixed) == content_sha256(executed().mixed)


def test_errors_of_processes_name_the_trial(
    executed: Assemble, processes: WorkerProcesses, tmp_path: Path
) -> None:
    (tmp_path / "store").write_text("sphere/02/normal")
    for more in ({}, {"runner": processes, "open_store": PlaneStore}):
        with pytest.raises(DatasetError, match=r"35, 3\), the first had|one mesh"):
            executed(**more)
    (tmp_path / "store").write_text("")
    damaged = file_of(tmp_path / "trials", "sphere/02/normal")
    damaged.write_bytes(b"half")
    for more in ({}, {"runner": processes, "open_store": PlaneStore}):
        with pytest.raises(DatasetError, match=r"sphere__02__normal\.npz: not a readable"):
            executed(**more)


def test_bases_of_some_trajectories_serve_all(
    executed: Assemble,
    processes: WorkerProcesses,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Four of ten are fitted; what is lost is measured on all, by the processes too."""
    whole = executed().mixed
    monkeypatch.setattr(data_sets, "FIT_TRAJECTORIES", 4)
    read: list[str] = []
    real = PlaneStore.trajectory

    def counted(store: Any, name: str) -> Any:
        read.append(name)
        return real(store, name)

    monkeypatch.setattr(PlaneStore, "trajectory", counted)
    some = executed().mixed
    assert read[:4] == [PRESSES[k] for k in (0, 3, 6, 9)]
    assert read[4:] == list(PRESSES)
    monkeypatch.undo()
    assert len(some.basis.modes) < len(whole.basis.modes)
    assert some.basis.loss_mean > whole.basis.loss_mean
    store = PlaneStore(tmp_path / "store")
    steps = [step for name in PRESSES for step in store.trajectory(name).steps]
    moved = np.array([step.displacement for step in steps], np.float32)
    moved = np.concatenate([moved, np.zeros((len(PRESSES), 36, 3), np.float32)])  # first touch
    left = np.linalg.norm(moved - some.basis.decode(encode(some.basis, moved)), axis=2)
    assert some.basis.loss_mean == pytest.approx(left.mean(), rel=1e-4)
    assert some.basis.loss_max == pytest.approx(left.max(), rel=1e-4)
    monkeypatch.setattr(data_sets, "FIT_TRAJECTORIES", 4)
    again = executed(runner=processes, open_store=PlaneStore).mixed
    assert content_sha256(again) == content_sha256(some)


def test_a_field_of_another_mesh_beyond_the_fit_is_named(
    executed: Assemble,
    processes: WorkerProcesses,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(data_sets, "FIT_TRAJECTORIES", 4)
    (tmp_path / "store").write_text("sphere/02/normal")
    for more in ({}, {"runner": processes, "open_store": PlaneStore}):
        with pytest.raises(DatasetError, match=r"^sphere/02/normal: displacement has shape"):
            executed(**more)
