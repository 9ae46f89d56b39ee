"""The lab's first hour on emulated devices: the commands of the page, to estimates and truth."""

from __future__ import annotations

import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from tests.readers.page import blocks_of
from tests.readers.truth import TOUCH_N, estimates_of, played_loop, truth_at

from palpate.config import LinkConfig
from palpate.files.bundle import read_bundle
from palpate.messages import QualityFlag

pytest.importorskip("torch")

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 240.0

AS_SAID = 2.0
"""Times the bundle's own figure that the error may be: both are of ten touches, most of them soft,
of which a bundle is off by 0.05 to 0.1 N."""

ALIKE = 0.9
"""Least correlation of estimates with the truth; 0.3 s late it is smaller."""

Floats = npt.NDArray[np.float64]
Start = Callable[[str, str], "Program"]


class Program:
    """A palpate command that runs; what it says goes to a file."""

    def __init__(self, line: str, log: Path) -> None:
        self._log = log
        with open(log, "wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "palpate_deploy", *shlex.split(line)[1:]],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                cwd=log.parent,
            )

    @property
    def said(self) -> str:
        return self._log.read_text(encoding="utf-8")

    def wait_for(self, words: str) -> str:
        until = time.monotonic() + PATIENCE_S
        while words not in self.said:
            assert self.process.poll() is None, self.said
            assert time.monotonic() < until, self.said
            time.sleep(0.05)
        return self.said

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        self.process.wait(PATIENCE_S)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    running: list[Program] = []

    def run(line: str, log: str) -> Program:
        running.append(Program(line, tmp_path / log))
        return running[-1]

    yield run
    for program in reversed(running):
        try:
            program.end()
        except subprocess.TimeoutExpired:
            program.process.kill()
            program.process.wait()


@pytest.fixture
def lines(new_port: Callable[[], int]) -> list[str]:
    """The commands of the page, at free ports."""
    page = (ROOT / "docs" / "first-biotac.md").read_text(encoding="utf-8")
    blocks = blocks_of(page.partition("## Without hardware")[2])
    text = "\n".join(line for block in blocks if block.language == "sh" for line in block.lines)
    for port in sorted(set(re.findall(r"port=?\s?(\d{5})", text))):
        text = text.replace(port, str(new_port()))
    return text.splitlines()[:3]


def correlation(force: Floats, truth: Floats, rows: npt.NDArray[np.bool_]) -> float:
    return float(np.corrcoef(force[rows], truth[rows])[0, 1])


@pytest.mark.slow
def test_from_two_devices_to_estimates_as_good_as_said(
    lines: list[str], start: Start, new_port: Callable[[], int], tmp_path: Path
) -> None:
    finger, force, walk = lines
    endpoint = f"tcp/127.0.0.1:{new_port()}"
    walk += f" --listen {endpoint} --look-s 1"
    for device in (start(finger, "finger"), start(force, "force")):
        device.wait_for("# palpate gateway probe")
    first = start(walk, "walk")
    said = first.wait_for("let go of the finger: it is tared")
    assert "written: try.toml" in said
    assert "features-twin:" in said, "before it is calibrated, the shipped bundle serves"
    assert "UNCALIBRATED" in said
    profile = (tmp_path / "try.toml").read_text(encoding="utf-8")
    # What the emulators play: they do not hear of the station, nor the station of this.
    loop = played_loop()
    first.wait_for("press 9 of 9")
    said = first.wait_for("the station runs; Ctrl-C stops it")
    served = said[said.index("served: ") :]
    assert "by features-emulated-1:1" in served
    assert "UNCALIBRATED" not in served

    # The loop has ten touches. Nine were pressed, so that none was learned from and held out at
    # once; what is compared is the whole loop.
    link = LinkConfig(connect=(endpoint,), wait_for_router_s=60)
    answers = estimates_of(link, "try", loop.duration_s)
    bundle = read_bundle(tmp_path / "data/palpate/models/features-emulated-1/1")
    assert {answer.bundle_sha256 for answer in answers} == {bundle.sha256}
    assert not any(QualityFlag.UNCALIBRATED in answer.quality for answer in answers)
    # What is unlike the presses that it learned from is flagged; the others are compared.
    known = [answer for answer in answers if not answer.quality]
    estimated = np.array([np.linalg.norm(answer.force) for answer in known])
    wall_ns = np.array([answer.source.wall_ns for answer in known])
    truth = truth_at(np.array(loop.wrench), wall_ns)
    touched = truth > TOUCH_N
    error = np.abs(estimated - truth)[touched]
    assert len(error) > 100
    said_n = bundle.manifest.metrics["force_magnitude_median_n"]
    assert np.median(error) <= AS_SAID * said_n
    # Most touches are soft, so that the median alone would not notice a chain that is late.
    assert correlation(estimated, truth, touched) > ALIKE
    for late_s in (0.3, 1.0):
        late = truth_at(np.array(loop.wrench), wall_ns + round(1e9 * late_s))
        assert correlation(estimated, late, late > TOUCH_N) < ALIKE

    # The same command goes on where it was: nothing is pressed, written or started twice.
    again = start(walk, "again")
    assert again.process.wait(PATIENCE_S) == 0, again.said
    assert "try.toml is there: it stays as it is" in again.said
    assert "station 'try' runs already" in again.said
    assert "calibrated already: features-emulated-1:1" in again.said
    assert "press 1 of" not in again.said
    assert (tmp_path / "try.toml").read_text(encoding="utf-8") == profile
    assert first.process.poll() is None
