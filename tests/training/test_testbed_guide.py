"""The guide does what it says."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate_training.experiment.trajectory_file import read_trajectories


def test_the_guides_code_runs(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (root / "docs" / "testbed.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for block in blocks:
        exec(block, names)
    # the arm of the guide is led into the holes by inverse kinematics, good to 0.01 mm
    assert np.max(names["found"].residual_m) < 0.02e-3
    assert not names["eliminated"]
    (motion,) = read_trajectories(tmp_path / "plan.jsonl").motions
    assert len(motion.time_s) == 61
    assert motion.joints is not None
