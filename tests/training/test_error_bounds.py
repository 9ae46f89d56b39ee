"""Bounds of errors: whether they hold what they promise, on presses that no one has seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from palpate.errors import BundleError, DatasetError
from palpate.files.bundle import read_bundle
from palpate.files.training_range import KnownInputs
from palpate.messages import FloatArray
from palpate_training.datasets.features import FeatureDataset, joined, write_dataset
from palpate_training.learning import intervals
from palpate_training.learning.features_net import FeaturesNetConfig
from palpate_training.learning.intervals import (
    EVERY_TERM,
    LEVEL,
    Floats,
    Labels,
    bounds,
    covered,
    fit_formula,
    fit_formulas,
    press_quantile,
    terms_of,
)
from palpate_training.learning.ranges import known_inputs, places_of, strangeness, with_pattern
from palpate_training.tasks.features import train_features
from palpate_training.tasks.finger import train_finger
from palpate_training.tasks.intervals import PRESSES_LEAST, add_intervals, held_out_features

MakeData = Callable[..., FeatureDataset]


def _presses(seed: int, presses: int, rows: int = 40) -> tuple[Floats, Floats, Labels]:
    """Errors that grow with the force and differ from press to press; terms; presses."""
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.0, 10.0, (presses, rows))
    each = np.exp(rng.normal(0.0, 0.5, (presses, 1)))
    errors = np.abs(rng.normal(size=(presses, rows))) * each * (0.1 + 0.1 * size)
    nothing = np.zeros(presses * rows)
    press = np.repeat(np.arange(presses), rows)
    return errors.ravel(), terms_of(size.ravel(), nothing, nothing), press


def test_bounds_hold_on_presses_that_were_not_seen() -> None:
    """On average over what might have been drawn, which is what conformal prediction promises."""
    share = []
    for seed in range(12):
        errors, terms, press = _presses(seed, 40)
        formula = fit_formula("force", errors, terms, press)
        new_errors, new_terms, new_press = _presses(1000 + seed, 400)
        share.append(covered(new_errors, bounds(formula, new_terms), new_press))
    assert 0.89 < np.mean(share) < 0.95


def test_of_many_presses_some_rows_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    errors, terms, press = _presses(8, 300)
    seen: list[int] = []

    def counted(cost: Floats, **given: Any) -> Any:
        seen.append(len(given["b_eq"]))
        return linprog(cost, **given)

    monkeypatch.setattr(intervals, "linprog", counted)
    monkeypatch.setattr(intervals, "ROWS_MOST", 900)
    formula = fit_formula("force", errors, terms, press)
    assert max(seen) == 900  # three rows of each press
    new_errors, new_terms, new_press = _presses(1008, 400)
    assert 0.87 < covered(new_errors, bounds(formula, new_terms), new_press) < 0.93


@pytest.mark.parametrize("most", [150, 300, 600])
def test_of_more_presses_than_rows_each_part_is_seen(
    monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    """Presses begin and end with light touches: these alone tell nothing of hard ones."""
    errors, terms, press = _presses(8, 300)
    order = np.lexsort((terms[:, 1], press)).reshape(300, 40)
    ramps = np.hstack([order[:, ::2], order[:, ::-2]]).ravel()  # up and down
    seen: list[int] = []

    def counted(cost: Floats, **given: Any) -> Any:
        seen.append(len(given["b_eq"]))
        return linprog(cost, **given)

    monkeypatch.setattr(intervals, "linprog", counted)
    monkeypatch.setattr(intervals, "ROWS_MOST", most)
    formula = fit_formula("force", errors[ramps], terms[ramps], press)
    assert max(seen) <= most
    new_errors, new_terms, new_press = _presses(1008, 400)
    hard = new_terms[:, 1] > np.log1p(5.0)
    held = covered(new_errors[hard], bounds(formula, new_terms[hard]), new_press[hard])
    assert 0.85 < held < 0.95


def test_bounds_follow_the_errors() -> None:
    errors, terms, press = _presses(3, 60)
    formula = fit_formula("force", errors, terms, press)
    light, hard = (bounds(formula, terms_of(*np.array([[n], [0.0], [0.0]])))[0] for n in (0.5, 9.0))
    assert 2.5 * light < hard < 15.0 * light  # the truth: 6.7 times as much
    same = fit_formula("force", errors, terms, press, use=(True, *(False,) * 4))
    assert same.weights[1:] == (0.0,) * 4
    new_errors, new_terms, new_press = _presses(4, 400)
    hardest = new_terms[:, 1] > np.log1p(8.0)
    # One width for all frames holds too few hard ones; that is why it follows the frame.
    in_hard = [
        covered(new_errors[hardest], bounds(one, new_terms[hardest]), new_press[hardest])
        for one in (formula, same)
    ]
    assert in_hard[0] > 0.85 > in_hard[1]


def test_a_press_counts_once_however_long_it_is() -> None:
    scores = np.concatenate([np.full(1000, 5.0), np.arange(1.0, 20.0)])
    press = np.concatenate([np.zeros(1000, int), np.arange(1, 20)])
    assert press_quantile(scores, press, 0.5) == 10.0
    # 20 presses and the next one: nine tenths of 21 are 18.9.
    assert press_quantile(scores, press, 0.9) == 18.0
    # So few presses promise nothing: the worst that was seen is taken.
    assert press_quantile(scores[-3:], press[-3:], 0.9) == 19.0


def test_rows_without_an_error_do_not_count() -> None:
    errors, terms, press = _presses(5, 30)
    holes = errors.copy()
    holes[::2] = np.nan
    some = fit_formulas(
        {"force": holes, "contact_location": np.full_like(errors, np.nan)}, terms, press
    )
    assert [one.name for one in some] == ["force"]
    assert some[0] == fit_formula("force", errors[1::2], terms[1::2], press[1::2])


@pytest.mark.parametrize("presses", [1, 2, 6])
def test_few_presses_give_finite_bounds(presses: int) -> None:
    errors, terms, press = _presses(6, presses)
    formula = fit_formula("force", errors, terms, press, use=EVERY_TERM)
    assert np.isfinite(bounds(formula, terms)).all()
    assert covered(errors, bounds(formula, terms), press) > 0.9


def test_errors_of_zero_have_a_bound() -> None:
    errors, terms, press = _presses(7, 30)
    formula = fit_formula("force", np.zeros_like(errors), terms, press)
    assert (bounds(formula, terms) > 0.0).all()


def _rows(data: FeatureDataset) -> KnownInputs:
    return known_inputs(data.tared_counts, data.group)


def test_a_pattern_knows_what_breaks_its_rules(press_data: MakeData) -> None:
    """Electrodes that each lie where they always lie, but not together."""
    rows = press_data(presses=80, rows=30).tared_counts
    known = _rows(press_data(presses=80, rows=30))
    assert known.pattern is not None
    assert np.mean(strangeness(known.pattern, rows) > 1.0) < 0.02
    mixed = np.column_stack([np.random.default_rng(k).permutation(rows[:, k]) for k in range(19)])
    assert np.mean(strangeness(known.pattern, mixed) > 1.0) > 0.95
    stuck = rows.copy()
    stuck[:, 6] = 400.0
    assert np.mean(strangeness(known.pattern, stuck) > 1.0) > 0.95


@pytest.mark.parametrize("rows", [10, 40])
def test_new_presses_are_as_strange_as_those_held_out(rows: int) -> None:
    """The strangest rows are representatives; these, too, are held out with their press."""
    counts, press = _local_presses(360, rows)
    learned = press < 60
    known = known_inputs(counts[learned], press[learned])
    assert known.pattern is not None
    assert np.mean(strangeness(known.pattern, counts[~learned]) > 1.0) < 0.02


def _local_presses(presses: int, rows: int) -> tuple[FloatArray, Labels]:
    """Tared counts of presses that each move the electrodes near one place; the press of each."""
    rng = np.random.default_rng(0)
    place, width = (rng.uniform(*ends, (presses, 1, 1)) for ends in ((-1.0, 1.0), (0.2, 0.4)))
    rise = np.sin(np.linspace(0.1, 3.0, rows))[:, None]
    depth = rise * rng.uniform(100.0, 800.0, (presses, 1, 1))
    counts = -depth * np.exp(-(((np.linspace(-1.0, 1.0, 19) - place) / width) ** 2))
    told: FloatArray = np.round(counts + rng.normal(0.0, 2.0, counts.shape)).astype(np.float32)
    return told.reshape(-1, 19), np.repeat(np.arange(presses), rows)


def test_an_electrode_that_never_changed_is_no_rule_made_of_rounding(press_data: MakeData) -> None:
    data = press_data(presses=80, rows=30)
    rows = data.tared_counts.copy()
    rows[:, 6] = 37.3
    bare = replace(known_inputs(rows, data.group), pattern=None)
    known, strange = with_pattern(bare, rows, data.group, among=True)
    assert known.pattern is not None
    assert np.mean(strange > 1.0) < 0.02
    moved = rows.copy()
    moved[:, 6] = 37.31
    assert np.mean(strangeness(known.pattern, moved) > 1.0) < 0.02
    moved[:, 6] = 200.0
    assert np.mean(strangeness(known.pattern, moved) > 1.0) > 0.95


def test_few_presses_know_no_pattern(press_data: MakeData) -> None:
    known = _rows(press_data(presses=20))
    assert known.pattern is None
    distance, _ = places_of(known, press_data(presses=20).tared_counts)
    assert (distance <= 1.0).mean() > 0.95


QUICK = FeaturesNetConfig(members=2, width=32, blocks=1, epochs=25, batch_rows=64)


@pytest.fixture
def trained(press_data: MakeData, tmp_path: Path) -> Path:
    write_dataset(tmp_path / "train.h5", press_data(presses=30))
    train_features(tmp_path / "train.h5", tmp_path / "old", config=QUICK)
    return tmp_path / "old"


def test_a_trained_bundle_has_bounds(trained: Path) -> None:
    intervals = read_bundle(trained).manifest.intervals
    assert intervals is not None
    assert intervals.level == LEVEL
    assert [one.name for one in intervals.formulas] == [
        "force_magnitude",
        "force",
        "contact_location",
    ]
    assert intervals.others == ()


def test_a_bundle_gets_bounds_and_keeps_its_answers(
    press_data: MakeData, trained: Path, tmp_path: Path
) -> None:
    held_out = press_data(presses=40, seed=1)
    write_dataset(tmp_path / "held.h5", held_out)
    other = replace(press_data(presses=8, seed=2), sensor_names=("another",))
    write_dataset(tmp_path / "other.h5", other)
    add_intervals(trained, [tmp_path / "held.h5"], tmp_path / "2", others=[tmp_path / "other.h5"])
    old, new = read_bundle(trained), read_bundle(tmp_path / "2")
    assert (new.model, new.manifest.metrics) == (old.model, old.manifest.metrics)
    assert new.manifest.version == 2
    for name, rows in old.golden.items():
        np.testing.assert_array_equal(new.golden[name], rows)
    intervals = new.manifest.intervals
    assert intervals is not None
    assert intervals.presses == 40
    assert intervals.data_sha256 == held_out.content_sha256()
    assert [one.name for one in intervals.others] == ["force_magnitude", "force"]
    assert "another" in intervals.others_source
    # So few presses do not know how the values of an input go together.
    assert old.known_inputs is not None
    assert new.known_inputs is not None
    assert new.known_inputs.pattern is old.known_inputs.pattern is None
    found = held_out_features(new, held_out)
    share = covered(
        found.errors["force"],
        bounds(intervals.formulas[1], found.terms(new.known_inputs)),
        found.press,
    )
    assert share > 0.88


def test_each_other_sensor_counts_once(press_data: MakeData, trained: Path, tmp_path: Path) -> None:
    """Bounds hold for every one that is given: its presses tell nothing of the next sensor."""
    write_dataset(tmp_path / "held.h5", press_data(presses=60, seed=1))
    sensors = [
        replace(press_data(presses=30, seed=2 + k), sensor_names=(f"other-{k}",)) for k in range(2)
    ]
    # The presses of the second are pieces of one recording.
    sensors[1] = replace(sensors[1], group=np.zeros_like(sensors[1].group))
    paths = [tmp_path / f"{k}.h5" for k in range(2)]
    for path, sensor in zip(paths, sensors, strict=True):
        write_dataset(path, sensor)
    add_intervals(trained, [tmp_path / "held.h5"], tmp_path / "2", others=paths)
    new = read_bundle(tmp_path / "2")
    assert new.manifest.intervals is not None
    assert new.known_inputs is not None
    assert new.known_inputs.pattern is not None
    for sensor in sensors:
        found = held_out_features(new, sensor)
        wide = bounds(new.manifest.intervals.others[0], found.terms(new.known_inputs))
        assert np.mean(found.errors["force_magnitude"] <= wide) > 0.97


def test_recordings_of_one_other_sensor_count_once(
    press_data: MakeData, trained: Path, tmp_path: Path
) -> None:
    """A second recording of a sensor is no second sensor, however many of its rows there are."""
    write_dataset(tmp_path / "held.h5", press_data(presses=40, seed=1))
    recordings = [
        replace(press_data(presses=30, seed=2 + k), sensor_names=("another",)) for k in range(2)
    ]
    paths = [tmp_path / f"{k}.h5" for k in range(2)]
    for path, recording in zip(paths, recordings, strict=True):
        write_dataset(path, recording)
    write_dataset(tmp_path / "both.h5", joined(recordings))
    found = []
    for k, others in enumerate((paths, [tmp_path / "both.h5"])):
        add_intervals(trained, [tmp_path / "held.h5"], tmp_path / f"{2 + k}", others=others)
        found.append(read_bundle(tmp_path / f"{2 + k}").manifest.intervals)
    apart, together = found
    assert apart is not None
    assert together is not None
    assert apart.others == together.others
    assert apart.others_source == together.others_source


def test_presses_of_other_sensors_are_given_once(
    press_data: MakeData, trained: Path, tmp_path: Path
) -> None:
    """Twice they would count as two sensors, or a sensor it is made for as another one."""
    write_dataset(tmp_path / "held.h5", press_data(presses=40, seed=1))
    write_dataset(tmp_path / "other.h5", press_data(presses=8, seed=2))
    renamed = replace(press_data(presses=8, seed=2), sensor_names=("another",))
    write_dataset(tmp_path / "renamed.h5", renamed)
    for others in (("other", "other"), ("other", "renamed"), ("held",)):
        with pytest.raises(DatasetError, match="hold the same presses"):
            add_intervals(
                trained,
                [tmp_path / "held.h5"],
                tmp_path / "2",
                others=[tmp_path / f"{name}.h5" for name in others],
            )
    assert not (tmp_path / "2").exists()


def test_what_cannot_calibrate_is_refused(
    press_data: MakeData, trained: Path, tmp_path: Path
) -> None:
    out = tmp_path / "2"
    with pytest.raises(DatasetError, match="was trained on presses of"):
        add_intervals(trained, [tmp_path / "train.h5"], out)
    # The same rows with other numbers of presses, as they come back from a table.
    seen = press_data(presses=30)
    renumbered = replace(seen, group=29 - seen.group, block=29 - seen.block)
    write_dataset(tmp_path / "again.h5", renumbered)
    with pytest.raises(DatasetError, match=r"was trained on presses of .*again\.h5"):
        add_intervals(trained, [tmp_path / "again.h5"], out)
    write_dataset(tmp_path / "half.h5", press_data(presses=PRESSES_LEAST // 2, seed=1))
    with pytest.raises(DatasetError, match="hold the same presses"):
        add_intervals(trained, [tmp_path / "half.h5", tmp_path / "half.h5"], out)
    half = press_data(presses=PRESSES_LEAST // 2, seed=1)
    late = replace(half, force=np.roll(half.force, 2, axis=0))
    write_dataset(tmp_path / "late.h5", late)
    with pytest.raises(DatasetError, match="hold the same presses"):
        add_intervals(trained, [tmp_path / "half.h5", tmp_path / "late.h5"], out)
    write_dataset(tmp_path / "few.h5", press_data(presses=PRESSES_LEAST - 1, seed=1))
    with pytest.raises(DatasetError, match=f"{PRESSES_LEAST} are needed"):
        add_intervals(trained, [tmp_path / "few.h5"], out)
    with pytest.raises(BundleError, match="exists and bundles are immutable"):
        add_intervals(trained, [tmp_path / "few.h5"], trained)
    data = press_data(presses=2)
    still = np.zeros(len(data), bool)
    write_dataset(tmp_path / "still.h5", replace(data, in_contact=still))
    with pytest.raises(DatasetError, match="no row is in contact"):
        add_intervals(trained, [tmp_path / "still.h5"], out)
    assert not out.exists()


def test_a_fingers_own_bundle_has_bounds(press_data: MakeData, tmp_path: Path) -> None:
    data = press_data(presses=24)
    train_finger(data, tmp_path / "b", name="features-mine", serials=["BT-7"])
    intervals = read_bundle(tmp_path / "b").manifest.intervals
    assert intervals is not None
    assert [one.name for one in intervals.formulas] == ["force_magnitude", "force"]
    assert "held out" in intervals.source
