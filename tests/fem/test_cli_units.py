"""``palpate fem units``: what a newcomer sees."""

from __future__ import annotations

import importlib
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from palpate.errors import ConfigError, DatasetError
from palpate_fem.cli.app import fem_app
from palpate_fem.cli.identify import store_overtravel_m
from palpate_fem.electrodes.specimen import SpecimenParameters
from palpate_fem.population.fitting import misses
from palpate_fem.population.members import (
    PAPER,
    Member,
    draw_members,
    read_population,
    write_population,
)
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter
from palpate_fem.trajectory import ANGLED_DEPTH_M, CLEARANCE_M, NORMAL_DEPTH_M

sample: Any = importlib.import_module("stored_sample")


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


def test_units_of_which_nothing_was_found_are_shown(tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    write_population(path, [Member(SpecimenParameters(name="one"), PAPER[0], 0.0)], source="a test")
    shown = CliRunner().invoke(fem_app, ["units", "show", str(path)], env={"COLUMNS": "100"})
    assert shown.exit_code == 0, shown.output
    assert f"- ({PAPER[0].max_force_n})" in shown.output


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


def stored(path: Path, name: str, depth_m: float) -> Path:
    """A store with one press, whose path is ``depth_m`` long from 0.3 mm above the skin on."""
    tip = sample.sample_fingertip(4, 1)
    with StoreWriter(path, tip) as store:
        store.write(name, sample.sample_trajectory(tip, steps=3, depth_m=depth_m))
    return path


PAPER_PRESS_M = CLEARANCE_M + NORMAL_DEPTH_M - sample.START_M
"""Depth of a sample whose path is as long as a press of the paper along the normal."""


@pytest.mark.parametrize(
    ("name", "depth_m", "more", "error", "word"),
    [
        ("cube/00007/random", PAPER_PRESS_M, (), DatasetError, "none of the paper's presses"),
        ("cube/00/path-0", PAPER_PRESS_M, (), DatasetError, "none of the paper's presses"),
        ("cube/press-0a1b2c3d4e", PAPER_PRESS_M, (), DatasetError, "none of the paper's presses"),
        ("cube/00/normal", PAPER_PRESS_M - 1e-3, (), DatasetError, "1 mm short"),
        (
            "cube/00/normal",
            PAPER_PRESS_M + 0.2e-3,
            ("--overtravel-mm", "0.3"),
            ConfigError,
            "go only 0.2 mm deeper",
        ),
    ],
)
def test_specimens_are_fitted_on_presses_like_the_papers_only(
    tmp_path: Path,
    name: str,
    depth_m: float,
    more: tuple[str, ...],
    error: type[Exception],
    word: str,
) -> None:
    store, out = stored(tmp_path / "a.sim", name, depth_m), tmp_path / "u.json"
    result = CliRunner().invoke(fem_app, ["units", "fit", str(store), "--out", str(out), *more])
    with pytest.raises(error, match=word):
        raise result.exception or AssertionError(result.output)
    assert not out.exists()


def test_overtravel_is_how_much_deeper_than_the_papers_all_paths_go(tmp_path: Path) -> None:
    path = stored(tmp_path / "a.sim", "cube/00/normal", PAPER_PRESS_M + 0.6e-3)
    assert store_overtravel_m(SimulationStore.open(path)) == pytest.approx(0.6e-3)
    stored(path, "cube/00/angled-3", CLEARANCE_M + ANGLED_DEPTH_M - sample.START_M + 0.4e-3)
    assert store_overtravel_m(SimulationStore.open(path)) == pytest.approx(0.4e-3)


def test_a_specimen_that_misses_what_is_published_by_far_is_named() -> None:
    shipped = read_population()
    assert not any(map(misses, shipped)), "20 % of force and 0.012 of the range are not far"
    first = shipped[0]
    for key, value, word in (
        ("low", -0.127, "lowest tared value -0.127, not -0.65"),
        ("high", 0.3, "highest 0.300, not 0.13"),
        ("max_force_n", 1.1, "largest force 1.1 N, not 23.4 N"),
        ("max_force_n", math.nan, "largest force nan N"),
    ):
        (said,) = misses(replace(first, found={**first.found, key: value}))
        assert said.startswith(word)
    assert not misses(draw_members(1, 0)[0])


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
