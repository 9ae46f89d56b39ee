"""Five readers: which page each of them follows, what is promised at its end, and what is found.

A check looks at what the page left, with other means than the page: files, numbers that were
printed, the truth of the emulated devices. It returns what it found, or raises ``Unexpected``.
"""

from __future__ import annotations

import csv
import json
import re
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tests.readers.terminal import Unexpected

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
NUMBER = r"(-?\d+(?:\.\d+)?(?:e[-+]\d+)?)"


@dataclass(frozen=True, slots=True)
class Visit:
    """What a check may look at while the programs of the page still run.

    Attributes:
        folder: Where the reader worked.
        printed: Output of each command, by its line.
        prefix: What a command line begins with to be in the reader's network.
    """

    folder: Path
    printed: dict[str, str] = field(default_factory=dict)
    prefix: tuple[str, ...] = ()

    def said(self, start: str) -> str:
        """Output of the command that begins so."""
        found = [text for line, text in self.printed.items() if line.startswith(start)]
        if not found:
            raise Unexpected(f"no command of the page begins with {start!r}")
        return found[-1]

    def number(self, start: str, pattern: str) -> float:
        """A number in the output of a command; ``#`` in the pattern stands for it."""
        text = self.said(start)
        found = re.search(pattern.replace("#", NUMBER), text)
        if found is None:
            raise Unexpected(f"{pattern!r} is not in what {start!r} printed:\n{text}")
        return float(found[1].replace(",", ""))


@dataclass(frozen=True, slots=True)
class Reader:
    """A reader.

    Attributes:
        name: Short, for files.
        who: Who it is, as the index of the documents says.
        pages: The page, and those that it sends its reader to, below ``docs``.
        promise: What the page promises.
        check: What came of it.
        own: Puts the reader's own files into the folder; the reason if there are none.
        after: The reader whose environment is used instead of a new one.
    """

    name: str
    who: str
    pages: tuple[str, ...]
    promise: str
    check: Callable[[Visit], str]
    own: Callable[[Path], str] | None = None
    after: str = ""


def _laptop(visit: Visit) -> str:
    touched = visit.number("palpate demo", r"touched .*: # of")
    force = visit.number("palpate demo", r"error: force # N")
    place = visit.number("palpate demo", r"location # mm")
    lines = [line for line in visit.said("python docs/examples").splitlines() if " N " in line]
    if len(lines) != 5 or not touched or not force < 1.0:
        raise Unexpected(f"{len(lines)} estimates; demo: {touched:g} touched, {force} N")
    replayed = visit.number("palpate replay", r"recorded features\s+│\s+([\d,]+)")
    return (
        f"{touched:g} touched frames in 5 s, median error {force} N and {place} mm; 5 estimates in "
        f"the second terminal; {replayed:g} replayed"
    )


def _lab(visit: Visit) -> str:
    said_n = visit.number("palpate new-station", r"this bundle\s+│\s+#")
    report = visit.folder / "truth.json"
    program = [sys.executable, "-m", "tests.readers.truth", "try", str(report)]
    done = subprocess.run(
        [*visit.prefix, *program], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise Unexpected(f"estimates could not be compared with the truth\n{done.stderr}")
    found = json.loads(report.read_text(encoding="utf-8"))
    if found["frames"] < 100 or not found["median_n"] < said_n:
        raise Unexpected(f"the bundle says {said_n} N; beside the truth: {found}")
    return (
        f"the bundle of this finger says {said_n} N of presses held out; {found['frames']} frames "
        f"on the bus are {found['median_n']:.2f} N (median) from the emulated truth"
    )


def _files(visit: Visit) -> str:
    pattern = r"\b{}force_magnitude_median_n\W+#"
    ours, mean, line = (
        visit.number("palpate train", pattern.replace("{}", name))
        for name in (r"(?<!_)", "constant_", "linear_")
    )
    rows = visit.number("palpate data import", r"# rows")
    if not ours < mean:
        raise Unexpected(f"the network: {ours} N; the mean force: {mean} N")
    text = (
        f"{rows:g} rows; median error of the force {ours:.3f} N (mean force {mean:.3f}, line "
        f"{line:.3f})"
    )
    if any(one.startswith("palpate replay") for one in visit.printed):
        frames = visit.number("palpate replay", r"recorded features\s+│\s+([\d,]+)")
        text += f"; {frames:g} frames of the log replayed"
    return text


def _robot(visit: Visit) -> str:
    field_line = visit.said("python ask.py")
    if "field (6870, 3)" not in field_line or field_line.count("refused:") != 2:
        raise Unexpected(field_line)
    strongest = visit.number("python press.py", r"#\] N")
    ros = re.findall(rf"finger {NUMBER} {NUMBER} {NUMBER} N", visit.said("python listen.py"))
    if len(ros) != 5 or not 0.1 < strongest < 30.0:
        raise Unexpected(f"{len(ros)} messages of ROS; simulated {strongest} N")
    return (
        f"estimates by each of four ways, two refusals as said; a simulation up to {strongest} N; "
        f"{len(ros)} WrenchStamped read by pycdr2"
    )


def _mechanics(visit: Visit) -> str:
    strongest = visit.number("palpate fem run --indenter sphere_medium", r"│\s+20 │[^│]*│\s*#")
    sizes = []
    for name in ("press.png", "slide.png"):
        head = (visit.folder / name).read_bytes()[:24]
        if head[:8] != b"\x89PNG\r\n\x1a\n":
            raise Unexpected(f"{name} is no picture")
        sizes.append("{} x {}".format(*struct.unpack(">II", head[16:24])))
    nodes = visit.number("python read.py", r"# nodes")
    moved = visit.number("python read.py", r"moved most: # mm")
    if not 0.5 < strongest < 10.0 or not 0.5 < moved < 3.0:
        raise Unexpected(f"{strongest} N, {moved} mm")
    return (
        f"{strongest} N at 2 mm, picture of {sizes[0]}; a slide: {nodes:g} nodes read, "
        f"the most moved by {moved} mm"
    )


def real_table(folder: Path) -> str:
    """``presses.csv`` of a real BioTac (LASA), as its owner might have it; or why there is none."""
    source = DATA / "lasa_force_calibration" / "force_calibration.npz"
    if not source.exists():
        return "no real recordings in ../shared/data"
    with np.load(source) as data:
        rest = data["finger1_baseline_stream_raw"][:100]
        counts = data["finger1_electrodes_raw"]
        force_mn = 1e3 * data["finger1_force_N"]
    names = ["finger", "press", "Fx", "Fy", "Fz", *(f"E{number}" for number in range(1, 20))]
    with (folder / "presses.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(names)
        table.writerows(["BT1", -1, 0, 0, 0, *row] for row in rest)
        # There are no presses in it, it is always touched: pieces of nine seconds stand for them.
        table.writerows(
            ["BT1", number // 900, *map(float, force), *row]
            for number, (force, row) in enumerate(zip(force_mn, counts, strict=True))
        )
    return ""


READERS = (
    Reader(
        "laptop",
        "a laptop and nothing else",
        ("quick-start.md",),
        "a demo with its errors, a station, estimates in a second terminal, a record, its replay",
        _laptop,
    ),
    Reader(
        "lab",
        "a BioTac on CAN and an ATI Net F/T on the table",
        ("first-biotac.md",),
        "a station, a bundle for this finger with its error, its forces on the bus",
        _lab,
    ),
    Reader(
        "files",
        "files with electrodes and forces",
        ("guides/train-on-your-files.md",),
        "a network of one's own with its error",
        _files,
    ),
    Reader(
        "real-files",
        "the same, with a table of a real BioTac",
        ("guides/train-on-your-files.md",),
        "a network of one's own with its error",
        _files,
        real_table,
        "files",
    ),
    Reader(
        "robot",
        "a robot to program, perhaps with ROS 2",
        ("guides/query-from-a-robot.md", "ros.md"),
        "a loop with estimates and a simulation; the same as messages of ROS",
        _robot,
    ),
    Reader(
        "mechanics",
        "an interest in the mechanics of the fingertip",
        ("guides/press-the-fingertip.md",),
        "an indentation in finite elements, its picture, its numbers",
        _mechanics,
    ),
)
