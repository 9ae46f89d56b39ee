"""Codec of simulation request, progress and cancelling; the reply's is in ``simulation_reply``."""

from __future__ import annotations

from math import isfinite

from palpate.codec.base import Codec, codec_of
from palpate.codec.checks import check_serial, pose_values, reject
from palpate.messages import (
    Pose,
    SimulationCancelReply,
    SimulationCancelRequest,
    SimulationParameters,
    SimulationPhase,
    SimulationProgress,
    SimulationRequest,
)
from palpate.v1 import common_pb2, simulation_pb2

_PARAMETERS = (
    "skin_thickness_m",
    "shear_modulus_pa",
    "friction_coefficient",
    "fluid_volume_m3",
)
MAX_POSES = 10_000
"""Longest path of a request."""

_PHASES = {int(phase): phase for phase in SimulationPhase}


def pose_from_wire(msg: common_pb2.Pose, what: str) -> Pose:
    """Check and convert a pose."""
    p = pose_values((msg.px, msg.py, msg.pz, msg.qw, msg.qx, msg.qy, msg.qz), what)
    return Pose((p[0], p[1], p[2]), (p[3], p[4], p[5], p[6]))


def pose_to_wire(pose: Pose, what: str) -> common_pb2.Pose:
    """Check and convert a pose."""
    px, py, pz, qw, qx, qy, qz = pose_values((*pose.position, *pose.orientation), what)
    return common_pb2.Pose(px=px, py=py, pz=pz, qw=qw, qx=qx, qy=qy, qz=qz)


def check_positive(value: float, what: str) -> float:
    """A finite number that is not negative."""
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
    if len(msg.path) > MAX_POSES:  # before each is looked at, which would take a second
        reject("path", f"path has {len(msg.path)} poses, at most {MAX_POSES:,} are allowed")
    return SimulationRequest(
        check_serial(msg.request_id, "request_id"),
        check_serial(msg.indenter, "indenter"),
        tuple(pose_from_wire(pose, f"path[{i}]") for i, pose in enumerate(msg.path)),
        SimulationParameters(**values),
        check_positive(msg.deadline_s, "deadline_s"),
        msg.want_displacement,
        msg.want_contact_force,
    )


def _request_encode(request: SimulationRequest) -> bytes:
    if len(request.path) > MAX_POSES:
        reject("path", f"path has {len(request.path)} poses, at most {MAX_POSES:,} are allowed")
    given = {
        name: value
        for name in _PARAMETERS
        if (value := getattr(request.parameters, name)) is not None
    }
    msg = simulation_pb2.SimulationRequest(
        request_id=request.request_id,
        indenter=request.indenter,
        path=[pose_to_wire(pose, f"path[{i}]") for i, pose in enumerate(request.path)],
        parameters=simulation_pb2.SimulationParameters(**given),
        deadline_s=request.deadline_s,
        want_displacement=request.want_displacement,
        want_contact_force=request.want_contact_force,
    )
    _request_from_wire(msg)  # rare message: one set of checks serves both ways
    return msg.SerializeToString()


def progress_from_wire(msg: simulation_pb2.SimulationProgress) -> SimulationProgress:
    """Check and convert a progress."""
    phase = _PHASES.get(msg.phase)
    if phase is None:
        reject("phase", f"phase {msg.phase} is not known")
    return SimulationProgress(
        check_serial(msg.request_id, "request_id"),
        msg.steps_done,
        msg.steps_total,
        check_positive(msg.elapsed_s, "elapsed_s"),
        phase,
        msg.waiting_before,
    )


def progress_to_wire(progress: SimulationProgress) -> simulation_pb2.SimulationProgress:
    """Check and convert a progress."""
    return simulation_pb2.SimulationProgress(
        request_id=check_serial(progress.request_id, "request_id"),
        steps_done=progress.steps_done,
        steps_total=progress.steps_total,
        elapsed_s=check_positive(progress.elapsed_s, "elapsed_s"),
        phase=int(progress.phase),  # type: ignore[arg-type]
        waiting_before=progress.waiting_before,
    )


def _cancel_from_wire(msg: simulation_pb2.SimulationCancelRequest) -> SimulationCancelRequest:
    return SimulationCancelRequest(check_serial(msg.request_id, "request_id"))


def _cancel_encode(request: SimulationCancelRequest) -> bytes:
    return simulation_pb2.SimulationCancelRequest(
        request_id=check_serial(request.request_id, "request_id")
    ).SerializeToString()


SIMULATION_REQUEST: Codec[SimulationRequest] = codec_of(
    simulation_pb2.SimulationRequest, _request_encode, _request_from_wire
)
SIMULATION_PROGRESS: Codec[SimulationProgress] = codec_of(
    simulation_pb2.SimulationProgress,
    lambda progress: progress_to_wire(progress).SerializeToString(),
    progress_from_wire,
)
SIMULATION_CANCEL_REQUEST: Codec[SimulationCancelRequest] = codec_of(
    simulation_pb2.SimulationCancelRequest, _cancel_encode, _cancel_from_wire
)
SIMULATION_CANCEL_REPLY: Codec[SimulationCancelReply] = codec_of(
    simulation_pb2.SimulationCancelReply,
    lambda reply: simulation_pb2.SimulationCancelReply(found=reply.found).SerializeToString(),
    lambda msg: SimulationCancelReply(msg.found),
)
