"""A real experiment: a record and the plan that was executed -> raw trials, as the twin makes them.

The record (`palpate record`, or the recorder of a running station) holds electrodes and wrench of
the finger, and the indenter's pose; instead of poses the robot's joint angles may come as a CSV
file. The plan is the trajectory file that the robot executed. Neither holds when it did so: the
robot's program notes the wall-clock instant at which it stood at a start pose and began, for the
whole plan or for each trajectory. At the end of every increment the tip is compared with its
command.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.alignment import linear, times_of
from palpate.errors import ConfigError, DatasetError
from palpate.rigid import Floats, Transform
from palpate_training.datasets.container import csv_rows
from palpate_training.datasets.record_streams import (
    SensorStreams,
    check_streams,
    force_at,
    middles,
    read_streams,
)
from palpate_training.datasets.trials import RawTrial, TrialHeader
from palpate_training.experiment.kinematics import ArmKinematics
from palpate_training.experiment.plan import DWELL_S, ArmMotion, commanded_travel
from palpate_training.experiment.trajectory_file import read_trajectories

_log = logging.getLogger(__name__)

GAP_S = 0.05
"""How old the last sample of an increment may be at its end [s]: five frames at 100 Hz."""

MISMATCH_M = 0.07e-3
"""How far an increment's end may be from its command, apart from what all of a trajectory share
[m]: less than an increment, so that a schedule that is off by one shows at its first or last, and
six standard deviations of the repeatability of the paper's robot (0.02 mm in three axes)."""

OFFSET_M = 5.0e-3
"""How far a whole trajectory may be from its command [m]: a few times the worst registration."""

Times = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class _AlignedSamples:
    """Samples that have electrodes and a wrench, and times at which they were taken."""

    time_ns: Times
    wall_ns: Times
    electrodes: npt.NDArray[np.uint16]
    force: Floats


@dataclass(frozen=True, slots=True)
class _Tip:
    """Where the tip was at each sample, where that is known, and what each pose said it was of."""

    position: Floats
    known: npt.NDArray[np.bool_]
    pose_ns: Times
    indenters: npt.NDArray[np.str_]


def ingest_experiment(
    record: Path,
    plan: Path,
    *,
    unit: str,
    sensor: str,
    start_wall_ns: int | Mapping[str, int],
    joint_logs: Mapping[str, JointLog] | None = None,
) -> list[RawTrial]:
    """Cut a record into the trials of a plan, in its order.

    Args:
        record: ``NAME.mcap``.
        plan: The trajectory file that was executed.
        unit: Name of the BioTac, for the headers.
        sensor: Name of the sensor in the record's keys.
        start_wall_ns: Wall clock when the plan started, or by trajectory when it started; with a
            mapping, trajectories that are not in it were not executed.
        joint_logs: By arm; the tip of an arm without one is by the poses of the record.

    Raises:
        RecordingError: Not a whole record.
        DatasetError: A stream is missing, the poses of a trajectory are of two indenters, the
            schedule does not match, or there is a gap of more than 50 ms at the end of an
            increment; names the trajectory and increment.
        ConfigError: Joints that the arm cannot have.
    """
    planned = read_trajectories(plan)
    streams = read_streams(record).get(sensor)
    if streams is None:
        raise DatasetError(
            f"{record}: no stream of sensor {sensor!r}", remedy="name the sensor as in the record"
        )
    samples = _samples(record, sensor, streams)
    starts = _starts(plan, planned.motions, start_wall_ns)
    logs = joint_logs or {}
    tips: dict[str, _Tip] = {}
    trials = []
    for motion in planned.motions:
        item = motion.trajectory
        if item.trajectory not in starts:
            continue
        if item.arm not in tips:
            if item.arm in logs:
                registered = planned.bases[item.arm].sensor_robot
                tips[item.arm] = _tip_of_joints(logs[item.arm], registered, samples)
            elif streams.poses or joint_logs is None:
                tips[item.arm] = _tip_of_poses(record, sensor, streams, samples)
            else:
                raise DatasetError(
                    f"{plan}: {item.trajectory!r} was executed by the {item.arm} arm, which has no"
                    " joint log",
                    remedy="pass the joint log of every arm of the plan",
                )
        start_ns = starts[item.trajectory]
        trials.append(_cut(record, motion, unit, start_ns, samples, tips[item.arm]))
    return trials


def _samples(record: Path, sensor: str, streams: SensorStreams) -> _AlignedSamples:
    check_streams(record, sensor, streams)
    frames = [frame for frame in streams.frames if frame.electrodes_valid]
    if not frames:
        raise DatasetError(
            f"{record}: sensor {sensor!r} has no valid BioTac frame",
            remedy="record the stream electrodes of the finger",
        )
    clock = streams.clock
    times, first = np.unique(times_of(frames, clock), return_index=True)
    frames = [frames[i] for i in first]
    at = times + middles(frames)
    force, known, _ = force_at(record, sensor, at, streams, clock)
    if not known.any():
        raise DatasetError(
            f"{record}: at no frame of sensor {sensor!r} is the force known",
            remedy="the clocks of their hosts differ by more than the record lasts (docs/time.md),"
            " or the force/torque sensor was overloaded all the time: record again",
        )
    walls = np.array([frame.stamp.wall_ns for frame in frames], dtype=np.int64)
    return _AlignedSamples(
        at[known],
        (walls + at - times)[known],
        np.array([frame.electrodes for frame in frames], dtype=np.uint16)[known],
        force[known],
    )


def _tip_of_poses(
    record: Path, sensor: str, streams: SensorStreams, samples: _AlignedSamples
) -> _Tip:
    if not streams.poses:
        raise DatasetError(
            f"{record}: sensor {sensor!r} has no pose stream",
            remedy="record the indenter's pose, or pass the joint log of each arm",
        )
    times = times_of(streams.poses, streams.clock)
    positions = np.array([p.position for p in streams.poses], dtype=np.float64)
    indenters = np.array([p.indenter for p in streams.poses])
    return _Tip(*linear(samples.time_ns, times, positions), times, indenters)


def _tip_of_joints(log: JointLog, registered: Transform, samples: _AlignedSamples) -> _Tip:
    times, joints = read_joint_log(log.path, log.arm)
    try:
        positions, _ = log.arm.tip(joints)
    except ConfigError as error:
        raise ConfigError(f"{log.path}: {error.problem}", remedy=error.remedy) from error
    sensor_robot = registered if log.sensor_robot is None else log.sensor_robot
    found = linear(samples.wall_ns, times, sensor_robot.apply(positions))
    return _Tip(*found, np.empty(0, np.int64), np.empty(0, np.str_))


def _starts(
    plan: Path, motions: tuple[ArmMotion, ...], start_wall_ns: int | Mapping[str, int]
) -> dict[str, int]:
    if not isinstance(start_wall_ns, Mapping):
        return {
            motion.trajectory.trajectory: start_wall_ns + round(motion.start_s * 1e9)
            for motion in motions
        }
    unknown = set(start_wall_ns) - {motion.trajectory.trajectory for motion in motions}
    if unknown:
        raise DatasetError(
            f"{plan}: no trajectory {sorted(unknown)[0]!r}",
            remedy="give the file that was executed, and start times by its ids",
        )
    return dict(start_wall_ns)


def _cut(
    record: Path,
    motion: ArmMotion,
    unit: str,
    start_ns: int,
    samples: _AlignedSamples,
    tip: _Tip,
) -> RawTrial:
    """One trial: the samples from its start to its end that have everything."""
    item = motion.trajectory
    where = f"{record}: trajectory {item.trajectory!r}"
    # The wall clock gives the start; after it the monotonic clock is used, which never jumps.
    first = int((samples.wall_ns >= start_ns).argmax())
    since_ns = samples.time_ns - samples.time_ns[first] + samples.wall_ns[first] - start_ns
    kept = np.flatnonzero(tip.known & (since_ns >= 0) & (since_ns < round(item.duration_s * 1e9)))
    if not len(kept):
        raise DatasetError(
            f"{where}: nothing was recorded in its {item.duration_s:g} s",
            remedy="check the start time: wall clock, in nanoseconds; leave out what was not run",
        )
    begun_ns, ended_ns = samples.time_ns[kept[[0, -1]]]
    named = tip.indenters[(tip.pose_ns >= begun_ns) & (tip.pose_ns <= ended_ns)]
    _check_indenter(where, item.indenter, sorted(set(named.tolist())))
    time_s = since_ns[kept] * 1e-9
    if time_s[0] > GAP_S:
        raise DatasetError(
            f"{where}: no sample with electrodes, wrench and tip in its first"
            f" {time_s[0] * 1e3:.0f} ms; at most {GAP_S * 1e3:g} ms",
            remedy="record from before the start on, all streams at 100 Hz",
        )
    ends = DWELL_S * np.arange(1, len(item.travel_m))
    last = np.searchsorted(time_s, ends) - 1
    late = ends - time_s[last]
    if late.max() > GAP_S:
        worst = int(late.argmax())
        raise DatasetError(
            f"{where}: no sample with electrodes, wrench and tip in the last"
            f" {late[worst] * 1e3:.0f} ms of increment {worst + 1}; at most {GAP_S * 1e3:g} ms",
            remedy="record all streams at 100 Hz, without an overload of the force/torque sensor;"
            " leave this trajectory out by start_wall_ns",
        )
    stops = kept[np.concatenate([[0], last])]
    _check_schedule(where, item.arm, tip.position[stops] - item.poses[:, :3])
    return RawTrial(
        header=TrialHeader(unit, item.trajectory, item.indenter, item.arm),
        time_s=time_s,
        electrodes=samples.electrodes[kept],
        force=samples.force[kept],
        tip=tip.position[kept],
        travel_m=commanded_travel(time_s, item.travel_m),
        increment_end=last.astype(np.int64),
    )


def _check_indenter(where: str, planned: str, named: Sequence[str]) -> None:
    """Refuse poses of two indenters; the names of one may differ, as an indenter may have two."""
    if len(named) > 1:
        raise DatasetError(
            f"{where} is of the indenter {planned!r}, its poses of {' and '.join(named)}",
            remedy="if the indenter was changed meanwhile, leave this trajectory out by"
            " start_wall_ns; else pass the joint log",
        )
    if named and named[0] != planned:
        _log.warning(
            "%s is of the indenter %r, its poses of %r: see that these are two names of one",
            where,
            planned,
            named[0],
        )


def _check_schedule(where: str, arm: str, missed: Floats) -> None:
    """Compare tip and command where it starts and at the ends of increments.

    A schedule that is early by a whole increment shows at the start, one that is late at the end.

    Args:
        where: For the message.
        arm: Which arm's tip, for the message.
        missed: Tip minus command [m], shape (I + 1, 3).
    """
    shared = np.median(missed, axis=0)  # by registration, as the fingertip sees it
    if np.linalg.norm(shared) > OFFSET_M:
        raise DatasetError(
            f"{where}: the tip of the {arm} arm is {np.linalg.norm(shared) * 1e3:.1f} mm from"
            " every command",
            remedy="check the start time, that pose and plan have one registration and tip, and"
            " that the poses are of this arm: where two arms press, pass the other's joint log",
        )
    off = np.linalg.norm(missed - shared, axis=1)
    if off.max() > MISMATCH_M:
        worst = int(off.argmax())
        at = f"at the end of increment {worst}" if worst else "at the start"
        raise DatasetError(
            f"{where}: {at} the tip is {off[worst] * 1e3:.2f} mm from where the schedule has it;"
            f" at most {MISMATCH_M * 1e3:g} mm",
            remedy="check the start time, and that the robot executed this plan",
        )


@dataclass(frozen=True, slots=True)
class JointLog:
    """Joint angles of an arm instead of poses.

    Attributes:
        path: CSV with a header ``time_s,<joint>,...``: wall clock [s since the Unix epoch], then
            the joints [rad or m] in the order of the arm's.
        arm: Its kinematics, with the tool that was used.
        sensor_robot: Its registration; None = the one in the trajectory file.
    """

    path: Path
    arm: ArmKinematics
    sensor_robot: Transform | None = None


def read_joint_log(path: Path, arm: ArmKinematics) -> tuple[Times, Floats]:
    """Wall clock [ns], shape (T,), and joints [rad or m], shape (T, n), of a CSV file.

    Raises:
        DatasetError: It cannot be read, or its columns are not time_s and the arm's joints; names
            the line.
    """
    n = len(arm.joint_names)
    rows = csv_rows(path, DatasetError)
    if len(rows) < 2 or rows[0][:1] != ["time_s"] or len(rows[0]) != n + 1:
        raise DatasetError(
            f"{path}: columns {', '.join(rows[0]) if rows else 'none'}",
            remedy=f"write time_s and {n} joints of {arm.name}, a header first",
        )
    values = np.empty((len(rows) - 1, n + 1))
    for number, row in enumerate(rows[1:], 2):
        try:
            values[number - 2] = [float(cell) for cell in row]
        except ValueError as error:
            raise DatasetError(
                f"{path}, line {number}: {error}", remedy=f"write {n + 1} numbers"
            ) from error
    if not np.isfinite(values).all() or (np.diff(values[:, 0]) <= 0.0).any():
        raise DatasetError(
            f"{path}: times do not increase, or a value is not finite",
            remedy="leave such lines out of the log",
        )
    return np.round(values[:, 0] * 1e9).astype(np.int64), values[:, 1:]
