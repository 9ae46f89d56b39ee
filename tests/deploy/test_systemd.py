"""The unit that ships is understood by systemd and as closed as it says."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from palpate_deploy.station import supervision
from palpate_deploy.station.processes import START_ORDER

UNIT = Path(__file__).resolve().parents[2] / "deploy" / "systemd" / "palpate@.service"
SCORE_MAX = 1.5
"""``systemd-analyze security``: 0 = closed, 10 = open; a bare unit scores 9.6."""


def test_unit_starts_a_profile_by_path() -> None:
    text = UNIT.read_text(encoding="utf-8")
    assert "palpate up --profile /etc/palpate/%i.toml" in text
    assert "KillMode=mixed" in text


def test_systemd_is_told_and_watches() -> None:
    text = UNIT.read_text(encoding="utf-8")
    assert "\nType=notify\n" in text
    limit = re.search(r"^WatchdogSec=(\d+)$", text, flags=re.MULTILINE)
    assert limit is not None
    # `palpate up` may wait this long for an answer of supervisord, twice, before it gives up.
    assert int(limit.group(1)) > 2 * supervision._ANSWER_S
    stop = re.search(r"^TimeoutStopSec=(\d+)$", text, flags=re.MULTILINE)
    assert stop is not None
    assert int(stop.group(1)) > len(START_ORDER) * supervision.STOP_WAIT_S


def test_systemd_understands_the_unit(tmp_path: Path) -> None:
    analyse = shutil.which("systemd-analyze")
    if analyse is None:
        pytest.skip("systemd-analyze is not installed")
    unit = tmp_path / "palpate@lab.service"
    text = UNIT.read_text(encoding="utf-8")
    unit.write_text(text.replace("/opt/palpate/bin/palpate", "/bin/true"), encoding="utf-8")
    result = subprocess.run(
        [analyse, "verify", str(unit)], capture_output=True, text=True, check=False
    )
    assert (result.returncode, result.stderr) == (0, "")


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
