"""Figures of the result pages are of what the pages say they are of."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]


def program(name: str) -> dict[str, Any]:
    """Names of a program that makes a page."""
    return runpy.run_path(str(ROOT / "docs" / name))


@pytest.mark.parametrize("name", ["attacks", "faults", "hostile", "web"])
def test_programs_that_use_the_tests_run_as_files(name: str, tmp_path: Path) -> None:
    path = ROOT / "docs" / f"make_{name}.py"
    command = [sys.executable, "-c", f"import runpy; runpy.run_path({str(path)!r})"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_the_plan_of_a_fleet_ends_at_twice_what_was_measured() -> None:
    page = program("make_fleet.py")

    def fleet(stations: int, cpu: float) -> dict[str, Any]:
        phase = {"bytes_hz_each": 1e3, "site_cpu_ratio": cpu, "site_rss_bytes": 0, "p50_s": 0.02}
        return {"stations": stations, "phases": dict.fromkeys(page["PHASES"], phase)}

    table = page["plan_table"]({"scale": [fleet(1, 0.005), fleet(16, 0.012)]})
    assert table.count("| more than 32 |") == len(page["PHASES"])
    table = page["plan_table"]({"scale": [fleet(1, 0.0), fleet(16, 0.3)]})
    assert table.count("| 25 |") == len(page["PHASES"])


def test_a_takeover_that_never_came_is_told() -> None:
    page = program("make_fleet.py")
    values = json.loads(page["FILE"].read_text(encoding="utf-8"))
    assert "none came" not in page["results_page"](values)
    values["takeovers"][0] |= {"gap_s": 8.2, "estimates_after_heal": 0}
    assert "| none came, for 8.20 |" in page["results_page"](values)


def test_a_bound_is_not_rounded_down() -> None:
    at_most = program("make_numbers.py")["_at_most"]
    assert at_most(6.5485) == "6.6"
    assert at_most(0.1501, 2) == "0.16"
    assert at_most(0.150000676, 2) == "0.15"


def test_a_bound_may_hold_in_most_rows_and_in_few_whole_presses() -> None:
    errors = np.ones(40)
    errors[::10] = 3.0  # one row of ten in each of four presses
    found = program("make_intervals.py")["share_of"](errors, np.full(40, 2.0), np.arange(40) // 10)
    assert found["coverage"] == pytest.approx(0.9)
    assert found["whole"] == 0.0


def test_every_column_of_the_population_is_a_mean_over_the_seeds() -> None:
    page = program("make_population.py")

    def report(error: float) -> dict[str, Any]:
        errors = dict.fromkeys(page["FIGURES"], error)
        rivals = ("network", "ridge", "constant", "network, all +0.05", "network, all -0.05")
        return {"cells": {cell: dict.fromkeys(rivals, errors) for cell in page["CELLS"]}}

    table = page["cells_table"]([report(1.0), report(3.0)])
    for row in table.splitlines()[2:]:
        _, *cells = (cell.strip() for cell in row.strip("|").split("|"))
        assert [cell.split()[0] for cell in cells] == ["2"] * len(cells)
