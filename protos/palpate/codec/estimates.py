"""Codec of estimates and their timings. Large float fields are spliced (see checks)."""

from __future__ import annotations

from collections.abc import Collection
from itertools import pairwise
from math import hypot, isfinite

import numpy as np

from palpate.codec.base import (
    check_digest,
    check_electrodes,
    check_field,
    check_serial,
    codec_of,
    delimited,
    field_from_wire,
    reject,
    splice,
    stamp_from_wire,
    stamp_to_wire,
    vector3_from_wire,
    vector3_to_wire,
)
from palpate.messages import (
    ErrorBounds,
    FeatureEstimate,
    FieldEstimate,
    FloatArray,
    QualityFlag,
    StageTimings,
    SynthesisEstimate,
)
from palpate.messages.estimates import UNIT_TOLERANCE
from palpate.v1 import estimates_pb2

_FLAGS = {int(flag): flag for flag in QualityFlag}
_NAME_MAX, _VERSION_MAX = 64, (1 << 32) - 1


def _quality_from_wire(values: Collection[int]) -> tuple[QualityFlag, ...]:
    """Flags, ascending, each once; those of a newer palpate become ``UNKNOWN``."""
    if not values:
        return ()
    return tuple(sorted({_FLAGS.get(value, QualityFlag.UNKNOWN) for value in values}))


def _quality_to_wire(flags: tuple[QualityFlag, ...]) -> tuple[int, ...]:
    if not flags:
        return ()
    values = tuple(map(int, flags))
    if any(a >= b for a, b in pairwise(values)) or not all(value in _FLAGS for value in values):
        reject("quality", f"quality {values} are no flags in ascending order, each once")
    return values


def _check_bundle(name: str, version: int) -> tuple[str, int]:
    """Name and version of a bundle; empty and 0 = it was not said."""
    if name and not (len(name) <= _NAME_MAX and name.isascii() and name.isprintable()):
        reject("bundle", f"bundle_name {name[:80]!r} is not at most 64 printable ASCII characters")
    if not 0 <= version <= _VERSION_MAX:
        reject("bundle", f"bundle_version {version} is not in uint32")
    return name, version


def _check_normal(normal: FloatArray, sd: float) -> float:
    """The standard deviation of a contact normal that may be sent."""
    x, y, z = normal.tolist()
    if abs(hypot(x, y, z) - 1.0) > UNIT_TOLERANCE:
        reject("normal", f"contact_normal = ({x}, {y}, {z}) is no unit vector")
    if not isfinite(sd):
        reject("non_finite", f"contact_normal_sd = {sd} is not finite")
    if sd < 0:
        reject("negative_sd", f"contact_normal_sd = {sd} is negative")
    return sd


_BOUNDS = ("force_magnitude", "force", "contact_location", "displacement")


def _bounds_from_wire(msg: estimates_pb2.ErrorBounds) -> ErrorBounds:
    given = {name: getattr(msg, name) for name in _BOUNDS if msg.HasField(name)}
    return _checked_bounds(ErrorBounds(msg.level, **given, other_sensors=msg.other_sensors))


def _bounds_to_wire(bounds: ErrorBounds) -> estimates_pb2.ErrorBounds:
    _checked_bounds(bounds)
    return estimates_pb2.ErrorBounds(
        level=bounds.level,
        force_magnitude=bounds.force_magnitude,
        force=bounds.force,
        contact_location=bounds.contact_location,
        displacement=bounds.displacement,
        other_sensors=bounds.other_sensors,
    )


_BOUND_MAX = 1e30
"""Far beyond any error; and what a float32 field takes."""


def _checked_bounds(bounds: ErrorBounds) -> ErrorBounds:
    given = (
        bounds.force_magnitude, bounds.force, bounds.contact_location, bounds.displacement,
    )  # fmt: skip
    if not 0.0 < bounds.level < 1.0:
        reject("bounds", f"bounds hold in a share of {bounds.level}, not between 0 and 1")
    if not all(value is None or 0.0 <= value <= _BOUND_MAX for value in given):
        reject("bounds", f"bounds {given} are not finite, or negative")
    return bounds


def _features_from_wire(msg: estimates_pb2.FeatureEstimate) -> FeatureEstimate:
    location = location_sd = None
    if msg.HasField("contact_location"):
        if not msg.HasField("contact_location_sd"):
            reject("location", "contact_location comes without contact_location_sd")
        if not msg.in_contact:
            reject("location", "contact_location comes although in_contact is false")
        location = vector3_from_wire(msg.contact_location, "contact_location")
        location_sd = vector3_from_wire(
            msg.contact_location_sd, "contact_location_sd", deviation=True
        )
    centre = centre_sd = None
    if msg.HasField("centre_of_pressure"):
        if not msg.HasField("centre_of_pressure_sd"):
            reject("centre", "centre_of_pressure comes without centre_of_pressure_sd")
        if not msg.in_contact:
            reject("centre", "centre_of_pressure comes although in_contact is false")
        centre = vector3_from_wire(msg.centre_of_pressure, "centre_of_pressure")
        centre_sd = vector3_from_wire(
            msg.centre_of_pressure_sd, "centre_of_pressure_sd", deviation=True
        )
    normal = normal_sd = None
    if msg.HasField("contact_normal"):
        if not msg.in_contact:
            reject("normal", "contact_normal comes although in_contact is false")
        normal = vector3_from_wire(msg.contact_normal, "contact_normal")
        normal_sd = _check_normal(normal, msg.contact_normal_sd)
    if not msg.HasField("force") or not msg.HasField("force_sd"):
        reject("force", "force or force_sd is missing")
    force_sd = vector3_from_wire(msg.force_sd, "force_sd", deviation=True)
    return FeatureEstimate(
        stamp_from_wire(msg.source),
        check_serial(msg.sensor_serial),
        check_digest(msg.bundle_sha256, "bundle_sha256"),
        msg.tare_id,
        msg.in_contact,
        vector3_from_wire(msg.force, "force"),
        force_sd,
        location,
        location_sd,
        _quality_from_wire(msg.quality),
        *_check_bundle(msg.bundle_name, msg.bundle_version),
        centre,
        centre_sd,
        normal,
        normal_sd,
        _feature_bounds(msg) if msg.HasField("bounds") else None,
    )


def _feature_bounds(msg: estimates_pb2.FeatureEstimate) -> ErrorBounds:
    bounds = _bounds_from_wire(msg.bounds)
    if bounds.contact_location is not None and not msg.HasField("contact_location"):
        reject("bounds", "a bound of contact_location comes without contact_location")
    return bounds


def _features_encode(estimate: FeatureEstimate) -> bytes:
    msg = estimates_pb2.FeatureEstimate(
        sensor_serial=check_serial(estimate.sensor_serial),
        bundle_sha256=check_digest(estimate.bundle_sha256, "bundle_sha256"),
        tare_id=estimate.tare_id,
        in_contact=estimate.in_contact,
        quality=_quality_to_wire(estimate.quality),  # type: ignore[arg-type]
    )
    msg.bundle_name, msg.bundle_version = _check_bundle(
        estimate.bundle_name, estimate.bundle_version
    )
    stamp_to_wire(estimate.source, msg.source)
    vector3_to_wire(estimate.force, msg.force, "force")
    vector3_to_wire(estimate.force_sd, msg.force_sd, "force_sd", deviation=True)
    if estimate.contact_location is not None:
        if estimate.contact_location_sd is None or not estimate.in_contact:
            reject("location", "contact_location needs contact_location_sd and in_contact")
        vector3_to_wire(estimate.contact_location, msg.contact_location, "contact_location")
        vector3_to_wire(
            estimate.contact_location_sd,
            msg.contact_location_sd,
            "contact_location_sd",
            deviation=True,
        )
    if estimate.centre_of_pressure is not None:
        if estimate.centre_of_pressure_sd is None or not estimate.in_contact:
            reject("centre", "centre_of_pressure needs centre_of_pressure_sd and in_contact")
        vector3_to_wire(estimate.centre_of_pressure, msg.centre_of_pressure, "centre_of_pressure")
        vector3_to_wire(
            estimate.centre_of_pressure_sd,
            msg.centre_of_pressure_sd,
            "centre_of_pressure_sd",
            deviation=True,
        )
    if estimate.contact_normal is not None:
        if estimate.contact_normal_sd is None or not estimate.in_contact:
            reject("normal", "contact_normal needs contact_normal_sd and in_contact")
        vector3_to_wire(estimate.contact_normal, msg.contact_normal, "contact_normal")
        msg.contact_normal_sd = _check_normal(estimate.contact_normal, estimate.contact_normal_sd)
    if (bounds := estimate.bounds) is not None:
        if bounds.contact_location is not None and estimate.contact_location is None:
            reject("bounds", "a bound of contact_location needs contact_location")
        msg.bounds.CopyFrom(_bounds_to_wire(bounds))
    return msg.SerializeToString()


_NO_FIELD: FloatArray = np.zeros((0, 3), np.float32)
"""Displacement of a reduced reply."""


def _field_from_wire(msg: estimates_pb2.FieldEstimate) -> FieldEstimate:
    coefficients = None
    if msg.coefficients:
        coefficients = field_from_wire(msg.coefficients, 1, "coefficients")
        check_digest(msg.basis_sha256, "basis_sha256")
    elif msg.basis_sha256:
        reject("basis", "basis_sha256 comes without coefficients")
    if not msg.displacement and coefficients is not None:
        displacement, nodes = _NO_FIELD, 0
    else:
        displacement = field_from_wire(msg.displacement, 3, "displacement")
        nodes = displacement.shape[0]
    sd = contact_force = None
    if not nodes and (msg.displacement_sd or msg.contact_force):
        reject("shape", "displacement_sd or contact_force comes without displacement")
    if msg.displacement_sd:
        sd = field_from_wire(msg.displacement_sd, 1, "displacement_sd", rows=nodes, deviation=True)
    if msg.contact_force:
        contact_force = field_from_wire(msg.contact_force, 3, "contact_force", rows=nodes)
    return FieldEstimate(
        stamp_from_wire(msg.source),
        check_serial(msg.sensor_serial),
        check_digest(msg.bundle_sha256, "bundle_sha256"),
        msg.tare_id,
        check_digest(msg.mesh_sha256, "mesh_sha256"),
        displacement,
        sd,
        contact_force,
        _quality_from_wire(msg.quality),
        *_check_bundle(msg.bundle_name, msg.bundle_version),
        coefficients,
        msg.basis_sha256,
        _bounds_from_wire(msg.bounds) if msg.HasField("bounds") else None,
    )


def _field_encode(estimate: FieldEstimate) -> bytes:
    coefficients = estimate.coefficients
    if coefficients is not None:
        check_field(coefficients, 1, "coefficients")
        check_digest(estimate.basis_sha256, "basis_sha256")
    elif estimate.basis_sha256:
        reject("basis", "basis_sha256 is given without coefficients")
    reduced = coefficients is not None and not len(estimate.displacement)
    if reduced and not (estimate.displacement_sd is None and estimate.contact_force is None):
        reject("shape", "displacement_sd or contact_force is given without displacement")
    displacement = _NO_FIELD if reduced else check_field(estimate.displacement, 3, "displacement")
    nodes = displacement.shape[0]
    msg = estimates_pb2.FieldEstimate(
        sensor_serial=check_serial(estimate.sensor_serial),
        bundle_sha256=check_digest(estimate.bundle_sha256, "bundle_sha256"),
        tare_id=estimate.tare_id,
        mesh_sha256=check_digest(estimate.mesh_sha256, "mesh_sha256"),
    )
    stamp_to_wire(estimate.source, msg.source)
    payload = msg.SerializeToString() + splice(6, displacement)
    if estimate.displacement_sd is not None:
        sd = check_field(estimate.displacement_sd, 1, "displacement_sd", rows=nodes, deviation=True)
        payload += splice(7, sd)
    if estimate.contact_force is not None:
        payload += splice(8, check_field(estimate.contact_force, 3, "contact_force", rows=nodes))
    name, version = _check_bundle(estimate.bundle_name, estimate.bundle_version)
    tail = estimates_pb2.FieldEstimate(
        quality=_quality_to_wire(estimate.quality),  # type: ignore[arg-type]
        bundle_name=name,
        bundle_version=version,
    )
    payload += tail.SerializeToString()
    if coefficients is not None:
        payload += splice(12, coefficients) + delimited(13, estimate.basis_sha256)
    if estimate.bounds is not None:
        payload += delimited(14, _bounds_to_wire(estimate.bounds).SerializeToString())
    return payload


def synthesis_from_wire(msg: estimates_pb2.SynthesisEstimate) -> SynthesisEstimate:
    """Check and convert a synthesis."""
    counts = check_electrodes(field_from_wire(msg.tared_counts, 1, "tared_counts"), "tared_counts")
    sd = None
    if msg.tared_counts_sd:
        sd = field_from_wire(
            msg.tared_counts_sd, 1, "tared_counts_sd", rows=counts.shape[0], deviation=True
        )
    return SynthesisEstimate(
        stamp_from_wire(msg.source),
        check_serial(msg.sensor_serial),
        check_digest(msg.bundle_sha256, "bundle_sha256"),
        check_digest(msg.mesh_sha256, "mesh_sha256"),
        counts,
        sd,
        _quality_from_wire(msg.quality),
        *_check_bundle(msg.bundle_name, msg.bundle_version),
    )


def _synthesis_encode(estimate: SynthesisEstimate) -> bytes:
    counts = check_electrodes(check_field(estimate.tared_counts, 1, "tared_counts"), "tared_counts")
    msg = estimates_pb2.SynthesisEstimate(
        sensor_serial=check_serial(estimate.sensor_serial),
        bundle_sha256=check_digest(estimate.bundle_sha256, "bundle_sha256"),
        mesh_sha256=check_digest(estimate.mesh_sha256, "mesh_sha256"),
    )
    stamp_to_wire(estimate.source, msg.source)
    payload = msg.SerializeToString() + splice(5, counts)
    if estimate.tared_counts_sd is not None:
        sd = check_field(
            estimate.tared_counts_sd, 1, "tared_counts_sd", rows=counts.shape[0], deviation=True
        )
        payload += splice(6, sd)
    name, version = _check_bundle(estimate.bundle_name, estimate.bundle_version)
    tail = estimates_pb2.SynthesisEstimate(
        quality=_quality_to_wire(estimate.quality),  # type: ignore[arg-type]
        bundle_name=name,
        bundle_version=version,
    )
    return payload + tail.SerializeToString()


def _checked(timings: StageTimings) -> StageTimings:
    stages = (
        timings.waiting_s, timings.decode_s, timings.tare_s, timings.infer_s, timings.encode_s,
    )  # fmt: skip
    if not isfinite(sum(stages) + (timings.age_at_arrival_s or 0.0)) or min(stages) < 0:
        reject("timings", f"{timings} are not finite, or negative")
    return timings


def _timings_from_wire(msg: estimates_pb2.StageTimings) -> StageTimings:
    return _checked(
        StageTimings(
            msg.age_at_arrival_s if msg.HasField("age_at_arrival_s") else None,
            msg.waiting_s,
            msg.decode_s,
            msg.tare_s,
            msg.infer_s,
            msg.encode_s,
        )
    )


def _timings_encode(timings: StageTimings) -> bytes:
    _checked(timings)
    return estimates_pb2.StageTimings(
        age_at_arrival_s=timings.age_at_arrival_s,
        waiting_s=timings.waiting_s,
        decode_s=timings.decode_s,
        tare_s=timings.tare_s,
        infer_s=timings.infer_s,
        encode_s=timings.encode_s,
    ).SerializeToString()


FEATURE_ESTIMATE = codec_of(estimates_pb2.FeatureEstimate, _features_encode, _features_from_wire)
FIELD_ESTIMATE = codec_of(estimates_pb2.FieldEstimate, _field_encode, _field_from_wire)
SYNTHESIS_ESTIMATE = codec_of(
    estimates_pb2.SynthesisEstimate, _synthesis_encode, synthesis_from_wire
)
STAGE_TIMINGS = codec_of(estimates_pb2.StageTimings, _timings_encode, _timings_from_wire)
