"""``palpate demo``: without a terminal, in short."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from palpate.files.record import summarise

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.mark.slow
def test_demo_ends_with_record_view_and_picture(
    palpate: Palpate, bundle: str, tmp_path: Path
) -> None:
    out = tmp_path / "demo"
    result = palpate("demo", "--seconds", "5", "--out", out, timeout=120)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "truth" in result.stdout
    assert "median error" in result.stdout
    found = re.search(r"([\d,]+) fields; .* ([\d,]+) syntheses", result.stdout)
    assert found is not None, result.stdout
    assert all(int(count.replace(",", "")) > 5 for count in found.groups())
    (record,) = out.glob("*.mcap")
    counts = {key.rpartition("/")[2]: n for key, n in summarise(record).counts.items()}
    assert counts["features"] > 100
    for path in (record, record.with_suffix(".rrd"), record.with_suffix(".png")):
        assert path.stat().st_size > 0
        assert str(path) in result.stdout
    assert f"rerun {record.with_suffix('.rrd')}" in result.stdout
