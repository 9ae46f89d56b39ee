"""Codec of simulation request, progress and reply."""

from __future__ import annotations

from math import isfinite

from palpate.protos.codec.base import Codec, codec_of
from palpate.protos.codec.checks import (
    check_digest,
    check_field,
    check_serial,
    delimited,
    field_from_wire,
    pose_values,
    reject,
    splice,
    vector3_from_wire,
    vector3_to_wire,
)
from palpate.protos.messages import (
    Pose,
    SimulationParameters,
    SimulationProgress,
    SimulationReply,
    SimulationRequest,
    SimulationStep,
)
from palpate.v1 import common_pb2, simulation_pb2

_PARAMETERS = (
    "skin_thickness_m",
    "shear_modulus_pa",
    "friction_coefficient",
    "fluid_volume_m3",
)


def _pose_from_wire(msg: common_pb2.Pose, what: str) -> Pose:
    p = pose_values((msg.px, msg.py, msg.pz, msg.qw, msg.qx, msg.qy, msg.qz), what)
    return Pose((p[0], p[1], p[2]), (p[3], p[4], p[5], p[6]))


def _pose_to_wire(pose: Pose, what: str) -> common_pb2.Pose:
    px, py, pz, qw, qx, qy, qz = pose_values((*pose.position, *pose.orientation), what)
    return common_pb2.Pose(px=px, py=py, pz=pz, qw=qw, qx=qx, qy=qy, qz=qz)


def _check_seconds(value: float, what: str) -> float:
    if not (isfinite(value) and value >= 0):
        reject("non_finite", f"{what} = {value} is not a non-negative number")
    return value


def _request_from_wire(msg: simulation_pb2.SimulationRequest) -> SimulationRequest:
    values: dict[str, float] = {}
    for name in _PARAMETERS:
        if msg.parameters.HasField(name):
            value = getattr(msg.parameters, name)
            if not isfinite(value):
                reject("non_finite", f"parameters.{name} = {value} is not finite")
            values[name] = value
    if not msg.path:
        reject("path", "path is empty: a simulation needs at least one pose")
    return SimulationRequest(
        check_serial(msg.request_id, "request_id"),
        check_serial(msg.indenter, "indenter"),
        tuple(_pose_from_wire(pose, f"path[{i}]") for i, pose in enumerate(msg.path)),
        SimulationParameters(**values),
        _check_seconds(msg.deadline_s, "deadline_s"),
        msg.want_displacement,
        msg.want_contact_force,
    )


def _request_encode(request: SimulationRequest) -> bytes:
    given = {
        name: value
        for name in _PARAMETERS
        if (value := getattr(request.parameters, name)) is not None
    }
    msg = simulation_pb2.SimulationRequest(
        request_id=request.request_id,
        indenter=request.indenter,
        path=[_pose_to_wire(pose, f"path[{i}]") for i, pose in enumerate(request.path)],
        parameters=simulation_pb2.SimulationParameters(**given),
        deadline_s=request.deadline_s,
        want_displacement=request.want_displacement,
        want_contact_force=request.want_contact_force,
    )
    _request_from_wire(msg)  # rare message: one set of checks serves both ways
    return msg.SerializeToString()


def _step_from_wire(msg: simulation_pb2.SimulationStep, what: str) -> SimulationStep:
    displacement = contact_force = None
    if msg.displacement:
        displacement = field_from_wire(msg.displacement, 3, f"{what}.displacement")
    if msg.contact_force:
        contact_force = field_from_wire(msg.contact_force, 3, f"{what}.contact_force")
    if not isfinite(msg.fluid_pressure_pa):
        reject("non_finite", f"{what}.fluid_pressure_pa is not finite")
    return SimulationStep(
        _pose_from_wire(msg.pose_sensor_indenter, f"{what}.pose_sensor_indenter"),
        vector3_from_wire(msg.force, f"{what}.force"),
        vector3_from_wire(msg.torque, f"{what}.torque"),
        msg.fluid_pressure_pa,
        displacement,
        contact_force,
    )


def _step_encode(step: SimulationStep, what: str) -> bytes:
    if not isfinite(step.fluid_pressure_pa):
        reject("non_finite", f"{what}.fluid_pressure_pa is not finite")
    msg = simulation_pb2.SimulationStep(
        pose_sensor_indenter=_pose_to_wire(step.pose_sensor_indenter, f"{what}.pose"),
        fluid_pressure_pa=step.fluid_pressure_pa,
    )
    vector3_to_wire(step.force, msg.force, f"{what}.force")
    vector3_to_wire(step.torque, msg.torque, f"{what}.torque")
    payload = msg.SerializeToString()
    for number, array in ((5, step.displacement), (6, step.contact_force)):
        if array is not None:
            payload += splice(number, check_field(array, 3, what))
    return payload


def _reply_from_wire(msg: simulation_pb2.SimulationReply) -> SimulationReply:
    return SimulationReply(
        check_serial(msg.request_id, "request_id"),
        check_digest(msg.mesh_sha256, "mesh_sha256"),
        tuple(_step_from_wire(step, f"steps[{i}]") for i, step in enumerate(msg.steps)),
        msg.stopped_because,
        _check_seconds(msg.elapsed_s, "elapsed_s"),
    )


def _reply_encode(reply: SimulationReply) -> bytes:
    # Fields in order of their numbers, so that the bytes equal the official encoder's.
    head = simulation_pb2.SimulationReply(
        request_id=check_serial(reply.request_id, "request_id"),
        mesh_sha256=check_digest(reply.mesh_sha256, "mesh_sha256"),
    )
    tail = simulation_pb2.SimulationReply(
        stopped_because=reply.stopped_because,
        elapsed_s=_check_seconds(reply.elapsed_s, "elapsed_s"),
    )
    steps = (delimited(3, _step_encode(step, f"steps[{i}]")) for i, step in enumerate(reply.steps))
    return head.SerializeToString() + b"".join(steps) + tail.SerializeToString()


def _progress_from_wire(msg: simulation_pb2.SimulationProgress) -> SimulationProgress:
    return SimulationProgress(
        check_serial(msg.request_id, "request_id"),
        msg.steps_done,
        msg.steps_total,
        _check_seconds(msg.elapsed_s, "elapsed_s"),
    )


def _progress_encode(progress: SimulationProgress) -> bytes:
    return simulation_pb2.SimulationProgress(
        request_id=check_serial(progress.request_id, "request_id"),
        steps_done=progress.steps_done,
        steps_total=progress.steps_total,
        elapsed_s=_check_seconds(progress.elapsed_s, "elapsed_s"),
    ).SerializeToString()


SIMULATION_REQUEST: Codec[SimulationRequest] = codec_of(
    simulation_pb2.SimulationRequest, _request_encode, _request_from_wire
)
SIMULATION_PROGRESS: Codec[SimulationProgress] = codec_of(
    simulation_pb2.SimulationProgress, _progress_encode, _progress_from_wire
)
SIMULATION_REPLY: Codec[SimulationReply] = codec_of(
    simulation_pb2.SimulationReply, _reply_encode, _reply_from_wire
)
