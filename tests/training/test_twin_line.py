"""A line through a simulated population: what it says, how it is kept, and as a prior."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.training.invented_population import population
from typer.testing import CliRunner

from palpate.anatomy import ELECTRODE_MIRROR
from palpate.errors import DatasetError
from palpate_training.cli import train_app
from palpate_training.datasets.features import FeatureDataset, write_dataset
from palpate_training.evaluation.transfer import fingers_of
from palpate_training.learning.electrode_nets import MIRROR_AXES
from palpate_training.learning.twin_line import TwinLine, fit_line, read_line, write_line
from palpate_training.systems import transfer


@pytest.fixture(scope="module")
def data() -> FeatureDataset:
    return population(gain_sd=0.05, presses=60)


def test_it_estimates_what_is_linear(data: FeatureDataset) -> None:
    line = fit_line(data)
    error = line.force(data.electrodes, data.baseline) - data.force
    assert np.median(np.linalg.norm(error, axis=1)) < 0.4 * np.linalg.norm(data.force.std(axis=0))
    assert line.data_sha256 == data.content_sha256()


def test_a_common_offset_changes_nothing_and_a_mirror_image_mirrors() -> None:
    line = read_line()
    rest = np.full((3, 19), 3000.0)
    rng = np.random.default_rng(0)
    change = rng.normal(0.0, 0.2, (3, 19))

    def counts(logs: np.ndarray) -> np.ndarray:
        return np.asarray(4095.0 / (1.0 + (4095.0 / rest - 1.0) * np.exp(logs)))

    plain = line.force(counts(change), rest)
    np.testing.assert_allclose(line.force(counts(change + 0.1), rest), plain, atol=1e-5)
    there = line.force(counts(change[:, ELECTRODE_MIRROR]), rest)
    np.testing.assert_allclose(there, plain * MIRROR_AXES, atol=1e-4)


def test_it_replaces_nothing_else(data: FeatureDataset, tmp_path: Path) -> None:
    rows, notes = tmp_path / "rows.h5", tmp_path / "notes.json"
    write_dataset(rows, data)
    notes.write_text("{}")
    for out, problem in ((rows, "written as JSON"), (notes, "exists and is no line")):
        before = out.read_bytes()
        result = CliRunner().invoke(train_app, ["line", str(rows), str(out)])
        assert isinstance(result.exception, DatasetError)
        assert problem in str(result.exception)
        assert out.read_bytes() == before
    write_line(tmp_path / "line.json", fit_line(data))
    write_line(tmp_path / "line.json", fit_line(data))


def test_it_is_kept_and_read_again(data: FeatureDataset, tmp_path: Path) -> None:
    write_dataset(tmp_path / "rows.h5", data)
    arguments = ["line", str(tmp_path / "rows.h5"), str(tmp_path / "line.json")]
    result = CliRunner().invoke(train_app, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    there, here = read_line(tmp_path / "line.json"), fit_line(data)
    np.testing.assert_allclose(there.weight, here.weight, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(there.offset, here.offset, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    "change",
    [
        {"format": "palpate.twin-line/9"},
        {"weight": [[1.0, 2.0, 3.0]] * 18},
        {"offset": [0.0, 0.0, float("inf")]},
        {"weight": None},
    ],
)
def test_what_is_no_line_is_refused(
    data: FeatureDataset, tmp_path: Path, change: dict[str, object]
) -> None:
    path = tmp_path / "line.json"
    write_line(path, fit_line(data))
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(DatasetError, match="palpate train line"):
        read_line(path)
    with pytest.raises(DatasetError, match="palpate train line"):
        read_line(tmp_path / "none.json")


def test_too_few_touched_rows_are_refused(data: FeatureDataset) -> None:
    untouched = replace(data, force=np.zeros_like(data.force))
    with pytest.raises(DatasetError, match="0 rows"):
        fit_line(untouched)


def test_as_a_prior_it_helps_and_its_scale_and_axes_do_not_matter(
    data: FeatureDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transfer, "SOURCE_ROWS", 8)
    source, finger = (
        one.recording for one in fingers_of(data) if one.name in ("unit-004", "unit-009")
    )
    line = fit_line(data)
    scale = np.array([0.3, 0.3, 0.5])
    scaled = TwinLine(line.weight * scale, line.offset * scale, "")
    truth = np.linalg.norm(finger.force, axis=1)
    lengths = [
        np.linalg.norm(
            transfer.ForceTransfer([source], prior).estimate(finger, unlabelled=False), axis=1
        )
        for prior in (None, line, scaled)
    ]
    without, with_line, _ = (np.median(np.abs(length - truth)) for length in lengths)
    assert with_line < 0.9 * without
    np.testing.assert_allclose(lengths[2], lengths[1], atol=1e-6)
