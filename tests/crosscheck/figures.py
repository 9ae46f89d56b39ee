"""The stored figures of the other codes: numbers we computed, beside the command that did it."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from tests.crosscheck.problem import Floats

FILE = Path(__file__).with_name("reference.json")


@lru_cache(maxsize=1)
def stored() -> dict[str, Any]:
    figures: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
    return figures


def elastic(element: str, case: str) -> dict[str, float]:
    """Figures of one of `tests.crosscheck.cases.CASES` by "Q1P0" or "Taylor-Hood Q2-Q1"."""
    figures: dict[str, float] = stored()["felupe"][element][case]
    return figures


def getfem(**wanted: float) -> dict[str, Any]:
    """The stored run of GetFEM with these arguments."""
    runs = [
        run
        for run in stored()["getfem"]["runs"]
        if all(run[name] == value for name, value in wanted.items())
    ]
    if len(runs) != 1:
        raise KeyError(f"{len(runs)} stored runs of GetFEM with {wanted}")
    found: dict[str, Any] = runs[0]
    return found


def forces(run: dict[str, Any]) -> Floats:
    """Forces on the block after every step [N], (K, 3)."""
    return np.array(run["force_n"], np.float64)
