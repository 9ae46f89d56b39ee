"""Tapes: what is written is read, and little is lost on the way."""

from __future__ import annotations

import dataclasses
import importlib
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import ConfigError, DatasetError
from palpate.files.tape import Tape, check_tape, read_tape, write_tape
from palpate.files.tape_build import build_tape, tape_specimen

sys.path.append(str(Path(__file__).parent))
fakes: Any = importlib.import_module("tape_arrays")


@pytest.fixture
def tape() -> Tape:
    return build_tape(**fakes.arrays())


def test_what_is_written_is_read(tape: Tape, tmp_path: Path) -> None:
    digest = write_tape(tmp_path / "a.npz", tape)
    assert fakes.plain(read_tape(tmp_path / "a.npz")) == fakes.plain(tape)
    assert write_tape(tmp_path / "b.npz", tape) == digest
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.npz"]


def test_numpy_alone_can_look_at_it(tape: Tape, tmp_path: Path) -> None:
    write_tape(tmp_path / "a.npz", tape)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        header = json.loads(archive["header"].tobytes())
        assert archive["counts"].shape == (2, 10, 19)
    assert (header["schema"], header["version"], header["frame"]) == ("palpate.tape", 1, "sensor")
    assert header["units"]["force"] == "N"
    assert json.loads(header["fingers"][0]["parameters"])["gain"] == [0.0] * 19


def test_step_0_is_untouched_and_the_others_are_what_was_given(tape: Tape) -> None:
    given = fakes.arrays()["presses"]
    for press, one in zip(given, tape.trajectories, strict=True):
        assert not tape.displacement(one.coefficients[0]).any()
        for k in range(5):
            decoded = tape.displacement(one.coefficients[k])
            np.testing.assert_allclose(decoded, press.displacement[k], atol=4e-6)
        np.testing.assert_array_equal(one.counts, press.counts.astype(np.float32))
        np.testing.assert_array_equal(one.poses, press.poses)


def test_little_is_lost_on_smooth_fields(tmp_path: Path) -> None:
    """The bound of the decision: 5 um of mean nodal error; a finer step loses less."""
    given = fakes.arrays(side=15, count=12)
    errors = []
    for step_m in (2e-6, 0.1e-6):
        tape = build_tape(**given, step_m=step_m)
        decoded = [tape.displacement(c) for one in tape.trajectories for c in one.coefficients]
        true = np.concatenate([press.displacement for press in given["presses"]])
        errors.append(np.linalg.norm(np.array(decoded) - true, axis=2).mean())
    assert np.linalg.norm(true, axis=2).max() > 2e-3
    assert errors[0] < 5e-6
    assert errors[1] < 0.2 * errors[0]
    few = build_tape(**given, modes=3)
    assert few.modes.shape == (3, 225, 3)


def test_modes_too_strong_for_16_bits_get_a_coarser_step() -> None:
    given = fakes.arrays()
    given["presses"] = [
        dataclasses.replace(p, displacement=p.displacement * 100.0) for p in given["presses"]
    ]
    tape = build_tape(**given)
    for press, one in zip(given["presses"], tape.trajectories, strict=True):
        decoded = tape.displacement(one.coefficients[-1])
        assert np.abs(decoded - press.displacement[-1]).max() < 1e-4 * 0.3


def test_what_is_not_there(tape: Tape, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.npz cannot be read"):
        read_tape(tmp_path / "none.npz")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_tape(tmp_path)
    with pytest.raises(ConfigError, match="end in"):
        write_tape(tmp_path / "a.tape", tape)
    with pytest.raises(DatasetError, match="cannot write"):
        write_tape(tmp_path / "nowhere" / "a.npz", tape)


def test_a_failed_write_leaves_the_old_file(
    tape: Tape, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.npz"
    write_tape(path, tape)
    before = path.read_bytes()

    def full(file: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DatasetError, match="No space left"):
        write_tape(path, dataclasses.replace(tape, source="another"))
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["a.npz"]


def test_a_wrong_tape_is_not_written(tape: Tape, tmp_path: Path) -> None:
    broken = dataclasses.replace(tape, mode_scales=tape.mode_scales[:-1])
    with pytest.raises(DatasetError, match="mode_scales has shape"):
        check_tape(broken)
    with pytest.raises(DatasetError, match="mode_scales has shape"):
        write_tape(tmp_path / "a.npz", broken)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"presses": []}, "at least one press"),
        ({"specimens": []}, "no specimens"),
        ({"nodes": fakes.patch(2)}, r"'p0' has shape \(5, 9, 3\), not \(K, 4, 3\)"),
        ({"mesh_sha256": b"short"}, "mesh_sha256"),
    ],
)
def test_arrays_that_make_no_tape(change: dict[str, Any], message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        build_tape(**{**fakes.arrays(), **change})


@pytest.mark.parametrize(
    ("text", "message"),
    [("{", "no JSON"), ("[]", "no number 'noise_counts'"), ('{"noise_counts": true}', "no number")],
)
def test_parameters_that_make_no_unit(text: str, message: str) -> None:
    with pytest.raises(DatasetError, match=f"specimen 'one'.*{message}"):
        tape_specimen("one", text, fakes.REST)


def test_presses_that_displace_nothing() -> None:
    given = fakes.arrays()
    given["presses"] = [
        dataclasses.replace(p, displacement=0.0 * p.displacement) for p in given["presses"]
    ]
    with pytest.raises(DatasetError, match="no press displaces anything"):
        build_tape(**given)
