"""Messages about the models of an estimating service: what serves, and commands to change it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum


class ModelAction(IntEnum):
    """What a command orders.

    ``LOAD`` serves a bundle, ``UNLOAD`` none (of one sensor: no longer one of its own),
    ``ROLL_BACK`` what was served before the last change; ``LIST`` changes nothing.
    """

    LIST = 1
    LOAD = 2
    UNLOAD = 3
    ROLL_BACK = 4


@dataclass(frozen=True, slots=True)
class ModelCommand:
    """What an operator orders of an estimating service.

    Attributes:
        station: Whom it is for, with ``service`` and ``instance`` (empty = each of the service).
        nonce: 16 random bytes; no command is obeyed twice.
        wall_ns: When it was given, by the operator's wall clock [ns since the Unix epoch].
        bundle: For ``LOAD``: ``name`` (its newest version) or ``name:version``.
        sensor: The sensor it is about; empty = all sensors without a bundle of their own.
    """

    action: ModelAction
    station: str
    service: str
    nonce: bytes
    wall_ns: int
    instance: str = ""
    bundle: str = ""
    sensor: str = ""


@dataclass(frozen=True, slots=True)
class ModelRequest:
    """An encoded ``ModelCommand``, and its HMAC-SHA256 with the station's admin token."""

    command: bytes
    mac: bytes


@dataclass(frozen=True, slots=True)
class ServedModel:
    """Which bundle makes a sensor's estimates.

    Attributes:
        sensor: Name of the sensor; empty = every one without a bundle of its own.
        name: Name of the bundle; empty = none: unloaded, or not to be had since a restart.
        version: Its version; 0 = none.
        bundle_sha256: Digest of its manifest, 32 bytes; empty = none.
        since_wall_ns: Since when it serves [ns since the Unix epoch].
        previous: Bundle that a roll back would serve, as ``name:version``; empty = there is none.
    """

    sensor: str
    name: str
    version: int
    bundle_sha256: bytes
    since_wall_ns: int
    previous: str = ""


@dataclass(frozen=True, slots=True)
class ModelInventory:
    """What a service serves after a command, and what it could load.

    Attributes:
        instance: Name of the process.
        served: Sensors with a bundle of their own come after the entry of all others.
        available: Bundles of its repository for its task, as ``name:version``, oldest first.
        change_s: From the acceptance of the command until the new bundle served [s]; 0 = nothing
            changed.
    """

    instance: str
    served: Sequence[ServedModel]
    available: Sequence[str]
    change_s: float = 0.0
