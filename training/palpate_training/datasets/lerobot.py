"""Rows of features as a LeRobotDataset, and a LeRobotDataset as a table.

Written is version 3.0 of that format: ``data/chunk-000/file-000.parquet`` with a list of numbers
for each feature, ``meta/info.json``, ``meta/stats.json``, ``meta/tasks.parquet`` and
``meta/episodes/chunk-000/file-000.parquet``. There is no video. Read are all Parquet files of
versions 2 and 3, in order.

An episode is a run of rows of one press at an even rate: LeRobot computes times from the number of
a frame, and refuses others. A row whose time differs from that by more than half a step begins the
next one; rows that share a time do not, as long as it can be that of one of them. The true time of
a row stays in the feature ``time_ns``, its finger in ``sensor``, its press in ``group`` and
``block``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.process import require
from palpate_training.datasets.export import written_new
from palpate_training.datasets.features import (
    ELECTRODES,
    STEP_TOLERANCE,
    FeatureDataset,
    period_of_steps,
    recording_of,
)
from palpate_training.datasets.tables import LISTS, METADATA, facts_of, read_table

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = "v3.0"
TASK = "press the finger"

_NAMES = {ELECTRODES: [f"E{number + 1}" for number in range(ELECTRODES)], 3: list("xyz")}
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_RATE_TOLERANCE = 0.02
"""Share by which a sensor's rows a second may differ from the rate of all."""

Ints = npt.NDArray[np.int64]


def export_lerobot(folder: Path, data: FeatureDataset, *, fps: float | None = None) -> int:
    """Write a folder, complete or not at all; returns the number of episodes.

    Args:
        folder: Must not exist.
        data: Rows; where nothing touches, what only a contact has is NaN. Rows of several fingers
            that lie between one another are written finger after finger.
        fps: Rows a second; None = what the rows' times say.

    Raises:
        DatasetError: The folder exists, the rows have no times and no rate is given, the times of a
            sensor say another rate, or the disk refused.
        MissingExtraError: pyarrow is not installed.
    """
    arrow = require("pyarrow", extra="training")
    import pyarrow.parquet as parquet

    data = _recordings_apart(data)
    rate = _rate(data, fps)
    episode = _episodes(data, rate)
    starts = np.flatnonzero(np.diff(episode, prepend=-1))
    lengths = np.diff(np.append(starts, len(data)))
    frame = np.arange(len(data)) - np.repeat(starts, lengths)
    known = data.arrays()
    lists = {LISTS[name]: known[name].astype(np.float32) for name in LISTS if name in known}
    plain: dict[str, npt.NDArray[Any]] = {
        "timestamp": (frame / rate).astype(np.float32),
        "frame_index": frame.astype(np.int64),
        "episode_index": episode,
        "index": np.arange(len(data), dtype=np.int64),
        "task_index": np.zeros(len(data), np.int64),
        "sensor": np.array(data.sensor_names, object)[data.sensor],
        "group": data.group.astype(np.int64),
        "block": data.block.astype(np.int64),
    }
    plain |= {name: known[name] for name in ("in_contact", "time_ns") if name in known}
    columns = {name: _lists(arrow, values) for name, values in lists.items()} | plain
    numbers = {name: values for name, values in plain.items() if values.dtype != object}
    stats = {name: _statistics(values) for name, values in (lists | numbers).items()}

    def write(part: Path) -> None:
        place = part / _DATA.format(chunk_index=0, file_index=0)
        meta = part / "meta"
        for one in (place.parent, meta / "episodes/chunk-000"):
            one.mkdir(parents=True)
        parquet.write_table(arrow.table(columns), place, compression="zstd")
        parquet.write_table(_tasks(arrow), meta / "tasks.parquet")
        parquet.write_table(
            arrow.table(_episode_rows(starts, lengths)),
            meta / "episodes/chunk-000/file-000.parquet",
        )
        _write_json(meta / "stats.json", stats)
        _write_json(meta / "info.json", _info(data, rate, lists, plain, len(starts)))

    written_new(folder, write)
    return len(starts)


def read_lerobot(folder: Path) -> pa.Table:
    """All rows of a LeRobotDataset of version 2 or 3.

    Raises:
        DatasetError: It is none, or its files do not hold the rows that it says.
        MissingExtraError: pyarrow is not installed.
    """
    arrow = require("pyarrow", extra="training")
    place = folder / "meta/info.json"
    try:
        info = json.loads(place.read_text(encoding="utf-8"))
        version, frames = str(info["codebase_version"]), int(info["total_frames"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{folder} is no LeRobotDataset: {place.name}: {error}",
            remedy="give the folder that holds meta/info.json",
        ) from error
    if version.split(".")[0] not in ("v2", "v3"):
        raise DatasetError(
            f"{folder} is of version {version}", remedy="convert it to v2 or v3 with LeRobot"
        )
    files = sorted((folder / "data").glob("chunk-*/*.parquet"))
    tables = [read_table(file) for file in files]
    rows = sum(table.num_rows for table in tables)
    if rows != frames:
        raise DatasetError(
            f"{folder}: {len(files)} files hold {rows} rows, {place.name} says {frames}",
            remedy="fetch the whole data set, with its large files",
        )
    try:
        known = {METADATA: json.dumps(info.get(METADATA.decode(), {})).encode()}
        return arrow.concat_tables(tables).replace_schema_metadata(known)
    except arrow.ArrowException as error:
        raise DatasetError(
            f"{folder}: its files have different columns: {error}", remedy="fetch it again"
        ) from error


def _recordings_apart(data: FeatureDataset) -> FeatureDataset:
    """The same rows, so that those of a sensor and group follow one another."""
    recording = recording_of(data)
    if 1 + np.count_nonzero(np.diff(recording)) == len(np.unique(recording)):
        return data
    order = np.lexsort((np.arange(len(data)), data.group, data.sensor))
    columns: dict[str, Any] = {name: array[order] for name, array in data.arrays().items()}
    return replace(data, **columns)


def _rate(data: FeatureDataset, fps: float | None) -> float:
    """Rows a second of all sensors: ``fps``, or what the times of the first one say.

    Raises:
        DatasetError: Nothing says it, or the times of a sensor say something else.
    """
    remedy = "say how many rows there are a second: --fps"
    if data.time_ns is None:
        if fps is None:
            raise DatasetError(f"{data.name}: rows have no times", remedy=remedy)
        return float(fps)
    steps = np.diff(data.time_ns)
    same = (np.diff(data.group) == 0) & (np.diff(data.sensor) == 0)
    # Rounded to what people call such a rate: 100 and not 99.998 a second.
    rates = {
        name: float(f"{1.0 / period_s:.4g}")
        for number, name in enumerate(data.sensor_names)
        if (period_s := period_of_steps(steps[same & (data.sensor[1:] == number)]))
    }
    if fps is None and not rates:
        raise DatasetError(
            f"{data.name}: no press has two rows with times that rise", remedy=remedy
        )
    rate = float(fps) if fps is not None else next(iter(rates.values()))
    for name, own_rate in rates.items():
        if abs(own_rate / rate - 1.0) > _RATE_TOLERANCE:
            raise DatasetError(
                f"{data.name}: by their times the rows of {name!r} come at {own_rate:g} a second,"
                f" not {rate:g}",
                remedy="leave --fps out, and export sensors of different rates as data sets of"
                " their own",
            )
    return rate


def _episodes(data: FeatureDataset, rate: float) -> Ints:
    """Number of each row's episode: it ends with a press, a sensor, and where a row is missing."""
    new = (np.diff(data.group) != 0) | (np.diff(data.sensor) != 0)
    if data.time_ns is not None:
        other = np.concatenate([[True], new | (np.diff(data.time_ns) != 0)])
        first = np.flatnonzero(other)
        last = np.append(first[1:], len(data)) - 1
        since_s = 1e-9 * (data.time_ns[first] - data.time_ns[0])
        # How late an episode began, in rows, by those of one time: it may be that of any of them.
        least, most = since_s * rate - last, since_s * rate - first
        low, high = least[0], most[0]
        for at in range(1, len(first)):
            row = first[at]
            early, late = most[at] + STEP_TOLERANCE, least[at] - STEP_TOLERANCE
            new[row - 1] |= early < low or late > high
            if new[row - 1]:
                low, high = least[at], most[at]
            else:
                low, high = max(low, late), min(high, early)
    return np.concatenate([[0], np.cumsum(new)]).astype(np.int64)


def _lists(arrow: Any, values: npt.NDArray[np.float32]) -> Any:
    flat = arrow.array(np.ascontiguousarray(values).reshape(-1))
    return arrow.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _tasks(arrow: Any) -> Any:
    """The one task; pandas, which LeRobot reads it with, finds its name in the index."""
    index = {
        "index_columns": ["task"],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64",
             "numpy_type": "int64", "metadata": None},
            {"name": "task", "field_name": "task", "pandas_type": "unicode",
             "numpy_type": "object", "metadata": None},
        ],
        "column_indexes": [],
    }  # fmt: skip
    table = arrow.table({"task_index": np.zeros(1, np.int64), "task": [TASK]})
    return table.replace_schema_metadata({b"pandas": json.dumps(index).encode()})


def _episode_rows(starts: Ints, lengths: Ints) -> dict[str, Any]:
    none = np.zeros(len(starts), np.int64)
    return {
        "episode_index": np.arange(len(starts), dtype=np.int64),
        "tasks": [[TASK] for _ in starts],
        "length": lengths,
        "data/chunk_index": none,
        "data/file_index": none,
        "dataset_from_index": starts,
        "dataset_to_index": starts + lengths,
        "meta/episodes/chunk_index": none,
        "meta/episodes/file_index": none,
    }


def _statistics(values: npt.NDArray[Any]) -> dict[str, list[float]]:
    """Least, largest, mean and spread of each number, where it is known."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    known = rows[np.isfinite(rows).all(axis=1)]
    some = known if len(known) else np.zeros((1, rows.shape[1]))
    return {
        "min": some.min(axis=0).tolist(),
        "max": some.max(axis=0).tolist(),
        "mean": some.mean(axis=0).tolist(),
        "std": some.std(axis=0).tolist(),
        "count": [len(known)],
    }


def _info(
    data: FeatureDataset,
    rate: float,
    lists: Mapping[str, npt.NDArray[Any]],
    plain: Mapping[str, npt.NDArray[Any]],
    episodes: int,
) -> dict[str, Any]:
    features = {
        name: {"dtype": "float32", "shape": [values.shape[1]], "names": _NAMES[values.shape[1]]}
        for name, values in lists.items()
    } | {
        name: {
            "dtype": "string" if values.dtype == object else str(values.dtype),
            "shape": [1],
            "names": None,
        }
        for name, values in plain.items()
    }
    return {
        "codebase_version": VERSION,
        "robot_type": "biotac",
        "total_episodes": episodes,
        "total_frames": len(data),
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": int(rate) if float(rate).is_integer() else rate,
        "splits": {"train": f"0:{episodes}"},
        "data_path": _DATA,
        "video_path": None,
        "features": features,
        METADATA.decode(): json.loads(facts_of(data)),
    }


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
