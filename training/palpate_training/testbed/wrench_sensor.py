"""Noise and drift of a six-axis strain-gauge force/torque sensor at about 100 Hz.

Of the kind of the paper's Weiss KMS 40 (120 N, 3 N m). Its noise is not published; the paper says
only that below 0.5 N "substantial noise persisted" after filtering. The numbers are therefore ours,
set so that about a tenth of that threshold is noise of one sample, and that drift over a trajectory
(5 minutes) stays below it, while that over an experiment does not: hence the tare of each.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from palpate.errors import ConfigError

Floats = npt.NDArray[np.float64]


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
        """What the sensor says of a wrench.

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
