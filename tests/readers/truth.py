"""How far the forces on the bus are from what the emulated devices play.

python -m tests.readers.truth STATION REPORT.json

The emulators hear nothing of the station, nor the station of this.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.bus import Delivery, Session
from palpate.bus.topics import FEATURES
from palpate.config import LinkConfig
from palpate.messages import FeatureEstimate
from palpate_gateway.emulators.twin import RATE_HZ, TwinLoop, loop_options, make_loop

TOUCH_N = 0.2
"""As where the presses of a record are read."""

Floats = npt.NDArray[np.float64]


def estimates_of(link: LinkConfig, station: str, seconds: float) -> list[FeatureEstimate]:
    """What a station estimates for some time."""
    with Session.open(link, station=station) as session:
        stream = session.subscriber(FEATURES, sensor="finger", delivery=Delivery.QUEUE)
        time.sleep(seconds)
        return [one.message for one in stream.next_batch(10, most=100_000)]


def truth_at(wrench: Floats, wall_ns: npt.NDArray[np.int64]) -> Floats:
    """Magnitudes of the twin's force [N] at times of the host's clock, which plays its loop."""
    magnitude = np.linalg.norm(wrench[:, :3], axis=1)
    frames = len(magnitude) - 1
    at = np.mod(1e-9 * wall_ns, frames / RATE_HZ) * RATE_HZ
    return np.asarray(np.interp(at, np.arange(frames + 1), magnitude))


def played_loop() -> TwinLoop:
    """The loop of the page's emulators."""
    return make_loop(loop_options(unit=2, seed=7))


def main() -> None:
    """Listen for one loop, compare, write."""
    station, report = sys.argv[1:]
    loop = played_loop()
    # What is unlike the presses that it learned from is flagged; the others are compared.
    known = [one for one in estimates_of(LinkConfig(), station, loop.duration_s) if not one.quality]
    estimated = np.array([np.linalg.norm(one.force) for one in known])
    truth = truth_at(np.array(loop.wrench), np.array([one.source.wall_ns for one in known]))
    touched = truth > TOUCH_N
    found = {
        "frames": int(touched.sum()),
        "median_n": round(float(np.median(np.abs(estimated - truth)[touched])), 4),
    }
    Path(report).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
