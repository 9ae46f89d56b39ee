"""Results as messages. In process and on the wire they are the same numbers, made here.

Forces, torques, pressure and scalars keep double precision; fields are rounded to float32, once,
by ``as_field``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.messages import (
    FloatArray,
    Pose,
    SimulationConvergence,
    SimulationOutcome,
    SimulationReply,
    SimulationRequest,
    SimulationStep,
)
from palpate_fem.result import (
    Convergence,
    Floats,
    IndentationOutcome,
    IndentationResult,
    IndentationStep,
)

OUTCOMES = {
    IndentationOutcome.COMPLETE: SimulationOutcome.COMPLETE,
    IndentationOutcome.FORCE_LIMIT: SimulationOutcome.FORCE_LIMIT,
    IndentationOutcome.DIVERGED: SimulationOutcome.DIVERGED,
    IndentationOutcome.DEADLINE: SimulationOutcome.DEADLINE,
    IndentationOutcome.CANCELLED: SimulationOutcome.CANCELLED,
}


def as_field(values: NDArray[Any]) -> FloatArray:
    """A field as it travels: float32, rounded to the nearest."""
    return np.ascontiguousarray(values, np.float32)


def as_pose(pose: Floats) -> Pose:
    """Position and quaternion w x y z, shape (7,)."""
    x, y, z, qw, qx, qy, qz = map(float, pose)
    return Pose((x, y, z), (qw, qx, qy, qz))


def as_step(step: IndentationStep, request: SimulationRequest) -> SimulationStep:
    """A step with the fields that the request wants."""
    touching = bool(np.isfinite(step.centre_of_pressure).all())
    return SimulationStep(
        as_pose(step.pose),
        np.array(step.force, np.float64),
        np.array(step.torque, np.float64),
        float(step.fluid_pressure_pa),
        as_field(step.displacement) if request.want_displacement else None,
        as_field(step.indenter_force) if request.want_contact_force else None,
        float(step.contact_area_m2),
        np.array(step.centre_of_pressure, np.float64) if touching else None,
        _convergence(step.convergence),
    )


def as_reply(
    trajectory: IndentationResult, request: SimulationRequest, mesh_sha256: bytes
) -> SimulationReply:
    """What ``Client.simulate`` returns for this trajectory; only ``elapsed_s`` differs."""
    return SimulationReply(
        request.request_id,
        mesh_sha256,
        tuple(as_step(step, request) for step in trajectory.steps),
        trajectory.reason,
        trajectory.seconds,
        outcome=OUTCOMES[trajectory.outcome],
        travel_m=trajectory.travel_m,
    )


def _convergence(record: Convergence) -> SimulationConvergence:
    return SimulationConvergence(
        int(record.increments),
        int(record.iterations),
        int(record.factorisations),
        float(record.residual),
        float(record.volume_error),
        float(record.penetration_m),
        float(record.seconds),
    )
