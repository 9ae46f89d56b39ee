"""A CSV file of robot poses, from file to the indenter's tip."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from tests.fuzz.streams import has_remedy

from palpate.config import parse_config
from palpate.errors import RecordingError
from palpate_gateway.pose.file import PoseFile, PoseFileOptions
from palpate_gateway.readings import PoseReading

_FOLDER = tempfile.TemporaryDirectory(prefix="fuzz-poses-")
_PATH = Path(_FOLDER.name, "a.csv")
_BENCH = {
    "path": _PATH,
    "indenter": "sphere_7mm",
    "base_sensor": {"position_m": (0.4, 0.0, 0.1), "orientation_wxyz": (0.0, 1.0, 0.0, 0.0)},
    "flange_indenter": {"position_m": (0.0, 0.0, 0.12), "orientation_wxyz": (1.0, 0.0, 0.0, 0.0)},
}
_OPTIONS = parse_config(PoseFileOptions, _BENCH, where="fuzz")


def check(data: bytes) -> None:
    """All bytes are the file."""
    _PATH.write_bytes(data)
    device = PoseFile(_OPTIONS)
    try:
        device.open()
    except RecordingError as error:
        has_remedy(error)
        return
    start_ns = device.identity.start_wall_ns
    assert start_ns is None or 0 <= start_ns < 1 << 63
    readings: list[PoseReading] = []
    for _ in range(2):  # damage is told once, and only after all that came before it
        try:
            while got := device.read(1.0):
                readings += [one for one in got if isinstance(one, PoseReading)]
            break
        except RecordingError as error:
            has_remedy(error)
    assert device.read(1.0) == []
    counters = device.counters
    device.close()
    assert counters["samples"] == len(readings)
    assert len(readings) + counters["repeated_poses"] <= data.count(b"\n") + 1
    times = [one.time_s for one in readings]
    assert times == sorted(set(times))
    assert [one.tick for one in readings] == list(range(len(readings)))
    for one in readings:
        assert np.isfinite(one.position).all()
        assert abs(float(np.linalg.norm(one.orientation)) - 1.0) < 1e-9


def seeds() -> list[bytes]:
    """Tables in metres and millimetres, with every kind of damage."""
    head = "time_s,x_m,y_m,z_m,qw,qx,qy,qz\n"
    rows = "".join(f"{0.004 * k:.3f},0.4,0.001,{0.2 + 1e-4 * k},0,1,0,0\n" for k in range(4))
    wall = head.replace("\n", ",wall_ns\n") + "0,0.4,0,0.2,1,0,0,0,1795327645710257442\n"
    damage = ["nan,0,0,0,1,0,0,0", "1,0,0,0,2,0,0,0", "1,2,3", "x,0,0,0,1,0,0,0", "",
              "0,0,0,0,1,0,0,0", "1_0,0,0,0,1,0,0,0", "1e400,0,0,0,1,0,0,0",
              "1,0,0,1e308,1,0,0,0", "9,,,,1,0,0,0"]  # fmt: skip
    return [
        (head + rows).encode(),
        (head.replace("_m", "_mm") + rows).encode(),
        wall.encode(),
        wall.replace("1795327645710257442", "x").encode(),
        wall.replace("1795327645710257442", "1" * 5000).encode(),
        (head + rows[:-9]).encode(),
        b"\xef\xbb\xbf" + (head + rows).replace("\n", "\r\n").encode(),
        head.replace(",", ";").encode(),
        head.encode(),
        rows.encode(),
        *((head + rows + line + "\n" + "8,0.4,0,0.2,1,0,0,0\n").encode() for line in damage),
    ]
