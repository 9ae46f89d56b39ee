"""Times of a LeRobotDataset: those of the rows, or the export is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.training.invented_population import population

from palpate.errors import DatasetError
from palpate_training.datasets.features import FeatureDataset
from palpate_training.datasets.lerobot import export_lerobot, read_lerobot

ROWS = 200


def rows_at(*rates_hz: float) -> FeatureDataset:
    """A press of ``ROWS`` rows on a finger for each rate: ``finger-0`` and so on."""
    known = population(specimens=1, presses=2 * ROWS, each=1)
    rows = np.arange(ROWS * len(rates_hz)) % len(known)
    sensor = np.repeat(np.arange(len(rates_hz), dtype=np.int32), ROWS)
    return FeatureDataset(
        electrodes=known.electrodes[rows],
        baseline=known.baseline[rows],
        force=known.force[rows],
        group=sensor,
        block=sensor,
        sensor=sensor,
        sensor_names=tuple(f"finger-{number}" for number in range(len(rates_hz))),
        provenance=known.provenance,
        time_ns=np.concatenate([np.rint(1e9 * np.arange(ROWS) / rate) for rate in rates_hz]).astype(
            np.int64
        ),
    )


def largest_error_s(folder: Path) -> float:
    """By how much a timestamp is off the row's own time since the episode began [s], at most."""
    table = read_lerobot(folder)
    timestamp, time_ns, episode = (
        table.column(name).to_numpy() for name in ("timestamp", "time_ns", "episode_index")
    )
    first = np.searchsorted(episode, episode)
    return float(np.abs(timestamp - 1e-9 * (time_ns - time_ns[first])).max())


@pytest.mark.parametrize("fps", [50.0, 67.0, 49.0, 30.0, 200.0, 97.0])
def test_a_rate_that_contradicts_the_times_is_refused(tmp_path: Path, fps: float) -> None:
    with pytest.raises(DatasetError, match=f"'finger-0' come at 100 a second, not {fps:g}"):
        export_lerobot(tmp_path / "set", rows_at(100.0), fps=fps)
    assert not list(tmp_path.iterdir())


def test_sensors_of_other_rates_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="'finger-1' come at 71 a second, not 100"):
        export_lerobot(tmp_path / "set", rows_at(100.0, 71.0))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("fps", [None, 100.0, 100.5])
def test_timestamps_stay_within_half_a_step_of_the_times(tmp_path: Path, fps: float | None) -> None:
    """Also of a rate that is nearly right, over a long episode."""
    assert export_lerobot(tmp_path / "set", rows_at(100.0, 99.0), fps=fps) < 12
    assert largest_error_s(tmp_path / "set") <= 0.00501


def test_times_in_whole_milliseconds_are_one_episode(tmp_path: Path) -> None:
    """Their median step, 10 ms, says 100 Hz of 97: half a step is reached after 17 rows."""
    data = rows_at(97.0)
    assert data.time_ns is not None
    rounded = replace(data, time_ns=data.time_ns // 1_000_000 * 1_000_000)
    assert export_lerobot(tmp_path / "set", rounded) == 1
    assert largest_error_s(tmp_path / "set") < 0.002


@pytest.mark.parametrize("fps", [None, 100.0])
def test_rows_of_two_fingers_between_one_another_are_two_episodes(
    tmp_path: Path, fps: float | None
) -> None:
    apart = rows_at(100.0, 100.0)
    assert apart.time_ns is not None
    order = np.argsort(apart.time_ns, kind="stable")
    columns: dict[str, Any] = {name: array[order] for name, array in apart.arrays().items()}
    between = replace(apart, **columns)
    assert list(between.sensor[:4]) == [0, 1, 0, 1]
    assert export_lerobot(tmp_path / "set", between, fps=fps) == 2
    written = read_lerobot(tmp_path / "set")
    for name in ("time_ns", "group"):
        np.testing.assert_array_equal(written.column(name), getattr(apart, name))
    np.testing.assert_array_equal(
        written.column("observation.force").to_pylist(), apart.force.tolist()
    )


@pytest.mark.parametrize("fps", [None, 100.0])
@pytest.mark.parametrize("row", [0, 1], ids=["of the first", "of the last"])
def test_rows_that_share_a_time_are_one_episode(
    tmp_path: Path, row: int, fps: float | None
) -> None:
    """Rows sent in pairs, with the time of one of them: 100 a second, and no row is missing."""
    data = rows_at(100.0)
    assert data.time_ns is not None
    pairs = replace(data, time_ns=np.repeat(data.time_ns[row::2], 2))
    assert export_lerobot(tmp_path / "set", pairs, fps=fps) == 1
    info = json.loads((tmp_path / "set/meta/info.json").read_text(encoding="utf-8"))
    assert info["fps"] == 100
    assert largest_error_s(tmp_path / "set") <= 0.01001


def test_an_episode_ends_where_a_burst_of_rows_is_missing(tmp_path: Path) -> None:
    data = rows_at(100.0)
    assert data.time_ns is not None
    times = np.repeat(data.time_ns[::2], 2)
    times[100:] += 20_000_000
    with_a_hole = replace(data, time_ns=times)
    assert export_lerobot(tmp_path / "set", with_a_hole) == 2


def test_a_time_twice_ends_no_episode(tmp_path: Path) -> None:
    data = rows_at(100.0)
    assert data.time_ns is not None
    times = data.time_ns.copy()
    times[4::5] = times[3::5]
    assert export_lerobot(tmp_path / "set", replace(data, time_ns=times)) == 1
