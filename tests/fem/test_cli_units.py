"""``palpate fem units``: what a newcomer sees."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from palpate.errors import ConfigError, DatasetError
from palpate_fem.cli.app import fem_app
from palpate_fem.population.members import PAPER


def test_show_names_each_unit_with_what_it_was_fitted_to() -> None:
    shown = CliRunner().invoke(fem_app, ["units", "show"], env={"COLUMNS": "100"})
    assert shown.exit_code == 0, shown.output
    for wanted in PAPER:
        assert wanted.name in shown.output
        assert f"({wanted.max_force_n})" in shown.output
    assert "[N]" in shown.output
    as_json = CliRunner().invoke(fem_app, ["units", "show", "--json"])
    assert [one["unit"]["name"] for one in json.loads(as_json.output)] == [
        wanted.name for wanted in PAPER
    ]


def test_what_cannot_be_fitted_or_shown_is_refused(tmp_path: Path) -> None:
    for arguments, error, word in (
        (["units", "show", str(tmp_path / "no.json")], ConfigError, "no.json"),
        (["units", "fit", str(tmp_path / "no.sim"), "--out", "x.json"], DatasetError, "no.sim"),
        (
            ["units", "fit", "a.sim", "--out", "x.json", "--touches", "3"],
            ConfigError,
            "--touches has no effect without --recording",
        ),
        (
            ["units", "fit", "a", "--recording=a.h5", "--out", "x.json", "--overtravel-mm", "1"],
            ConfigError,
            "--overtravel-mm has no effect with --recording",
        ),
        (
            ["units", "fit", str(tmp_path), "--out", "x.json", "--overtravel-mm", "-1"],
            ConfigError,
            "overtravel",
        ),
    ):
        result = CliRunner().invoke(fem_app, arguments)
        assert result.exit_code != 0
        with pytest.raises(error, match=word):
            raise result.exception or AssertionError(result.output)


def test_drawn_units_are_written_shown_and_the_same_for_the_same_seed(tmp_path: Path) -> None:
    out = tmp_path / "drawn.json"
    drawn = CliRunner().invoke(
        fem_app, ["units", "draw", "5", "--seed", "3", "--out", str(out)], env={"COLUMNS": "100"}
    )
    assert drawn.exit_code == 0, drawn.output
    assert "core displaced distally by [mm]" in drawn.output
    shown = CliRunner().invoke(fem_app, ["units", "show", str(out)], env={"COLUMNS": "160"})
    assert shown.exit_code == 0, shown.output
    assert "unit-005" in shown.output
    again = CliRunner().invoke(fem_app, ["units", "draw", "5", "--seed", "3", "--json"])
    assert json.loads(again.output) == json.loads(out.read_text())["members"]
