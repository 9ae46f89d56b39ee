"""How rmw_zenoh, a middleware of ROS 2, uses Zenoh: keys, attachments, liveliness tokens.

Read in the public source of rmw_zenoh (jazzy and later): a topic's key holds domain, name, type and
type hash; each sample carries sequence, time and the publisher's id; each node, publisher and
subscription declares a token, from which ``ros2 topic list`` and its like are answered.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, field

from palpate.errors import ConfigError, WireError

NO_TYPE_HASH = "TypeHashNotSupported"
"""What stands for the type hash in ROS 2 Humble."""

GID_BYTES = 16
"""Length of a publisher's id."""

GID_BYTES_HUMBLE = 24
"""The same in ROS 2 Humble."""

_NUMBERS = struct.Struct("<qq")

_QOS = "::,10:,:,:,,"
"""Reliable, volatile, keep the last 10; empty = rmw_zenoh's own default."""


@dataclass(frozen=True, slots=True)
class RosTopic:
    """A topic of ROS 2.

    Attributes:
        name: Its full name, e.g. ``"/hand/biotac"``.
        layout: Name of the message, e.g. ``"geometry_msgs/msg/WrenchStamped"``.
        type_hash: Hash of the layout, or ``NO_TYPE_HASH``; ``"*"`` = any, to subscribe.
        domain: ROS domain id.
    """

    name: str
    layout: str
    type_hash: str = "*"
    domain: int = 0

    @property
    def dds_type(self) -> str:
        """Name of the message in keys, e.g. ``"geometry_msgs::msg::dds_::WrenchStamped_"``."""
        *folders, name = self.layout.split("/")
        return "::".join([*folders, "dds_", f"{name}_"])

    @property
    def key(self) -> str:
        """Key of its samples."""
        return f"{self.domain}/{self.name.strip('/')}/{self.dds_type}/{self.type_hash}"


def check_topic_name(name: str) -> str:
    """Check the full name of a ROS topic, and return it.

    Raises:
        ConfigError: It does not begin with ``/``, or a part is no ROS name.
    """
    parts = name.split("/")[1:]
    ok = name.startswith("/") and len(name) < 256
    for part in parts:
        word = part.replace("_", "a")
        ok = ok and word.isascii() and word.isalnum() and not word[0].isdigit()
    if not ok:
        raise ConfigError(
            f"{name!r} is no full name of a ROS topic",
            remedy="write it as `ros2 topic list` does, e.g. /hand/biotac",
        )
    return name


@dataclass(frozen=True, slots=True)
class SampleInfo:
    """What rmw_zenoh attaches to a sample.

    Attributes:
        sequence: Number of the sample, counted by its publisher, from 1.
        time_ns: When it was published, publisher's wall clock [ns since the Unix epoch].
        gid: The publisher's id.
    """

    sequence: int
    time_ns: int
    gid: bytes

    def encode(self) -> bytes:
        """Its bytes: two little-endian int64, then the id after its length."""
        return _NUMBERS.pack(self.sequence, self.time_ns) + bytes([len(self.gid)]) + self.gid

    @classmethod
    def decode(cls, attachment: bytes) -> SampleInfo:
        """The information in an attachment.

        Raises:
            WireError: It is not one of rmw_zenoh.
        """
        at = _NUMBERS.size
        gid = attachment[at + 1 :]
        if (
            len(attachment) <= at
            or attachment[at] != len(gid)
            or len(gid) not in (GID_BYTES, GID_BYTES_HUMBLE)
        ):
            raise WireError(
                f"an attachment of {len(attachment)} bytes is none of rmw_zenoh",
                remedy="publish with rmw_zenoh of ROS 2 Jazzy or later, or of Humble",
                reason="attachment",
            )
        sequence, time_ns = _NUMBERS.unpack_from(attachment)
        return cls(sequence, time_ns, gid)


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"


@dataclass(slots=True)
class RosNode:
    """A node as rmw_zenoh announces it; numbers its publishers and subscriptions.

    Attributes:
        zid: Id of the Zenoh session.
        name: Name of the node.
        domain: ROS domain id.
    """

    zid: str
    name: str
    domain: int = 0
    _entities: int = field(default=0, init=False)

    @property
    def token(self) -> str:
        """Key of the node's liveliness token."""
        return self._head(0, "NN")

    def publisher_token(self, topic: RosTopic) -> str:
        """Key of the liveliness token of one more publisher."""
        return self._entity("MP", topic)

    def subscription_token(self, topic: RosTopic) -> str:
        """Key of the liveliness token of one more subscription; its topic needs a type hash."""
        return self._entity("MS", topic)

    def _head(self, number: int, kind: str) -> str:
        return f"@ros2_lv/{self.domain}/{self.zid}/0/{number}/{kind}/%/%/{self.name}"

    def _entity(self, kind: str, topic: RosTopic) -> str:
        self._entities += 1
        parts = [_mangled(topic.name), topic.dds_type, topic.type_hash, _QOS]
        return "/".join([self._head(self._entities, kind), *parts])


def gid_of(token: str, length: int = GID_BYTES) -> bytes:
    """An id for the publisher with this token.

    rmw_zenoh hashes the token as well, by XXH3; nothing compares the two, so any hash serves.
    """
    return hashlib.sha256(token.encode()).digest()[:length]
