"""The walks that docs/house.md draws are those that running stations take."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_walks_enter_the_files_that_are_drawn() -> None:
    pytest.importorskip("warp", reason="warp-lang not installed (extra fem)")
    result = subprocess.run(
        [sys.executable, "docs/make_walks.py", "--check"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
