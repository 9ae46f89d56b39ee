"""The unit that ships is understood by systemd and as closed as it says."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

UNIT = Path(__file__).resolve().parents[2] / "deploy" / "systemd" / "palpate@.service"
SCORE_MAX = 1.5
"""``systemd-analyze security``: 0 = closed, 10 = open; a bare unit scores 9.6."""


def test_unit_starts_a_profile_by_path() -> None:
    text = UNIT.read_text(encoding="utf-8")
    assert "palpate up --profile /etc/palpate/%i.toml" in text
    assert "KillMode=mixed" in text


def test_unit_is_closed(tmp_path: Path) -> None:
    analyse = shutil.which("systemd-analyze")
    if analyse is None:
        pytest.skip("systemd-analyze is not installed")
    unit = tmp_path / "palpate@lab.service"
    shutil.copy(UNIT, unit)
    result = subprocess.run(
        [analyse, "security", "--offline=true", str(unit)],
        capture_output=True,
        text=True,
        check=False,
    )
    score = re.search(r": ([0-9]+\.[0-9]+) ", result.stdout)
    assert score is not None, result.stdout + result.stderr
    assert float(score.group(1)) <= SCORE_MAX
