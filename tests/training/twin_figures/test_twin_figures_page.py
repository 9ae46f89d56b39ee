"""The page with its pictures, and the command that writes it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.errors import ConfigError, DatasetError
from palpate_training.cli import data_app
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    MixedDataset,
    write_experiment,
    write_mixed,
)
from palpate_training.figures.noise import IdleStream
from palpate_training.figures.page import PAGE, PageSources, write_page
from palpate_training.figures.plate import PlateLog

pytest.importorskip("matplotlib", reason="matplotlib not installed (extra training)")
pytest.importorskip("h5py", reason="h5py not installed (extra training)")

MakeTrials = Callable[..., ExperimentDataset]
MakeFields = Callable[..., MixedDataset]


def _pictures(folder: Path) -> set[str]:
    """Names of the pictures, which must all be whole, shown by the page, and nothing else there."""
    page = (folder / PAGE).read_text(encoding="utf-8")
    shown = set(re.findall(r"!\[[^\]]*\]\(([^)]+)\)", page))
    assert {path.name for path in folder.iterdir()} == {PAGE, *shown}
    for name in shown:
        content = (folder / name).read_bytes()
        assert content.startswith(b"\x89PNG")
        assert b"IEND" in content[-12:]
    return shown


def test_page_with_everything(
    trials_data: MakeTrials, fields_data: MakeFields, tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    counts = 3000 + rng.normal(size=(6000, 19))
    rest = PlateLog(
        "log1",
        0.01 * np.arange(40.0),
        np.repeat([2400.0, 2700], [30, 10]),
        3000 - 300.0 * np.repeat([[0], [1]], [30, 10], axis=0) * np.ones(19),
        np.tile([0.0, 0, 1], (40, 1)),
    )
    steps: list[str] = []
    sources = PageSources(
        experiment=trials_data(),
        mixed=fields_data(),
        idle=(
            IdleStream("biotac-1", 100.0, counts, real=False),
            IdleStream("real, idle", 100.0, counts, real=True),
        ),
        plate=(rest,),
    )
    statistics = write_page(
        tmp_path / "page", sources, command="palpate data figures x.h5", on_step=steps.append
    )
    assert _pictures(tmp_path / "page") == {
        "contacts.png", "force.png", "electrodes.png", "motion.png", "noise.png", "signs.png",
    }  # fmt: skip
    page = (tmp_path / "page" / PAGE).read_text(encoding="utf-8")
    assert "`palpate data figures x.h5`" in page
    assert "made by a test" in page  # where the data set comes from
    assert f"| trials, all units | {statistics.trials} | 889 |" in page
    assert "biotac-1 4.5 N" in page  # largest magnitude, in the caption
    assert "No idle stream" not in page
    assert "0 % of their samples repeat" in page
    assert "same sign" in page
    assert len(steps) == 7
    assert len(page.splitlines()) > 60
    assert all(line == line.rstrip() for line in page.splitlines())


def test_page_leaves_out_what_is_not_given(trials_data: MakeTrials, tmp_path: Path) -> None:
    write_page(tmp_path, PageSources(trials_data(units=1)), command="test")
    assert _pictures(tmp_path) == {"contacts.png", "force.png", "electrodes.png"}
    page = (tmp_path / PAGE).read_text(encoding="utf-8")
    assert "nominal fingertip" in page
    for absent in ("## Skin motion", "## Noise", "## Rise"):
        assert absent not in page


def test_page_says_when_the_twin_has_no_idle_stream(
    trials_data: MakeTrials, tmp_path: Path
) -> None:
    stream = IdleStream("real", 100.0, np.random.default_rng(0).normal(size=(6000, 19)), real=True)
    write_page(tmp_path, PageSources(trials_data(), idle=(stream,)), command="test")
    assert "No idle stream of the twin" in (tmp_path / PAGE).read_text(encoding="utf-8")


def test_unit_without_trials_is_named_and_nothing_is_written(
    trials_data: MakeTrials, tmp_path: Path
) -> None:
    data = trials_data(units=2)
    data = replace(data, unit_names=(*data.unit_names, "biotac-9"))
    with pytest.raises(DatasetError, match="biotac-9"):
        write_page(tmp_path / "page", PageSources(data), command="test")
    assert not (tmp_path / "page").exists()


def test_folder_that_cannot_be_made_is_named(trials_data: MakeTrials, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file", encoding="utf-8")
    with pytest.raises(DatasetError, match="taken"):
        write_page(tmp_path / "taken", PageSources(trials_data()), command="test")


def test_more_units_than_the_paper_stand_without_its_numbers(
    trials_data: MakeTrials, tmp_path: Path
) -> None:
    write_page(tmp_path, PageSources(trials_data(units=7)), command="test")
    page = (tmp_path / PAGE).read_text(encoding="utf-8")
    (line,) = [line for line in page.splitlines() if line.startswith("| largest force")]
    assert line.count("(") == 3


def test_command_writes_the_page(fields_data: MakeFields, tmp_path: Path) -> None:
    mixed = fields_data(units=2)
    write_experiment(tmp_path / "e.h5", mixed.experiment)
    write_mixed(tmp_path / "m.h5", mixed)
    (tmp_path / "public").mkdir()
    out = tmp_path / "out"
    arguments = [
        "figures", str(tmp_path / "e.h5"), "--mixed", str(tmp_path / "m.h5"), "--out", str(out),
        "--public-data", str(tmp_path / "public"),
    ]  # fmt: skip
    result = CliRunner().invoke(data_app, arguments)
    assert result.exit_code == 0, result.output
    assert "16 trials" in result.output
    assert _pictures(out) == {"contacts.png", "force.png", "electrodes.png", "motion.png"}


def test_command_names_a_missing_folder_of_public_data(tmp_path: Path) -> None:
    arguments = ["figures", "e.h5", "--out", "out", "--public-data", str(tmp_path / "none")]
    result = CliRunner().invoke(data_app, arguments)
    assert isinstance(result.exception, ConfigError)
    assert "--public-data" in str(result.exception)
