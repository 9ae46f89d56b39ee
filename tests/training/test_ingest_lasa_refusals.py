"""Archives as of the LASA force calibration that are odd: each is refused by name, or told."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.errors import DatasetError
from palpate_training.cli import data_app
from palpate_training.datasets.features import electrodes_at_ends, period_of
from palpate_training.datasets.ingest import ingest_lasa

ROWS = 60


def finger(number: int, rows: int = ROWS) -> dict[str, Any]:
    """Arrays of a finger that is pressed with 3 N."""
    rng = np.random.default_rng(number)
    return {
        f"finger{number}_electrodes_raw": rng.integers(2000, 3000, (rows, 19)),
        f"finger{number}_baseline_mean": np.full(19, 2500.0),
        f"finger{number}_force_N": np.tile([0.1, 0.2, -3.0], (rows, 1)),
    }


def archive(folder: Path, **arrays: Any) -> Path:
    path = folder / "force_calibration.npz"
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize(
    ("value", "told"),
    [(np.nan, "nan"), (np.inf, "inf"), (2000.5, "2000.5"), (-3, "-3"), (66000, "66000")],
)
def test_counts_that_no_biotac_sends(tmp_path: Path, value: float, told: str) -> None:
    arrays = finger(9)
    arrays["finger9_electrodes_raw"] = arrays["finger9_electrodes_raw"].astype(np.float64)
    arrays["finger9_electrodes_raw"][20, 5] = value
    with pytest.raises(DatasetError, match=f"finger 9: E6 reads {told} in row 20, not whole"):
        ingest_lasa(archive(tmp_path, **arrays))


@pytest.mark.parametrize("fingers", [(), (2,)])
def test_a_number_with_a_zero_in_front_is_not_left_out(
    tmp_path: Path, fingers: tuple[int, ...]
) -> None:
    zero = {name.replace("finger2", "finger02"): array for name, array in finger(2).items()}
    path = archive(tmp_path, **finger(1), **zero)
    with pytest.raises(DatasetError, match=r"finger02_electrodes_raw, .* zeros in front"):
        ingest_lasa(path, fingers=fingers)
    assert len(ingest_lasa(path, fingers=(1,), lag_rows=0)) == ROWS


def test_counts_are_checked_where_the_lag_leaves_them_out(tmp_path: Path) -> None:
    arrays = finger(9)
    arrays["finger9_electrodes_raw"][0, 0] = -65000
    with pytest.raises(DatasetError, match="E1 reads -65000 in row 0"):
        ingest_lasa(archive(tmp_path, **arrays))


@pytest.mark.parametrize("kind", [np.float16, np.float32, ">f8", ">i4"])
def test_whole_counts_of_any_kind_are_read(tmp_path: Path, kind: str) -> None:
    arrays = finger(9)
    arrays["finger9_electrodes_raw"] //= 2  # half-precision numbers hold whole ones to 2048
    path = archive(tmp_path, **arrays | {
        "finger9_electrodes_raw": arrays["finger9_electrodes_raw"].astype(kind)
    })  # fmt: skip
    data = ingest_lasa(path, lag_rows=0)
    np.testing.assert_array_equal(data.electrodes, arrays["finger9_electrodes_raw"])


@pytest.mark.parametrize(
    ("what", "kind"), [("force_N", complex), ("electrodes_raw", "U6"), ("baseline_mean", bool)]
)
def test_arrays_that_hold_no_real_numbers(tmp_path: Path, what: str, kind: Any) -> None:
    arrays = finger(9)
    arrays[f"finger9_{what}"] = arrays[f"finger9_{what}"].astype(kind)
    with pytest.raises(DatasetError, match=f"finger 9: {what} holds .*, not real numbers"):
        ingest_lasa(archive(tmp_path, **arrays))


@pytest.mark.parametrize(
    ("factor", "told"),
    [(1e3, "finger 9: the force is 3008 N in row 0"), (1e-3, "finger 9: no force is above 0.2 N")],
)
def test_forces_in_another_unit(tmp_path: Path, factor: float, told: str) -> None:
    arrays = finger(9)
    arrays["finger9_force_N"] *= factor
    with pytest.raises(DatasetError, match=told) as refused:
        ingest_lasa(archive(tmp_path, **arrays))
    assert "newtons" in str(refused.value.remedy)


def test_a_force_that_is_not_known(tmp_path: Path) -> None:
    arrays = finger(9)
    arrays["finger9_force_N"][40] = np.nan
    with pytest.raises(DatasetError, match="finger 9: force_N is not finite in row 40"):
        ingest_lasa(archive(tmp_path, **arrays))


def test_a_baseline_that_is_not_known(tmp_path: Path) -> None:
    arrays = finger(9)
    arrays["finger9_baseline_mean"][3] = np.nan
    with pytest.raises(DatasetError, match="finger 9: baseline_mean of E4 is not finite"):
        ingest_lasa(archive(tmp_path, **arrays))


def test_untouched_rows_are_not_in_contact(tmp_path: Path) -> None:
    arrays = finger(9)
    arrays["finger9_force_N"][:30] = 0.1
    data = ingest_lasa(archive(tmp_path, **arrays), lag_rows=2)
    assert data.in_contact is not None
    # A row has the electrodes of two rows later.
    np.testing.assert_array_equal(np.flatnonzero(data.in_contact), np.arange(30, ROWS - 2))
    assert "in contact above 0.2 N: 28 of 58 rows" in data.provenance.notes
    pressed = ingest_lasa(archive(tmp_path, **finger(9)))
    assert "always in contact" in pressed.provenance.notes


def test_an_array_that_a_finger_lacks(tmp_path: Path) -> None:
    arrays = finger(1) | finger(2)
    del arrays["finger2_baseline_mean"]
    path = archive(tmp_path, **arrays)
    with pytest.raises(DatasetError, match="finger 2 lacks finger2_baseline_mean ->") as refused:
        ingest_lasa(path)
    assert "--finger 1 reads the rest" in str(refused.value.remedy)
    assert ingest_lasa(path, fingers=(1,)).sensor_names == ("lasa-finger1",)
    with pytest.raises(DatasetError, match="has no finger 7; it has 1, 2 ->"):
        ingest_lasa(path, fingers=(7,))


def test_a_force_without_electrodes(tmp_path: Path) -> None:
    arrays = finger(2)
    del arrays["finger2_electrodes_raw"]
    with pytest.raises(DatasetError, match="finger 2 lacks finger2_electrodes_raw ->"):
        ingest_lasa(archive(tmp_path, **arrays))


def test_names_with_zeros_in_front(tmp_path: Path) -> None:
    arrays = {name.replace("finger1_", "finger01_"): value for name, value in finger(1).items()}
    with pytest.raises(
        DatasetError, match=r"has finger01_electrodes_raw, .* zeros in front"
    ) as refused:
        ingest_lasa(archive(tmp_path, **arrays))
    assert "finger1_electrodes_raw" in str(refused.value.remedy)


def test_electrodes_at_an_end_of_the_range(tmp_path: Path) -> None:
    arrays = finger(1) | finger(2)
    arrays["finger2_electrodes_raw"][:, 4] = 4095
    arrays["finger2_electrodes_raw"][10:13, 12] = (0, 1, 4094)
    arrays["finger2_electrodes_raw"][20:22, 13] = (2, 4093)
    data = ingest_lasa(archive(tmp_path, **arrays), lag_rows=0)
    assert electrodes_at_ends(data) == {"lasa-finger2": {"E5": ROWS, "E13": 3}}


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 300.0])
def test_another_rate_becomes_times(tmp_path: Path, rate_hz: float) -> None:
    path = archive(tmp_path, **finger(1), **finger(2, rows=40))
    data = ingest_lasa(path, rate_hz=rate_hz)
    assert data.time_ns is not None
    for sensor in (0, 1):
        times = data.time_ns[data.sensor == sensor]
        assert period_of(times) == pytest.approx(1.0 / rate_hz, rel=1e-6)
    assert f"{rate_hz:g} Hz as told" in data.provenance.notes
    assert ingest_lasa(path).time_ns is None


def test_forces_of_the_other_sign_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    arrays = finger(9)
    ingest_lasa(archive(tmp_path, **arrays))
    assert not caplog.records
    arrays["finger9_force_N"] *= -1.0
    ingest_lasa(archive(tmp_path, **arrays))
    assert "finger 9: the mean force along z is -3 N" in caplog.text


def test_commands_tell_electrodes_at_an_end_of_the_range(tmp_path: Path) -> None:
    arrays = finger(1)
    arrays["finger1_electrodes_raw"][:, 4] = 4095
    path, out = archive(tmp_path, **arrays), str(tmp_path / "out.h5")
    for command in (["ingest-lasa", str(path), out, "--rate-hz", "50"], ["inspect", out]):
        result = CliRunner().invoke(data_app, command, catch_exceptions=False)
        assert result.exit_code == 0
        assert "range: lasa-finger1: E5 in 58 rows" in " ".join(result.output.split())
    found = CliRunner().invoke(data_app, ["inspect", out, "--json"], catch_exceptions=False)
    assert json.loads(found.output)["at_end_of_range"] == {"lasa-finger1": {"E5": 58}}
    assert "50 Hz as told" in json.loads(found.output)["provenance"]["notes"]
