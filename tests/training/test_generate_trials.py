"""Trials of a generated experiment belong to one simulation."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from palpate.errors import DatasetError
from palpate_training.experiment.generate.simulator import ExperimentSpec
from palpate_training.experiment.generate.trials import FINGERTIP, make_trials


def test_trials_are_not_mixed_with_the_simulation_of_another_fingertip(tmp_path: Path) -> None:
    """As after the store alone was removed, and made again by another version."""

    def made(key: str, folder: str) -> bool:
        store = SimpleNamespace(
            path=tmp_path / "mechanics.sim", fingertip=lambda: SimpleNamespace(key=key), ids=list
        )
        nothing = SimpleNamespace(plans=lambda *_: [], manipulations=lambda *_: [])
        return make_trials(
            ExperimentSpec(), cast("Any", store), (), cast("Any", nothing), tmp_path / folder,
            cast("Any", None), on_progress=lambda *_: None, stop=threading.Event(),
        )  # fmt: skip

    (tmp_path / "trials").mkdir()
    (tmp_path / "trials" / FINGERTIP).write_text("a1", encoding="utf-8")
    assert made("a1", "trials")
    with pytest.raises(DatasetError, match=r"trials holds trials of another .*mechanics\.sim"):
        made("b2", "trials")
    assert made("b2", "other"), "nothing is left to do, so nothing is written"
    assert not (tmp_path / "other").exists()
