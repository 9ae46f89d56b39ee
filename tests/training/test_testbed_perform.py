"""Played trials: the schedule, what comes before contact, noise, drift, and determinism."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from palpate.errors import ConfigError
from palpate_training.datasets.processing import filter_force, last_of_increments
from palpate_training.datasets.trials import RawTrial, TrialHeader
from palpate_training.experiment.virtual_testbed import WrenchSensor, contact_travel, perform

Floats = npt.NDArray[np.float64]
HEADER = TrialHeader("biotac-1", "sphere_3-5mm/00/normal", "sphere_3-5mm", "left")
DIRECTION = np.array([0.6, 0.0, 0.8])
TARGET = np.array([-5e-3, 1e-3, -8e-3])
NIL = np.zeros(6)
SILENT = WrenchSensor(noise_sd=NIL, offset_sd=NIL, walk_sd=NIL, warm_up_sd=NIL, step=NIL)


def read_plainly(ideal: Floats, time_s: Floats) -> npt.NDArray[np.uint16]:
    assert time_s.shape == ideal.shape[:1]
    return np.clip(np.rint(ideal), 0, 4095).astype(np.uint16)


def press(depth_m: float = 0.5e-3, rows: int = 6) -> dict[str, Any]:
    """A result whose force and counts go as the square of the travel."""
    travel = np.linspace(0.0, depth_m, rows)
    growth = (travel / 1e-3)[:, None] ** 2
    return {
        "travel_m": travel,
        "force": growth * [0.0, 4.0, 20.0],
        "counts": 3000.0 - growth * np.arange(100.0, 2000.0, 100.0),
        "tip": TARGET + travel[:, None] * DIRECTION,
    }


def play(**changes: Any) -> RawTrial:
    values: dict[str, Any] = {
        **press(),
        "read_electrodes": read_plainly,
        "sensor": SILENT,
        "repeatability_m": 0.0,
    }
    return perform(HEADER, **{**values, **changes})


def test_a_trial_is_the_whole_schedule() -> None:
    trial = play()
    assert len(trial.time_s) == 35 * 500
    assert (np.diff(trial.time_s) > 0).all()
    assert np.abs(trial.time_s - np.arange(35 * 500) / 100).max() < 0.003
    np.testing.assert_array_equal(trial.increment_end, np.arange(1, 36) * 500 - 1)
    np.testing.assert_allclose(trial.travel_m[trial.increment_end], 1e-4 * np.arange(1, 36))
    assert trial.travel_m[0] == 0
    assert trial.electrodes.dtype == np.uint16
    assert trial.header == HEADER


def test_last_samples_alone_are_those_of_the_whole_trial() -> None:
    """Electrodes that creep, and a force with noise."""
    readings: list[int] = []

    def read(ideal: Floats, time_s: Floats) -> npt.NDArray[np.uint16]:
        readings.append(len(time_s))
        followed = ideal.copy()
        ways = np.exp(-np.diff(time_s, prepend=time_s[0]) / 15.0)[:, None]
        for k in range(1, len(ideal)):
            followed[k] = ideal[k] + (followed[k - 1] - ideal[k]) * ways[k]
        return read_plainly(0.8 * ideal + 0.2 * followed, time_s)

    def played(**how: Any) -> RawTrial:
        return play(read_electrodes=read, sensor=None, repeatability_m=2e-5, seed=4, **how)

    last, whole = played(last_only=True), last_of_increments(filter_force(played()))
    for name in ("time_s", "electrodes", "force", "tip", "travel_m", "increment_end"):
        np.testing.assert_array_equal(getattr(last, name), getattr(whole, name), err_msg=name)
    assert readings[0] < readings[1] / 10, "read in dwells"


def test_before_contact_there_is_nothing_and_the_tip_comes_straight() -> None:
    trial = play()
    before = trial.travel_m <= 3e-3
    assert before[: 30 * 500].all()
    assert not before[30 * 500 + 1 :].any()
    assert not trial.force[before].any()
    assert (trial.electrodes[before] == 3000).all()
    expected = TARGET + (trial.travel_m[:, None] - 3e-3) * DIRECTION
    np.testing.assert_allclose(trial.tip, expected, atol=1e-12)


def test_after_contact_it_follows_the_result() -> None:
    trial = play()
    ends = trial.increment_end[30:]
    depth = 1e-4 * np.arange(1, 6) / 1e-3
    np.testing.assert_allclose(trial.force[ends], depth[:, None] ** 2 * [0, 4, 20], atol=1e-9)
    expected = np.rint(3000 - depth[:, None] ** 2 * np.arange(100, 2000, 100))
    np.testing.assert_allclose(trial.electrodes[ends], expected, atol=1)
    moving = (trial.time_s > 150.0) & (trial.time_s < 150.19)
    assert (np.diff(trial.force[moving, 2]) > 0).all()


def test_a_result_that_begins_clear_of_the_skin() -> None:
    """As the simulated paths do: the first row 0.05 mm before contact."""
    values = press()
    values["travel_m"] = np.concatenate([[-0.05e-3], values["travel_m"]])
    for key in ("force", "counts"):
        values[key] = np.concatenate([values[key][:1], values[key]])
    values["tip"] = np.concatenate([[TARGET - 0.05e-3 * DIRECTION], values["tip"]])
    for key in ("force", "electrodes"):
        np.testing.assert_array_equal(getattr(play(**values), key), getattr(play(), key))
    np.testing.assert_allclose(play(**values).tip, play().tip, atol=1e-12)


def test_the_tip_is_measured_with_the_error_of_registration_and_repeatability() -> None:
    error = np.array([0.4e-3, -0.7e-3, 0.2e-3])
    true = play().tip
    np.testing.assert_allclose(
        play(registration_error_m=error).tip - true, np.tile(error, (17500, 1))
    )
    missed = play(**press(6e-3, 10), repeatability_m=0.02e-3).tip - play(**press(6e-3, 10)).tip
    at_ends = missed[499::500]
    assert np.sqrt((at_ends**2).sum(axis=1).mean()) == pytest.approx(0.02e-3, rel=0.2)
    np.testing.assert_allclose(missed[:500], np.tile(missed[0], (500, 1)))  # one miss a move
    assert np.abs(missed[499] - missed[500]).max() > 0


def test_an_error_along_the_path_delays_contact() -> None:
    error = 0.7e-3 * DIRECTION + [0.0, 1e-3, 0.0]
    contact_m = contact_travel(error, 2 * DIRECTION)
    assert contact_m == pytest.approx(3.7e-3)
    trial = play(contact_m=contact_m, registration_error_m=error, length_m=4e-3)
    assert len(trial.increment_end) == 40
    touched = np.linalg.norm(trial.force, axis=1) > 0
    assert trial.travel_m[touched].min() > 3.7e-3
    # the robot believes itself where it was commanded to be, but for what is aside
    along = (trial.tip - TARGET) @ DIRECTION
    np.testing.assert_allclose(along, trial.travel_m - 3e-3, atol=1e-12)


def test_a_trial_is_that_of_its_seed() -> None:
    def noisy(seed: int) -> RawTrial:
        return play(sensor=None, repeatability_m=0.02e-3, seed=seed)

    one, same, other = noisy(1), noisy(1), noisy(2)
    for key in ("time_s", "electrodes", "force", "tip", "travel_m", "increment_end"):
        np.testing.assert_array_equal(getattr(one, key), getattr(same, key))
    for key in ("time_s", "force", "tip"):
        assert not np.array_equal(getattr(one, key), getattr(other, key))


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"length_m": 3.7e-3}, "the result ends at 3.500 mm"),
        ({"contact_m": 0.0}, "at least 0.1 mm away"),
        ({"registration_error_m": [0.0, np.nan, 0.0]}, "registration error"),
        ({"travel_m": press()["travel_m"][::-1]}, "does not increase"),
        ({"travel_m": press()["travel_m"] + 1e-4}, "untouched"),
        ({"force": press()["force"] + 1.0}, "untouched"),
        ({"force": press()["force"] * np.nan}, "force is not finite"),
        ({"counts": press()["counts"][:, :18]}, r"\(6, 18\)"),
        ({"read_electrodes": lambda ideal, time_s: ideal}, "float64"),
        ({"read_electrodes": lambda ideal, time_s: read_plainly(ideal, time_s)[1:]}, "17499"),
    ],
)
def test_what_cannot_be_played_is_refused(changes: dict[str, Any], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        play(**changes)


def rest(seed: int, *, minutes: int = 10, **changes: Any) -> Floats:
    count = minutes * 6000
    time_s = np.arange(count) / 100
    read = WrenchSensor(**changes).read(np.zeros((count, 6)), time_s, seed=seed)
    return np.asarray(read)


def test_the_sensor_adds_the_noise_that_it_says() -> None:
    sensor = WrenchSensor()
    read = rest(0, walk_sd=np.zeros(6), warm_up_sd=np.zeros(6))
    sd = np.hypot(sensor.noise_sd, sensor.step / np.sqrt(12))
    np.testing.assert_allclose(read.std(axis=0), sd, rtol=0.03)
    np.testing.assert_allclose(np.diff(read, axis=0).std(axis=0), sd * np.sqrt(2), rtol=0.03)
    steps = read / sensor.step
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    offsets = np.array([rest(s, minutes=1).mean(axis=0) for s in range(30)])
    assert (
        np.abs(offsets.std(axis=0) / np.hypot(sensor.offset_sd, sensor.warm_up_sd) - 1) < 0.5
    ).all()


def test_the_sensor_drifts() -> None:
    zero = np.zeros(6)
    still: dict[str, Any] = {"noise_sd": zero, "offset_sd": zero, "step": zero}
    time_s = np.arange(241.0)
    sensor = WrenchSensor(**still, warm_up_sd=zero)
    walks = np.array(
        [sensor.read(np.zeros((241, 6)), time_s, seed=s)[[0, 60, 240]] for s in range(200)]
    )
    gained = np.diff(walks, axis=1).std(axis=0) / WrenchSensor().walk_sd
    np.testing.assert_allclose(gained[0], 1.0, rtol=0.2)  # one minute
    np.testing.assert_allclose(gained[1], np.sqrt(3), rtol=0.2)  # three minutes
    sensor = WrenchSensor(**still, walk_sd=zero)
    time_s = np.array([0.0, 600.0, 1e5])
    cold = sensor.read(np.zeros((3, 6)), time_s, seed=1, since_power_on_s=0.0)
    np.testing.assert_allclose(cold[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(cold[1] / cold[2], 1 - np.exp(-1), rtol=1e-9)
    warm = sensor.read(np.zeros((3, 6)), time_s, seed=1, since_power_on_s=1800.0)
    assert (np.ptp(warm, axis=0) < 0.06 * np.abs(cold[2])).all()


def test_the_sensor_reads_what_is_there_and_saturates() -> None:
    wrench = np.array([[1.0, -2.0, 3.0, 0.1, 0.2, -0.3], [500.0, 0, -500.0, 0, 9.0, 0]])
    read = SILENT.read(wrench, np.array([0.0, 0.01]), seed=0)
    np.testing.assert_allclose(read[0], wrench[0])
    np.testing.assert_array_equal(read[1], [120, 0, -120, 0, 3, 0])
    sensor = WrenchSensor()
    np.testing.assert_array_equal(sensor.read(wrench[:, :3], [0.0, 0.01], seed=3).shape, (2, 3))


@pytest.mark.parametrize(
    ("wrench", "time_s", "match"),
    [
        (np.zeros((2, 4)), np.zeros(2), "shape"),
        (np.zeros((2, 6)), np.zeros(3), "shape"),
        (np.full((2, 6), np.nan), np.zeros(2), "not finite"),
        (np.zeros((2, 6)), np.array([1.0, 0.0]), "decrease"),
    ],
)
def test_what_no_sensor_can_read_is_refused(wrench: Floats, time_s: Floats, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        WrenchSensor().read(wrench, time_s, seed=0)


@pytest.mark.parametrize(
    "change", [{"warm_up_s": 0.0}, {"noise_sd": np.ones(3)}, {"step": -np.ones(6)}]
)
def test_a_sensor_that_cannot_be_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(change))):
        WrenchSensor(**change)
