"""Codec of simulations: request, progress, cancelling, and the reply with its steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from typing import Any, TypeVar

import numpy as np

from palpate.codec.base import (
    Codec,
    check_digest,
    check_field,
    check_serial,
    codec_of,
    delimited,
    field_from_wire,
    pose_from_wire,
    pose_to_wire,
    reject,
    splice,
    vector3_from_wire,
    vector3_to_wire,
)
from palpate.messages import (
    DoubleArray,
    SimulationCancelReply,
    SimulationCancelRequest,
    SimulationConvergence,
    SimulationOutcome,
    SimulationParameters,
    SimulationPhase,
    SimulationProgress,
    SimulationReply,
    SimulationRequest,
    SimulationStep,
)
from palpate.v1 import simulation_pb2

C = TypeVar("C")

_PARAMETERS = tuple(SimulationParameters.__dataclass_fields__)
MAX_POSES = 10_000
"""Longest path of a request."""

_PHASES = {int(phase): phase for phase in SimulationPhase}


def check_positive(value: float, what: str) -> float:
    """A finite number that is not negative."""
    if not (isfinite(value) and value >= 0):
        reject("non_finite", f"{what} = {value} is not a non-negative number")
    return value


def simulation_request_from_wire(msg: simulation_pb2.SimulationRequest) -> SimulationRequest:
    """Check and convert a request."""
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
    simulation_request_from_wire(msg)  # rare message: one set of checks serves both ways
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


SIMULATION_REQUEST = codec_of(
    simulation_pb2.SimulationRequest, _request_encode, simulation_request_from_wire
)
SIMULATION_PROGRESS: Codec[SimulationProgress] = codec_of(
    simulation_pb2.SimulationProgress,
    lambda progress: progress_to_wire(progress).SerializeToString(),
    progress_from_wire,
)
SIMULATION_CANCEL_REQUEST: Codec[SimulationCancelRequest] = codec_of(
    simulation_pb2.SimulationCancelRequest,
    lambda request: simulation_pb2.SimulationCancelRequest(
        request_id=check_serial(request.request_id, "request_id")
    ).SerializeToString(),
    lambda msg: SimulationCancelRequest(check_serial(msg.request_id, "request_id")),
)
SIMULATION_CANCEL_REPLY: Codec[SimulationCancelReply] = codec_of(
    simulation_pb2.SimulationCancelReply,
    lambda reply: simulation_pb2.SimulationCancelReply(found=reply.found).SerializeToString(),
    lambda msg: SimulationCancelReply(msg.found),
)


OUTCOMES_BY_NUMBER = {int(outcome): outcome for outcome in SimulationOutcome}


def _doubles(values: Sequence[float], count: int, what: str) -> DoubleArray:
    array = np.array(values, np.float64)
    if array.shape != (count,):
        reject("shape", f"{what} has shape {array.shape}, not ({count},)")
    if not np.isfinite(array).all():
        reject("non_finite", f"{what} = {array.tolist()} is not finite")
    return array


def _convergence(source: Any, target: Callable[..., C], what: str) -> C:
    """Check and convert to or from the wire: both sides name the numbers alike."""
    counts = {
        name: getattr(source, name) for name in ("increments", "iterations", "factorisations")
    }
    sizes = {
        name: check_positive(getattr(source, name), f"{what}.{name}")
        for name in ("residual", "volume_error", "penetration_m", "seconds")
    }
    return target(**counts, **sizes)


def step_from_wire(msg: simulation_pb2.SimulationStep, what: str) -> SimulationStep:
    """Check and convert a step."""
    displacement = contact_force = centre = convergence = None
    if msg.displacement:
        displacement = field_from_wire(msg.displacement, 3, f"{what}.displacement")
    if msg.contact_force:
        contact_force = field_from_wire(msg.contact_force, 3, f"{what}.contact_force")
    if not isfinite(msg.fluid_pressure_pa):
        reject("non_finite", f"{what}.fluid_pressure_pa is not finite")
    force = vector3_from_wire(msg.force, f"{what}.force").astype(np.float64)
    torque = vector3_from_wire(msg.torque, f"{what}.torque").astype(np.float64)
    if msg.wrench:  # absent before it was in the contract
        wrench = _doubles(msg.wrench, 6, f"{what}.wrench")
        if np.abs(wrench).max() > np.finfo(np.float32).max:  # what is accepted can be said again
            reject("non_finite", f"{what}.wrench = {wrench.tolist()} exceeds float32")
        force, torque = wrench[:3], wrench[3:]
    if msg.centre_of_pressure:
        centre = _doubles(msg.centre_of_pressure, 3, f"{what}.centre_of_pressure")
    if msg.HasField("convergence"):
        convergence = _convergence(msg.convergence, SimulationConvergence, f"{what}.convergence")
    return SimulationStep(
        pose_from_wire(msg.pose_sensor_indenter, f"{what}.pose_sensor_indenter"),
        force,
        torque,
        msg.fluid_pressure_pa,
        displacement,
        contact_force,
        check_positive(msg.contact_area_m2, f"{what}.contact_area_m2"),
        centre,
        convergence,
    )


def step_encode(step: SimulationStep, what: str) -> bytes:
    """Check a step and give its bytes."""
    if not isfinite(step.fluid_pressure_pa):
        reject("non_finite", f"{what}.fluid_pressure_pa is not finite")
    # Fields in order of their numbers, so that the bytes equal the official encoder's.
    head = simulation_pb2.SimulationStep(
        pose_sensor_indenter=pose_to_wire(step.pose_sensor_indenter, f"{what}.pose"),
        fluid_pressure_pa=step.fluid_pressure_pa,
    )
    force = _doubles(step.force, 3, f"{what}.force")  # type: ignore[arg-type]
    torque = _doubles(step.torque, 3, f"{what}.torque")  # type: ignore[arg-type]
    vector3_to_wire(force.astype(np.float32), head.force, f"{what}.force")
    vector3_to_wire(torque.astype(np.float32), head.torque, f"{what}.torque")
    payload = head.SerializeToString()
    for number, array in ((5, step.displacement), (6, step.contact_force)):
        if array is not None:
            payload += splice(number, check_field(array, 3, what))
    tail = simulation_pb2.SimulationStep(
        wrench=(*force.tolist(), *torque.tolist()),
        contact_area_m2=check_positive(step.contact_area_m2, f"{what}.contact_area_m2"),
    )
    if step.centre_of_pressure is not None:
        centre = _doubles(step.centre_of_pressure, 3, f"{what}.centre_of_pressure")  # type: ignore[arg-type]
        tail.centre_of_pressure.extend(centre.tolist())
    if step.convergence is not None:
        to_wire = simulation_pb2.SimulationConvergence
        tail.convergence.CopyFrom(_convergence(step.convergence, to_wire, f"{what}.convergence"))
    return payload + tail.SerializeToString()


def _reply_from_wire(msg: simulation_pb2.SimulationReply) -> SimulationReply:
    outcome = OUTCOMES_BY_NUMBER.get(msg.outcome)
    if outcome is None:
        reject("outcome", f"outcome {msg.outcome} is not known")
    return SimulationReply(
        check_serial(msg.request_id, "request_id"),
        _check_mesh(msg.mesh_sha256, len(msg.steps)),
        tuple(step_from_wire(step, f"steps[{i}]") for i, step in enumerate(msg.steps)),
        msg.stopped_because,
        check_positive(msg.elapsed_s, "elapsed_s"),
        msg.more,
        msg.first_step,
        progress_from_wire(msg.progress) if msg.HasField("progress") else None,
        outcome,
        check_positive(msg.travel_m, "travel_m"),
    )


def _check_mesh(digest: bytes, steps: int) -> bytes:
    return digest if not digest and not steps else check_digest(digest, "mesh_sha256")


def _reply_encode(reply: SimulationReply) -> bytes:
    head = simulation_pb2.SimulationReply(
        request_id=check_serial(reply.request_id, "request_id"),
        mesh_sha256=_check_mesh(reply.mesh_sha256, len(reply.steps)),
    )
    tail = simulation_pb2.SimulationReply(
        stopped_because=reply.stopped_because,
        elapsed_s=check_positive(reply.elapsed_s, "elapsed_s"),
        more=reply.more,
        first_step=reply.first_step,
        outcome=int(reply.outcome),  # type: ignore[arg-type]
        travel_m=check_positive(reply.travel_m, "travel_m"),
        progress=None if reply.progress is None else progress_to_wire(reply.progress),
    )
    # A reply is head, steps (field 3) and tail: the steps' packed floats are spliced, so they are
    # not part of a message that protobuf would encode once more.
    steps = (delimited(3, step_encode(step, f"steps[{i}]")) for i, step in enumerate(reply.steps))
    return head.SerializeToString() + b"".join(steps) + tail.SerializeToString()


SIMULATION_REPLY = codec_of(simulation_pb2.SimulationReply, _reply_encode, _reply_from_wire)
