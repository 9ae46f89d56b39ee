"""Values to bytes and back, checked both ways. One ``Codec`` for each message of ``palpate.v1``."""

from typing import Any

from palpate.codec.base import Codec
from palpate.codec.estimates import (
    FEATURE_ESTIMATE,
    FIELD_ESTIMATE,
    STAGE_TIMINGS,
    SYNTHESIS_ESTIMATE,
)
from palpate.codec.frames import (
    ELECTRODE_FRAME,
    FIELD_FRAME,
    INDENTER_POSE_FRAME,
    ROBOT_POSE_FRAME,
    WRENCH_FRAME,
)
from palpate.codec.models import MODEL_COMMAND, MODEL_INVENTORY, MODEL_REQUEST
from palpate.codec.requests import (
    BASIS_REQUEST,
    FEATURE_REQUEST,
    FIELD_BASIS,
    FIELD_REQUEST,
    SYNTHESIS_REPLY,
    SYNTHESIS_REQUEST,
)
from palpate.codec.service import (
    ERROR,
    MODEL_METADATA,
    SERVICE_REQUEST,
    STATUS,
    TARE,
    TARE_REQUEST,
    WRENCH_ZERO,
    WRENCH_ZERO_REQUEST,
)
from palpate.codec.simulation import (
    SIMULATION_CANCEL_REPLY,
    SIMULATION_CANCEL_REQUEST,
    SIMULATION_PROGRESS,
    SIMULATION_REPLY,
    SIMULATION_REQUEST,
)

CODECS: tuple[Codec[Any], ...] = tuple(
    value for value in globals().values() if isinstance(value, Codec)
)
"""All codecs of the contract: what is imported above."""

__all__ = [
    "BASIS_REQUEST",
    "CODECS",
    "ELECTRODE_FRAME",
    "ERROR",
    "FEATURE_ESTIMATE",
    "FEATURE_REQUEST",
    "FIELD_BASIS",
    "FIELD_ESTIMATE",
    "FIELD_FRAME",
    "FIELD_REQUEST",
    "INDENTER_POSE_FRAME",
    "MODEL_COMMAND",
    "MODEL_INVENTORY",
    "MODEL_METADATA",
    "MODEL_REQUEST",
    "ROBOT_POSE_FRAME",
    "SERVICE_REQUEST",
    "SIMULATION_CANCEL_REPLY",
    "SIMULATION_CANCEL_REQUEST",
    "SIMULATION_PROGRESS",
    "SIMULATION_REPLY",
    "SIMULATION_REQUEST",
    "STAGE_TIMINGS",
    "STATUS",
    "SYNTHESIS_ESTIMATE",
    "SYNTHESIS_REPLY",
    "SYNTHESIS_REQUEST",
    "TARE",
    "TARE_REQUEST",
    "WRENCH_FRAME",
    "WRENCH_ZERO",
    "WRENCH_ZERO_REQUEST",
    "Codec",
]
