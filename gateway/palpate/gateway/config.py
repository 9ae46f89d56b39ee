"""Configuration of the gateway: which sensors, and how they are paced and tared."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from palpate.gateway.tare import MAX_SD_COUNTS, TARE_FRAMES
from palpate.protos.config import StrictConfig
from palpate.protos.names import Name


class SensorConfig(StrictConfig):
    """One sensor.

    Attributes:
        name: Its name in keys.
        driver: Name in the driver table.
        options: The driver's own options, checked by the driver.
    """

    name: Name = "finger"
    driver: str = "virtual"
    options: dict[str, Any] = Field(default_factory=dict)


class GatewayConfig(StrictConfig):
    """The gateway.

    Attributes:
        sensors: What it serves.
        tare_frames: Frames averaged in a tare.
        tare_max_sd_counts: An electrode that varies more is being touched [counts].
        pace: Recordings at their own pace (stamps are now) or as fast as possible (stamps as
            recorded, nothing is ever dropped).
        wait_for: Services that must be ready before a fast recording starts.
        exit_at_end: End the process when every source has ended.
        linger_s: Time between the end of the sources and that of the process [s], in which late
            consumers still get their answers.
    """

    sensors: tuple[SensorConfig, ...] = Field(default=(SensorConfig(),), min_length=1)
    tare_frames: int = Field(default=TARE_FRAMES, ge=2, le=100_000)
    tare_max_sd_counts: float = Field(default=MAX_SD_COUNTS, gt=0.0)
    pace: Literal["recorded", "fast"] = "recorded"
    wait_for: tuple[Name, ...] = ()
    exit_at_end: bool = False
    linger_s: float = Field(default=1.0, ge=0.0)

    @model_validator(mode="after")
    def _names_differ(self) -> GatewayConfig:
        names = [sensor.name for sensor in self.sensors]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"sensor name {twice[0]!r} is given twice; names must differ")
        return self
