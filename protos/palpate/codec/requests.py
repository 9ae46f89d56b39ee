"""Codec of questions for one estimate, and of answers that are more than an estimate."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np

from palpate.codec.base import (
    Codec,
    check_digest,
    check_field,
    check_request_id,
    check_serial,
    codec_of,
    delimited,
    field_from_wire,
    reject,
    splice,
)
from palpate.codec.estimates import SYNTHESIS_ESTIMATE, synthesis_from_wire
from palpate.codec.frames import (
    ELECTRODE_FRAME,
    FIELD_FRAME,
    electrodes_from_wire,
    field_frame_from_wire,
)
from palpate.codec.simulation import (
    OUTCOMES_BY_NUMBER,
    SIMULATION_REQUEST,
    check_positive,
    simulation_request_from_wire,
    step_encode,
    step_from_wire,
)
from palpate.config import check_name
from palpate.errors import ConfigError
from palpate.messages import (
    BasisRequest,
    ContactDescription,
    FeatureRequest,
    FieldFrame,
    FieldRequest,
    ModeBasis,
    SynthesisReply,
    SynthesisRequest,
)
from palpate.v1 import requests_pb2, service_pb2

DEFAULT_SIMULATOR = "twin"


def _check_sensor(sensor: str, what: str = "sensor") -> str:
    try:
        return check_name(sensor, what)
    except ConfigError as error:
        reject("sensor", error.problem)


def _field_request_from_wire(msg: service_pb2.FieldRequest) -> FieldRequest:
    return FieldRequest(_check_sensor(msg.sensor), electrodes_from_wire(msg.frame), msg.reduced)


def _field_request_encode(request: FieldRequest) -> bytes:
    head = service_pb2.FieldRequest(sensor=_check_sensor(request.sensor))
    tail = service_pb2.FieldRequest(reduced=request.reduced)
    frame = delimited(2, ELECTRODE_FRAME.encode(request.frame))
    return head.SerializeToString() + frame + tail.SerializeToString()


def _feature_request_from_wire(msg: requests_pb2.FeatureRequest) -> FeatureRequest:
    return FeatureRequest(_check_sensor(msg.sensor), electrodes_from_wire(msg.frame))


def _feature_request_encode(request: FeatureRequest) -> bytes:
    head = requests_pb2.FeatureRequest(sensor=_check_sensor(request.sensor))
    return head.SerializeToString() + delimited(2, ELECTRODE_FRAME.encode(request.frame))


def _three(values: Sequence[float], what: str) -> tuple[float, float, float]:
    if len(values) != 3 or not isfinite(sum(values)):
        reject("shape", f"{what} = {list(values)[:6]} are not three finite numbers")
    x, y, z = values
    return x, y, z


def _contact_from_wire(msg: requests_pb2.ContactDescription) -> ContactDescription:
    until = msg.WhichOneof("until")
    if until is None:
        reject("contact", "neither depth_m nor force_n is given: where shall the indenter stop?")
    wanted = getattr(msg, until)
    if not (isfinite(wanted) and wanted > 0):
        reject("contact", f"{until} = {wanted} is not a positive number")
    direction = _three(msg.direction, "direction") if msg.direction else None
    if direction is not None and not any(direction):
        reject("contact", "direction is the zero vector")
    return ContactDescription(
        check_serial(msg.indenter, "indenter"),
        _three(msg.location, "location"),
        direction,
        **{until: wanted},
    )


def _contact_to_wire(contact: ContactDescription) -> requests_pb2.ContactDescription:
    if (contact.depth_m is None) == (contact.force_n is None):
        reject("contact", "give depth_m or force_n, and not both")
    msg = requests_pb2.ContactDescription(
        indenter=contact.indenter,
        location=contact.location,
        direction=contact.direction or (),
        depth_m=contact.depth_m,
        force_n=contact.force_n,
    )
    _contact_from_wire(msg)  # rare message: one set of checks serves both ways
    return msg


def _synthesis_request_from_wire(msg: requests_pb2.SynthesisRequest) -> SynthesisRequest:
    match msg.WhichOneof("source"):
        case "field":
            source: object = field_frame_from_wire(msg.field)
        case "contact":
            source = _contact_from_wire(msg.contact)
        case "simulation":
            source = simulation_request_from_wire(msg.simulation)
        case _:
            reject("source", "neither a field nor a contact nor a simulation is given")
    return SynthesisRequest(
        source,  # type: ignore[arg-type]
        _check_sensor(msg.simulator or DEFAULT_SIMULATOR, "simulator"),
        check_positive(msg.deadline_s, "deadline_s"),
        msg.every_step,
        check_request_id(msg.request_id),
    )


def _synthesis_request_encode(request: SynthesisRequest) -> bytes:
    source = request.source
    if isinstance(source, FieldFrame):
        head = delimited(1, FIELD_FRAME.encode(source))
    elif isinstance(source, ContactDescription):
        head = delimited(2, _contact_to_wire(source).SerializeToString())
    else:
        head = delimited(3, SIMULATION_REQUEST.encode(source))
    tail = requests_pb2.SynthesisRequest(
        simulator=_check_sensor(request.simulator, "simulator"),
        deadline_s=check_positive(request.deadline_s, "deadline_s"),
        every_step=request.every_step,
        request_id=check_request_id(request.request_id),
    )
    return head + tail.SerializeToString()


def _synthesis_reply_from_wire(msg: requests_pb2.SynthesisReply) -> SynthesisReply:
    outcome = OUTCOMES_BY_NUMBER.get(msg.outcome)
    if outcome is None:
        reject("outcome", f"outcome {msg.outcome} is not known")
    return SynthesisReply(
        synthesis_from_wire(msg.estimate) if msg.HasField("estimate") else None,
        step_from_wire(msg.step, "step") if msg.HasField("step") else None,
        msg.step_number,
        outcome,
        msg.stopped_because,
        msg.more,
    )


def _synthesis_reply_encode(reply: SynthesisReply) -> bytes:
    head = b""
    if reply.estimate is not None:
        head += delimited(1, SYNTHESIS_ESTIMATE.encode(reply.estimate))
    if reply.step is not None:
        head += delimited(2, step_encode(reply.step, "step"))
    tail = requests_pb2.SynthesisReply(
        step_number=reply.step_number,
        outcome=int(reply.outcome),  # type: ignore[arg-type]
        stopped_because=reply.stopped_because,
        more=reply.more,
    )
    return head + tail.SerializeToString()


def _basis_request_from_wire(msg: requests_pb2.BasisRequest) -> BasisRequest:
    digest = msg.basis_sha256
    return BasisRequest(check_digest(digest, "basis_sha256") if digest else b"")


def _check_parts(basis: ModeBasis) -> None:
    end = basis.first_mode + len(basis.modes)
    if end > basis.modes_total or (end == basis.modes_total) == basis.more:
        reject("basis", f"modes {basis.first_mode}..{end} of {basis.modes_total} are no part")
    if (basis.mean is None) != (basis.first_mode > 0):
        reject("basis", "the mean belongs to the first part, and to no other")


def _basis_from_wire(msg: requests_pb2.FieldBasis) -> ModeBasis:
    nodes = msg.nodes
    mean = field_from_wire(msg.mean, 3, "mean", rows=nodes) if msg.mean else None
    flat = field_from_wire(msg.modes, 3, "modes")
    if not nodes or len(flat) % nodes:
        reject("shape", f"modes have {len(flat)} vectors, not a multiple of {nodes} nodes")
    basis = ModeBasis(
        check_digest(msg.basis_sha256, "basis_sha256"),
        check_digest(msg.mesh_sha256, "mesh_sha256"),
        mean,
        flat.reshape(-1, nodes, 3),
        msg.modes_total,
        msg.first_mode,
        msg.more,
    )
    _check_parts(basis)
    return basis


def _basis_encode(basis: ModeBasis) -> bytes:
    _check_parts(basis)
    head = requests_pb2.FieldBasis(
        basis_sha256=check_digest(basis.basis_sha256, "basis_sha256"),
        mesh_sha256=check_digest(basis.mesh_sha256, "mesh_sha256"),
        modes_total=basis.modes_total,
        first_mode=basis.first_mode,
        nodes=basis.modes.shape[1],
    )
    payload = head.SerializeToString()
    if basis.mean is not None:
        payload += splice(6, check_field(basis.mean, 3, "mean", rows=basis.modes.shape[1]))
    flat = np.ascontiguousarray(basis.modes).reshape(-1, 3)
    payload += splice(7, check_field(flat, 3, "modes"))
    return payload + requests_pb2.FieldBasis(more=basis.more).SerializeToString()


FEATURE_REQUEST = codec_of(
    requests_pb2.FeatureRequest, _feature_request_encode, _feature_request_from_wire
)
FIELD_REQUEST = codec_of(service_pb2.FieldRequest, _field_request_encode, _field_request_from_wire)
SYNTHESIS_REQUEST = codec_of(
    requests_pb2.SynthesisRequest, _synthesis_request_encode, _synthesis_request_from_wire
)
SYNTHESIS_REPLY = codec_of(
    requests_pb2.SynthesisReply, _synthesis_reply_encode, _synthesis_reply_from_wire
)
BASIS_REQUEST: Codec[BasisRequest] = codec_of(
    requests_pb2.BasisRequest,
    lambda request: requests_pb2.BasisRequest(
        basis_sha256=request.basis_sha256
    ).SerializeToString(),
    _basis_request_from_wire,
)
FIELD_BASIS = codec_of(requests_pb2.FieldBasis, _basis_encode, _basis_from_wire)
