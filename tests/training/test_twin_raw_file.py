"""Raw trials on disk: what goes in comes out, one by one, and what is broken is named."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.processing import process
from palpate_training.datasets.trials import (
    COLUMNS,
    RawTrial,
    TrialHeader,
    read_contents,
    read_trials,
    write_trials,
)

RATE_HZ = 20
SAMPLES = 20
"""Samples of an increment."""


def trial(
    unit: str = "biotac-1", trajectory: str = "cube/00/normal", slope: float = 3.0
) -> RawTrial:
    """Five increments; the force grows from the third on."""
    count = 5 * SAMPLES
    random = np.random.default_rng(list(f"{unit} {trajectory}".encode()))
    increment = np.arange(count) // SAMPLES
    force = np.zeros((count, 3))
    force[:, 2] = 1.5 + slope * np.maximum(increment - 1, 0)
    return RawTrial(
        header=TrialHeader(unit, trajectory, trajectory.split("/")[0], "left"),
        time_s=np.arange(count) / RATE_HZ,
        electrodes=random.integers(2000, 3000, (count, 19)).astype(np.uint16),
        force=force,
        tip=random.normal(0.0, 1e-3, (count, 3)),
        travel_m=np.asarray(1e-4 * (increment + 1.0), np.float64),
        increment_end=np.arange(SAMPLES - 1, count, SAMPLES, dtype=np.int64),
    )


TRIALS = [trial(), trial(trajectory="cube/01/normal"), trial("biotac-2")]


@pytest.fixture
def path(tmp_path: Path, provenance: Provenance) -> Path:
    write_trials(tmp_path / "t.h5", iter(TRIALS), provenance)
    return tmp_path / "t.h5"


def test_trials_come_back_in_order_and_give_the_same_rows(
    path: Path, provenance: Provenance
) -> None:
    back = list(read_trials(path))
    assert [one.header for one in back] == [one.header for one in TRIALS]
    for read, written in zip(back, TRIALS, strict=True):
        for name in COLUMNS:
            np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
            assert getattr(read, name).dtype == getattr(written, name).dtype
        rows, expected = process(read), process(written)
        for name in ("rest", "travel_m", "tared", "force", "location"):
            np.testing.assert_array_equal(getattr(rows, name), getattr(expected, name))
        assert len(rows.travel_m) == 4  # at 0.5 N, and the three increments above
    found = read_contents(path)
    assert found.headers == tuple(one.header for one in TRIALS)
    assert found.samples == (100, 100, 100)
    assert found.provenance == provenance
    assert [file.name for file in path.parent.iterdir()] == ["t.h5"], "no partial file is left"


def test_units_frame_and_compression_are_in_the_file(path: Path) -> None:
    with h5py.File(path) as file:
        assert file.attrs["schema"] == "palpate.trials"
        assert "x distal" in file.attrs["frame"]
        streams = file["trials/00001"]
        assert {name: streams[name].attrs["unit"] for name in streams} == {
            "time_s": "s",
            "electrodes": "counts",
            "force": "N",
            "tip": "m",
            "travel_m": "m",
            "increment_end": "1",
        }
        assert all(streams[name].chunks and streams[name].compression for name in streams)


def test_the_digest_is_of_the_content(path: Path, tmp_path: Path, provenance: Provenance) -> None:
    digest = read_contents(path).content_sha256
    assert write_trials(tmp_path / "same.h5", TRIALS, replace(provenance, command="x")) == digest
    turned = [TRIALS[0], TRIALS[1], replace(TRIALS[2], tip=TRIALS[2].tip + 1e-9)]
    assert write_trials(tmp_path / "other.h5", turned, provenance) != digest
    named = replace(TRIALS[2], header=replace(TRIALS[2].header, arm="right"))
    assert write_trials(tmp_path / "arm.h5", [*TRIALS[:2], named], provenance) != digest


def _unit(name: str, unit: str) -> Callable[[Any], None]:
    return lambda file: file[name].attrs.__setitem__("unit", unit)


def _rename(file: Any) -> None:
    """The third trial becomes a second run of the first."""
    file["trials/00002"].attrs["unit"] = "biotac-1"


def _shorten(file: Any) -> None:
    streams = file["trials/00000"]
    force = streams["force"][:-1]
    del streams["force"]
    streams.create_dataset("force", data=force).attrs["unit"] = "N"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.attrs.__setitem__("schema", "palpate.mixed"), "schema is 'palpate.mixed'"),
        (lambda f: f.attrs.__setitem__("schema_version", 2), "version 2.*update palpate"),
        (lambda f: f.attrs.__setitem__("frame", "world"), "frame is 'world'"),
        (lambda f: f.attrs.__delitem__("content_sha256"), "content_sha256 is missing"),
        (lambda f: f.attrs.__delitem__("trial_count"), "trial_count is missing"),
        (lambda f: f.__delitem__("trials"), "group trials/00000 is missing; .* 3 trials"),
        (lambda f: f.__delitem__("trials/00001"), "group trials/00001 is missing"),
        (lambda f: f.copy("trials/00001", "trials/00003"), "has 4 groups; .* 3 trials"),
        (lambda f: f["trials/00001"].attrs.__delitem__("arm"), "00001 has no attribute arm"),
        (_rename, "biotac-1 cube/00/normal is there twice"),
        (lambda f: f["trials/00000"].attrs.__setitem__("content_sha256", "ab"), "do not match its"),
        (lambda f: f.__delitem__("trials/00000/tip"), "'trials/00000/tip' is missing"),
        (_unit("trials/00000/tip", "mm"), "00000/tip is in 'mm', expected 'm'"),
        (_unit("trials/00000/force", ""), "00000/force is in 'no stated unit'"),
        (_shorten, "biotac-1 cube/00/normal: force is float64 .99, 3."),
        (
            lambda f: f["trials/00000/force"].__setitem__((7, 0), 9.0),
            "trials/00000 .biotac-1 cube/00/normal. does not match its content_sha256",
        ),
        (
            lambda f: f["trials/00000"].attrs.__setitem__("arm", "right"),
            "trials/00000 .* does not match its content_sha256",
        ),
    ],
)
def test_a_broken_file_is_named(path: Path, change: Callable[[Any], None], words: str) -> None:
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(DatasetError, match=words) as caught:
        list(read_trials(path))
    assert str(path) in str(caught.value)
    assert caught.value.remedy


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.95])
def test_a_truncated_file_is_named(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DatasetError, match=r"t\.h5.*truncated or damaged"):
        list(read_trials(path))


def test_trials_are_read_one_by_one(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["trials/00001/force"][3, 1] = 7.0
    trials = read_trials(path)
    assert next(trials).header == TRIALS[0].header
    with pytest.raises(DatasetError, match="trials/00001"):
        next(trials)


def test_what_is_no_trial_is_not_written(tmp_path: Path, provenance: Provenance) -> None:
    one = TRIALS[0]
    high = one.electrodes.copy()
    high[4, 2] = 4096
    for wrong, words in (
        ([], "no trials"),
        ([one, TRIALS[1], one], "biotac-1 cube/00/normal is there twice"),
        ([replace(one, tip=one.tip[:-1])], "tip is float64"),
        ([replace(one, electrodes=one.electrodes[:, :18])], "electrodes is uint16"),
        ([replace(one, force=one.force.astype(np.float32))], "force is float32"),
        ([replace(one, electrodes=high)], "4095 counts in sample 4"),
        ([replace(one, increment_end=one.increment_end[:0])], "increment_end"),
    ):
        with pytest.raises(DatasetError, match=words):
            write_trials(tmp_path / "new.h5", wrong, provenance)
        assert not list(tmp_path.iterdir())


def test_an_interrupted_write_leaves_the_old_file(path: Path, provenance: Provenance) -> None:
    before = path.read_bytes()

    def broken() -> Iterator[RawTrial]:
        yield TRIALS[0]
        raise DatasetError("the source ends here", remedy="none")

    with pytest.raises(DatasetError, match="ends here"):
        write_trials(path, broken(), provenance)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["t.h5"]
