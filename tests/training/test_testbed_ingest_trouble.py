"""What is wrong with the record of an experiment is named: stream, trajectory and increment."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bus.topics import ELECTRODES, POSE, WRENCH
from palpate.errors import DatasetError, RecordingError
from palpate.messages import ElectrodeFrame, IndenterPoseFrame, SensorType, WrenchFrame
from palpate_training.datasets.trials import RawTrial
from palpate_training.experiment.executed_plan import ingest_experiment
from palpate_training.experiment.plan import RobotPlan

sys.path.append(str(Path(__file__).parent))
fakes: Any = importlib.import_module("testbed_fakes")
arm, plan, plan_file, played = fakes.arm, fakes.plan, fakes.plan_file, fakes.played
START_NS = fakes.START_NS
thin, streams_of, write = fakes.thin, fakes.streams_of, fakes.write

Streams = dict[str, list[ElectrodeFrame | WrenchFrame | IndenterPoseFrame]]


def drop(name: str) -> Callable[[Streams], None]:
    return lambda streams: streams[name].clear()


def cut_end_of(name: str, increment: int) -> Callable[[Streams], None]:
    """Lose a stream from the middle of an increment of the first trajectory to its end."""

    def change(streams: Streams) -> None:
        end = START_NS + increment * 5_000_000_000
        streams[name][:] = [
            m for m in streams[name] if not end - 2_500_000_000 < m.stamp.wall_ns < end
        ]

    return change


def overload_end_of(increment: int) -> Callable[[Streams], None]:
    """The force/torque sensor is overloaded in the second half of an increment."""

    def change(streams: Streams) -> None:
        end = START_NS + increment * 5_000_000_000
        for i, one in enumerate(wrenches := streams[WRENCH.name]):
            if isinstance(one, WrenchFrame) and end - 2_500_000_000 < one.stamp.wall_ns < end:
                wrenches[i] = replace(one, overload=True)

    return change


def cut_start_of(name: str) -> Callable[[Streams], None]:
    def change(streams: Streams) -> None:
        streams[name][:] = [m for m in streams[name] if m.stamp.wall_ns > START_NS + 10**9]

    return change


def move_tip(increment: int, by_m: float, *, onward: bool = False) -> Callable[[Streams], None]:
    def change(streams: Streams) -> None:
        end = START_NS + increment * 5_000_000_000
        for i, pose in enumerate(streams[POSE.name]):
            assert isinstance(pose, IndenterPoseFrame)
            inside = end - 4_800_000_000 < pose.stamp.wall_ns < end + (increment == 0) * 10**9
            if inside or (onward and pose.stamp.wall_ns > end):
                position = pose.position + np.array([by_m, 0, 0])
                streams[POSE.name][i] = replace(pose, position=position)

    return change


def invalidate(streams: Streams) -> None:
    frames = streams[ELECTRODES.name]
    frames[:] = [replace(f, validity=1) for f in frames if isinstance(f, ElectrodeFrame)]


def exchange(streams: Streams) -> None:
    """The last frame is one of a BioTac SP."""
    frames = streams[ELECTRODES.name]
    frame = frames[-1]
    assert isinstance(frame, ElectrodeFrame)
    frames[-1] = replace(
        frame,
        sensor_type=SensorType.BIOTAC_SP,
        electrodes=np.full(24, 2000, np.uint16),
        pac=np.full(27, 2000, np.uint16),
    )


def overload_all(streams: Streams) -> None:
    wrenches = streams[WRENCH.name]
    wrenches[:] = [replace(w, overload=True) for w in wrenches if isinstance(w, WrenchFrame)]


def other_host(streams: Streams) -> None:
    """Wrenches come from a host whose wall clock is a day late."""
    for i, one in enumerate(wrenches := streams[WRENCH.name]):
        late = one.stamp.wall_ns - 86_400_000_000_000
        stamp = replace(one.stamp, monotonic_ns=i + 1, wall_ns=late, clock_id=8)
        wrenches[i] = replace(one, stamp=stamp)


def rename_from(increment: int, indenter: str) -> Callable[[Streams], None]:
    """Another indenter is told from an increment of the first trajectory on."""

    def change(streams: Streams) -> None:
        end = START_NS + increment * 5_000_000_000
        for i, pose in enumerate(poses := streams[POSE.name]):
            if isinstance(pose, IndenterPoseFrame) and pose.stamp.wall_ns > end:
                poses[i] = replace(pose, indenter=indenter)

    return change


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (drop(WRENCH.name), "no wrench stream"),
        (drop(POSE.name), "no pose stream"),
        (drop(ELECTRODES.name), "no valid BioTac frame"),
        (invalidate, "no valid BioTac frame"),
        (exchange, "1 of [0-9]+ frames of 'finger' are of a BIOTAC_SP with 24 electrodes"),
        (cut_end_of(ELECTRODES.name, 4), "'s/00/normal': no sample.*increment 4;"),
        (cut_end_of(WRENCH.name, 4), "'s/00/normal': no sample.*increment 4;"),
        (overload_end_of(4), "'s/00/normal': no sample.*increment 4;.*without an overload"),
        (cut_end_of(POSE.name, 1), "'s/00/normal': no sample.*increment 1;"),
        (cut_start_of(WRENCH.name), "'s/00/normal': no sample.* in its first"),
        (move_tip(0, -0.25e-3), "at the start the tip is 0.2"),
        (move_tip(7, 0.25e-3), "end of increment 7 the tip is 0.2"),
        (move_tip(31, 0.2e-3, onward=True), r"'s/00/normal': at the end of increment 3[12] "),
        (move_tip(1, 9e-3, onward=True), "'s/00/normal': the tip of the left arm is .* mm from"),
        (overload_all, "at no frame of sensor 'finger' is the force known"),
        (other_host, "at no frame of sensor 'finger' is the force known"),
        (rename_from(2, "t"), "'s/00/normal' is of the indenter 's', its poses of s and t"),
    ],
)
def test_what_a_record_lacks_is_named(
    plan: RobotPlan,
    plan_file: Path,
    played: list[RawTrial],
    tmp_path: Path,
    change: Callable[[Streams], None],
    match: str,
) -> None:
    streams = streams_of([thin(t, 8) for t in played], plan)
    change(streams)
    record = write(streams, tmp_path / "r.mcap")
    with pytest.raises(DatasetError, match=rf"r\.mcap.*{match}"):
        ingest_experiment(record, plan_file, unit="u", sensor="finger", start_wall_ns=START_NS)


def test_another_name_of_the_indenter_is_told_and_no_trouble(
    plan: RobotPlan,
    plan_file: Path,
    played: list[RawTrial],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """As ``sphere_7mm`` in a pose's options, of which a plan says ``sphere_medium``."""
    streams = streams_of(played, plan)
    rename_from(-1, "t")(streams)
    record = write(streams, tmp_path / "r.mcap")
    found = ingest_experiment(record, plan_file, unit="u", sensor="finger", start_wall_ns=START_NS)
    assert len(found) == len(played)
    assert "'s/00/normal' is of the indenter 's', its poses of 't'" in caplog.text


@pytest.mark.parametrize(
    ("late_s", "match"),
    [
        (5.0, "no sample|from where the schedule has it"),
        (-5.0, "no sample|from where the schedule has it"),
        (0.1, "no sample.* in its first"),
        (-3600.0, "nothing was recorded"),
        (3600.0, "nothing was recorded"),
    ],
)
def test_a_wrong_start_shows(
    plan: RobotPlan,
    plan_file: Path,
    played: list[RawTrial],
    tmp_path: Path,
    late_s: float,
    match: str,
) -> None:
    record = write(streams_of([thin(t) for t in played], plan), tmp_path / "r.mcap")
    start = START_NS + round(late_s * 1e9)
    with pytest.raises(DatasetError, match=match):
        ingest_experiment(record, plan_file, unit="u", sensor="finger", start_wall_ns=start)


@pytest.mark.parametrize("increments", [-1, 1])
def test_a_schedule_that_is_off_by_one_increment_shows(
    plan: RobotPlan, plan_file: Path, played: list[RawTrial], tmp_path: Path, increments: int
) -> None:
    """Even where the record goes on before and after, the tip standing still."""
    (trial, _) = (thin(t) for t in played)
    shift_s = -159.97 if increments < 0 else 160.0  # samples where the wrong schedule starts
    edge = trial.tip[0 if increments < 0 else -1]
    rest = replace(trial, time_s=trial.time_s + shift_s, tip=np.tile(edge, (len(trial.tip), 1)))
    first = RobotPlan(plan.motions[:1], plan.bases)
    streams = streams_of([trial], first)
    for name, extra in streams_of([rest], first).items():
        streams[name] = sorted(streams[name] + extra, key=lambda m: m.stamp.wall_ns)
    record = write(streams, tmp_path / "r.mcap")
    name = plan.motions[0].trajectory.trajectory

    def ingest(start_ns: int) -> list[RawTrial]:
        return ingest_experiment(
            record, plan_file, unit="u", sensor="finger", start_wall_ns={name: start_ns}
        )

    assert len(ingest(START_NS)) == 1
    with pytest.raises(DatasetError, match="from where the schedule has it"):
        ingest(START_NS + increments * 5_000_000_000)


def test_another_sensor_and_a_broken_record_are_named(
    plan: RobotPlan, plan_file: Path, played: list[RawTrial], tmp_path: Path
) -> None:
    record = write(streams_of([thin(t) for t in played], plan), tmp_path / "r.mcap")
    with pytest.raises(DatasetError, match="no stream of sensor 'thumb'"):
        ingest_experiment(record, plan_file, unit="u", sensor="thumb", start_wall_ns=START_NS)
    record.write_bytes(record.read_bytes()[:2000])
    with pytest.raises(RecordingError):
        ingest_experiment(record, plan_file, unit="u", sensor="finger", start_wall_ns=START_NS)
