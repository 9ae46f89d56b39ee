"""Whether the recordings of a chaos run hold what the robot got, and say so where they do not."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.bus.topics import ELECTRODES
from palpate.errors import PalpateError, WireError
from palpate.files.record import read_record

KILLED = re.compile(r"kill recorder|hang recorder|disk read-only|kill palpate up|hang palpate up"
                    r"|kill supervisord|hang supervisord|systemctl kill")  # fmt: skip
"""Faults that end a recorder without a warning."""

_LATER_NS = 5_000_000_000


def check_recordings(
    folder: Path, frames: npt.NDArray[np.int64], events: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Read every file; compare its frames with those that the robot got.

    ``lost_s`` has, of each kill of a recorder alone, the time between the last frame in any
    recording from before it and the last that the robot got before it [s].
    """
    files = sorted(folder.glob("*.mcap"))
    readable, malformed, problems = 0, 0, []
    stamps: list[int] = []
    for file in files:
        try:
            for item in read_record(file):
                if item.address.topic != ELECTRODES.name:
                    continue
                try:
                    stamps.append(ELECTRODES.codec.decode(item.payload).stamp.monotonic_ns)
                except WireError:  # what strangers sent is recorded as it came
                    malformed += 1
        except PalpateError as error:
            problems.append(f"{file.name}: {error.problem}")
        else:
            readable += 1
    recorded = np.sort(np.array(stamps, np.int64))
    lost_s = [
        gap
        for one in events
        if one["fault"] == "kill recorder" and not one["pair"]
        if (gap := _lost_s(recorded, frames, one["begun_ns"])) is not None
    ]
    killed = sum(bool(KILLED.match(one["fault"])) for one in events)
    recovered = sum(".recovered" in file.name for file in files)
    return {
        "files": len(files),
        "bytes": sum(file.stat().st_size for file in files),
        "readable": readable,
        "problems": problems,
        "malformed": malformed,
        "recovered": recovered,
        "kills": len(lost_s),
        "ended_without_warning": killed,
        "look_whole": len(problems),
        "parts": len(list(folder.glob("*.part"))),
        "frames": len(recorded),
        "repeated": len(recorded) - len(np.unique(recorded)),
        "of_the_robots": float(np.isin(frames[:, 2], recorded).mean()),
        "lost_s": lost_s,
        "lost_max_s": max(lost_s, default=0.0),
    }


def _lost_s(
    recorded: npt.NDArray[np.int64], frames: npt.NDArray[np.int64], killed_ns: int
) -> float | None:
    """How much a killed recorder had taken and not yet written [s]; None = nothing came then."""
    got = frames[(frames[:, 2] < killed_ns) & (frames[:, 2] > killed_ns - _LATER_NS), 2]
    kept = recorded[recorded < killed_ns]
    if not len(got) or not len(kept):
        return None
    return float(max(0, got.max() - kept.max()) * 1e-9)
