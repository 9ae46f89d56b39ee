"""Robot poses in a palpate record, made into poses of the tip anew."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bus.topics import ROBOT_POSE, sensor_key
from palpate.errors import ConfigError, RecordingError
from palpate.files.record_writer import RecordWriter
from palpate.messages import Pose, RobotPoseFrame
from palpate_gateway.drivers import make_device
from palpate_gateway.readings import PoseReading

fakes: Any = importlib.import_module("pose_fakes")
WALL_NS = 1_700_000_000_000_000_000


def write(path: Path, frames: Iterable[RobotPoseFrame], *, period_ns: int = 4_000_000) -> Path:
    """A record in which each pose was received after a period, with a delay of 1 ms."""
    with RecordWriter(path) as writer:
        for number, frame in enumerate(frames):
            writer.write(
                sensor_key("lab", frame.robot, ROBOT_POSE.name),
                ROBOT_POSE.codec.schema,
                ROBOT_POSE.codec.encode(frame),
                log_time_ns=WALL_NS + 1_000_000 + period_ns * number,
            )
            if number % 50 == 49:
                writer.flush()  # as time does it
    return path


def drain(path: Path, **options: Any) -> tuple[list[PoseReading], dict[str, int], int | None]:
    with make_device("pose_file", {"path": path, **fakes.BENCH, **options}) as device:
        readings: list[PoseReading] = []
        while got := device.read(1.0):
            readings += [r for r in got if isinstance(r, PoseReading)]
        counters = {name: n for name, n in device.counters.items() if n}
        return readings, counters, device.identity.start_wall_ns


def test_recorded_poses_become_the_tip(tmp_path: Path) -> None:
    frames = [fakes.frame(n, wall_ns=WALL_NS + 4_000_000 * n) for n in range(1, 201) if n != 100]
    readings, counters, start_wall_ns = drain(write(tmp_path / "a.mcap", frames))
    assert fakes.numbers(readings) == [n for n in range(1, 201) if n != 100]
    assert counters == {"samples": 199, "lost_poses": 1}
    assert [r.missed_before for r in readings if r.missed_before] == [1]
    np.testing.assert_allclose(np.diff([r.time_s for r in readings[:99]]), 0.004, atol=1e-9)
    assert readings[99].tick == 101
    assert start_wall_ns == WALL_NS + 4_000_000, "by the robot's clock, not by the recorder's"


def test_recorded_millimetres_are_no_metres(tmp_path: Path) -> None:
    far = replace(fakes.frame(3), pose_base_flange=Pose((400.0, 0.0, 300.0), (1.0, 0.0, 0.0, 0.0)))
    path = write(tmp_path / "a.mcap", [fakes.frame(1), fakes.frame(2), far])
    with make_device("pose_file", {"path": path, **fakes.BENCH}) as device:
        assert len(device.read(1.0)) == 2
        with pytest.raises(RecordingError, match=r"pose 3 is at \(400, 0, 300\) m, out of any"):
            device.read(1.0)


def test_another_placement_moves_the_tip(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [fakes.frame(n) for n in range(1, 11)])
    nearer = {**fakes.BENCH["base_sensor"]}
    before, _, start_wall_ns = drain(path)
    x, y, z = nearer["position_m"]
    after, _, _ = drain(path, base_sensor={**nearer, "position_m": (x, y, z + 0.001)})
    moved = [np.linalg.norm(b.position - a.position) for a, b in zip(before, after, strict=True)]
    np.testing.assert_allclose(moved, 0.001, atol=1e-12)
    assert start_wall_ns == WALL_NS + 1_000_000, "the recorder's, where the robot tells none"


def test_a_program_that_began_anew_goes_on_by_the_recorders_clock(tmp_path: Path) -> None:
    frames = [fakes.frame(n) for n in range(1, 11)]
    frames += [fakes.frame(n, run_id=8, time_ns=4_000_000 * n) for n in range(1, 11)]
    readings, counters, _ = drain(write(tmp_path / "a.mcap", frames))
    assert counters == {"samples": 20, "restarts": 1}
    times = [reading.time_s for reading in readings]
    np.testing.assert_allclose(times, 0.004 * np.arange(20), atol=1e-9)


def test_a_second_program_that_has_ended_does_not_lock_the_first_one_out(tmp_path: Path) -> None:
    frames = [fakes.frame(n, time_ns=1_000_000_000 * n) for n in range(1, 61)]
    short = fakes.frame(1, run_id=8, time_ns=5)
    path = write(tmp_path / "a.mcap", [*frames[:5], short, *frames[6:]], period_ns=1_000_000_000)
    readings, counters, _ = drain(path)
    assert counters["restarts"] == 2
    assert counters["poses_of_old_runs"] == 30, "what it published while the other was in force"
    assert fakes.numbers(readings)[-1] == 60


def drifting(count: int, *, tells_wall: bool = False) -> list[RobotPoseFrame]:
    """Poses a quarter of a second apart, by a clock that runs 200 ppm too fast."""
    return [
        replace(
            fakes.frame(n),
            time_ns=round(250_000_000 * n * (1 + 200e-6)),
            wall_ns=WALL_NS + 250_000_000 * (n - 1) if tells_wall else 0,
        )
        for n in range(1, count + 1)
    ]


@pytest.mark.parametrize("tells_wall", [False, True])
def test_the_drift_of_the_robots_clock_does_not_add_up(tmp_path: Path, tells_wall: bool) -> None:
    frames = drifting(2401, tells_wall=tells_wall)
    path = write(tmp_path / "a.mcap", frames, period_ns=250_000_000)
    readings, _, _ = drain(path)
    assert readings[-1].time_s == pytest.approx(600.0, abs=0.001), "120 ms by the robot's clock"


@pytest.mark.parametrize("step_s", [-20.0, 20.0])
def test_a_wall_clock_that_was_set_while_it_recorded_moves_no_pose(
    tmp_path: Path, step_s: float
) -> None:
    path = tmp_path / "a.mcap"
    with RecordWriter(path) as writer:
        for number, frame in enumerate(drifting(400)):
            writer.write(
                sensor_key("lab", frame.robot, ROBOT_POSE.name),
                ROBOT_POSE.codec.schema,
                ROBOT_POSE.codec.encode(frame),
                log_time_ns=WALL_NS + 250_000_000 * number + round(1e9 * step_s * (number > 200)),
            )
    readings, _, _ = drain(path)
    steps_s = np.diff([one.time_s for one in readings])
    np.testing.assert_allclose(steps_s, 0.25, atol=0.01)


@pytest.mark.parametrize("step_s", [-0.4, -0.2, 0.2])
def test_a_small_step_of_the_wall_clock_moves_no_pose(tmp_path: Path, step_s: float) -> None:
    frames = [
        fakes.frame(n, time_ns=10_000_000 * n, wall_ns=WALL_NS + 10_000_000 * n + shift)
        for n in range(1, 3001)
        for shift in [round(1e9 * step_s) * (n > 1000)]
    ]
    readings, _, _ = drain(write(tmp_path / "a.mcap", frames, period_ns=10_000_000))
    np.testing.assert_allclose([one.time_s for one in readings], 0.01 * np.arange(3000), atol=1e-3)


def test_a_first_pose_that_came_late_shortens_no_time(tmp_path: Path) -> None:
    """Where poses tell no wall clock, the recorder's says how the robot's clock drifts."""
    path = tmp_path / "a.mcap"
    with RecordWriter(path) as writer:
        for number in range(2000):
            frame = fakes.frame(number + 1, time_ns=10_000_000 * (number + 1))
            late_ns = max(0, 300_000_000 - 10_000_000 * number)  # a queue of the start
            writer.write(
                sensor_key("lab", frame.robot, ROBOT_POSE.name),
                ROBOT_POSE.codec.schema,
                ROBOT_POSE.codec.encode(frame),
                log_time_ns=WALL_NS + 10_000_000 * number + late_ns,
            )
    readings, _, _ = drain(path)
    np.testing.assert_allclose([one.time_s for one in readings], 0.01 * np.arange(2000), atol=1e-3)


def test_one_of_several_robots(tmp_path: Path) -> None:
    frames = [fakes.frame(n, robot=robot) for n in range(1, 6) for robot in ("left", "right")]
    path = write(tmp_path / "a.mcap", frames)
    with pytest.raises(ConfigError, match="holds 2 robots: left, right -> choose one"):
        drain(path)
    readings, _, _ = drain(path, robot="right")
    assert len(readings) == 5
    with pytest.raises(RecordingError, match="holds no poses of a robot"):
        drain(path, robot="middle")


def test_a_pose_that_breaks_the_contract_is_left_out_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    key = sensor_key("lab", "arm", ROBOT_POSE.name)
    payloads = [ROBOT_POSE.codec.encode(fakes.frame(n)) for n in range(1, 6)]
    with RecordWriter(path) as writer:
        for number, payload in enumerate([b"no pose", *payloads[:3], b"no pose", *payloads[3:]]):
            writer.write(key, ROBOT_POSE.codec.schema, payload, log_time_ns=WALL_NS + number)
    readings, counters, _ = drain(path)
    assert fakes.numbers(readings) == [1, 2, 3, 4, 5]
    assert counters == {"samples": 5, "rejected_parse": 2}


def test_a_record_of_something_else(tmp_path: Path) -> None:
    with RecordWriter(tmp_path / "a.mcap") as writer:
        writer.write("palpate/@v1/lab/x/tare", "palpate.v1.Tare", b"", log_time_ns=1)
    with pytest.raises(RecordingError, match="the driver record replays poses"):
        drain(tmp_path / "a.mcap")
    (tmp_path / "b.mcap").write_bytes(b"no record")
    with pytest.raises(RecordingError, match="no MCAP file"):
        drain(tmp_path / "b.mcap")


def test_a_cut_record_delivers_what_is_whole(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [fakes.frame(n) for n in range(1, 501)])
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    readings: list[Any] = []
    with make_device("pose_file", {"path": path, **fakes.BENCH}) as device:
        error = fakes.read_to_damage(device, readings)
        assert device.read(1.0) == []
    assert "damaged or cut off after" in error.problem
    assert readings
    assert fakes.numbers(readings) == list(range(1, len(readings) + 1))
