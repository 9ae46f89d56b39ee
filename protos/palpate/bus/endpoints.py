"""The endpoint table: the questions that can be asked on the bus, beside the streams of ``topics``.

A node serves an endpoint with ``Session.queryable`` (one reply) or ``Session.stream_queryable``
(several), and a caller asks it with ``Session.query``, ``query_all`` or ``query_stream``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from palpate import codec
from palpate.codec import Codec

Q = TypeVar("Q")
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Endpoint(Generic[Q, R]):
    """One question and its reply.

    Attributes:
        name: Last chunk of its key.
        doc: One line for people.
        per_service: Whether its key names a service instead of a sensor.
        services: The services that answer, where its key names one; empty = every process.
        device: What a gateway must have under the sensor's name to answer; empty = anything.
    """

    name: str
    request: Codec[Q]
    reply: Codec[R]
    doc: str
    per_service: bool = False
    services: tuple[str, ...] = ()
    device: str = ""


TARE = Endpoint(
    "tare",
    codec.TARE_REQUEST,
    codec.TARE,
    "tare a BioTac, or look up a tare by its id",
    device="BioTac",
)
ZERO = Endpoint(
    "zero",
    codec.WRENCH_ZERO_REQUEST,
    codec.WRENCH_ZERO,
    "zero a force/torque sensor",
    device="force/torque sensor",
)
SIMULATE = Endpoint(
    "simulate",
    codec.SIMULATION_REQUEST,
    codec.SIMULATION_REPLY,
    "indent the finite-element fingertip; several replies",
)
SIMULATE_AT = Endpoint(
    "simulate",
    codec.SIMULATION_REQUEST,
    codec.SIMULATION_REPLY,
    "the same of one replica of the finite-element service; several replies",
    True,
    ("fem",),
)
CANCEL_SIMULATION = Endpoint(
    "simulate_cancel",
    codec.SIMULATION_CANCEL_REQUEST,
    codec.SIMULATION_CANCEL_REPLY,
    "stop a simulation that waits or runs",
)
STATUS = Endpoint(
    "status", codec.SERVICE_REQUEST, codec.STATUS, "state and counters of a process", True
)
MODEL = Endpoint(
    "model",
    codec.SERVICE_REQUEST,
    codec.MODEL_METADATA,
    "metadata of the served bundle",
    True,
    ("features", "field", "synthesis"),
)
MODELS = Endpoint(
    "models",
    codec.MODEL_REQUEST,
    codec.MODEL_INVENTORY,
    "list, load, unload or roll back bundles; needs the station's admin token",
    True,
    ("features", "field", "synthesis"),
)
ESTIMATE_FEATURES = Endpoint(
    "estimate",
    codec.FEATURE_REQUEST,
    codec.FEATURE_ESTIMATE,
    "features of one electrode frame",
    True,
    ("features",),
)
ESTIMATE_FIELD = Endpoint(
    "estimate",
    codec.FIELD_REQUEST,
    codec.FIELD_ESTIMATE,
    "field of one electrode frame",
    True,
    ("field",),
)
SYNTHESISE = Endpoint(
    "synthesise",
    codec.FIELD_FRAME,
    codec.SYNTHESIS_ESTIMATE,
    "tared counts of one field",
    True,
    ("synthesis",),
)

SYNTHESISE_FROM = Endpoint(
    "synthesise_from",
    codec.SYNTHESIS_REQUEST,
    codec.SYNTHESIS_REPLY,
    "tared counts of a field, a contact or a simulation; several replies",
    True,
    ("synthesis",),
)
BASIS = Endpoint(
    "basis",
    codec.BASIS_REQUEST,
    codec.FIELD_BASIS,
    "basis of the coefficients of fields; several replies",
    True,
    ("field",),
)

ENDPOINTS: dict[str, Endpoint[Any, Any]] = {
    name.lower(): value for name, value in tuple(globals().items()) if isinstance(value, Endpoint)
}
"""All questions above by the name of their constant: services may share the last part of a key."""
