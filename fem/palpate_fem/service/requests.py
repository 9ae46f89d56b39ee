"""Requests to jobs, and results to replies.

Everything that can be refused without solving is refused here. Results are the same numbers in
process and on the wire: forces, torques, pressure and scalars keep double precision; fields are
rounded to float32, once, by ``as_field``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.bus import MAX_PAYLOAD_BYTES
from palpate.errors import ConfigError
from palpate.messages import (
    FloatArray,
    Pose,
    SimulationConvergence,
    SimulationOutcome,
    SimulationParameters,
    SimulationRequest,
    SimulationStep,
)
from palpate_fem.arrays import Floats
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.indenter.path import check_path
from palpate_fem.result import Convergence, IndentationOutcome, IndentationStep
from palpate_fem.service.config import FemConfig
from palpate_fem.service.fingertips import check_start, without_friction
from palpate_fem.service.jobs import SimulationJob
from palpate_fem.store.content import StoredFingertip

OUTCOMES = {outcome: SimulationOutcome[outcome.name] for outcome in IndentationOutcome}

_STEP_BYTES = 1024  # upper bound for the scalars of a step and of its message; really about 400


def parameters_of(
    wanted: SimulationParameters, default: FingertipParameters
) -> FingertipParameters:
    """The default parameters, replaced by those that a request gives.

    Raises:
        ConfigError: One is out of range.
    """
    given = {
        name: value
        for name in SimulationParameters.__dataclass_fields__
        if (value := getattr(wanted, name)) is not None
    }
    return replace(default, **given)


def path_of(request: SimulationRequest, *, max_steps: int) -> Floats:
    """Poses for the solver, shape (K, 7), with quaternions normalised in double precision.

    Raises:
        ConfigError: The path makes no sense, or is too long.
    """
    path = np.array([(*pose.position, *pose.orientation) for pose in request.path], np.float64)
    # The codec accepts quaternions that are unit within single precision.
    path[:, 3:] /= np.linalg.norm(path[:, 3:], axis=1, keepdims=True)
    steps = len(path) - 1
    if steps > max_steps:
        raise ConfigError(
            f"the path has {steps} steps, at most {max_steps} are served",
            remedy="cut the path, or ask for fewer steps; the solver adds its own where needed",
        )
    return check_path(path)


def check_size(request: SimulationRequest, nodes: int) -> None:
    """Check that one step with its fields fits into one message.

    Raises:
        ConfigError: It does not fit.
    """
    fields = request.want_displacement + request.want_contact_force
    size = _STEP_BYTES + fields * nodes * 12  # three float32 for each node
    if size > MAX_PAYLOAD_BYTES:
        raise ConfigError(
            f"one step with {fields} fields of {nodes:,} nodes has {size / 2**20:.1f} MiB, a "
            f"message at most {MAX_PAYLOAD_BYTES / 2**20:.1f} MiB",
            remedy="ask for one field, or for none",
        )


def job_of(
    request: SimulationRequest,
    config: FemConfig,
    default: FingertipParameters,
    fingertips: Mapping[FingertipParameters, StoredFingertip],
) -> SimulationJob:
    """Check a request and make the job that answers it.

    Args:
        request: As received; its codec has checked numbers and quaternions.
        config: What is served.
        default: Parameters where the request gives none.
        fingertips: Fingertips that workers have built, by parameters without friction. For others,
            the worker checks the start when it has built them.

    Raises:
        ConfigError: The request is refused; says why.
    """
    make_indenter(request.indenter)
    parameters = parameters_of(request.parameters, default)
    path = path_of(request, max_steps=config.max_steps)
    for fingertip in list(fingertips.values())[:1]:
        check_size(request, len(fingertip.mesh.nodes))
    known = fingertips.get(without_friction(parameters))
    if known is not None:
        check_start(known, request.indenter, path[0])
    deadline_s = min(request.deadline_s or math.inf, config.max_deadline_s)
    return SimulationJob(request.request_id, parameters, request.indenter, path, deadline_s)


def as_field(values: NDArray[Any]) -> FloatArray:
    """A field as it is sent: float32, rounded to nearest."""
    return np.ascontiguousarray(values, np.float32)


def as_pose(pose: Floats) -> Pose:
    """A pose message from position and quaternion w x y z, shape (7,)."""
    x, y, z, qw, qx, qy, qz = map(float, pose)
    return Pose((x, y, z), (qw, qx, qy, qz))


def as_step(step: IndentationStep, request: SimulationRequest) -> SimulationStep:
    """A step message with the fields that the request wants."""
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
