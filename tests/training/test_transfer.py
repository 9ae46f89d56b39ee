"""Force on a finger that training has not met: invented fingers with one physics."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from typer.testing import CliRunner

from palpate.anatomy import ELECTRODE_MIRROR
from palpate.errors import ConfigError, DatasetError
from palpate_training.cli import train_app
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.features import FeatureDataset, write_dataset
from palpate_training.datasets.ingest import ingest_lasa
from palpate_training.evaluation.transfer import (
    Finger,
    as_dict,
    fingers_of,
    remarks,
    run_transfer,
    summary,
    worst_of,
)
from palpate_training.learning.twin_line import TwinLine, fit_line, read_line, write_line
from palpate_training.systems import transfer
from palpate_training.systems.transfer import FingerRecording, ForceTransfer, LabelledPresses

Floats = npt.NDArray[np.float64]

ROWS = 1600
ALL_ROWS = transfer.SOURCE_ROWS

GOALS = {0: (0.24, 0.125), 5: (0.26, 0.08)}
"""Median error of the magnitude [N] and angle [rad] of the worse real finger, by presses."""


def pattern(force: Floats) -> Floats:
    """Logarithms of the impedance over that at rest, (N, 19).

    The mirror image of a force gives the mirror image of the pattern.
    """
    random = np.random.default_rng(7)
    weight = random.normal(0.0, 0.05, (3, 19))
    weight = 0.5 * (weight + np.array([[1.0], [-1.0], [1.0]]) * weight[:, ELECTRODE_MIRROR])
    return np.asarray(np.tanh(force @ weight))


def invented(
    seed: int,
    *,
    conductivity: float = 0.0,
    sensitivity: float = 1.0,
    rest: tuple[float, float] = (2400.0, 3000.0),
    name: str = "",
) -> FeatureDataset:
    """A finger in ordinary use; ``conductivity`` shifts all its logarithms since the tare."""
    random = np.random.default_rng(seed)
    steps = random.normal(size=(ROWS, 3)).cumsum(axis=0)
    steps -= np.linspace(0.0, 1.0, ROWS)[:, None] * steps[-1]
    force = np.array([0.0, 0.0, 4.0]) + np.array([1.0, 0.7, 1.2]) * steps / steps.std(axis=0)
    force[:, 2] = np.maximum(force[:, 2], 0.5)
    baseline = random.uniform(*rest, 19)
    ratio = 4095.0 / baseline - 1.0
    logs = sensitivity * pattern(force) + random.normal(0.0, 0.002, (ROWS, 19)) + conductivity
    counts = np.clip(np.rint(4095.0 / (1.0 + ratio * np.exp(logs))), 0, 4095)
    return FeatureDataset(
        electrodes=counts.astype(np.uint16),
        baseline=np.tile(baseline, (ROWS, 1)).astype(np.float32),
        force=force.astype(np.float32),
        group=np.zeros(ROWS, np.int32),
        block=np.zeros(ROWS, np.int32),
        sensor=np.zeros(ROWS, np.int32),
        sensor_names=(name or f"finger-{seed}",),
        provenance=Provenance("invented", "", "", "", ""),
    )


def finger(seed: int, *, conductivity: float = 0.0) -> Finger:
    return fingers_of(invented(seed, conductivity=conductivity))[0]


@pytest.fixture(scope="module", autouse=True)
def few_rows() -> Iterator[None]:
    """Real fingers give more rows, which take longer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(transfer, "SOURCE_ROWS", 150)
        yield


@pytest.fixture(scope="module")
def model(few_rows: None) -> ForceTransfer:
    """Fitted to the first finger."""
    return ForceTransfer([finger(1).recording])


def test_a_finger_that_was_never_met_is_estimated_better_than_by_the_mean() -> None:
    result = run_transfer([finger(1)], finger(2))
    assert result["magnitude_median_n"] < 0.3 * result["constant"]["magnitude_median_n"]
    assert result["angle_median_rad"] < 0.3 * result["constant"]["angle_median_rad"]
    assert 0.0 < result["magnitude_median_n"] < result["magnitude_p95_n"]
    assert 0.5 < result["coverage_90"] <= 1.0


def test_a_common_offset_changes_nothing(
    model: ForceTransfer,
) -> None:
    """Conductivity and temperature multiply all impedances: no reason to see another force."""
    plain, shifted = finger(2).recording, finger(2, conductivity=0.05).recording
    for unlabelled in (False, True):
        moved = model.estimate(shifted, unlabelled=unlabelled) - model.estimate(
            plain, unlabelled=unlabelled
        )
        # A count is about 0.001 of a logarithm.
        assert np.abs(moved).max() < 0.1 + (0.2 if unlabelled else 0.0)


def test_a_press_corrects_most_what_comes_just_before_and_after_it(model: ForceTransfer) -> None:
    """Baselines wander within half a minute, but not from one recording to the next."""
    whole = replace(finger(2).recording, period_s=0.1)
    estimate = whole.force - np.array([0.0, 0.0, 0.5])
    rows = np.arange(800, 820)
    labelled = LabelledPresses(rows, np.zeros(20, np.int64))
    by = np.linalg.norm(model.correct(whole, estimate, labelled).force - estimate, axis=1)
    near, far = np.r_[760:790, 830:860], np.r_[0:300, 1300:1600]
    assert by[near].mean() > 2.0 * by[far].mean()
    ended = replace(whole, segment=(np.arange(ROWS) >= 825).astype(np.int64))
    after = np.linalg.norm(model.correct(ended, estimate, labelled).force - estimate, axis=1)
    assert after[830:860].mean() < 0.85 * by[830:860].mean()
    np.testing.assert_allclose(after[760:790], by[760:790])


def test_without_labels_a_row_depends_on_the_tare_and_the_rows_before_it_only(
    model: ForceTransfer,
) -> None:
    whole = finger(2).recording
    some = replace(
        whole,
        electrodes=whole.electrodes[:800],
        baseline=whole.baseline[:800],
        segment=whole.segment[:800],
        force=whole.force[:800],
    )
    early = model.estimate(whole, unlabelled=False)[:800]
    np.testing.assert_allclose(model.estimate(some, unlabelled=False), early, atol=1e-9)


def test_a_moving_mean_begins_anew_after_an_interruption(
    model: ForceTransfer,
) -> None:
    whole = finger(2).recording
    order = np.r_[900:ROWS, 0:900]
    broken = replace(whole, segment=(np.arange(ROWS) >= 900).astype(int))
    turned = FingerRecording(
        whole.electrodes[order],
        whole.baseline[order],
        broken.segment[order],
        whole.period_s,
        whole.force[order],
    )
    np.testing.assert_allclose(
        model.estimate(turned, unlabelled=False),
        model.estimate(broken, unlabelled=False)[order],
        atol=1e-9,
    )


def test_the_mirror_image_of_a_finger_has_the_mirror_image_of_the_force(
    model: ForceTransfer,
) -> None:
    one = finger(2).recording
    image = model.estimate(one.mirrored(), unlabelled=False)
    np.testing.assert_allclose(
        image, model.estimate(one, unlabelled=False) * [1.0, -1.0, 1.0], atol=1e-6
    )


def test_forces_that_are_not_labelled_are_not_looked_at(
    model: ForceTransfer,
) -> None:
    one = finger(2).recording
    labelled = LabelledPresses(np.arange(100, 300, 5), np.repeat([0, 1], 20))
    hidden = replace(one, force=np.full_like(one.force, np.nan))
    hidden.force[labelled.rows] = one.force[labelled.rows]
    estimate = model.estimate(one, unlabelled=True)
    np.testing.assert_array_equal(estimate, model.estimate(hidden, unlabelled=True))
    first, second = (model.correct(each, estimate, labelled) for each in (one, hidden))
    np.testing.assert_array_equal(first.force, second.force)


def test_labelled_presses_correct_what_is_wrong_near_them(
    model: ForceTransfer,
) -> None:
    one = finger(2).recording
    wrong = replace(one, force=one.force + np.array([0.0, 0.0, 0.5]))
    estimate = model.estimate(wrong, unlabelled=False)
    rows = np.arange(0, ROWS, 10)
    labelled = LabelledPresses(rows, rows // 200)
    corrected = model.correct(wrong, estimate, labelled)
    before, after = (np.abs(each - wrong.force).mean() for each in (estimate, corrected.force))
    assert after < 0.5 * before


def test_a_held_out_press_is_estimated_as_if_it_had_not_been_labelled(
    model: ForceTransfer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But for the weight of the line, which follows from all of them."""
    monkeypatch.setattr(transfer, "_line_weight", lambda *_: 0.3)
    one = finger(2).recording
    estimate = model.estimate(one, unlabelled=False)
    rows = np.concatenate([np.arange(at, at + 200, 20) for at in (0, 600, 1200)])
    press = np.repeat([0, 1, 2], 10)
    whole = model.correct(one, estimate, LabelledPresses(rows, press))
    others = press != 1
    without = model.correct(one, estimate, LabelledPresses(rows[others], press[others]))
    np.testing.assert_allclose(whole.held_out[~others], without.force[rows[~others]], atol=1e-8)


def test_the_size_of_its_signals_tells_that_a_finger_is_more_sensitive() -> None:
    """It is alike at rest, and without that its forces would seem several times as large."""

    def slow(seed: int, sensitivity: float) -> Finger:
        """In use for some minutes."""
        one = fingers_of(invented(seed, sensitivity=sensitivity))[0]
        return replace(one, recording=replace(one.recording, period_s=0.1))

    sensitive, other, of_its_kind = slow(2, 4.0), slow(1, 1.0), slow(4, 4.0)
    for unlabelled in (False, True):
        result = run_transfer([other], sensitive, unlabelled=unlabelled)
        assert not result["unlike"]
        assert 3.0 < result["signal_ratio"] < 5.0
        assert result["magnitude_median_n"] < 0.8 * result["constant"]["magnitude_median_n"]
        assert result["magnitude_median_n"] < 0.3 * result["ridge"]["magnitude_median_n"]
    assert run_transfer([other, of_its_kind], sensitive)["signal_ratio"] < transfer.SAME_USE


def test_presses_tell_how_sensitive_a_finger_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the size of its signals does not."""
    monkeypatch.setattr(transfer, "SAME_USE", 100.0)
    sensitive = fingers_of(invented(2, sensitivity=4.0))[0]
    results = {
        shots: run_transfer([finger(1)], sensitive, shots=shots, draws=3) for shots in (0, 5)
    }
    constant = results[5]["constant"]["magnitude_median_n"]
    assert results[0]["magnitude_median_n"] > 2.0 * constant
    assert results[5]["magnitude_median_n"] < 0.5 * constant


def test_a_finger_that_is_pressed_somewhat_harder_is_estimated_as_it_is(
    model: ForceTransfer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long it is left untouched, too."""
    one = finger(2).recording
    hard = one.with_signals_divided(np.full(ROWS, 1.0 / 1.3))
    idle = replace(
        hard,
        electrodes=np.vstack([np.tile(hard.baseline[:1], (ROWS, 1)), hard.electrodes]),
        baseline=np.vstack([hard.baseline] * 2),
        segment=np.zeros(2 * ROWS, np.int64),
        force=np.vstack([0.0 * hard.force, hard.force]),
    )
    ratios = [model.signal_ratio(each, whole=True)[-1] for each in (one, hard, idle)]
    assert 0.8 < ratios[0] < 1.0 + 0.5 * (transfer.SAME_USE - 1.0)
    assert ratios[1] < transfer.SAME_USE
    assert ratios[2] == pytest.approx(ratios[1], rel=0.02)
    estimate = model.estimate(hard, unlabelled=False)
    monkeypatch.setattr(transfer, "SAME_USE", 100.0)
    np.testing.assert_array_equal(model.estimate(hard, unlabelled=False), estimate)


def test_presses_of_a_finger_like_the_others_do_not_change_its_scale(
    model: ForceTransfer, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = finger(2).recording
    estimate = model.estimate(one, unlabelled=False)
    rows = np.arange(0, ROWS, 10)
    labelled = LabelledPresses(rows, rows // 200)
    found = model.correct(one, estimate, labelled)
    monkeypatch.setattr(transfer, "LIKELIER", np.inf)
    np.testing.assert_array_equal(found.force, model.correct(one, estimate, labelled).force)


@pytest.mark.parametrize("presses", [2, 6])
def test_where_the_line_is_right_and_the_processes_are_not_it_is_believed(
    model: ForceTransfer, presses: int
) -> None:
    """The more, the more presses say so; after one press alone nothing can."""
    one = finger(2).recording
    turned = model.estimate(one, unlabelled=False)[:, [1, 0, 2]]  # x for y
    starts = np.linspace(0, ROWS - 200, presses).astype(int)
    rows = np.concatenate([np.arange(at, at + 200, 10) for at in starts])
    labelled = LabelledPresses(rows, np.repeat(np.arange(presses), 20))
    by_both = model.correct(one, turned, labelled).force
    first = labelled.where(labelled.press == 0)
    by_one = model.correct(one, turned, first).force
    error, of_one = (np.linalg.norm(one.force - each, axis=1).mean() for each in (by_both, by_one))
    assert error < (0.4 if presses == 6 else 0.8) * of_one


def test_without_a_press_an_unlike_finger_is_estimated_no_worse_than_by_a_constant() -> None:
    """Its skin lies near the core: four times the impedance, and as much more sensitive."""
    unlike = fingers_of(invented(2, sensitivity=4.0, rest=(1000.0, 1600.0)))[0]
    result = run_transfer([finger(1), finger(3)], unlike)
    assert result["unlike"]
    assert 3.0 < result["impedance_ratio"] < 6.0
    # The constant is a mean over other rows of the same fingers.
    assert result["magnitude_median_n"] <= 1.2 * result["constant"]["magnitude_median_n"]
    assert result["angle_median_rad"] < result["constant"]["angle_median_rad"]
    assert result["coverage_90"] > 0.8
    assert not run_transfer([finger(1)], finger(2))["unlike"]
    # With a finger of its kind among the others it is one of them.
    of_its_kind = fingers_of(invented(4, sensitivity=4.0, rest=(1000.0, 1600.0)))[0]
    assert not run_transfer([finger(1), of_its_kind], unlike)["unlike"]


def presses_of_seconds(seconds: int, *, one_clock: bool = True) -> FeatureDataset:
    """A recording of 100 rows a second with a label for every second, of one clock or of each."""
    data = invented(1)
    row = np.arange(ROWS)
    label = (row // (100 * seconds)).astype(np.int32)
    time = row if one_clock else row % (100 * seconds)
    return replace(data, group=label, block=label, time_ns=time.astype(np.int64) * 10_000_000)


def test_presses_in_the_order_of_their_labels_are_put_in_order_of_time() -> None:
    """0, 1, 10, 11, ..., 2, 3: or rows are tested that were measured just after a labelled one."""
    data = presses_of_seconds(1)
    order = np.concatenate(
        [np.flatnonzero(data.group == label) for label in sorted(np.unique(data.group), key=str)]
    )
    assert not np.array_equal(order, np.arange(ROWS))
    shuffled = replace(data, **{name: column[order] for name, column in data.arrays().items()})
    (one,), (other,) = fingers_of(data), fingers_of(shuffled)
    for name in ("electrodes", "baseline", "segment", "force"):
        np.testing.assert_array_equal(
            getattr(other.recording, name), getattr(one.recording, name), err_msg=name
        )
    np.testing.assert_array_equal(other.tared, one.tared)
    assert other.recording.period_s == one.recording.period_s


def test_presses_with_a_clock_of_each_are_not_mixed() -> None:
    data = presses_of_seconds(4, one_clock=False)
    (one,) = fingers_of(data)
    np.testing.assert_array_equal(one.recording.electrodes, data.electrodes)
    np.testing.assert_array_equal(one.recording.segment, np.arange(ROWS) // 400)


def test_electrodes_that_are_dead_do_not_make_a_finger_unlike_the_others() -> None:
    data = invented(2)
    for column in (data.electrodes, data.baseline):
        column[:, [4, 12]] = 4095
    (dead,) = fingers_of(data)
    result = run_transfer([finger(1)], dead)
    assert 0.8 < result["impedance_ratio"] < 1.25
    assert not result["unlike"]
    assert result["clipped"] == {"finger-2": {"E5": ROWS, "E13": ROWS}}


@pytest.mark.parametrize("trained_on", [False, True])
def test_an_electrode_at_an_end_of_its_range_is_told(trained_on: bool) -> None:
    data = invented(2)
    data.electrodes[100:, 4] = 4094
    (died,), whole = fingers_of(data), finger(1)
    result = run_transfer([died], whole) if trained_on else run_transfer([whole], died)
    assert result["clipped"] == {"finger-2": {"E5": ROWS - 100}}
    said = remarks(result)
    assert "Electrodes of finger-2 are at an end of their range" in said[0]
    assert f"E5 ({ROWS - 100})" in said[0]
    assert remarks({**result, "clipped": {}, "signal_ratio": 1.0, "unlike": False}) == []


@pytest.mark.parametrize("changed", ["paired otherwise", "tared otherwise", "in part"])
def test_the_same_recording_is_recognised_whatever_was_made_of_it(changed: str) -> None:
    data = invented(1)
    if changed == "paired otherwise":
        other = replace(data, force=np.roll(data.force, 2, axis=0))
    elif changed == "tared otherwise":
        other = replace(data, baseline=data.baseline + np.float32(3.0))
    else:
        some: dict[str, Any] = {name: rows[300:500] for name, rows in data.arrays().items()}
        other = replace(data, **some | {"force": some["force"] + np.float32(0.01)})
    (same,) = fingers_of(replace(other, sensor_names=("another name",)))
    with pytest.raises(DatasetError, match="hold the same presses"):
        run_transfer([finger(1)], same)


def test_fingers_without_any_signal_in_some_rows_are_not_the_same() -> None:
    lost = []
    for seed in (1, 2):
        data = invented(seed)
        data.electrodes[:100] = 0
        lost += fingers_of(data)
    assert run_transfer(lost[:1], lost[1])["rows"] == ROWS


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"force": 1e3}, "more than a fingertip bears"),
        ({"force": 1e-3}, "largest force is .* N, and a press has 0.5 N"),
        ({"force": 0.0}, "force is the same in all"),
        ({"electrodes": 0}, "electrodes, tared, is the same in all"),
    ],
)
def test_a_finger_that_tells_nothing_is_refused(changed: dict[str, float], problem: str) -> None:
    data = invented(2)
    times = {name: getattr(data, name) * np.float32(by) for name, by in changed.items()}
    columns = {name: rows.astype(getattr(data, name).dtype) for name, rows in times.items()}
    with pytest.raises(DatasetError, match=f"finger-2: .*{problem}"):
        fingers_of(replace(data, **columns))


def test_a_finger_may_be_untouched_for_half_of_its_recording() -> None:
    data = invented(1)
    data.force[: ROWS // 2] = 0.0
    (late,) = fingers_of(data)
    assert np.isfinite(run_transfer([late], finger(2))["interval_median_n"])


def test_a_name_without_rows_is_no_finger() -> None:
    data = replace(invented(1), sensor=np.ones(ROWS, np.int32), sensor_names=("none", "one"))
    assert [one.name for one in fingers_of(data)] == ["one"]


def test_what_cannot_be_tested_is_refused() -> None:
    one, two = finger(1), finger(2)
    with pytest.raises(
        DatasetError, match=r"\(to test\) and finger-2 \(to train on\) hold the same"
    ):
        run_transfer([one, two], replace(two, name="another name"))
    whole = invented(2)
    early: dict[str, Any] = {name: values[: ROWS // 2] for name, values in whole.arrays().items()}
    (part,) = fingers_of(replace(whole, **early))
    with pytest.raises(DatasetError, match=f"hold the same presses: {ROWS // 2} rows"):
        run_transfer([one, part], two)
    with pytest.raises(DatasetError, match=f"hold the same presses: {ROWS} rows"):
        run_transfer([one, one], two)
    with pytest.raises(DatasetError, match="8 presses of 2 s, 9 are to be labelled"):
        run_transfer([one], two, shots=9)
    # Of 8 presses none lies 1 s from 7 others.
    with pytest.raises(
        DatasetError, match=r"no row is left to test: 7 of 8 presses are labelled.*label fewer"
    ):
        run_transfer([one], two, shots=7)
    # Pieces of a second have no press of two; without labels none is needed.
    short = replace(two, recording=replace(two.recording, segment=np.arange(ROWS) // 100))
    with pytest.raises(DatasetError, match=r"has 0 presses of 2 s, 1 are.*label fewer"):
        run_transfer([one], short, shots=1)
    assert run_transfer([one], short)["rows"] == ROWS


def test_draws_are_reproducible_and_leave_the_labelled_rows_out() -> None:
    results = [run_transfer([finger(1)], finger(2), shots=3, draws=2) for _ in range(2)]
    assert results[0] == results[1]
    assert results[0]["rows"] == ROWS, "all that the finger has, whatever is drawn"
    # Three presses of 200 rows, and up to 100 rows before and after each.
    assert ROWS - 3 * 400 <= results[0]["tested_rows"] < ROWS - 3 * 200
    other = run_transfer([finger(1)], finger(2), shots=3, draws=2, seed=1)
    assert other["magnitude_median_n"] != results[0]["magnitude_median_n"]


def test_all_figures_are_those_of_the_worst_of_several_fingers() -> None:
    results = [run_transfer([finger(1)], finger(seed)) for seed in (2, 3)]
    better, worse = sorted(results, key=lambda one: one["magnitude_median_n"])
    better["constant"]["magnitude_median_n"] = better["angle_median_rad"] = 9.0
    worst = worst_of(results)
    assert worst["worst_finger"] == worse["test"]
    assert {key: worst[key] for key in worse} == worse
    assert worst["fingers"] == {"finger-2": results[0], "finger-3": results[1]}


def test_what_is_not_known_is_null_in_json() -> None:
    untouched = summary(np.ones((9, 3)), np.zeros((9, 3)))
    assert np.isnan(untouched["angle_median_rad"])
    told = as_dict([{**untouched, "ridge": untouched, "rows": 9}])
    assert told["angle_median_rad"] is told["ridge"]["angle_median_rad"] is None
    assert told["rows"] == 9
    assert told["magnitude_median_n"] == pytest.approx(np.sqrt(3.0))


@pytest.mark.parametrize("shots", [0, 2])
def test_command_prints_json(tmp_path: Path, shots: int) -> None:
    for seed in (1, 2):
        write_dataset(tmp_path / f"{seed}.h5", invented(seed))
    arguments = ["transfer", "--train", str(tmp_path / "1.h5"), "--test", str(tmp_path / "2.h5")]
    options = ["--shots", str(shots), "--draws", "2", "--json"]
    done = CliRunner().invoke(train_app, arguments + options)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert {"magnitude_median_n", "magnitude_p95_n", "angle_median_rad", "coverage_90"} <= set(
        found
    )
    assert (found["shots"], found["unlabelled"], found["test"]) == (shots, shots > 0, "finger-2")
    assert set(found["ridge"]) == set(found["constant"]) > {"magnitude_median_n"}
    table = CliRunner().invoke(train_app, [*arguments, "--draws", "1"])
    assert "ridge" in table.output
    assert "90 % intervals" in table.output


def test_the_command_tells_fingers_by_their_whole_names(tmp_path: Path) -> None:
    names = ("index[left]", "a[/b]")
    for seed, name in enumerate(names, start=1):
        data = invented(seed, name=name)
        data.electrodes[:100, 4] = 4095
        write_dataset(tmp_path / f"{seed}.h5", data)
    arguments = ["transfer", "--train", str(tmp_path / "1.h5"), "--test", str(tmp_path / "2.h5")]
    done = CliRunner().invoke(train_app, arguments, env={"COLUMNS": "200"}, catch_exceptions=False)
    for words in ("a[/b], from index[left], with", *(f"Electrodes of {name}" for name in names)):
        assert words in done.output


def test_the_prior_is_the_line_that_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[TwinLine | None] = []

    def run(*_: object, line: TwinLine | None, **__: object) -> dict[str, Any]:
        taken.append(line)
        return {}

    monkeypatch.setattr("palpate_training.evaluation.transfer.run_transfer", run)
    for seed in (1, 2):
        write_dataset(tmp_path / f"{seed}.h5", invented(seed))
    write_line(tmp_path / "mine.json", fit_line(invented(3)))
    arguments = ["transfer", "--train", str(tmp_path / "1.h5"), "--test", str(tmp_path / "2.h5")]
    arguments += ["--json"]
    mine = ["--line", str(tmp_path / "mine.json")]
    for options in (mine, []):
        done = CliRunner().invoke(train_app, arguments + options, catch_exceptions=False)
        assert done.exit_code == 0, done.output
    named, shipped = (line.data_sha256 for line in taken if line is not None)
    assert named == invented(3).content_sha256()
    assert shipped == read_line().data_sha256
    with pytest.raises(ConfigError, match="--no-twin is for none"):
        CliRunner().invoke(train_app, [*arguments, *mine, "--no-twin"], catch_exceptions=False)


@pytest.mark.slow
@pytest.mark.parametrize("shots", sorted(GOALS))
def test_real_fingers_that_were_never_met(
    shared_data: Path, shots: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transfer, "SOURCE_ROWS", ALL_ROWS)
    source = shared_data / "lasa_force_calibration" / "force_calibration.npz"
    if not source.is_file():
        pytest.skip("the LASA force calibration is not among the real data")
    one, two = fingers_of(ingest_lasa(source))
    magnitude_n, angle_rad = GOALS[shots]
    for known, tested in ((one, two), (two, one)):
        result = run_transfer([known], tested, shots=shots, unlabelled=shots > 0, draws=4)
        assert result["magnitude_median_n"] <= magnitude_n
        assert result["angle_median_rad"] <= angle_rad
        assert 0.8 < result["coverage_90"] < 0.99
        for rival in ("constant", "ridge"):
            assert result["angle_median_rad"] < result[rival]["angle_median_rad"]
