"""The paper's plan for a real robot, aimed at the simulated skin, for the arms that reach it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from palpate.errors import ConfigError
from palpate_training.experiment.generate.simulator import (
    ExperimentSpec,
    IndentationStore,
    OnProgress,
    SimulatedFingertip,
    TwinSimulator,
)
from palpate_training.experiment.kinematics import ArmKinematics
from palpate_training.experiment.plan import (
    ARMS,
    ArmBase,
    EliminatedTrajectory,
    PlannedTrajectory,
    RobotPlan,
    facing,
    make_plan,
)
from palpate_training.experiment.registration import ArmRegistration
from palpate_training.experiment.stand_in_arm import HOME, sensor_robot, stand_in_arm

SAME_PATH = 1e-6
"""Paths of the same plan agree to this, in metres and in numbers of a quaternion."""


def bases_of(
    arms: Mapping[str, ArmKinematics], registrations: Mapping[str, ArmRegistration] | None
) -> dict[str, ArmBase]:
    """The arms as they stand.

    Args:
        arms: Kinematics by arm; an arm without gets poses only, whose joints its controller finds.
        registrations: By arm; None = the stand-in arms, which stand where the twin's do.

    Raises:
        ConfigError: Kinematics are given for an arm that is not registered.
    """
    if registrations is None and not arms:
        return {side: ArmBase(sensor_robot(side), stand_in_arm(side), HOME) for side in ARMS}
    for arm in arms:
        if arm not in (registrations or {}):
            raise ConfigError(
                f"the {arm} arm has a URDF and no registration",
                remedy="measure its holes, palpate data register, and give --registration",
            )
    return {
        arm: ArmBase(found.sensor_robot, arms.get(arm))
        for arm, found in (registrations or {}).items()
    }


def plan_experiment(
    spec: ExperimentSpec,
    fingertip: SimulatedFingertip,
    bases: Mapping[str, ArmBase],
    simulator: TwinSimulator,
    *,
    store: IndentationStore | None = None,
    on_progress: OnProgress = lambda *_: None,
) -> tuple[RobotPlan, list[EliminatedTrajectory]]:
    """Plan what the twin presses, to the paper's depths; also returns what no arm can follow.

    Args:
        spec: Indenters, points, angles and seed; its overtravel is left out.
        fingertip: Whose skin is aimed at.
        bases: By arm; a single one executes everything.
        simulator: Plans the trajectories on its skin.
        store: Simulation that the trials will be mixed with: what it holds must be this plan's.
        on_progress: Called before each trajectory.

    Raises:
        ConfigError: No arm, or the store holds a trajectory of the same name that goes
            elsewhere.
    """
    if not bases:
        raise ConfigError("no arm is registered", remedy="palpate data register")
    plans = simulator.plans(replace(spec, overtravel_m=0.0), fingertip)
    if store is not None:
        _check_same(plans, store, simulator.clearance_m)

    def trajectories() -> Iterator[PlannedTrajectory]:
        for k, plan in enumerate(plans):
            on_progress(k, len(plans), plan.trajectory)
            yield plan if len(bases) > 1 else replace(plan, arm=next(iter(bases)))

    found = make_plan(trajectories(), bases)
    on_progress(len(plans), len(plans), "")
    return found


def _check_same(
    plans: Sequence[PlannedTrajectory], store: IndentationStore, clearance_m: float
) -> None:
    """Refuse a store of another seed: its trajectories have the same names and other points."""
    there = set(store.ids())
    for plan in plans:
        if plan.trajectory not in there:
            continue
        tip = plan.target + (plan.contact_m - clearance_m) * plan.direction
        start = np.concatenate([tip, facing(plan.direction)])
        off = float(np.abs(store.summary(plan.trajectory).path[0] - start).max())
        if off > SAME_PATH:
            raise ConfigError(
                f"{store.path}: {plan.trajectory} starts {off:.3g} m from this plan's",
                remedy="give the --seed with which the store was made",
            )
