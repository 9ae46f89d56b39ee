"""Who may do what on the bus, by the role in a certificate: the one table, and Zenoh's settings.

Every process of a station with certificates enforces it on what comes in: on its direct links
itself, and what comes through the router by the router, which is believed. Whoever has a
certificate of the lab may read; who may write is listed here for each key of ``topics`` and
``endpoints``. What is not listed is denied (docs/adr/0030-security.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from palpate.bus.endpoints import ENDPOINTS
from palpate.bus.topics import (
    ASKING_ROOT,
    CLAIM_ROOT,
    DUTY_ROOT,
    LIVE_ROOT,
    MAX_PAYLOAD_BYTES,
    ROOT,
    STATION_ROOT,
    TOPICS,
    live_key,
    sensor_key,
    service_key,
)
from palpate.config import Role

ROLE_OF = {role.common_name: role for role in Role}
"""Roles by the common name of a certificate."""

DOOR_PROTOCOL = "unixsock-stream"
"""Protocol of the router's own door, through which it asks itself (``router``)."""

DOOR_ROOT = f"{ROOT}/@router"
"""Root of the keys that are asked there."""


class Deed(StrEnum):
    """What somebody does under a key."""

    PUBLISH = "publish"
    SUBSCRIBE = "subscribe"
    ASK = "ask"
    ANSWER = "answer"
    SHOW = "show"
    WATCH = "watch"


_MESSAGES: dict[Deed, tuple[str, ...]] = {
    Deed.PUBLISH: ("put",),
    Deed.SUBSCRIBE: ("declare_subscriber",),
    Deed.ASK: ("query",),
    Deed.ANSWER: ("declare_queryable", "reply"),
    Deed.SHOW: ("liveliness_token",),
    Deed.WATCH: ("liveliness_query", "declare_liveliness_subscriber"),
}
"""Zenoh's messages for each deed. Nobody of palpate sends ``delete``, so nobody may."""

_GATEWAY, _SERVICE = frozenset({Role.GATEWAY}), frozenset({Role.SERVICE})
_PROCESSES = _GATEWAY | _SERVICE
_OPERATOR = frozenset({Role.OPERATOR})
_USERS = frozenset({Role.ROBOT, Role.OPERATOR, Role.SERVICE})
_ALL = frozenset(Role) - {Role.ROUTER}

PUBLISHERS: dict[str, frozenset[Role]] = {
    "electrodes": _GATEWAY,
    "wrench": _GATEWAY,
    "pose": _GATEWAY,
    "field_truth": _GATEWAY,
    "tare": _GATEWAY,
    "robot_pose": frozenset({Role.ROBOT}),
    "features": _SERVICE,
    "field": _SERVICE,
    "synthesis": _SERVICE,
    "simulation_progress": _SERVICE,
    "status": _PROCESSES,
}
"""Who publishes each stream, by the name of its topic."""


@dataclass(frozen=True, slots=True)
class _Question:
    """Who asks an endpoint, and who answers."""

    askers: frozenset[Role]
    answerers: frozenset[Role]


QUESTIONS: dict[str, _Question] = {
    # Services look a tare up by its id at the endpoint that also takes one.
    "tare": _Question(_OPERATOR | _SERVICE, _GATEWAY),
    "zero": _Question(_OPERATOR, _GATEWAY),
    "models": _Question(_OPERATOR, _SERVICE),
    "simulate": _Question(_USERS, _SERVICE),
    "simulate_at": _Question(_USERS, _SERVICE),
    "cancel_simulation": _Question(_USERS, _SERVICE),
    "status": _Question(_ALL, _PROCESSES),
    "model": _Question(_ALL, _SERVICE),
    "estimate_features": _Question(_USERS, _SERVICE),
    "estimate_field": _Question(_USERS, _SERVICE),
    "synthesise": _Question(_USERS, _SERVICE),
    "synthesise_from": _Question(_USERS, _SERVICE),
    "basis": _Question(_ALL, _SERVICE),
}
"""Who asks and answers each question, by the name of its constant in ``endpoints``."""

_SMALL_BYTES = 64 << 10
MOST_BYTES: dict[str, int] = {
    "field": MAX_PAYLOAD_BYTES,
    "field_truth": MAX_PAYLOAD_BYTES,
    "status": 1 << 20,
}
"""Largest payload of a stream where it is more than 64 KiB [bytes]: thousands of messages may wait
in a ring, and 4 MiB each would fill the memory."""


@dataclass(slots=True)
class _Rights:
    """Key expressions under which one role may do each deed."""

    keys: dict[Deed, list[str]] = field(default_factory=lambda: {deed: [] for deed in Deed})

    def allow(self, deed: Deed, key: str) -> None:
        if key not in self.keys[deed]:
            self.keys[deed].append(key)


EVERY_KEY = (
    f"{ROOT}/**",
    f"{ROOT}/*/@service/**",
    f"{LIVE_ROOT}/**",
    f"{ASKING_ROOT}/**",
    f"{CLAIM_ROOT}/**",
    f"{DUTY_ROOT}/**",
    f"{STATION_ROOT}/**",
)
"""Key expressions that match every key of the contract: ``**`` matches no ``@chunk``."""


def rights(role: Role) -> dict[Deed, list[str]]:
    """Key expressions under which a role may do each deed, at any station."""
    found = _Rights()
    if role is Role.ROUTER:  # it passes on what it has checked
        return {deed: list(EVERY_KEY) for deed in Deed}
    for key in EVERY_KEY[:2]:
        found.allow(Deed.SUBSCRIBE, key)
    for key in EVERY_KEY[2:]:
        found.allow(Deed.WATCH, key)
    for name, topic in TOPICS.items():
        if role in PUBLISHERS[name]:
            found.allow(Deed.PUBLISH, _key(topic.name, per_service=topic.per_service, of=role))
    for name, endpoint in ENDPOINTS.items():
        question = QUESTIONS[name]
        if role in question.askers:
            found.allow(Deed.ASK, _key(endpoint.name, per_service=endpoint.per_service))
        if role in question.answerers:
            of = role if endpoint.per_service else None
            found.allow(Deed.ANSWER, _key(endpoint.name, per_service=endpoint.per_service, of=of))
    if role in _PROCESSES:
        found.allow(Deed.SHOW, live_key("*", _service_of(role), "*", "*"))
    if role is Role.GATEWAY:
        found.allow(Deed.SHOW, f"{CLAIM_ROOT}/**")
    if role is Role.SERVICE:
        found.allow(Deed.SHOW, f"{DUTY_ROOT}/**")
    if role in _USERS:
        found.allow(Deed.SHOW, f"{ASKING_ROOT}/**")
    return found.keys


def _key(name: str, *, per_service: bool, of: Role | None = None) -> str:
    """Key of a stream or endpoint of any sensor, or of any process that ``of`` may be."""
    if not per_service:
        return sensor_key("*", "*", name)
    return service_key("*", "*" if of is None else _service_of(of), "*", name)


def _service_of(role: Role) -> str:
    """Name of the processes of a role in keys: a gateway speaks for gateways only."""
    return "gateway" if role is Role.GATEWAY else "*"


def settings() -> dict[str, Any]:
    """Zenoh's settings of a process with certificates: who may do what, and how large it may be."""
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    every = [message for messages in _MESSAGES.values() for message in messages]
    # To whoever has a role everything may go out: what it may read is decided by what it asks for.
    rules.append(_rule("out", ["egress"], every, EVERY_KEY))
    for role in Role:
        own = [
            _rule(f"{role} {deed}", ["ingress"], _MESSAGES[deed], keys)
            for deed, keys in rights(role).items()
            if keys
        ]
        rules += own
        policies.append({"rules": ["out", *(rule["id"] for rule in own)], "subjects": [role.value]})
    subjects: list[dict[str, Any]] = [
        {"id": role.value, "cert_common_names": [role.common_name]} for role in Role
    ]
    # The router's own door is a socket that only its user can reach.
    rules.append(_rule("door", ["ingress", "egress"], every, (f"{DOOR_ROOT}/**",)))
    subjects.append({"id": "door", "link_protocols": [DOOR_PROTOCOL]})
    policies.append({"rules": ["door"], "subjects": ["door"]})
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": subjects,
            "policies": policies,
        },
        "low_pass_filter": list(_filters()),
    }


def _rule(
    name: str, flows: list[str], messages: Sequence[str], keys: Sequence[str]
) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": flows,
        "messages": list(messages),
        "key_exprs": list(keys),
    }


def _filters() -> Iterator[dict[str, Any]]:
    """One filter for each size: of streams that come in."""
    by_size: dict[int, list[str]] = {}
    for name, topic in TOPICS.items():
        key = _key(topic.name, per_service=topic.per_service)
        by_size.setdefault(MOST_BYTES.get(name, _SMALL_BYTES), []).append(key)
    for size, keys in sorted(by_size.items()):
        yield {
            "id": f"up-to-{size}",
            "messages": ["put"],
            "flows": ["ingress"],
            "key_exprs": keys,
            "size_limit": size,
        }
