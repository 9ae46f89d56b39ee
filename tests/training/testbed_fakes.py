"""Arms, plans and performances for tests of the testbed, and records of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from palpate.bus.topics import ELECTRODES, POSE, WRENCH, sensor_key
from palpate.files.record_writer import RecordWriter
from palpate.messages import (
    ElectrodeFrame,
    IndenterPoseFrame,
    Origin,
    SensorType,
    Stamp,
    WrenchFrame,
)
from palpate_training.datasets.trials import RawTrial, TrialHeader
from palpate_training.experiment import stand_in_arm as stand_in
from palpate_training.experiment.kinematics import ArmKinematics
from palpate_training.experiment.plan import (
    ArmBase,
    PlannedTrajectory,
    RobotPlan,
    assign_arm,
    make_plan,
)
from palpate_training.experiment.trajectory_file import write_trajectories
from palpate_training.experiment.virtual_testbed import perform

START_NS = 1_700_000_000_000_000_000
BOOT_NS = START_NS - 7_000_000_000_000  # monotonic clock = wall clock minus this
ERROR_M = np.array([0.5e-3, -0.8e-3, 0.3e-3])


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> ArmKinematics:
    path = stand_in.write_arm_urdf("left", tmp_path_factory.mktemp("arm") / "left.urdf")
    return ArmKinematics.from_urdf(path, stand_in.FLANGE, stand_in.tool())


@pytest.fixture(scope="module")
def plan(arm: ArmKinematics) -> RobotPlan:
    direction = np.array([0.0, 0.0, 1.0])
    made, _ = make_plan(
        [
            PlannedTrajectory(
                f"s/0{i}/normal",
                "s",
                "left",
                np.array([-5e-3 + i * 1e-3, 1e-3, -8e-3]),
                direction,
                0.0,
                0.2e-3,
            )
            for i in range(2)
        ],
        {"left": ArmBase(stand_in.sensor_robot("left"), arm, stand_in.HOME)},
    )  # fmt: skip
    return made


@pytest.fixture(scope="module")
def plan_file(plan: RobotPlan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_trajectories(plan, tmp_path_factory.mktemp("plan") / "plan.jsonl")


@pytest.fixture(scope="module")
def played(plan: RobotPlan) -> list[RawTrial]:
    """The plan on a virtual finger, by a robot that stands wrong."""
    return play(plan)


def play(plan: RobotPlan) -> list[RawTrial]:
    """A plan on a virtual finger, by robots that stand wrong."""
    trials = []
    for seed, motion in enumerate(plan.motions):
        item = motion.trajectory
        travel = np.linspace(0, item.depth_m, 3)
        trials.append(
            perform(
                TrialHeader("biotac-1", item.trajectory, item.indenter, item.arm),
                travel_m=travel,
                force=np.outer(travel, [0.0, 2e3, 1e4]),
                counts=3000 - np.outer(travel, np.linspace(0, 4e6, 19)),
                tip=item.target + (item.contact_m + travel[:, None]) * item.direction,
                read_electrodes=lambda ideal, _: np.rint(ideal).astype(np.uint16),
                registration_error_m=ERROR_M,
                seed=seed,
            )
        )
    return trials


def thin(trial: RawTrial, kept: int = 6) -> RawTrial:
    """Only the first and the last samples of each increment, so that a test writes little."""
    near = np.concatenate([np.arange(-499, kept - 499), np.arange(1 - kept, 1)])
    rows = (trial.increment_end[:, None] + near).ravel()
    return replace(
        trial,
        time_s=trial.time_s[rows],
        electrodes=trial.electrodes[rows],
        force=trial.force[rows],
        tip=trial.tip[rows],
        travel_m=trial.travel_m[rows],
        increment_end=np.arange(1, len(trial.increment_end) + 1) * 2 * kept - 1,
    )


Streams = dict[str, list[ElectrodeFrame | WrenchFrame | IndenterPoseFrame]]


def streams_of(trials: list[RawTrial], plan: RobotPlan) -> Streams:
    """What a gateway would have published while the plan ran, stamped by one clock."""
    streams: Streams = {ELECTRODES.name: [], WRENCH.name: [], POSE.name: []}
    sequence = 0
    for trial, motion in zip(trials, plan.motions, strict=True):
        since = START_NS + round(motion.start_s * 1e9)
        for time_s, counts, force, tip in zip(
            trial.time_s, trial.electrodes, trial.force, trial.tip, strict=True
        ):
            sequence += 1
            wall = since + round(time_s * 1e9)
            stamp = Stamp(sequence, sequence, wall - BOOT_NS, wall, 7, Origin.SIMULATED)
            streams[ELECTRODES.name].append(frame(stamp, counts))
            streams[WRENCH.name].append(
                WrenchFrame(stamp, "ft", force.astype(np.float32), np.zeros(3, np.float32))
            )
            streams[POSE.name].append(
                IndenterPoseFrame(
                    stamp, motion.trajectory.indenter, tip, np.array([1.0, 0.0, 0.0, 0.0])
                )
            )
    return streams


def frame(stamp: Stamp, counts: npt.NDArray[np.uint16]) -> ElectrodeFrame:
    return ElectrodeFrame(
        stamp=stamp,
        sensor_serial="s1",
        sensor_type=SensorType.BIOTAC,
        electrodes=counts,
        pdc=2000,
        pac=np.full(22, 2000, dtype=np.uint16),
        tac=2000,
        tdc=2000,
        validity=(1 << SensorType.BIOTAC.layout.slots) - 1,
        slot_period_ns=227_000,
    )


def write(streams: Streams, path: Path) -> Path:
    topics = {topic.name: topic for topic in (ELECTRODES, WRENCH, POSE)}
    with RecordWriter(path) as writer:
        for name, messages in streams.items():
            topic = topics[name]
            for i, message in enumerate(messages):
                writer.write(
                    sensor_key("lab", "finger", name),
                    topic.codec.schema,
                    topic.codec.encode(message),  # type: ignore[arg-type]
                    log_time_ns=i,
                )
    return path


def trajectory(
    name: str = "sphere_3-5mm/00/normal",
    *,
    lateral_m: float = 2e-3,
    depth_m: float = 3e-3,
    tilt_rad: float = 0.0,
    target: tuple[float, float, float] | None = None,
) -> PlannedTrajectory:
    at = (-5e-3, lateral_m, -8e-3) if target is None else target
    direction = np.array([np.sin(tilt_rad), 0.0, np.cos(tilt_rad)])
    return PlannedTrajectory(
        name, name.split("/")[0], assign_arm(at), np.array(at), direction, -0.4e-3, depth_m
    )


@pytest.fixture(scope="module")
def bases(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ArmBase]:
    folder = tmp_path_factory.mktemp("arms")
    made = {}
    for side in stand_in.SIDES:
        path = stand_in.write_arm_urdf(side, folder / f"{side}.urdf")
        arm = ArmKinematics.from_urdf(path, stand_in.FLANGE, stand_in.tool())
        made[side] = ArmBase(stand_in.sensor_robot(side), arm, stand_in.HOME)
    return made


@pytest.fixture
def two_arms(bases: dict[str, ArmBase]) -> RobotPlan:
    made, eliminated = make_plan(
        [
            trajectory("a/00/normal", lateral_m=2e-3, depth_m=0.3e-3),
            trajectory("b/01/angled-0", lateral_m=-2e-3, depth_m=0.2e-3, tilt_rad=np.pi / 6),
        ],
        bases,
    )
    assert not eliminated
    return made
