"""Does calibration find known parameters? Simulate with them, add noise, calibrate, compare.

A self-test: the simulator explains its own forces. So it says how far noise, alignment and search
reach, and nothing about whether the model is right.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from palpate.errors import SimulationError
from palpate.rigid import path_lengths
from palpate_fem.calibration.calibrate import calibrate
from palpate_fem.calibration.measured import SIMULATED, MeasuredIndentation
from palpate_fem.calibration.result import Calibration, Evaluation
from palpate_fem.calibration.runs import PlannedPath, SimulatedRun, SimulationRuns, Simulator
from palpate_fem.calibration.settings import (
    FRICTION,
    MODULUS,
    THICKNESS,
    VOLUME,
    CalibrationSettings,
)
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.approach import OuterSurface
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.trajectory import angled_direction, pad_point, press_path

TOLERANCES = {THICKNESS: 0.02, MODULUS: 0.02, FRICTION: 0.05, VOLUME: 0.01}
"""Largest allowed relative errors of the calibration."""


@dataclass(frozen=True, slots=True)
class ParameterRecovery:
    """Known and found parameters.

    Attributes:
        truth: Known values by name, the fluid volume included.
        found: Calibrated values.
        sd: Their standard deviations, as stated by the calibration.
        calibration: The whole calibration.
        measured: The noisy trajectories that it used.
    """

    truth: dict[str, float]
    found: dict[str, float]
    sd: dict[str, float]
    calibration: Calibration
    measured: tuple[MeasuredIndentation, ...]

    @property
    def errors(self) -> dict[str, float]:
        """Relative errors, signed."""
        return {name: self.found[name] / value - 1.0 for name, value in self.truth.items()}

    @property
    def passed(self) -> bool:
        """Whether every error is within its tolerance."""
        return all(abs(error) <= TOLERANCES[name] for name, error in self.errors.items())

    def rows(self) -> list[tuple[str, ...]]:
        """Rows of a table: parameter, known, found, error, stated deviation, tolerance, verdict."""
        return [
            (
                name,
                f"{self.truth[name]:.4g}",
                f"{self.found[name]:.4g}",
                f"{error:+.2%}",
                f"{self.sd[name] / self.found[name]:.2%}",
                f"{TOLERANCES[name]:.0%}",
                "ok" if abs(error) <= TOLERANCES[name] else "FAILED",
            )
            for name, error in self.errors.items()
        ]


def noisy(
    planned: PlannedPath,
    run: SimulatedRun,
    sensor: str,
    noise_n: float,
    random: np.random.Generator,
) -> MeasuredIndentation:
    """A simulated trajectory with the noise of an instrument, up to where it ended.

    Args:
        planned: What was simulated.
        run: The result, at the poses of the path.
        sensor: Name of the virtual sensor.
        noise_n: Standard deviation of the noise of each axis [N].
        random: Source of the noise.

    Raises:
        SimulationError: Fewer than two steps, or steps that are not at the poses of the path.
    """
    count = len(run.forces)
    if count < 2 or not np.allclose(run.travel, path_lengths(planned.path)[:count]):
        raise SimulationError(
            f"{planned.name} cannot be simulated: {run.outcome} {run.reason}".strip(),
            remedy="plan another trajectory",
        )
    return MeasuredIndentation(
        f"{planned.name}/{sensor}",
        planned.indenter,
        sensor,
        planned.path[:count],
        run.forces + random.normal(0.0, noise_n, run.forces.shape),
        SIMULATED,
        str(run.outcome),
    )


def recover(
    simulator: Simulator,
    truth: FingertipParameters,
    trajectories: Sequence[PlannedPath],
    noise_n: float,
    seed: int,
    *,
    sensors: int = 1,
    settings: CalibrationSettings | None = None,
    executor: Executor | None = None,
    on_evaluation: Callable[[Evaluation], None] | None = None,
    on_run: Callable[[int, int], None] | None = None,
) -> ParameterRecovery:
    """Calibrate on simulated, noisy trajectories of known parameters.

    The calibration gets forces and poses only, and begins with its scan, or, by a `SlopeSimulator`,
    in the middle of the bounds.

    Args:
        simulator: Runs the known and the calibrated simulations.
        truth: Known parameters.
        trajectories: What to simulate; include angled ones, for friction.
        noise_n: Standard deviation of the noise of each axis [N].
        seed: For the noise.
        sensors: Copies of each trajectory with independent noise; the paper had three BioTacs.
        settings: Settings of the calibration.
        executor: Runs simulations, see ``calibrate``.
        on_evaluation: See ``calibrate``.
        on_run: See ``calibrate``.

    Raises:
        SimulationError: The trajectories cannot be simulated or compared.
    """
    random = np.random.default_rng(seed)
    plans = [MeasuredIndentation(p.name, p.indenter, "-", p.path, np.zeros((len(p.path), 3)))
             for p in trajectories]  # fmt: skip
    runs = SimulationRuns(simulator, executor, on_run).run((truth, plan) for plan in plans)
    measured = tuple(
        noisy(planned, run, f"virtual{number + 1}", noise_n, random)
        for planned, run in zip(trajectories, runs, strict=True)
        for number in range(sensors)
    )
    result = calibrate(
        simulator,
        measured,
        settings,
        executor=executor,
        on_evaluation=on_evaluation,
        on_run=on_run,
    )
    planted = {
        THICKNESS: truth.skin_thickness_m,
        MODULUS: truth.shear_modulus_pa,
        FRICTION: truth.friction_coefficient,
        VOLUME: runs[0].fluid_volume_m3,
    }
    sd = {estimate.name: estimate.sd for estimate in result.estimates}
    return ParameterRecovery(
        planted,
        {name: result.value(name) for name in planted},
        {VOLUME: result.fluid_volume_sd_m3} | sd,
        result,
        measured,
    )


class _Press(NamedTuple):
    indenter: str
    x_m: float
    depth_m: float
    angle_deg: float
    azimuth_deg: float


# Below about 6 N thickness and modulus have the same effect; a pinch on the core to 10 N and more
# separates them. Friction is visible where an indenter moves sideways.
PRESSES = {
    "pinch": _Press("cylinder_long", -4e-3, 4.2e-3, 0.0, 0.0),
    "normal": _Press("sphere_medium", -4e-3, 3.0e-3, 0.0, 0.0),
    "distal": _Press("sphere_medium", -4e-3, 2.5e-3, 30.0, 0.0),
    "lateral": _Press("sphere_large", -6e-3, 2.5e-3, 30.0, 90.0),
    "proximal": _Press("cube", -4e-3, 2.0e-3, 30.0, 180.0),
}

CLEARANCE_M = 1e-3
"""Distance of the first pose from the skin [m]; the calibration tries thicker skins, too."""


def plan_recovery(tip: Fingertip) -> list[PlannedPath]:
    """Paths of the indentations, from first contact with this finger's pad on."""
    surface = OuterSurface(tip.nodes, tip.geometry.mesh.outer_faces)
    planned = []
    for name, press in PRESSES.items():
        target, normal = pad_point(surface, press.x_m, 0.0)
        direction = angled_direction(
            normal, math.radians(press.angle_deg), math.radians(press.azimuth_deg)
        )
        indenter = make_indenter(press.indenter)
        path = press_path(
            indenter,
            target,
            direction,
            surface,
            depth_m=press.depth_m,
            steps=20,
            clearance_m=CLEARANCE_M,
        )
        planned.append(PlannedPath(name, press.indenter, path))
    return planned
