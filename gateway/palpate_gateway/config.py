"""Configuration of the gateway: which sensors, and how they are paced and tared."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from palpate.config import Name, StrictConfig
from palpate_gateway.condition.condition import DRIFT_COUNTS
from palpate_gateway.condition.stillness import MAX_PAC_SD_COUNTS, MAX_SD_COUNTS
from palpate_gateway.one_core import CoreChoice
from palpate_gateway.tare import TARE_FRAMES, TareMode


class SensorConfig(StrictConfig):
    """One sensor.

    Attributes:
        name: Its name in keys.
        driver: Name in the driver table.
        options: The driver's own options, checked by the driver.
        of: The finger that this force/torque sensor or pose of the indenter belongs to: its
            readings are published under the keys of that finger, where recordings expect them;
            None = under its own.
    """

    name: Name = "finger"
    driver: str = "virtual"
    options: dict[str, Any] = Field(default_factory=dict)
    of: Name | None = None

    @property
    def key_name(self) -> str:
        """The name in the keys of its readings."""
        return self.of or self.name


class GatewayConfig(StrictConfig):
    """The gateway.

    Attributes:
        sensors: The sensors.
        tare: When a finger is tared first: ``still`` = as soon as electrodes, PAC and PDC are
            still; ``first`` = as soon as the electrodes are still, for a robot that shakes the
            finger, and always for recordings; ``query`` = on request only.
        tare_frames: Frames averaged in a tare.
        tare_max_sd_counts: If an electrode varies more, the finger counts as touched [counts].
        tare_max_pac_sd_counts: If PAC varies more, the finger counts as touched [counts].
        retare_after_s: Tare again without a request once a finger has been untouched for this long
            and its baseline has drifted [s]; None = never. A press that comes slowly and then stays
            looks like drift: docs/tare-and-health.md.
        retare_drift_counts: Drift of an electrode that causes this [counts].
        pace: Recordings at their own pace (stamped with the present time; messages of a palpate
            record keep their stamps) or as fast as possible (stamps as recorded, nothing is ever
            dropped).
        wait_for: Services that must be ready before a fast recording starts.
        exit_at_end: End the process when every source has ended; of a fast recording, when all
            services have read it.
        core: The processor core that the process is bound to: its number, ``idlest`` = the one with
            the least load at the start, or ``any`` = not bound. A recording as fast as possible is
            never bound.
        linger_s: Time from the end of the sources to the end of the process [s], in which requests
            are still answered.
    """

    sensors: tuple[SensorConfig, ...] = Field(default=(SensorConfig(),), min_length=1)
    tare: TareMode = "still"
    tare_frames: int = Field(default=TARE_FRAMES, ge=2, le=100_000)
    tare_max_sd_counts: float = Field(default=MAX_SD_COUNTS, gt=0.0)
    tare_max_pac_sd_counts: float = Field(default=MAX_PAC_SD_COUNTS, gt=0.0)
    retare_after_s: float | None = Field(default=None, ge=5.0)
    retare_drift_counts: float = Field(default=DRIFT_COUNTS, gt=0.0)
    pace: Literal["recorded", "fast"] = "recorded"
    wait_for: tuple[Name, ...] = ()
    exit_at_end: bool = False
    core: CoreChoice = "idlest"
    linger_s: float = Field(default=1.0, ge=0.0)

    @model_validator(mode="after")
    def _names_differ(self) -> GatewayConfig:
        names = [sensor.name for sensor in self.sensors]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"sensor name {twice[0]!r} is given twice; names must differ")
        return self

    @model_validator(mode="after")
    def _owners_exist(self) -> GatewayConfig:
        owners = {sensor.name for sensor in self.sensors if sensor.of is None}
        for sensor in self.sensors:
            if sensor.of is not None and sensor.of not in owners:
                raise ValueError(
                    f"sensor {sensor.name!r} is of {sensor.of!r}, which is no sensor of its own; "
                    f"there are: {', '.join(sorted(owners))}"
                )
        return self
