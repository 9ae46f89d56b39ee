"""What tests of robot poses share: any pose, a bench with a robot over a finger, patience."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import strategies as st

from palpate.errors import DeviceTimeout, RecordingError
from palpate.messages import Pose, RobotPoseFrame
from palpate.rigid import compose, inverse, normalised
from palpate_gateway.device import Device
from palpate_gateway.readings import PoseReading, Reading

PATIENCE_S = 20.0
NEAR = 1e-12  # a metre in float64, a few products deep

BASE_SENSOR = normalised(Pose((0.41, -0.2, 0.13), (0.1, 0.9, -0.2, 0.3)))
FLANGE_INDENTER = normalised(Pose((0.01, -0.003, 0.12), (0.7, 0.1, 0.1, -0.7)))
BENCH: dict[str, Any] = {
    "indenter": "sphere_7mm",
    "base_sensor": {
        "position_m": BASE_SENSOR.position,
        "orientation_wxyz": BASE_SENSOR.orientation,
    },
    "flange_indenter": {
        "position_m": FLANGE_INDENTER.position,
        "orientation_wxyz": FLANGE_INDENTER.orientation,
    },
}
"""Options of a bench that is askew in every respect."""


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    """Any place within two metres, any orientation."""
    x, y, z = (draw(st.floats(-2.0, 2.0)) for _ in range(3))
    turns = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: math.hypot(*q) > 0.1)
    return normalised(Pose((x, y, z), draw(turns)))


def matrix(pose: Pose) -> npt.NDArray[np.float64]:
    """The homogeneous matrix of a pose."""
    w, x, y, z = pose.orientation
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = pose.position
    return out


def tip(number: int) -> Pose:
    """Where the tip is at a pose of this number: the number can be read off."""
    turn = (math.cos(0.001 * number), 0.0, math.sin(0.001 * number), 0.0)
    return Pose((-0.004, 0.0, -0.012 + 1e-6 * number), turn)


def flange(number: int) -> Pose:
    """Where the flange of the bench is then."""
    return compose(compose(BASE_SENSOR, tip(number)), inverse(FLANGE_INDENTER))


def frame(number: int, **changes: Any) -> RobotPoseFrame:
    """What a robot at 250 Hz tells of it, from the tenth second of its clock on."""
    facts = {"run_id": 7, **changes}
    return RobotPoseFrame(
        facts.get("robot", "arm"),
        facts.get("sequence", number),
        facts.get("time_ns", 10_000_000_000 + 4_000_000 * number),
        facts.get("pose", flange(number)),
        facts["run_id"],
        facts.get("wall_ns", 0),
    )


def numbers(readings: Sequence[Any]) -> list[int]:
    """The numbers of the poses that readings were made of; they are read off the tip."""
    return [round((reading.position[2] + 0.012) * 1e6) for reading in readings]


def take(device: Device, count: int) -> list[PoseReading]:
    """The next readings."""
    readings: list[PoseReading] = []
    deadline = time.monotonic() + PATIENCE_S
    while len(readings) < count:
        assert time.monotonic() < deadline
        try:
            readings += [r for r in device.read(0.5) if isinstance(r, PoseReading)]
        except DeviceTimeout:
            continue
    return readings


def read_to_damage(device: Device, readings: list[Reading]) -> RecordingError:
    """Read all that is whole into ``readings``; what is then said of the damage."""
    try:
        while got := device.read(1.0):
            readings += got
    except RecordingError as error:
        return error
    raise AssertionError("no damage was told")


def until(true: Callable[[], Any]) -> Any:
    """Poll; tests wait for facts, not for times."""
    deadline = time.monotonic() + PATIENCE_S
    while not (value := true()):
        assert time.monotonic() < deadline, "it did not become true in time"
        time.sleep(0.01)
    return value


def csv_lines(count: int, *, unit: str = "m", first: int = 1) -> list[str]:
    """A header and rows of the bench at 250 Hz."""
    scale = {"m": 1.0, "mm": 1e3}[unit]
    lines = [f"time_s,x_{unit},y_{unit},z_{unit},qw,qx,qy,qz"]
    for number in range(first, first + count):
        pose = flange(number)
        values = [0.004 * number, *(scale * x for x in pose.position), *pose.orientation]
        lines.append(",".join(f"{value!r}" for value in values))
    return lines


def write_csv(path: Path, lines: Sequence[str], *, end: str = "\n", cut: int = 0) -> Path:
    """Write a file, without its last ``cut`` bytes."""
    data = "".join(line + end for line in lines).encode()
    path.write_bytes(data[: len(data) - cut])
    return path
