"""Codec of estimates: features, fields, synthesis. Large float fields are spliced (see checks)."""

from __future__ import annotations

from palpate.codec.base import (
    check_digest,
    check_electrodes,
    check_field,
    check_serial,
    codec_of,
    field_from_wire,
    reject,
    splice,
    stamp_from_wire,
    stamp_to_wire,
    vector3_from_wire,
    vector3_to_wire,
)
from palpate.messages import FeatureEstimate, FieldEstimate, SynthesisEstimate
from palpate.v1 import estimates_pb2


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
    )


def _features_encode(estimate: FeatureEstimate) -> bytes:
    msg = estimates_pb2.FeatureEstimate(
        sensor_serial=check_serial(estimate.sensor_serial),
        bundle_sha256=check_digest(estimate.bundle_sha256, "bundle_sha256"),
        tare_id=estimate.tare_id,
        in_contact=estimate.in_contact,
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
    return msg.SerializeToString()


def _field_from_wire(msg: estimates_pb2.FieldEstimate) -> FieldEstimate:
    displacement = field_from_wire(msg.displacement, 3, "displacement")
    nodes = displacement.shape[0]
    sd = contact_force = None
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
    )


def _field_encode(estimate: FieldEstimate) -> bytes:
    displacement = check_field(estimate.displacement, 3, "displacement")
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
    return payload


def _synthesis_from_wire(msg: estimates_pb2.SynthesisEstimate) -> SynthesisEstimate:
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
    return payload


FEATURE_ESTIMATE = codec_of(estimates_pb2.FeatureEstimate, _features_encode, _features_from_wire)
FIELD_ESTIMATE = codec_of(estimates_pb2.FieldEstimate, _field_encode, _field_from_wire)
SYNTHESIS_ESTIMATE = codec_of(
    estimates_pb2.SynthesisEstimate, _synthesis_encode, _synthesis_from_wire
)
