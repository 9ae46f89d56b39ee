"""Noise, drift and sign pattern: planted in made-up streams, then read from real sensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from palpate.errors import DatasetError
from palpate_training.datasets.experiment import ExperimentDataset
from palpate_training.figures.noise import (
    FORCE_CALIBRATION,
    drift,
    read_idle_real,
    read_idle_twin,
    spectrum,
)
from palpate_training.figures.plate import (
    CONTACT_NORMAL,
    PlateLog,
    agreement,
    flat_presses,
    plate_response,
    read_plate_logs,
    signs,
)

pytest.importorskip("matplotlib", reason="matplotlib not installed (extra training)")

RATE_HZ = 100.0
SAMPLES = 12_000
WELCH_RTOL = 0.1
"""Two minutes are 22 windows: the density summed over 490 bins scatters by about 2 %."""
MakeTrials = Callable[..., ExperimentDataset]
Floats = npt.NDArray[np.float64]


@pytest.fixture
def white() -> Floats:
    """White noise, of standard deviation 0.5 on E1 and rising to 5 on E19."""
    return np.random.default_rng(3).normal(size=(SAMPLES, 19)) * np.linspace(0.5, 5, 19)


def test_density_of_white_noise_is_flat_and_sums_to_its_variance(white: Floats) -> None:
    found = spectrum(3000 + white, RATE_HZ)
    assert 0 < found.frequency_hz[0] <= 0.1
    assert found.frequency_hz[-1] < RATE_HZ / 2
    level = 2 * np.linspace(0.5, 5, 19) ** 2 / RATE_HZ
    np.testing.assert_allclose(found.density.mean(axis=0), level, rtol=WELCH_RTOL)
    share = np.sqrt((RATE_HZ / 2 - 1) / (RATE_HZ / 2))
    np.testing.assert_allclose(found.noise_sd(), share * np.linspace(0.5, 5, 19), rtol=WELCH_RTOL)


def test_a_tone_stands_at_its_frequency() -> None:
    time_s = np.arange(SAMPLES)[:, None] / RATE_HZ
    found = spectrum(np.tile(4 * np.sin(2 * np.pi * 12.5 * time_s), (1, 19)), RATE_HZ)
    peak = found.frequency_hz[found.density[:, 0].argmax()]
    assert peak == pytest.approx(12.5, abs=0.1)
    np.testing.assert_allclose(found.noise_sd(), 4 / np.sqrt(2), rtol=1e-3)


def test_a_line_is_drift_and_no_noise(white: Floats) -> None:
    minutes = np.arange(SAMPLES)[:, None] / RATE_HZ / 60
    slopes = np.linspace(-40, 60, 19)
    drifting = 3000 + white + slopes * minutes
    np.testing.assert_allclose(
        spectrum(drifting, RATE_HZ).noise_sd(), spectrum(white, RATE_HZ).noise_sd(), rtol=1e-3
    )
    change = drift(drifting, RATE_HZ)
    assert change.time_s[0] == 0.5
    assert len(change.time_s) == SAMPLES // RATE_HZ
    assert not change.change[0].any()
    # a mean over 1 s scatters by 0.5 counts on the noisiest electrode
    np.testing.assert_allclose(change.per_minute(), slopes, atol=0.5)


def test_common_share_tells_one_course_from_many() -> None:
    course = np.cumsum(np.random.default_rng(0).normal(size=(SAMPLES, 19)), axis=0)
    together = drift(course[:, :1] * np.linspace(0.5, 2, 19), RATE_HZ)
    assert together.common_share() == pytest.approx(1)
    assert drift(course, RATE_HZ).common_share() < 0.9
    assert np.isnan(drift(np.zeros((SAMPLES, 19)), RATE_HZ).common_share())


def test_short_streams_are_refused() -> None:
    with pytest.raises(DatasetError, match="too few"):
        spectrum(np.zeros((1500, 19)), RATE_HZ)
    with pytest.raises(DatasetError, match="no two means"):
        drift(np.zeros((150, 19)), RATE_HZ)


@pytest.mark.parametrize("rate_hz", [0.01, 0.2, 2.0, 2.2])
def test_a_rate_that_shows_no_noise_is_refused(rate_hz: float) -> None:
    with pytest.raises(DatasetError, match=f"{rate_hz:g} Hz show nothing faster than 1 Hz"):
        spectrum(np.random.default_rng(1).normal(size=(1000, 19)), rate_hz)


def test_a_slow_rate_that_shows_some_noise_is_not_refused() -> None:
    found = spectrum(np.random.default_rng(1).normal(size=(1000, 19)), 2.5)
    assert (found.noise_sd() > 0).all()


def test_idle_twin_is_read(tmp_path: Path) -> None:
    path = tmp_path / "idle.npz"
    counts = np.full((6000, 19), 3000, np.uint16)
    streams: dict[str, Any] = {"biotac-1": counts, "biotac-2": counts + 1}
    np.savez(path, rate_hz=100.0, **streams)
    one, two = read_idle_twin(path)
    assert (one.name, one.rate_hz, one.real) == ("biotac-1", 100.0, False)
    assert (two.counts == 3001).all()
    assert two.counts.dtype == np.float64  # differences of counts must not wrap round


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"biotac-1": np.zeros((6000, 19))}, "rate_hz"),
        ({"rate_hz": 0.0, "biotac-1": np.zeros((6000, 19))}, "rate_hz"),
        ({"rate_hz": 100.0}, "no stream"),
        ({"rate_hz": 100.0, "biotac-1": np.zeros((6000, 18))}, r"biotac-1 has shape \(6000, 18\)"),
        ({"rate_hz": 100.0, "biotac-1": np.zeros((5999, 19))}, "biotac-1 lasts"),
    ],
)
def test_wrong_idle_archive_is_named(tmp_path: Path, arrays: dict[str, Any], message: str) -> None:
    path = tmp_path / "idle.npz"
    np.savez(path, **arrays)
    with pytest.raises(DatasetError, match=message) as error:
        read_idle_twin(path)
    assert str(path) in str(error.value)


def test_public_data_is_left_out_where_absent_and_refused_where_damaged(tmp_path: Path) -> None:
    assert read_idle_real(tmp_path) == ()
    assert read_plate_logs(tmp_path) == ()
    for name in (FORCE_CALIBRATION, CONTACT_NORMAL):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(DatasetError, match="force_calibration"):
        read_idle_real(tmp_path)
    with pytest.raises(DatasetError, match="contact_normal_logs"):
        read_plate_logs(tmp_path)
    np.savez(tmp_path / CONTACT_NORMAL, log1_pdc_raw=np.zeros(3))
    with pytest.raises(DatasetError, match="log1_unix_time_s"):
        read_plate_logs(tmp_path)


@pytest.fixture
def plate_log() -> PlateLog:
    """40 untouched samples, 30 of a ventral plate, 30 of a tilted one."""
    state = np.repeat([0, 1, 2], [40, 30, 30])
    answer = np.zeros((3, 19))
    answer[1, 0], answer[1, 16], answer[2] = 409.5, -819, -2000
    pdc = np.array([2400.0, 2700, 2800])[state] + np.where(state > 0, np.arange(100), 0)
    normal = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0.6, 0.8]])[state]
    return PlateLog("log1", 0.01 * np.arange(100.0), pdc, 3000 + answer[state], normal)


def test_plate_response_is_tared_and_ventral_only(plate_log: PlateLog) -> None:
    found = plate_response([plate_log])
    assert found is not None
    assert (found.samples, found.logs) == (30, 1)
    np.testing.assert_allclose(found.tared[[0, 16]], [0.1, -0.2])
    assert not found.tared[1:16].any()


def test_logs_never_touched_or_never_at_rest_are_left_out(plate_log: PlateLog) -> None:
    parts = (plate_log.time_s, plate_log.pdc, plate_log.electrodes, plate_log.normal)
    untouched = PlateLog("log2", *(part[:40] for part in parts))
    pressed = replace(plate_log, pdc=plate_log.pdc + 25 * np.arange(100))
    tilted = replace(plate_log, normal=np.tile([0, 0.6, 0.8], (100, 1)))
    assert plate_response([untouched, pressed, tilted]) is None
    found = plate_response([untouched, plate_log])
    assert found is not None
    assert found.logs == 1


def test_signs_and_their_agreement() -> None:
    real = np.zeros(19)
    real[:4] = [0.02, -0.02, 0.02, 0.004]
    twin = np.zeros(19)
    twin[:4] = [0.5, -0.01, -0.3, 0.3]
    np.testing.assert_array_equal(signs(real)[:4], [1, -1, 1, 0])
    assert agreement(real, twin) == (2, 3)
    assert agreement(real, np.zeros(19)) == (0, 3)  # undecided agrees with nothing


def test_flat_presses_are_normal_from_below_with_the_cube(trials_data: MakeTrials) -> None:
    data = trials_data(units=2, rows=3)
    tared = np.zeros_like(data.tared)
    force = data.force.copy()
    for trial in range(data.trials):
        name, rows = data.trajectories[data.trial_trajectory[trial]], data.rows_of(trial)
        if name == "cube/00/normal":
            tared[rows] = 0.01 * (1 + data.trial_unit[trial])
        elif name == "cube/01/normal":  # from the side
            tared[rows], force[rows] = 9, [0, 3, 0.5]
        else:
            tared[rows] = 9
    one, two = flat_presses(replace(data, tared=tared, force=force))
    assert (one.name, one.rows, one.trials) == ("biotac-1", 3, 1)
    np.testing.assert_allclose(one.tared, 0.01, rtol=1e-6)
    np.testing.assert_allclose(two.tared, 0.02, rtol=1e-6)
    assert two.unit == 1


def test_unit_without_flat_presses_is_left_out(trials_data: MakeTrials) -> None:
    data = trials_data(units=2, rows=3)
    assert flat_presses(replace(data, indenters=("sphere_small",) * len(data.indenters))) == ()


def test_real_plate_raises_the_sides_and_lowers_the_middle(shared_data: Path) -> None:
    """The pattern of the notes (section 4.4), in signs and in size."""
    if not (shared_data / CONTACT_NORMAL).is_file():
        pytest.skip("LASA contact-normal logs not present")
    found = plate_response(read_plate_logs(shared_data))
    assert found is not None
    assert found.samples > 500
    (rising,) = np.nonzero(found.tared > 0.01)
    assert set(rising + 1) == {1, 4, 6, 11, 14, 16}
    (falling,) = np.nonzero(found.tared < -0.005)
    assert set(falling + 1) >= {7, 8, 9, 10, 17, 18, 19}
    assert found.tared.max() < 0.06
    assert found.tared.min() > -0.45


def test_idle_real_sensors_warm_up_together(shared_data: Path) -> None:
    if not (shared_data / FORCE_CALIBRATION).is_file():
        pytest.skip("LASA force calibration not present")
    streams = read_idle_real(shared_data)
    assert len(streams) == 2
    for stream in streams:
        change = drift(stream.counts, stream.rate_hz)
        assert (change.per_minute() > 10).all()
        assert change.common_share() > 0.99
        noise = spectrum(stream.counts, stream.rate_hz).noise_sd()
        assert (noise > 1).all()
        assert (noise < 8).all()
