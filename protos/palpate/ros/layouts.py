"""Layouts of the ROS messages that palpate takes and gives, and their bytes.

The tactile definitions were written from the public layouts (hardware reference, section 7). A test
compares their MD5 sums, by which ROS 1 tells versions of a message, with the published ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from palpate.errors import WireError
from palpate.process import require

BIOTAC_HAND = "biotac_sensors/msg/BioTacHand"
"""A whole 100 Hz frame of each finger at a Cheetah adapter."""

BIOTAC_ALL = "sr_robot_msgs/msg/BiotacAll"
"""The five fingers of a Shadow hand at this instant."""

WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
"""Force [N] and torque [N m] in the frame that the header names."""

POINT_STAMPED = "geometry_msgs/msg/PointStamped"
"""A point [m] in the frame that the header names."""

FEATURES = "palpate_msgs/msg/Features"
"""All that palpate says of one frame of a finger; ours, so that it has no published MD5 sum."""

Dialect = Literal["cdr", "ros1"]
"""How a message becomes bytes: ``cdr`` in ROS 2 and its bags, ``ros1`` in bags of ROS 1."""

DEFINITIONS: dict[str, str] = {
    "biotac_sensors/msg/BioTacData": """
string bt_serial
uint16 bt_position
uint16 tdc_data
uint16 tac_data
uint16 pdc_data
uint16[22] pac_data
uint16[19] electrode_data
""",
    "biotac_sensors/msg/BioTacTime": """
time frame_start_time
time frame_end_time
uint32 tdc_ns_offset
uint32 tac_ns_offset
uint32 pdc_ns_offset
uint32[22] pac_ns_offset
uint32[19] electrode_ns_offset
""",
    BIOTAC_HAND: """
std_msgs/Header header
string hand_id
BioTacData[] bt_data
BioTacTime bt_time
""",
    "sr_robot_msgs/msg/Biotac": """
int16 pac0
int16 pac1
int16 pdc
int16 tac
int16 tdc
int16[] electrodes
""",
    BIOTAC_ALL: """
std_msgs/Header header
Biotac[5] tactiles
""",
    FEATURES: """
std_msgs/Header header
string sensor_serial
uint64 sequence
bool in_contact
geometry_msgs/Vector3 force
geometry_msgs/Vector3 force_sd
geometry_msgs/Point contact_location
geometry_msgs/Vector3 contact_location_sd
geometry_msgs/Point centre_of_pressure
geometry_msgs/Vector3 centre_of_pressure_sd
geometry_msgs/Vector3 contact_normal
float64 contact_normal_sd
uint8[] quality
string bundle
""",
}
"""Text of each layout that is not of ROS itself, as in its ``.msg`` file."""

MD5 = {
    BIOTAC_HAND: "d96f900cbfb096d61de125081e11dcab",
    BIOTAC_ALL: "e27dd065f854b80a2d092dd322ddfd40",
    WRENCH_STAMPED: "d78d3cb249ce23087ade7e7d0c40cfa7",
    POINT_STAMPED: "c63aecb41bfdfd6b7e1fac37c7cbe7bf",
}
"""Published MD5 sum of each message in ROS 1."""

_ELEMENTS_MAX = 1024
"""Longest list in a message: a wrong length must not reserve memory."""


@cache
def typestore(dialect: Dialect) -> Any:
    """The typestore of ``rosbags`` with all layouts.

    Raises:
        MissingExtraError: ``rosbags`` is not installed.
    """
    typesys: Any = require("rosbags.typesys", extra="gateway")
    stores: Any = require("rosbags.typesys.stores", extra="gateway")
    base = stores.Stores.ROS1_NOETIC if dialect == "ros1" else stores.Stores.ROS2_JAZZY
    store = stores.get_typestore(base)
    store.max_sequence_length = _ELEMENTS_MAX
    types: dict[str, Any] = {}
    for name, text in DEFINITIONS.items():
        types |= typesys.get_types_from_msg(text, name)
    store.register(types)
    return store


def type_hash(layout: str) -> str:
    """Hash of a layout as ROS 2 computes it, e.g. ``"RIHS01_8dc3..."``; it stands in keys."""
    return str(typestore("cdr").hash_rihs01(layout))


def decode(payload: bytes, layout: str, dialect: Dialect = "cdr") -> Any:
    """The message in these bytes, with the fields of its layout as attributes.

    Raises:
        WireError: The bytes are not a message of this layout: too short, too long, no text.
        MissingExtraError: ``rosbags`` is not installed.
    """
    store = typestore(dialect)
    take = store.deserialize_ros1 if dialect == "ros1" else store.deserialize_cdr
    try:
        return take(payload, layout)
    # rosbags translates most errors of damaged bytes, but not all: e.g. IndexError.
    except Exception as error:
        raise WireError(
            f"{len(payload)} bytes are no {layout}: {error}",
            remedy="check the message type of the topic, and that sender and palpate mean the same "
            "version of it",
            reason="parse",
        ) from error


def encode(fields: Mapping[str, Any], layout: str, dialect: Dialect = "cdr") -> bytes:
    """The bytes of a message.

    Args:
        fields: Values by field name; of nested messages mappings again, of lists of messages
            lists of mappings.
        layout: Name of the layout.
        dialect: The kind of bytes.

    Raises:
        WireError: A field is missing, unknown, or does not fit.
        MissingExtraError: ``rosbags`` is not installed.
    """
    store = typestore(dialect)
    put = store.serialize_ros1 if dialect == "ros1" else store.serialize_cdr
    try:
        message = _built(store, fields, layout)
        if dialect == "cdr":
            return bytes(put(message, layout, little_endian=True))
        return bytes(put(message, layout))
    except Exception as error:
        raise WireError(
            f"no {layout} can be made of these fields: {type(error).__name__}: {error}",
            remedy="give every field of the layout, with values that fit its type",
            reason="field",
        ) from error


def _built(store: Any, fields: Mapping[str, Any], layout: str) -> Any:
    """A message of rosbags from nested mappings."""
    values = {}
    _, described = store.fielddefs[layout]
    for name, (kind, detail) in described:
        value = fields[name]
        if kind.name == "NAME":
            value = _built(store, value, detail)
        elif kind.name in ("ARRAY", "SEQUENCE") and detail[0][0].name == "NAME":
            value = [_built(store, one, detail[0][1]) for one in value]
        values[name] = value
    if unknown := fields.keys() - values.keys():
        raise KeyError(f"unknown field {min(unknown)!r}")
    return store.types[layout](**values)


def bytes_list(values: Iterable[int]) -> npt.NDArray[np.uint8]:
    """Values of a field ``uint8[]``."""
    return np.array([int(value) for value in values], np.uint8)


def time_of(stamp: Any) -> int:
    """A ROS time as nanoseconds since the Unix epoch; 0 = not set."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamp_of(time_ns: int) -> dict[str, int]:
    """Nanoseconds since the Unix epoch as fields of a ROS time."""
    sec, nanosec = divmod(time_ns, 1_000_000_000)
    return {"sec": sec, "nanosec": nanosec}
