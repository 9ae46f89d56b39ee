"""``palpate demo``: without a terminal, in short."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from matplotlib.image import imread

from palpate.errors import RecordingError
from palpate.files.record import summarise
from palpate_deploy.demo import demo
from palpate_deploy.demo.comparison import TouchComparison
from palpate_deploy.demo.demo import run_demo
from palpate_deploy.station.host import running_folders
from palpate_services.recorder import writer

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]


def test_a_disk_without_room_is_told_before_anything_starts(
    bundle: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "free_bytes", lambda _: 10**6)
    with pytest.raises(RecordingError, match="1 MB free, a record needs 268 MB"):
        run_demo(1.0, tmp_path / "demo")
    assert not running_folders()


def test_estimates_without_a_record_are_not_said_to_be_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The disk got full meanwhile."""

    def watch(_: object, __: object, comparison: TouchComparison, *___: object) -> None:
        comparison.count = 1900

    station = MagicMock()
    station.__enter__.return_value.log_tail.return_value = "no space left"
    monkeypatch.setattr(demo, "Supervisor", lambda *_: station)
    monkeypatch.setattr(demo, "_watch", watch)
    assert run_demo(1.0, tmp_path / "demo") == 1
    said = capsys.readouterr().out
    assert "no record was written" in said
    assert "no space left" in said
    assert "no estimate came" not in said


@pytest.mark.slow
@pytest.mark.essential
def test_demo_ends_with_record_view_and_picture(
    palpate: Palpate, bundle: str, tmp_path: Path
) -> None:
    out = tmp_path / "demo"
    result = palpate("demo", "--seconds", "5", "--out", out, timeout=120)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "truth" in result.stdout
    lines = result.stdout.splitlines()
    headline = next(line for line in lines if line.startswith("touched (true force >= 0.5 N): "))
    assert "location error [mm]" in result.stdout
    found = re.search(r"([\d,]+) fields; .* ([\d,]+) syntheses", result.stdout)
    assert found is not None, result.stdout
    assert all(int(count.replace(",", "")) > 5 for count in found.groups())
    (record,) = out.glob("*.mcap")
    counts = {key.rpartition("/")[2]: n for key, n in summarise(record).counts.items()}
    assert counts["features"] > 100
    for path in (
        record,
        record.with_suffix(".rrd"),
        record.with_suffix(".png"),
        record.with_suffix(".json"),
    ):
        assert path.stat().st_size > 0
        assert str(path) in result.stdout
    assert f"rerun {record.with_suffix('.rrd')}" in result.stdout
    numbers = json.loads(record.with_suffix(".json").read_text())["touches"]
    assert list(numbers["bins"]) == [
        ">= 0.5 N", "0.5 to 1 N", "1 to 2 N", "2 to 8 N", ">= 8 N", "all frames"
    ]  # fmt: skip
    touched, everything = numbers["bins"][">= 0.5 N"], numbers["bins"]["all frames"]
    assert 0 < touched["frames"] < everything["frames"] <= numbers["estimates"]
    assert f"force {touched['force_median_n']:.3f} N" in headline
    assert f"location {1e3 * touched['location_median_m']:.2f} mm" in headline
    assert touched["force_median_n"] > everything["force_median_n"]
    # A review of the record ends, with the same numbers and a picture that shows something.
    again = tmp_path / "again.png"
    reviewed = palpate("review", record, "--out", tmp_path / "again.rrd", "--png", again)
    assert reviewed.returncode == 0, reviewed.stderr
    assert headline in reviewed.stdout.splitlines()
    pixels = imread(again)[..., :3]
    assert pixels.mean() > 0.5
    assert (np.ptp(pixels, axis=2) > 0.25).mean() > 0.05
