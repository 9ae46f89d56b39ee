"""Attacks on a station with certificates, each by what a stranger or a wrong role can really send.

Each returns what came of it. ``tests/hostile/test_attacks.py`` asserts it, and
``python docs/make_attacks.py`` writes it down.
"""

from __future__ import annotations

from collections.abc import Callable

from tests.hostile.attack_bus import (
    Outcome,
    altered_command,
    bundle_by_path,
    expired,
    foreign_authority,
    forging,
    half_open_links,
    no_certificate,
    no_encryption,
    no_role,
    old_command,
    only_loopback,
    operator_without_token,
    replayed_by_robot,
    replayed_command,
    robot_answers,
    robot_claims,
    robot_loads,
    robot_routes,
    robot_tares,
)
from tests.hostile.attack_load import (
    altered_bundle,
    crafted_recordings,
    flood_of_messages,
    flood_of_questions,
    flood_of_refusals,
    hostile_model_folders,
    oversize,
    path_traversal,
    unsigned_bundle,
)
from tests.hostile.lab import Lab

ATTACKS: dict[str, Callable[[Lab], Outcome]] = {
    "no certificate": no_certificate,
    "certificate of another authority": foreign_authority,
    "certificate that has ended": expired,
    "certificate without a role": no_role,
    "no encryption": no_encryption,
    "open doors": only_loopback,
    "200 half-open connections": half_open_links,
    "robot sends frames and estimates": forging("robot", "electrodes", "features", "tare"),
    "gateway sends estimates": forging("gateway", "features", "field"),
    "service sends frames": forging("service", "electrodes", "tare"),
    "operator sends frames": forging("operator", "electrodes", "robot_pose"),
    "robot tares": robot_tares,
    "robot loads a model": robot_loads,
    "robot claims a finger": robot_claims,
    "robot answers for a service": robot_answers,
    "robot plays the router": robot_routes,
    "replayed command": replayed_command,
    "command replayed by a robot": replayed_by_robot,
    "command held back": old_command,
    "altered command": altered_command,
    "operator without the token": operator_without_token,
    "bundle by path": bundle_by_path,
    "unsigned bundle": unsigned_bundle,
    "altered bundle": altered_bundle,
    "hostile model folders": hostile_model_folders,
    "crafted recordings": crafted_recordings,
    "path traversal": path_traversal,
    "oversize messages": oversize,
    "flood of messages": flood_of_messages,
    "flood of refused messages": flood_of_refusals,
    "flood of questions": flood_of_questions,
}
