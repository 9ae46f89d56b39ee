"""From a request to a job: everything that can be refused without solving is refused here."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from palpate.bus import MAX_REPLY_BYTES
from palpate.errors import ConfigError
from palpate.messages import SimulationParameters, SimulationRequest
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.indenter.path import check_path
from palpate_fem.result import Floats
from palpate_fem.service.config import FemConfig
from palpate_fem.service.fingertips import without_friction
from palpate_fem.service.jobs import Job
from palpate_fem.service.start import check_start
from palpate_fem.store.content import StoredFingertip

_STEP_BYTES = 1024  # of a step's scalars and a message's own fields; in truth some 400


def parameters_of(
    wanted: SimulationParameters, default: FingertipParameters
) -> FingertipParameters:
    """The default parameters with those that a request names.

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
    """Poses as the solver takes them, shape (K, 7), quaternions made unit to the last bit.

    Raises:
        ConfigError: A path that cannot be meant, or a long one.
    """
    path = np.array([(*pose.position, *pose.orientation) for pose in request.path], np.float64)
    # The codec has let pass what single precision leaves of a unit quaternion.
    path[:, 3:] /= np.linalg.norm(path[:, 3:], axis=1, keepdims=True)
    steps = len(path) - 1
    if steps > max_steps:
        raise ConfigError(
            f"the path has {steps} steps, at most {max_steps} are served",
            remedy="cut the path, or ask for fewer steps; the solver adds its own where needed",
        )
    return check_path(path)


def check_size(request: SimulationRequest, nodes: int) -> None:
    """Check that one step with its fields fits a message.

    Raises:
        ConfigError: It does not.
    """
    fields = request.want_displacement + request.want_contact_force
    size = _STEP_BYTES + fields * nodes * 12  # three float32 for each node
    if size > MAX_REPLY_BYTES:
        raise ConfigError(
            f"one step with {fields} fields of {nodes:,} nodes has {size / 2**20:.1f} MiB, a "
            f"message at most {MAX_REPLY_BYTES / 2**20:.1f} MiB",
            remedy="ask for one field, or for none",
        )


def job_of(
    request: SimulationRequest,
    config: FemConfig,
    default: FingertipParameters,
    fingertips: Mapping[FingertipParameters, StoredFingertip],
) -> Job:
    """Check a request and make the job that answers it.

    Args:
        request: As it came; its codec has checked numbers and quaternions.
        config: What is served.
        default: Parameters where the request names none.
        fingertips: Those that workers have built, by parameters without friction. On others the
            start is checked by the worker, once it has built one.

    Raises:
        ConfigError: It is refused; says why.
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
    return Job(request.request_id, parameters, request.indenter, path, deadline_s)
