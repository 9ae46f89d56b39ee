"""``palpate train all``: every bundle of a data set by one command, or none of them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from palpate.errors import BundleError, ConfigError, DatasetError
from palpate.files.bundle import read_bundle
from palpate_training.cli import train_app
from palpate_training.datasets.experiment import MixedDataset, write_mixed
from palpate_training.datasets.export import export_published, features
from palpate_training.datasets.features import write_dataset


def test_one_command_trains_all_bundles_and_writes_their_cards(
    mixed: MixedDataset, tmp_path: Path
) -> None:
    write_mixed(tmp_path / "mixed.h5", mixed)
    arguments = ["all", str(tmp_path / "mixed.h5"), str(tmp_path / "models")]
    arguments += ["--unit", "biotac-2", "--name", "mine", "--version", "7", "--epochs", "2"]
    result = CliRunner().invoke(train_app, arguments)
    assert result.exit_code == 0, result.output
    cards = (tmp_path / "models" / "cards.md").read_text(encoding="utf-8")
    for task in ("features", "field", "synthesis"):
        manifest = read_bundle(tmp_path / "models" / f"{task}-mine" / "7").manifest
        assert (manifest.task, manifest.version) == (task, 7)
        assert f"# {task}-mine 7" in cards
    assert (
        "biotac-2" in read_bundle(tmp_path / "models" / "synthesis-mine" / "7").manifest.trained_on
    )
    # One that is there already: refused before anything is trained.
    (tmp_path / "models" / "field-mine" / "8").mkdir()
    again = CliRunner().invoke(train_app, [*arguments, "--version", "8"])
    assert isinstance(again.exception, BundleError)
    assert not (tmp_path / "models" / "features-mine" / "8").exists()
    # Nor is anything trained where the specimen of the last one is not known.
    again = CliRunner().invoke(train_app, [*arguments, "--version", "9", "--unit", "biotac-9"])
    assert isinstance(again.exception, DatasetError)
    assert "biotac-9" in str(again.exception)
    assert not (tmp_path / "models" / "features-mine" / "9").exists()


def test_published_files_have_features_alone_and_it_says_so(
    mixed: MixedDataset, tmp_path: Path
) -> None:
    export_published(tmp_path / "published", mixed.experiment)
    arguments = ["all", str(tmp_path / "published"), str(tmp_path / "models")]
    result = CliRunner().invoke(train_app, [*arguments, "--assumed-rest", "3200", "--epochs", "2"])
    assert result.exit_code == 0, result.output
    assert "no displacements" in result.output
    assert [each.name for each in (tmp_path / "models").iterdir() if each.is_dir()] == [
        "features-twin"
    ]


@pytest.mark.parametrize("task", ["features", "field", "synthesis"])
def test_a_gpu_that_is_not_there_is_told_before_a_training(
    mixed: MixedDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, task: str
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    data, out = tmp_path / "data.h5", tmp_path / "bundle"
    if task == "features":
        write_dataset(data, features(mixed))
        arguments = [task, "--data", str(data), "--out", str(out)]
    else:
        write_mixed(data, mixed)
        arguments = [task, str(data), str(out)]
    arguments += ["--unit", "biotac-2"] if task == "synthesis" else []
    result = CliRunner().invoke(train_app, [*arguments, "--device", "cuda", "--epochs", "1"])
    assert isinstance(result.exception, ConfigError)
    assert "no GPU" in str(result.exception)
    assert not out.exists()
