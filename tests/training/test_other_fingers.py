"""A finger that is estimated by what other fingers taught: before it is pressed, and together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch
from onnxruntime import InferenceSession

from palpate.errors import DatasetError
from palpate.files.bundle import read_bundle
from palpate.files.intervals import bound_terms, bounds_of
from palpate_training.datasets.features import FeatureDataset, joined
from palpate_training.datasets.ingest import ingest_lasa
from palpate_training.evaluation.transfer import fingers_of, first_seconds
from palpate_training.learning.other_fingers import OtherFingers, SharedForce
from palpate_training.tasks import finger
from palpate_training.tasks.finger import SHARED, estimate_of, known_rows, train_finger
from palpate_training.tasks.other_fingers import fingers_in, train_unpressed

MakeData = Callable[..., FeatureDataset]
Floats = npt.NDArray[np.float64]


@pytest.fixture(autouse=True)
def few_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finger, "ROWS_MOST", 240)


def another(data: FeatureDataset, *, warmth: float = 0.9, name: str = "two") -> FeatureDataset:
    """A finger that is like this one: other untouched counts, a warmer fluid since the tare."""
    impedance, rest = (
        4095.0 / one.astype(np.float64) - 1.0 for one in (data.electrodes, data.baseline)
    )
    baseline = data.baseline + np.linspace(-200.0, 150.0, 19).astype(np.float32)
    changed = (4095.0 / baseline - 1.0) * impedance / rest * warmth
    return replace(
        data,
        electrodes=np.round(4095.0 / (1.0 + changed)).astype(np.uint16),
        baseline=baseline,
        sensor_names=(name,),
    )


def size(forces: npt.NDArray[np.floating]) -> Floats:
    return np.asarray(np.linalg.norm(forces, axis=1), np.float64)


def rest_of(data: FeatureDataset) -> Floats:
    return np.asarray(data.baseline.mean(axis=0, dtype=np.float64))


def test_a_finger_is_estimated_before_it_is_pressed(press_data: MakeData, tmp_path: Path) -> None:
    """Its fluid is warmer and its untouched counts are others: neither turns an estimate round."""
    known, new = press_data(presses=16), another(press_data(presses=16))
    report = train_unpressed(fingers_in(known), rest_of(new), tmp_path / "b", name="features-two")
    assert report.presses == 0
    manifest = read_bundle(tmp_path / "b").manifest
    assert manifest.sensor_serials == (), "no sensor is taken for calibrated"
    assert manifest.intervals is not None
    assert "too close for another finger" in manifest.intervals.source
    # A service gives these bounds to a sensor that a bundle was not made for: here to every one.
    given = bounds_of(manifest.intervals, bound_terms(2.0, 0.0, 0.0), others=True)
    assert given is not None
    assert given.other_sensors
    assert given.force_magnitude is not None
    assert "too close for another finger" in manifest.intervals.others_source
    session = InferenceSession((tmp_path / "b" / "model.onnx").read_bytes())
    force = session.run(["force"], {"electrodes": new.tared_counts})[0]
    touched = size(new.force) > 1.0
    errors = np.abs(size(force) - size(new.force))[touched]
    assert np.median(errors) < 0.25 * np.median(size(new.force)[touched])


def test_light_touches_of_other_fingers_are_touches(press_data: MakeData, tmp_path: Path) -> None:
    """Here 0.2 to 0.5 N: they do not raise the force from which there is contact."""
    known = press_data(presses=16)
    assert known.in_contact is not None
    light = known.in_contact & (size(known.force) < 0.5)
    assert light.any()
    thresholds = []
    for k, data in enumerate((known, replace(known, in_contact=known.in_contact & ~light))):
        train_unpressed(fingers_in(data), rest_of(data), tmp_path / f"{k}", name="features-two")
        thresholds.append(read_bundle(tmp_path / f"{k}").manifest.contact_threshold_n)
    assert thresholds[0] < 0.3 * thresholds[1]


def test_bounds_of_several_other_fingers_are_those_of_a_finger_left_out(
    press_data: MakeData, tmp_path: Path
) -> None:
    one = press_data(presses=12)
    stiff = replace(another(one, name="stiff"), force=2.0 * one.force)
    alike = fingers_in(joined([one, another(one)]))
    unlike = fingers_in(joined([one, stiff]))
    reports = [
        train_unpressed(others, rest_of(one), tmp_path / f"{k}", name="features-three")
        for k, others in enumerate((alike, unlike))
    ]
    medians = [report.metrics["force_magnitude_median_n"] for report in reports]
    assert medians[1] > 3.0 * medians[0], "how much fingers differ is told"
    intervals = read_bundle(tmp_path / "0").manifest.intervals
    assert intervals is not None
    assert "each finger left out" in intervals.source
    assert "each finger left out" in intervals.others_source
    assert intervals.presses == 24


def test_without_other_fingers_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="never pressed"):
        train_unpressed([], np.full(19, 3000.0), tmp_path / "b", name="features-two")
    assert not list(tmp_path.iterdir())


def test_fingers_of_a_file_are_told_apart(press_data: MakeData) -> None:
    data = joined([press_data(presses=8), another(press_data(presses=7))])
    one, two = fingers_in(data)
    assert (one.name, two.name) == ("finger", "two")
    assert [len(np.unique(each.rows.press)) for each in (one, two)] == [8, 7]
    assert not np.array_equal(one.rest, two.rest)
    few = joined([press_data(presses=8), another(press_data(presses=3))])
    with pytest.raises(DatasetError, match="two holds 3 presses"):
        fingers_in(few)


def test_its_own_presses_count_more_the_more_there_are(press_data: MakeData) -> None:
    """Other fingers say twice the force: a finger with many presses believes itself."""
    data = press_data(presses=40)
    known, _ = known_rows(data)
    double = replace(another(data, warmth=1.0), force=2.0 * data.force)
    others = OtherFingers(fingers_in(double), rest_of(data))
    hard = size(data.force) > 2.0
    tared = data.tared_counts[hard].astype(np.float64)
    excess = []
    for presses in (6, 40):
        few = known.where(known.press < presses)
        net = SharedForce(others, few, rest_of(data))
        excess.append(float(np.median(size(estimate_of(net, tared)) / size(data.force[hard]))))
    assert 1.8 > excess[0] > excess[1] + 0.2 > 1.2


def test_other_fingers_are_taken_only_where_they_know_the_finger(
    press_data: MakeData, tmp_path: Path
) -> None:
    data = press_data(presses=12)
    like = train_finger(
        data, tmp_path / "a", name="features-mine", others=fingers_in(another(data))
    )
    assert like.estimator == SHARED
    assert like.others is not None
    assert like.metrics["others_force_magnitude_median_n"] > 0.0
    foreign = train_finger(
        data, tmp_path / "b", name="features-mine", others=fingers_in(press_data(12, seed=5))
    )
    assert foreign.estimator != SHARED
    assert foreign.others is not None
    assert foreign.others > finger.LIKE_OTHERS > like.others
    # What it then holds is what it would hold without them.
    alone = train_finger(data, tmp_path / "c", name="features-mine")
    with_them, without = (read_bundle(tmp_path / which).golden["force"] for which in "bc")
    np.testing.assert_array_equal(with_them, without)
    assert alone.others is None


def test_a_common_rise_of_all_impedances_changes_no_estimate(press_data: MakeData) -> None:
    data = press_data(presses=8)
    rest = rest_of(data)
    net = OtherFingers(fingers_in(another(data)), rest)
    counts = rest + data.tared_counts.astype(np.float64)
    warmer = 4095.0 / (1.0 + 0.9 * (4095.0 / counts - 1.0)) - rest
    with torch.inference_mode():
        before, after = (net(torch.from_numpy(one)).numpy() for one in (counts - rest, warmer))
    np.testing.assert_allclose(after, before, atol=1e-4)


def test_one_real_finger_helps_the_other(
    shared_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the first half minute of a real finger, on the rest, in both directions."""
    monkeypatch.setattr(finger, "ROWS_MOST", 600)
    archive = shared_data / "lasa_force_calibration" / "force_calibration.npz"
    if not archive.is_file():
        pytest.skip("the LASA force calibration is not present")
    sets = [ingest_lasa(archive, fingers=[number]) for number in (1, 2)]
    for mine, theirs in (sets, sets[::-1]):
        (one,) = fingers_of(mine)
        known, rest, later = first_seconds(one, 30.0, most=600)
        others = OtherFingers(fingers_in(theirs), rest)
        tared, truth = one.tared[later].astype(np.float64), one.recording.force[later]
        shared, alone, own = (
            np.median(np.abs(size(estimate_of(net, tared)) - size(truth)))
            for net in (
                SharedForce(others, known, rest),
                others,
                finger.ESTIMATORS["Gaussian processes, locality 0.5"](known, rest),
            )
        )
        constant = np.median(np.abs(size(truth) - size(known.force).mean()))
        assert alone < 0.6 * constant
        assert shared < 0.75 * own
