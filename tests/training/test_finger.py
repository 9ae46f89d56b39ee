"""A finger's own bundle: what it learns, what is said of it, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from onnxruntime import InferenceSession

import palpate_training
from palpate.errors import BundleError, DatasetError
from palpate.files.bundle import read_bundle
from palpate_training.datasets.experiment import read_mixed
from palpate_training.datasets.export import features
from palpate_training.datasets.features import FeatureDataset
from palpate_training.datasets.ingest import TOUCH_N
from palpate_training.learning.force_process import (
    Floats,
    ForceLine,
    ForceProcesses,
    KnownRows,
)
from palpate_training.learning.intervals import bounds, terms_of
from palpate_training.learning.told_finger import ToldFinger
from palpate_training.learning.twin_line import read_line
from palpate_training.tasks import finger
from palpate_training.tasks.finger import (
    STEPS,
    TOLD,
    HeldOutPresses,
    chosen,
    estimate_of,
    known_rows,
    train_finger,
)

MakeData = Callable[..., FeatureDataset]
SAMPLE = Path(palpate_training.__file__).parent / "samples" / "twin.h5"


@pytest.fixture(autouse=True)
def few_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finger, "ROWS_MOST", 240)


def test_a_bundle_of_its_own(press_data: MakeData, tmp_path: Path) -> None:
    steps: list[int] = []
    data = press_data(presses=16)
    report = train_finger(
        data,
        tmp_path / "b",
        name="features-mine",
        version=3,
        serials=["BT-7"],
        on_step=lambda: steps.append(1),
    )
    assert len(steps) == STEPS
    bundle = read_bundle(tmp_path / "b")
    manifest = bundle.manifest
    assert bundle.sha256 == report.digest
    assert (manifest.name, manifest.version) == ("features-mine", 3)
    assert manifest.sensor_serials == ("BT-7",)
    assert [one.name for one in manifest.outputs] == ["force", "force_sd"]
    assert (report.presses, report.rows) == (16, 240)
    found = report.metrics
    assert found["force_magnitude_median_n"] < 0.1 * found["constant_force_magnitude_median_n"]
    assert found["force_angle_median_rad"] < 0.1
    assert found["coverage_90"] >= 0.85
    assert 0.05 <= manifest.contact_threshold_n < 0.3
    answers = bundle.golden["force"]
    assert np.isfinite(answers).all()
    assert 2.0 < np.linalg.norm(answers, axis=1).max() < 6.0


@pytest.fixture(scope="module")
def simulated() -> FeatureDataset:
    """The sample's presses of one of the twin's specimens, which the network has not met."""
    data = features(read_mixed(SAMPLE))
    kept = data.sensor == data.sensor_names.index("biotac-2")
    columns = {name: values[kept] for name, values in data.arrays().items()}
    columns["sensor"] = np.zeros(kept.sum(), np.int32)
    return replace(data, **columns, sensor_names=("biotac-2",))


def test_a_simulated_finger_gets_the_network_of_the_population(
    simulated: FeatureDataset, tmp_path: Path
) -> None:
    report = train_finger(simulated, tmp_path / "b", name="features-mine")
    assert "population" in report.estimator
    manifest = read_bundle(tmp_path / "b").manifest
    assert {"contact_location", "contact_normal_sd"} <= {one.name for one in manifest.outputs}
    assert manifest.intervals is not None
    assert "contact_location" in {one.name for one in manifest.intervals.formulas}
    # The sensor tells no place: what is known of that comes from the population alone.
    session = InferenceSession((tmp_path / "b" / "model.onnx").read_bytes())
    names = [one.name for one in session.get_outputs()]
    hard = np.linalg.norm(simulated.force, axis=1) > 0.5
    answers = dict(
        zip(names, session.run(None, {"electrodes": simulated.tared_counts}), strict=True)
    )
    assert simulated.contact_location is not None
    apart = np.linalg.norm(answers["contact_location"] - simulated.contact_location, axis=1)[hard]
    assert np.median(apart) < 2.5e-3
    assert report.metrics["force_magnitude_median_n"] < 0.15
    line = report.metrics["linear_force_magnitude_median_n"]
    assert report.metrics["force_magnitude_median_n"] < 0.5 * line


def test_the_network_is_taken_only_where_it_knows_the_finger() -> None:
    """The gateway's invented finger: the others know nothing of its hardest press, nor does it."""
    force = np.array([[0.0, 0.0, 1.0]] * 9 + [[0.0, 0.0, 20.0]])
    line = np.array([0.3] * 9 + [30.0])
    for error, taken in ((0.1, TOLD), (0.9, "line")):
        told = np.array([error] * 9 + [10.0])
        assert told.mean() < line.mean()
        assert chosen({"line": line, TOLD: told}, force) == taken
    # It knows the finger, but a line knows it better.
    assert chosen({"line": np.full(10, 0.01), TOLD: np.full(10, 0.1)}, force) == "line"


def test_a_finger_that_is_told_is_another_one(simulated: FeatureDataset) -> None:
    """The same electrodes with forces three times as large: presses tell it."""
    known, touched = known_rows(simulated)
    rest = simulated.baseline[0].astype(np.float64)
    harder = replace(known, force=3.0 * known.force)
    once, thrice = (
        np.linalg.norm(estimate_of(ToldFinger(rows, rest), known.tared[touched]), axis=1)
        for rows in (known, harder)
    )
    assert 2.0 < np.median(thrice / once) < 4.0


def test_what_is_said_of_it_comes_from_presses_that_were_held_out(
    press_data: MakeData, tmp_path: Path
) -> None:
    """Electrodes that know which press it is, but nothing of its force, help nobody."""
    data = press_data(presses=12)
    assert data.in_contact is not None
    rng = np.random.default_rng(3)
    fingerprint = rng.normal(0, 300, (12, 19))[data.group] * data.in_contact[:, None]
    invented = replace(
        data, electrodes=np.clip(data.baseline + fingerprint, 0, 4095).astype(np.uint16)
    )
    found = train_finger(invented, tmp_path / "b", name="features-mine").metrics
    assert found["force_magnitude_median_n"] > 0.5 * found["constant_force_magnitude_median_n"]
    assert found["coverage_90"] >= 0.8


def test_intervals_are_told_by_presses_that_did_not_set_them() -> None:
    """One press in six is ten times as wrong as the others: nothing in them says so."""
    press = np.repeat(np.arange(6), 10)
    force = np.tile([0.0, 0.0, 2.0], (60, 1))
    rows = KnownRows(np.zeros((60, 19)), force, press)
    wrong = np.where(press == 3, 1.0, 0.1)[:, None] * np.ones(3)
    said = HeldOutPresses.of(force + wrong, rows, np.ones(60, bool), {})
    assert said.metrics["coverage_90"] == pytest.approx(5 / 6)
    assert (1.645 * said.force_sd >= 0.99).all(), "the width itself knows all presses"


def test_what_is_said_of_fingers_left_out_holds_on_each() -> None:
    """Presses of a finger tell nothing of the next one, of which the estimate may know less."""
    rng = np.random.default_rng(0)
    number, press = np.repeat(np.arange(3), 400), np.repeat(np.arange(60), 20)
    force = rng.uniform(4.0, 8.0, 60)[press, None] * np.array([0.0, 0.0, 1.0])
    wrong = rng.uniform(0.5, 1.0, (1200, 3)) * np.where(number == 1, 1.0, 0.1)[:, None]
    rows = KnownRows(np.zeros((1200, 19)), force, press)
    said = HeldOutPresses.of(force + wrong, rows, np.ones(1200, bool), {}, finger=number)
    assert said.presses == 60
    assert said.metrics["coverage_90"] == pytest.approx(2 / 3, abs=0.01)
    worst = number == 1
    assert (np.mean(np.abs(wrong[worst]) <= 1.645 * said.force_sd, axis=0) >= 0.9).all()
    nothing = np.zeros(1200)
    terms = terms_of(np.linalg.norm(force + wrong, axis=1), nothing, nothing)
    _, vector = said.formulas
    held = np.linalg.norm(wrong, axis=1) <= bounds(vector, terms)
    assert 0.9 <= held[worst].mean() < 1.0


def test_untouched_rows_do_not_make_intervals_of_touched_ones_closer() -> None:
    rng = np.random.default_rng(0)
    press = np.repeat(np.arange(40), 100)
    touched = np.arange(4000) % 2 == 0
    truth = np.where(touched[:, None], [0.0, 0.0, 2.0], 0.0)
    wrong = np.where(touched[:, None], rng.normal(0.0, 1.0, (4000, 3)), 1e-3)
    rows = KnownRows(np.zeros((4000, 19)), truth, press)
    said = HeldOutPresses.of(truth + wrong, rows, touched, {})
    assert said.metrics["coverage_90"] == pytest.approx(0.92, abs=0.02)
    np.testing.assert_allclose(said.force_sd, 1.0, rtol=0.15)


def test_what_never_changes_is_refused(press_data: MakeData, tmp_path: Path) -> None:
    data = press_data(presses=8)
    still = replace(data, force=np.full_like(data.force, 2.0))
    with pytest.raises(DatasetError, match="force is the same in all 480 rows"):
        train_finger(still, tmp_path / "b", name="features-mine")
    dead = replace(data, electrodes=data.electrodes[:1].repeat(len(data), axis=0))
    with pytest.raises(DatasetError, match="electrodes, tared, is the same in all 480 rows"):
        train_finger(dead, tmp_path / "b", name="features-mine")
    absurd = data.force.copy()
    absurd[7, 1] = 1e30
    with pytest.raises(DatasetError, match=r"force is 1e\+30 N in row 7"):
        train_finger(replace(data, force=absurd), tmp_path / "b", name="features-mine")
    assert not list(tmp_path.iterdir())


def test_a_recording_without_presses_counts_its_blocks(press_data: MakeData) -> None:
    data = press_data(presses=8)
    rows = replace(
        data,
        group=np.zeros_like(data.group),
        in_contact=None,
        contact_location=None,
        centre_of_pressure=None,
        contact_normal=None,
    )
    known, touched = known_rows(rows)
    assert len(np.unique(known.press)) == 8
    np.testing.assert_array_equal(touched, np.linalg.norm(known.force, axis=1) > TOUCH_N)


def test_noise_of_the_force_sensor_is_no_touch(press_data: MakeData) -> None:
    """Where nothing says what is touched, as in a table, the same rows are learned from."""
    data = press_data(presses=12, rows=200)
    assert data.in_contact is not None
    idle = np.sort(np.r_[np.arange(len(data)), np.repeat(np.flatnonzero(~data.in_contact), 20)])
    noise = np.random.default_rng(1).normal(0.0, 0.03, (len(idle), 3)).astype(np.float32)
    columns = {name: values[idle] for name, values in data.arrays().items()}
    told = replace(data, **columns | {"force": data.force[idle] + noise})
    untold = replace(
        told, in_contact=None, contact_location=None, centre_of_pressure=None, contact_normal=None
    )
    pressed = []
    for one in (told, untold):
        known, touched = known_rows(one)
        assert 0.15 < np.mean(~touched) < 0.25
        pressed.append(np.count_nonzero(np.linalg.norm(known.force, axis=1) >= 0.5))
    assert pressed[1] >= 0.95 * pressed[0] > 100


@pytest.mark.parametrize("presses", [100, 240, 300, 700])
def test_many_presses_are_learned_from_as_a_whole(press_data: MakeData, presses: int) -> None:
    """Not from their ends, which are light touches, and never from too many rows."""
    data = press_data(presses=presses)
    known, touched = known_rows(data)
    assert len(known) <= finger.ROWS_MOST
    assert len(np.unique(known.press[touched])) >= min(presses, 150)
    strength = np.linalg.norm(known.force[touched], axis=1)
    assert 0.4 < np.mean(strength >= 2.0) < 0.8  # of all touched rows: 0.66
    estimate = estimate_of(ForceLine(known), data.tared_counts.astype(np.float64))
    assert np.median(np.linalg.norm(estimate - data.force, axis=1)) < 0.05


def test_few_presses_are_refused(press_data: MakeData, tmp_path: Path) -> None:
    data = press_data(presses=5)
    with pytest.raises(DatasetError, match=r"5 presses of at least 0\.5 N; 6 are needed"):
        train_finger(data, tmp_path / "b", name="features-mine")
    light = replace(press_data(presses=8), force=press_data(presses=8).force * np.float32(0.05))
    with pytest.raises(DatasetError, match="0 presses of at least"):
        train_finger(light, tmp_path / "b", name="features-mine")
    assert not list(tmp_path.iterdir())


def test_a_force_that_was_not_zeroed_is_not_blamed_on_the_presses(press_data: MakeData) -> None:
    """Without a pose all is one touch, and one press."""
    data = press_data(presses=8)
    one = replace(
        data,
        force=data.force + np.array([0, 0, 1.5], np.float32),
        group=np.zeros(len(data), np.int32),
        block=np.zeros(len(data), np.int32),
        in_contact=np.ones(len(data), np.bool_),
        contact_location=None,
        centre_of_pressure=None,
        contact_normal=None,
    )
    with pytest.raises(DatasetError, match=r"1 presses .*; the force is never below 1\.") as told:
        known_rows(one)
    assert told.value.remedy.startswith("zero the force/torque sensor while nothing touches")


def test_two_fingers_are_refused(press_data: MakeData, tmp_path: Path) -> None:
    data = press_data(presses=8)
    two = replace(data, sensor=(data.group >= 4).astype(np.int32), sensor_names=("one", "two"))
    with pytest.raises(DatasetError, match="holds 2 fingers: one, two"):
        train_finger(two, tmp_path / "b", name="features-mine")


def test_no_bundle_is_overwritten(press_data: MakeData, tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    with pytest.raises(BundleError, match="exists"):
        train_finger(press_data(presses=8), tmp_path / "b", name="features-mine")


def test_a_common_rise_of_all_impedances_turns_no_force_round(press_data: MakeData) -> None:
    """A warmer fluid: directions see nothing of the common mode, or a tenth of it."""
    data = press_data(presses=16)
    known, touched = known_rows(data)
    rest = data.baseline[0].astype(np.float64)
    net = ForceProcesses(known, rest, local=0.1)
    counts = rest + known.tared[touched]
    warmer = 4095.0 / (1.0 + 0.9 * (4095.0 / counts - 1.0)) - rest

    def directions(tared: Floats) -> Floats:
        with torch.inference_mode():
            force = net(torch.from_numpy(tared)).numpy().astype(np.float64)
        return np.asarray(force / np.linalg.norm(force, axis=1, keepdims=True))

    cosine = np.sum(directions(known.tared[touched]) * directions(warmer), axis=1)
    assert np.median(np.arccos(np.clip(cosine, -1, 1))) < 0.05


def test_presses_tell_the_scale_and_the_axes_of_the_twins_line() -> None:
    """A finger whose forces are those of the line, stiffer and turned: nothing is left to learn."""
    rng = np.random.default_rng(0)
    rest = np.full(19, 3000.0)
    tared = rng.normal(0.0, 120.0, (400, 19)).round()
    line = read_line()
    turn = np.array([[2.0, 0.0, 0.3], [0.0, 1.5, 0.0], [-0.2, 0.0, 2.5]])
    force = line.force(rest + tared, np.tile(rest, (400, 1))) @ turn
    known = KnownRows(tared[:200], force[:200], np.arange(200) // 10)
    net = ForceProcesses(known, rest, local=0.1)
    with torch.inference_mode():
        found = net.twin(torch.from_numpy(tared[200:])).numpy()
    error = np.linalg.norm(found - force[200:], axis=1)
    assert np.median(error) < 0.15 * np.median(np.linalg.norm(force, axis=1))
