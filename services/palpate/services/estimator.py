"""One frame to one estimate: a pure function of frame, tare and bundle.

No clock and no state go in, so that replaying a record gives the same bytes again.
"""

from __future__ import annotations

from enum import StrEnum
from math import sqrt

import numpy as np

from palpate.protos.messages import (
    NO_TARE,
    ElectrodeFrame,
    FeatureEstimate,
    FloatArray,
    Tare,
)
from palpate.services.runtime import Runtime


class Refusal(StrEnum):
    """Why a frame got no estimate; the value is the name it is counted by."""

    UNTARED = "untared"
    """The frame was taken before any tare, or the tare given is not the one it names."""

    INVALID_CHANNELS = "invalid_channels"
    """At least one electrode is marked bad."""

    WRONG_SENSOR = "wrong_sensor"
    """The bundle was made for another type of sensor."""

    NON_FINITE = "non_finite"
    """The model answered with NaN, infinity or a negative standard deviation."""


def tared_counts(frame: ElectrodeFrame, tare: Tare) -> FloatArray:
    """Electrodes minus baseline [counts], float32, shape ``(19,)``."""
    return np.subtract(frame.electrodes, tare.electrodes, dtype=np.float32)


def estimate(
    frame: ElectrodeFrame, tare: Tare | None, runtime: Runtime
) -> FeatureEstimate | Refusal:
    """Estimate the features of one frame.

    Args:
        frame: Raw counts of one sampling round.
        tare: The tare that ``frame.tare_id`` names; None where nobody knows it.
        runtime: A loaded bundle of the task ``features``.

    Returns:
        The estimate, or why there is none. Never an estimate from bad input.
    """
    if frame.sensor_type is not runtime.sensor_type:
        return Refusal.WRONG_SENSOR
    if tare is None or frame.tare_id == NO_TARE or tare.tare_id != frame.tare_id:
        return Refusal.UNTARED
    if not frame.electrodes_valid:
        return Refusal.INVALID_CHANNELS
    outputs = runtime.run(tared_counts(frame, tare))
    if outputs is None:
        return Refusal.NON_FINITE
    force = outputs["force"]
    x, y, z = force.tolist()
    in_contact = sqrt(x * x + y * y + z * z) >= runtime.contact_threshold_n
    return FeatureEstimate(
        source=frame.stamp,
        sensor_serial=frame.sensor_serial,
        bundle_sha256=runtime.sha256,
        tare_id=frame.tare_id,
        in_contact=in_contact,
        force=force,
        force_sd=outputs["force_sd"],
        contact_location=outputs.get("contact_location") if in_contact else None,
        contact_location_sd=outputs.get("contact_location_sd") if in_contact else None,
    )
