"""Plays a quasi-static result as the streams of a whole trial, as the testbed would record them.

Noise and drift of a six-axis strain-gauge force/torque sensor at about 100 Hz.

Of the kind of the paper's Weiss KMS 40 (120 N, 3 N m). Its noise is not published; the paper says
only that below 0.5 N "substantial noise persisted" after filtering. The numbers are therefore ours,
set so that about a tenth of that threshold is noise of one sample, and that drift over a trajectory
(5 minutes) stays below it, while that over an experiment does not: hence the tare of each.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from palpate.errors import ConfigError
from palpate.rigid import Floats
from palpate_training.datasets.processing import filter_dwells
from palpate_training.datasets.trials import Counts, RawTrial, TrialHeader, trial_name
from palpate_training.experiment.plan import (
    APPROACH_M,
    DWELL_S,
    INCREMENT_M,
    commanded_travel,
    increments_of,
    unit,
)

RATE_HZ = 100
"""Of all streams; paper: at least 100 Hz."""

REPEATABILITY_M = 0.02e-3
"""Root mean square distance by which the arm misses a commanded pose [m]; paper, of the YuMi."""

JITTER_SD_S = 2.0e-4
"""Of time stamps; far below a sample, so that they stay in order."""

_UNTOUCHED_N = 1e-6  # what a solver may leave of a force that is none

ReadElectrodes = Callable[[Floats, Floats], Counts]
"""Ideal counts (T, 19) and time [s] (T,) -> raw counts, uint16, (T, 19)."""


def perform(
    header: TrialHeader,
    *,
    travel_m: npt.ArrayLike,
    force: npt.ArrayLike,
    counts: npt.ArrayLike,
    tip: npt.ArrayLike,
    read_electrodes: ReadElectrodes,
    sensor: WrenchSensor | None = None,
    registration_error_m: npt.ArrayLike = (0.0, 0.0, 0.0),
    repeatability_m: float = REPEATABILITY_M,
    contact_m: float = APPROACH_M,
    length_m: float | None = None,
    since_power_on_s: float = 1800.0,
    seed: int = 0,
    last_only: bool = False,
) -> RawTrial:
    """Play a quasi-static press as a trial: approach, increments of 0.1 mm, 5 s each.

    Between the rows of the result everything is interpolated linearly; before the first one there
    is no force, the counts are those of the first row, and the tip comes along the line of the
    first step.

    Args:
        header: What the trial is.
        travel_m: Travel past first contact of each row [m], shape (S,), increasing; the first, at
            0 or before, is untouched.
        force: On the BioTac [N], shape (S, 3).
        counts: Ideal electrodes [counts], shape (S, 19).
        tip: True tip of the indenter [m], shape (S, 3).
        read_electrodes: Adds what the electronics do: noise, drift, creep, rounding.
        sensor: The force/torque sensor; None = one with the default noise.
        registration_error_m: Tip by kinematics and registration minus true tip [m], shape (3,);
            one vector for a unit and arm.
        repeatability_m: Root mean square distance by which each increment is missed [m].
        contact_m: Commanded travel at which the skin is first touched [m]: 3 mm as planned, or what
            `contact_travel` gives for a robot with a registration error.
        length_m: Commanded travel in all [m]; None = to the end of the result, in whole increments.
        since_power_on_s: Age of the force/torque sensor when the trial starts [s].
        seed: Same seed, same trial, where ``read_electrodes`` is deterministic.
        last_only: Give what ``filter_force`` and ``last_of_increments`` would leave of the trial,
            in a fraction of the time: electrodes are not read in dwells but for their last sample.
            Their noise is drawn otherwise then.

    Raises:
        ConfigError: Rows that do not fit one another, touch at once or end too early, or electrodes
            of another shape or type.
    """
    travel, forces, ideal, tips = _rows(header, travel_m, force, counts, tip)
    error = np.asarray(registration_error_m, np.float64)
    if error.shape != (3,) or not np.isfinite(error).all():
        raise ConfigError(
            f"{header.trajectory}: registration error {error.tolist()}",
            remedy="give three finite numbers [m]",
        )
    if not contact_m >= INCREMENT_M:
        raise ConfigError(
            f"{header.trajectory}: contact after {contact_m * 1e3:.3f} mm",
            remedy="the first increment must end before contact: start at least 0.1 mm away",
        )
    reach = contact_m + float(travel[-1])
    commands = increments_of(reach if length_m is None else length_m)
    if commands[-1] > reach + 1e-9:
        raise ConfigError(
            f"{header.trajectory}: commanded travel of {commands[-1] * 1e3:.3f} mm, the result ends"
            f" at {reach * 1e3:.3f} mm",
            remedy="simulate deeper, by the registration error along the direction",
        )
    random = np.random.default_rng(seed)
    samples = round(DWELL_S * RATE_HZ)
    total = samples * (len(commands) - 1)
    nominal = np.arange(total) / RATE_HZ
    # a stamp is late, never early; the limit keeps them in order however unlikely the draw
    late = np.minimum(np.abs(random.normal(0.0, JITTER_SD_S, total)), 0.2 / RATE_HZ)
    commanded = commanded_travel(nominal, commands)

    row, weight = _locate(commanded - contact_m, travel)
    touched = np.maximum(weight, 0.0)  # before the first row nothing changes but the tip
    missed = random.normal(0.0, repeatability_m / math.sqrt(3.0), size=(len(commands) - 1, 3))
    time_s = nominal + late
    ends = samples * np.arange(1, len(commands)) - 1
    at = np.arange(total)
    if last_only:  # nothing ideal changes in a dwell: what creeps or drifts needs no reading in it
        at = np.union1d(np.flatnonzero(np.diff(commanded, prepend=-1.0)), ends)
    electrodes = read_electrodes(_between(ideal, row[at], touched[at]), time_s[at])
    if electrodes.shape != (len(at), ideal.shape[1]) or electrodes.dtype != np.uint16:
        raise ConfigError(
            f"read_electrodes gave {electrodes.dtype} {electrodes.shape}",
            remedy=f"return uint16 ({len(at)}, {ideal.shape[1]})",
        )
    sensor = WrenchSensor() if sensor is None else sensor
    read = sensor.read(
        _between(forces, row, touched), time_s, seed=random, since_power_on_s=since_power_on_s
    )
    kept = np.arange(total)
    if last_only:
        read = filter_dwells(trial_name(header), read, time_s, ends)
        electrodes, kept = electrodes[np.isin(at, ends)], ends
    missed_at = np.repeat(missed, samples, axis=0)[kept]
    return RawTrial(
        header=header,
        time_s=time_s[kept],
        electrodes=electrodes,
        force=read[kept],
        tip=_between(tips, row[kept], weight[kept]) + error + missed_at,
        travel_m=commanded[kept],
        increment_end=np.arange(len(ends)) if last_only else ends,
    )


def contact_travel(registration_error_m: npt.ArrayLike, direction: npt.ArrayLike) -> float:
    """Commanded travel at first contact of a robot that stands wrong [m].

    The tip truly is at its command minus the registration error, so an error along the direction
    delays contact.

    Args:
        registration_error_m: Tip by kinematics and registration minus true tip [m], shape (3,).
        direction: Where the tip moves, shape (3,).
    """
    return APPROACH_M + float(np.asarray(registration_error_m, np.float64) @ unit(direction))


def _rows(
    header: TrialHeader,
    travel_m: npt.ArrayLike,
    force: npt.ArrayLike,
    counts: npt.ArrayLike,
    tip: npt.ArrayLike,
) -> tuple[Floats, Floats, Floats, Floats]:
    travel, forces, ideal, tips = (
        np.asarray(values, np.float64) for values in (travel_m, force, counts, tip)
    )
    rows = len(travel) if travel.ndim == 1 else 0
    shapes = (forces.shape, ideal.shape, tips.shape)
    if rows < 2 or shapes != ((rows, 3), (rows, 19), (rows, 3)):
        raise ConfigError(
            f"{header.trajectory}: travel {travel.shape}, force, counts, tip {shapes}",
            remedy="give (S,), (S, 3), (S, 19) and (S, 3), S of at least 2",
        )
    for name, values in (("travel", travel), ("force", forces), ("counts", ideal), ("tip", tips)):
        if not np.isfinite(values).all():
            raise ConfigError(
                f"{header.trajectory}: {name} is not finite", remedy="cut it at the divergence"
            )
    if (np.diff(travel) <= 0.0).any():
        raise ConfigError(f"{header.trajectory}: travel does not increase", remedy="sort the rows")
    if travel[0] > 0.0 or np.linalg.norm(forces[0]) > _UNTOUCHED_N:
        raise ConfigError(
            f"{header.trajectory}: the first row is at {travel[0]} m with"
            f" {np.linalg.norm(forces[0]):.3g} N",
            remedy="begin with the untouched state, at travel 0 or before",
        )
    return travel, forces, ideal, tips


def _locate(at: Floats, travel: Floats) -> tuple[npt.NDArray[np.intp], Floats]:
    """Row before each travel, and how far on towards the next: below 0 before the first row."""
    row = np.clip(np.searchsorted(travel, at, side="right") - 1, 0, len(travel) - 2)
    return row, (at - travel[row]) / (travel[row + 1] - travel[row])


def _between(values: Floats, row: npt.NDArray[np.intp], weight: Floats) -> Floats:
    steps = np.diff(values, axis=0)
    return np.asarray(values[row] + weight[:, None] * steps[row])


def _axes(*values: float) -> Floats:
    return np.array(values, np.float64)


@dataclass(frozen=True, slots=True)
class WrenchSensor:
    """What a sensor adds to the wrench; axes fx fy fz tx ty tz, [N] and [N m], each shape (6,).

    Attributes:
        noise_sd: White noise of one sample. Along the axis of the sensor (z) strain gauges of this
            build see less strain, hence more noise.
        offset_sd: Constant offset, drawn once a run.
        walk_sd: Random walk: standard deviation of what it gains in one minute.
        warm_up_sd: Drift since power-on that has passed after a few ``warm_up_s``, drawn once.
        warm_up_s: Time constant of the warm-up [s].
        step: Quantisation.
        range: Beyond it the reading saturates.
    """

    noise_sd: Floats = field(default_factory=lambda: _axes(0.04, 0.04, 0.06, 8e-4, 8e-4, 6e-4))
    offset_sd: Floats = field(default_factory=lambda: _axes(1.5, 1.5, 2.5, 0.03, 0.03, 0.02))
    walk_sd: Floats = field(default_factory=lambda: _axes(0.02, 0.02, 0.03, 4e-4, 4e-4, 3e-4))
    warm_up_sd: Floats = field(default_factory=lambda: _axes(0.6, 0.6, 1.0, 0.01, 0.01, 0.008))
    warm_up_s: float = 600.0
    step: Floats = field(default_factory=lambda: _axes(0.01, 0.01, 0.01, 2e-4, 2e-4, 2e-4))
    range: Floats = field(default_factory=lambda: _axes(120.0, 120.0, 120.0, 3.0, 3.0, 3.0))

    def __post_init__(self) -> None:
        if self.warm_up_s <= 0.0 or not np.isfinite(self.warm_up_s):
            raise ConfigError(f"warm_up_s = {self.warm_up_s}", remedy="give a time above 0")
        for name in ("noise_sd", "offset_sd", "walk_sd", "warm_up_sd", "step", "range"):
            value = np.asarray(getattr(self, name))
            if value.shape != (6,) or not (np.isfinite(value) & (value >= 0.0)).all():
                raise ConfigError(
                    f"{name} = {value.tolist()}",
                    remedy="give six finite numbers, 0 or more: fx fy fz tx ty tz",
                )

    def read(
        self,
        wrench: npt.ArrayLike,
        time_s: npt.ArrayLike,
        *,
        seed: int | np.random.Generator,
        since_power_on_s: float = 1800.0,
    ) -> Floats:
        """Readings of the sensor for a true wrench.

        Args:
            wrench: True wrench, shape (T, 6), or force alone, shape (T, 3).
            time_s: Of each sample [s], shape (T,), not decreasing.
            seed: Same seed, same readings.
            since_power_on_s: Age of the sensor at time 0 [s]; the paper waits 30 minutes.

        Returns:
            Readings, shape of ``wrench``.

        Raises:
            ConfigError: Shapes that do not fit, NaN, or times that decrease.
        """
        true = np.asarray(wrench, np.float64)
        time = np.asarray(time_s, np.float64)
        if true.ndim != 2 or true.shape[1] not in (3, 6) or time.shape != (len(true),):
            raise ConfigError(
                f"wrench {true.shape} and time {time.shape}",
                remedy="give shapes (T, 6) or (T, 3), and (T,)",
            )
        if not (np.isfinite(true).all() and np.isfinite(time).all()):
            raise ConfigError("wrench or time is not finite", remedy="leave out broken samples")
        steps = np.diff(time, prepend=time[:1])
        if (steps < 0.0).any():
            raise ConfigError("times decrease", remedy="sort the samples by time")
        n = true.shape[1]
        random = np.random.default_rng(seed)
        offset, warm_up = self.offset_sd[:n], self.warm_up_sd[:n]
        constant = random.normal(size=n) * offset
        warming = random.normal(size=n) * warm_up
        # float32 draws: half the time, and the noise needs no more digits
        walk = random.standard_normal(true.shape, np.float32)
        walk *= np.sqrt(steps / 60.0)[:, None] * self.walk_sd[:n]
        noise = random.standard_normal(true.shape, np.float32) * self.noise_sd[:n]
        passed = -np.expm1(-(time + since_power_on_s) / self.warm_up_s)
        read = true + constant + passed[:, None] * warming + np.cumsum(walk, axis=0) + noise
        step = self.step[:n]
        read = np.where(step > 0.0, np.round(read / np.where(step > 0.0, step, 1.0)) * step, read)
        return np.asarray(np.clip(read, -self.range[:n], self.range[:n]))
