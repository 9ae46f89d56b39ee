"""The topic table: every stream of the bus with its key, message, rate and priority.

Keys (docs/adr/0004-keys-and-qos.md)::

    palpate/@v1/<station>/<sensor>/<stream>                          sensor streams
    palpate/@v1/<station>/@service/<service>/<instance>/<endpoint>   status, endpoints
    palpate/@v1/@live/<station>/<service>/<instance>/<alive|ready>   presence (liveliness tokens)
    palpate/@v1/@asking/<station>/<digest of a request's id>          a caller that waits (token)
    palpate/@v1/@sensor/<station>/<sensor>/<wanted|held>/<since>/<session>/<instance>/<host>/<serial>
                                                                     a gateway's claim (token)
    palpate/@v1/@duty/<duty>/<station>/<sensor>/<wanted|held>/...    a service's claim (token)
    palpate/@v1/@station/<station>/router/<wanted|held>/...          a router's claim (token)

``@v1`` is a verbatim chunk: ``*`` and ``**`` never match it, so a future contract cannot be taken
for this one by accident.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Generic, TypeVar

from palpate import codec
from palpate.codec import Codec
from palpate.config import check_name, is_name
from palpate.errors import WireError
from palpate.messages import Stamp

M = TypeVar("M")

CONTRACT_VERSION = 1
"""Major version of the wire contract; it stands in keys, schemas and bundles."""

ROOT = f"palpate/@v{CONTRACT_VERSION}"
LIVE_ROOT = f"{ROOT}/@live"
ASKING_ROOT = f"{ROOT}/@asking"
CLAIM_ROOT = f"{ROOT}/@sensor"
DUTY_ROOT = f"{ROOT}/@duty"
STATION_ROOT = f"{ROOT}/@station"
ENCODING_PREFIX = "application/protobuf;"

MAX_MESSAGE_BYTES = 4 << 20
"""Larger messages are refused on arrival; Zenoh's own limit is 1 GiB."""

_FRAMING_BYTES = 4096
"""Upper bound of what key, encoding and Zenoh's headers add to a payload; about 200 in practice."""

MAX_PAYLOAD_BYTES = MAX_MESSAGE_BYTES - _FRAMING_BYTES
"""Largest payload of a message [bytes]; receivers drop larger messages without an error."""


class Priority(IntEnum):
    """Zenoh priorities in use; the numbers are Zenoh's."""

    REAL_TIME = 1
    DATA_HIGH = 4
    DATA = 5
    BACKGROUND = 7


@dataclass(frozen=True, slots=True)
class Topic(Generic[M]):
    """One stream.

    Attributes:
        name: Last chunk of its key.
        codec: Its message.
        rate_hz: Usual rate [Hz]; 0 = on events.
        priority: Zenoh priority.
        doc: One line for people.
        recorded: Whether the recorder keeps it.
        contiguous: Whether its stamps' sequences have no holes unless the bus lost something.
        per_service: Whether its key names a service instead of a sensor.
    """

    name: str
    codec: Codec[M]
    rate_hz: float
    priority: Priority
    doc: str
    recorded: bool = True
    contiguous: bool = False
    per_service: bool = False

    @property
    def encoding(self) -> str:
        """Zenoh encoding of its payloads."""
        return ENCODING_PREFIX + self.codec.schema

    def stamp_of(self, message: M) -> Stamp | None:
        """Stamp of a message; an estimate's is its source's. None where it has none."""
        stamp = getattr(message, "stamp", None) or getattr(message, "source", None)
        return stamp if isinstance(stamp, Stamp) else None


_RT = Priority.REAL_TIME
ELECTRODES = Topic(
    "electrodes", codec.ELECTRODE_FRAME, 100, _RT, "raw counts of one BioTac", contiguous=True
)
WRENCH = Topic(
    "wrench", codec.WRENCH_FRAME, 100, _RT, "force and torque on the BioTac", contiguous=True
)
POSE = Topic("pose", codec.INDENTER_POSE_FRAME, 100, _RT, "where the indenter is", contiguous=True)
ROBOT_POSE = Topic(
    "robot_pose",
    codec.ROBOT_POSE_FRAME,
    250,
    _RT,
    "pose of a robot's flange, published by its program",
)
FIELD_TRUTH = Topic(
    "field_truth",
    codec.FIELD_FRAME,
    20,
    Priority.DATA_HIGH,
    "known displacement of each skin node",
)
TARE = Topic("tare", codec.TARE, 0, Priority.DATA_HIGH, "a new baseline of one sensor")
FEATURES = Topic("features", codec.FEATURE_ESTIMATE, 100, _RT, "contact location and net force")
FIELD = Topic(
    "field", codec.FIELD_ESTIMATE, 20, Priority.DATA_HIGH, "displacement of each skin node"
)
SYNTHESIS = Topic("synthesis", codec.SYNTHESIS_ESTIMATE, 100, _RT, "tared counts from a field")
SIMULATION_PROGRESS = Topic(
    "simulation_progress",
    codec.SIMULATION_PROGRESS,
    0,
    Priority.DATA,
    "how far a finite-element simulation is",
    recorded=False,
)
STATUS = Topic(
    "status",
    codec.STATUS,
    1,
    Priority.BACKGROUND,
    "state and counters of a process",
    per_service=True,
)

TOPICS: dict[str, Topic[Any]] = {
    value.name: value for value in tuple(globals().values()) if isinstance(value, Topic)
}
"""All streams above by name."""

SCHEMAS: dict[str, Codec[Any]] = {item.schema: item for item in codec.CODECS}
"""All codecs by the full name of their message."""


def sensor_key(station: str, sensor: str, stream: str) -> str:
    """Key of a sensor's stream or endpoint; ``"*"`` for any station or sensor."""
    return f"{ROOT}/{_chunks(station=station, sensor=sensor)}/{stream}"


def service_key(station: str, service: str, instance: str, endpoint: str) -> str:
    """Key of a stream or endpoint of a process; ``"*"`` for any."""
    process = _chunks(service=service, instance=instance)
    return f"{ROOT}/{_chunks(station=station)}/@service/{process}/{endpoint}"


def live_key(station: str, service: str, instance: str, what: str) -> str:
    """Key of a liveliness token; ``"*"`` for any."""
    return f"{LIVE_ROOT}/{_chunks(station=station, service=service, instance=instance)}/{what}"


def caller_key(station: str, request_id: str) -> str:
    """Key of the token of a caller that waits for the answer to ``request_id``; ``"*"`` for any.

    The id may be any text, so its digest stands in the key.
    """
    digest = "*" if request_id == "*" else hashlib.sha256(request_id.encode()).hexdigest()[:32]
    return f"{ASKING_ROOT}/{_chunks(station=station)}/{digest}"


def duty_root(duty: str) -> str:
    """Root of the claims on what services do for a sensor: a topic or ``simulate``."""
    return f"{DUTY_ROOT}/{check_name(duty, 'duty')}"


@dataclass(frozen=True, slots=True)
class SensorClaim:
    """A gateway's claim on the key of a sensor: only the gateway that holds it publishes there.

    Services claim in the same way what they do for a sensor, and routers the name of their station.

    A frame may arrive before the token that announces its session. While the serial number becomes
    known there are two tokens of one session; the older is withdrawn after the newer is declared.

    Attributes:
        station: Station of the sensor.
        sensor: Its name in keys; ``router`` in a claim on a station's name.
        session_id: Run of the gateway, as in ``Stamp.session_id``; never 0.
        held: Whether it publishes; else it waits, or is about to take over.
        since_wall_ns: Wall clock when it came into this state [ns since the Unix epoch].
        instance: Name of the gateway among several.
        host: Name of its host; empty = unknown.
        serial: Serial number of the sensor; empty = not opened yet. Of a service, the digest of
            what its answers depend on.
        root: What is claimed: ``CLAIM_ROOT``, a ``duty_root`` or ``STATION_ROOT``.
    """

    station: str
    sensor: str
    session_id: int
    held: bool = True
    since_wall_ns: int = 0
    instance: str = "gateway"
    host: str = ""
    serial: str = ""
    root: str = CLAIM_ROOT

    @property
    def order(self) -> tuple[bool, int, int]:
        """Of all claims on a sensor the first in this order may publish: the one held the longest.

        Among those that only wait it is the one with the lowest session id. Two are held for a
        moment where neither could see the other, e.g. while the router was started again.
        """
        return not self.held, self.since_wall_ns if self.held else 0, self.session_id


def claim_key(claim: SensorClaim) -> str:
    """Key of the liveliness token of a claim."""
    names = _chunks(station=claim.station, sensor=claim.sensor)
    state = "held" if claim.held else "wanted"
    numbers = f"{claim.since_wall_ns:016x}/{claim.session_id:016x}"
    texts = f"{_hidden(claim.host)}/{_hidden(claim.serial)}"
    return f"{claim.root}/{names}/{state}/{numbers}/{_chunks(instance=claim.instance)}/{texts}"


def claims_key(
    station: str, sensor: str = "*", *, held_only: bool = False, root: str = CLAIM_ROOT
) -> str:
    """Key that matches all claims on a sensor; ``"*"`` for any station or sensor."""
    names = _chunks(station=station, sensor=sensor)
    return f"{root}/{names}/{'held' if held_only else '*'}/*/*/*/*/*"


def parse_claim_key(key: str) -> SensorClaim:
    """The claim that a token's key stands for; the inverse of ``claim_key``.

    Raises:
        WireError: It is not such a key (reason ``"key"``).
    """
    try:
        root = _claim_root(key)
        chunks = key.removeprefix(f"{root}/").split("/")
        station, sensor, state, since, session, instance, host, serial = chunks
        claim = SensorClaim(
            check_name(station, "station"),
            check_name(sensor, "sensor"),
            int(session, 16),
            state == "held",
            int(since, 16),
            check_name(instance, "instance"),
            _shown(host),
            _shown(serial),
            root,
        )
        if claim_key(claim) != key or claim.session_id <= 0 or claim.since_wall_ns < 0:
            raise ValueError("not as claim_key writes it")
    except ValueError as error:
        raise WireError(
            f"key {key!r} is no claim on a sensor: {error}",
            remedy="declare the keys of docs/adr/0004-keys-and-qos.md",
            reason="key",
        ) from error
    return claim


def _claim_root(key: str) -> str:
    for root in (CLAIM_ROOT, STATION_ROOT):
        if key.startswith(f"{root}/"):
            return root
    if key.startswith(f"{DUTY_ROOT}/"):
        return duty_root(key.removeprefix(f"{DUTY_ROOT}/").partition("/")[0])
    raise ValueError("another root")


def _hidden(text: str) -> str:
    """Any text as a chunk of a key: its bytes in hex, behind an ``x``."""
    return "x" + text.encode().hex()


def _shown(chunk: str) -> str:
    """The text of ``_hidden``; raises ``ValueError`` for anything else."""
    if not chunk.startswith("x"):
        raise ValueError(f"{chunk!r} is no text in hex")
    return bytes.fromhex(chunk[1:]).decode()


def _chunks(**names: str) -> str:
    """Names in a key, each checked; ``"*"`` for any."""
    return "/".join(name if name == "*" else check_name(name, what) for what, name in names.items())


@dataclass(frozen=True, slots=True)
class StreamAddress:
    """Parts of a key: station, sensor (or ``service/instance``) and topic."""

    station: str
    sensor: str
    topic: str


def parse_key(key: str) -> StreamAddress:
    """Split a stream's key.

    Raises:
        WireError: It is not a key of this contract (reason ``"key"``).
    """
    chunks = key.split("/")
    # Zenoh lets anybody publish to a wildcard: names are checked, or "*" would be a sensor.
    if key.startswith(f"{ROOT}/") and all(map(is_name, (*chunks[2:3], *chunks[4:]))):
        if len(chunks) == 5 and is_name(chunks[3]):
            return StreamAddress(chunks[2], chunks[3], chunks[4])
        if len(chunks) == 7 and chunks[3] == "@service":
            return StreamAddress(chunks[2], f"{chunks[4]}/{chunks[5]}", chunks[6])
    raise WireError(
        f"key {key!r} is not {ROOT}/<station>/<sensor>/<stream>",
        remedy="publish under the keys of docs/adr/0004-keys-and-qos.md",
        reason="key",
    )


def check_size(payload: bytes, schema: str, *, remedy: str) -> None:
    """Check that a payload fits into a message.

    Raises:
        WireError: It does not, and would be lost on the way (reason ``"size"``).
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise WireError(
            f"a {schema} of {len(payload):,} bytes is larger than a message may be"
            f" ({MAX_PAYLOAD_BYTES:,} bytes)",
            remedy=remedy,
            reason="size",
        )


def check_schema(encoding: str, wanted: str) -> None:
    """Check the encoding of a payload.

    Raises:
        WireError: Another schema (reason ``"schema"``), or one of a future contract
            (reason ``"future_contract"``).
    """
    if encoding == ENCODING_PREFIX + wanted:
        return
    schema = encoding.removeprefix(ENCODING_PREFIX)
    package, _, message = schema.rpartition(".")
    version = package.removeprefix("palpate.v")
    if package.startswith("palpate.v") and version.isdigit() and int(version) > CONTRACT_VERSION:
        raise WireError(
            f"{message} comes in contract v{version}, this palpate speaks v{CONTRACT_VERSION}",
            remedy="upgrade palpate on this host: pip install --upgrade palpate",
            reason="future_contract",
        )
    raise WireError(
        f"payload is {encoding!r}, not {ENCODING_PREFIX + wanted!r}",
        remedy="publish the message that belongs to the key, with its encoding",
        reason="schema",
    )
