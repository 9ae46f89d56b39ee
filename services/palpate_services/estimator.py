"""One message to one estimate: pure functions of frame or field, tare and bundle.

No clock and no state go in, so that replaying a record gives the same bytes again.
"""

from __future__ import annotations

from enum import StrEnum
from math import sqrt

import numpy as np

from palpate.messages import (
    NO_TARE,
    ElectrodeFrame,
    FeatureEstimate,
    FieldEstimate,
    FieldFrame,
    FloatArray,
    SynthesisEstimate,
    Tare,
    as_field_frame,
)
from palpate_services.runtime import Runtime


class Refusal(StrEnum):
    """Why a message got no estimate; the value is the name it is counted by."""

    UNTARED = "untared"
    """The frame was taken before any tare, or the tare given is not the one it names or has another
    number of electrodes."""

    INVALID_CHANNELS = "invalid_channels"
    """At least one electrode is marked bad."""

    WRONG_SENSOR = "wrong_sensor"
    """The bundle was made for another type of sensor."""

    WRONG_MESH = "wrong_mesh"
    """The field is one of another mesh than the bundle's."""

    NON_FINITE = "non_finite"
    """The input holds NaN or infinity, or the model answered so, or with a negative deviation."""


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
    outputs = _run_on_electrodes(frame, tare, runtime)
    if isinstance(outputs, Refusal):
        return outputs
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


def estimate_field(
    frame: ElectrodeFrame, tare: Tare | None, runtime: Runtime
) -> FieldEstimate | Refusal:
    """Estimate the displacement of each skin node from one frame.

    Args:
        frame: Raw counts of one sampling round.
        tare: The tare that ``frame.tare_id`` names; None where nobody knows it.
        runtime: A loaded bundle of the task ``field``.

    Returns:
        The estimate on the bundle's mesh, or why there is none.
    """
    outputs = _run_on_electrodes(frame, tare, runtime)
    if isinstance(outputs, Refusal):
        return outputs
    return FieldEstimate(
        source=frame.stamp,
        sensor_serial=frame.sensor_serial,
        bundle_sha256=runtime.sha256,
        tare_id=frame.tare_id,
        mesh_sha256=runtime.mesh_sha256,
        displacement=outputs["displacement"].reshape(-1, 3),
        displacement_sd=outputs.get("displacement_sd"),
    )


def synthesise(field: FieldFrame | FieldEstimate, runtime: Runtime) -> SynthesisEstimate | Refusal:
    """Estimate the tared counts that go with a displacement field.

    Args:
        field: Known or estimated, on the mesh of the bundle.
        runtime: A loaded bundle of the task ``synthesis``.

    Returns:
        The estimate, or why there is none.
    """
    known = as_field_frame(field)
    sample = known.displacement.reshape(-1)
    if known.mesh_sha256 != runtime.mesh_sha256 or sample.shape != runtime.sample_shape:
        return Refusal.WRONG_MESH
    # A network may hide it: a rectifier turns NaN into 0 on some machines.
    if not np.isfinite(sample).all():
        return Refusal.NON_FINITE
    outputs = runtime.run(sample)
    if outputs is None:
        return Refusal.NON_FINITE
    return SynthesisEstimate(
        source=known.stamp,
        sensor_serial=known.sensor_serial,
        bundle_sha256=runtime.sha256,
        mesh_sha256=runtime.mesh_sha256,
        tared_counts=outputs["tared_counts"],
        tared_counts_sd=outputs["tared_counts_sd"],
    )


def _run_on_electrodes(
    frame: ElectrodeFrame, tare: Tare | None, runtime: Runtime
) -> dict[str, FloatArray] | Refusal:
    """Outputs of a model for the tared counts of a frame, or why there are none."""
    if frame.sensor_type is not runtime.sensor_type:
        return Refusal.WRONG_SENSOR
    if tare is None or frame.tare_id == NO_TARE or tare.tare_id != frame.tare_id:
        return Refusal.UNTARED
    if tare.electrodes.shape != frame.electrodes.shape:  # of the finger that was there before
        return Refusal.UNTARED
    if not frame.electrodes_valid:
        return Refusal.INVALID_CHANNELS
    outputs = runtime.run(tared_counts(frame, tare))
    return Refusal.NON_FINITE if outputs is None else outputs
