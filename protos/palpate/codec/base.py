"""What all codecs share: the ``Codec``, checks of wire values, and fast encoding of float fields.

Protobuf is a codec, not a validator: one bit flip in a valid frame still parses in 88 % of cases.
So every field that a consumer relies on is checked here, in plain Python because it runs on every
frame (docs/adr/0003-wire-format.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import isfinite
from typing import Generic, NoReturn, TypeVar

import numpy as np
from google.protobuf.message import DecodeError, Message

from palpate.errors import WireError
from palpate.messages import FloatArray, Origin, Pose, SensorType, Stamp
from palpate.v1 import common_pb2

M = TypeVar("M")
P = TypeVar("P", bound=Message)


@dataclass(frozen=True, slots=True)
class Codec(Generic[M]):
    """Bytes to value and back, checked both ways.

    Attributes:
        schema: Full name of the protobuf message, e.g. ``"palpate.v1.ElectrodeFrame"``.
        encode: Value to payload; raises ``WireError`` for a value that breaks the contract.
        decode: Payload to value; raises ``WireError`` likewise.
        message_type: The generated class (for schemas embedded in records).
    """

    schema: str
    encode: Callable[[M], bytes]
    decode: Callable[[bytes], M]
    message_type: type[Message]


def codec_of(
    message_type: type[P], encode: Callable[[M], bytes], from_wire: Callable[[P], M]
) -> Codec[M]:
    """Build a codec from an encoder and a checked conversion of the parsed message."""
    schema = message_type.DESCRIPTOR.full_name
    parse = message_type.FromString

    def encode_own(value: M) -> bytes:
        try:
            return encode(value)
        except WireError as error:  # checks are those of decoding, which blame the sender
            if error.remedy != _SENDER:
                raise
            raise WireError(
                error.problem,
                remedy=f"correct the value; docs/messages.md says what {schema} may hold",
                reason=error.reason,
            ) from error

    def decode(payload: bytes) -> M:
        try:
            message = parse(payload)
        except DecodeError as error:
            raise WireError(
                f"{len(payload)} bytes do not parse as {schema}",
                remedy="the sender is broken or speaks another contract",
                reason="parse",
            ) from error
        return from_wire(message)

    return Codec(schema, encode_own, decode, message_type)


_ELECTRODES = {kind.layout.electrodes: kind.name for kind in SensorType}
_ORIGINS = {int(origin): origin for origin in Origin}
_SENDER = "the sender breaks contract palpate.v1: fix or upgrade it"


def reject(reason: str, problem: str) -> NoReturn:
    """Raise a ``WireError`` that is counted under ``reason``."""
    raise WireError(problem, remedy=_SENDER, reason=reason)


def check_serial(serial: str, what: str = "sensor_serial") -> str:
    """A serial number: 1-64 printable ASCII characters."""
    if not (0 < len(serial) <= 64 and serial.isascii() and serial.isprintable()):
        reject("serial", f"{what} {serial[:80]!r} is not 1-64 printable ASCII characters")
    return serial


def check_request_id(request_id: str) -> str:
    """The id of a request whose caller may hold no token: then it is empty."""
    return check_serial(request_id, "request_id") if request_id else ""


def check_digest(digest: bytes, what: str) -> bytes:
    """A SHA-256: 32 bytes."""
    if len(digest) != 32:
        reject("digest", f"{what} has {len(digest)} bytes, a SHA-256 has 32")
    return digest


def stamp_from_wire(msg: common_pb2.Stamp) -> Stamp:
    """Check and convert a stamp."""
    sequence = msg.sequence
    origin = _ORIGINS.get(msg.origin)
    if sequence == 0:
        reject("stamp", "stamp is missing or its sequence is 0 (sequences start at 1)")
    if origin is None:
        reject("stamp", f"stamp.origin {msg.origin} is not known")
    monotonic_ns, wall_ns = msg.monotonic_ns, msg.wall_ns
    # Beyond int64 no clock of ours can be; and consumers store times as int64.
    if monotonic_ns >> 63 or wall_ns >> 63:
        reject("stamp", f"stamp times {monotonic_ns}, {wall_ns} ns exceed int64")
    return Stamp(
        sequence,
        msg.device_tick,
        monotonic_ns,
        wall_ns,
        msg.clock_id,
        origin,
        msg.missed_before,
        msg.session_id,
    )


def stamp_to_wire(stamp: Stamp, msg: common_pb2.Stamp) -> None:
    """Check and fill a stamp."""
    if stamp.sequence < 1:
        reject("stamp", f"stamp.sequence is {stamp.sequence}, sequences start at 1")
    try:
        msg.sequence = stamp.sequence
        msg.device_tick = stamp.device_tick
        msg.monotonic_ns = stamp.monotonic_ns
        msg.wall_ns = stamp.wall_ns
        msg.clock_id = stamp.clock_id
        msg.origin = int(stamp.origin)  # type: ignore[assignment]
        msg.missed_before = stamp.missed_before
        msg.session_id = stamp.session_id
    except (ValueError, TypeError) as error:
        raise WireError(f"stamp {stamp}: {error}", remedy=_SENDER, reason="stamp") from error
    if stamp.monotonic_ns >> 63 or stamp.wall_ns >> 63:
        reject("stamp", f"stamp times {stamp.monotonic_ns}, {stamp.wall_ns} ns exceed int64")


def vector3_from_wire(msg: common_pb2.Vector3, what: str, *, deviation: bool = False) -> FloatArray:
    """Check and convert three floats, shape ``(3,)``; a standard deviation is not negative."""
    x, y, z = msg.x, msg.y, msg.z
    # The sum of three float32 cannot overflow a double, and NaN or inf in any of them survives it.
    if not isfinite(x + y + z):
        reject("non_finite", f"{what} = ({x}, {y}, {z}) is not finite")
    if deviation and (x < 0 or y < 0 or z < 0):
        reject("negative_sd", f"{what} = ({x}, {y}, {z}) is negative")
    return np.array((x, y, z), np.float32)


def vector3_to_wire(
    value: FloatArray, msg: common_pb2.Vector3, what: str, *, deviation: bool = False
) -> None:
    """Check and fill three floats; a standard deviation is not negative."""
    try:
        x, y, z = value.tolist()
    except (AttributeError, ValueError, TypeError) as error:
        shape = getattr(value, "shape", type(value).__name__)
        raise WireError(
            f"{what} has shape {shape}, not (3,)", remedy=_SENDER, reason="shape"
        ) from error
    if not isfinite(x + y + z):
        reject("non_finite", f"{what} = ({x}, {y}, {z}) is not finite")
    if deviation and (x < 0 or y < 0 or z < 0):
        reject("negative_sd", f"{what} = ({x}, {y}, {z}) is negative")
    msg.x = x
    msg.y = y
    msg.z = z
    # A float32 field stores an out-of-range double as infinity.
    if value.dtype != np.float32 and not isfinite(msg.x + msg.y + msg.z):
        reject("non_finite", f"{what} = ({x}, {y}, {z}) exceeds float32")


def pose_numbers(msg: common_pb2.Pose, what: str) -> tuple[float, ...]:
    """Check a pose of the wire: px py pz qw qx qy qz."""
    return pose_values((msg.px, msg.py, msg.pz, msg.qw, msg.qx, msg.qy, msg.qz), what)


def pose_values(values: Iterable[float], what: str) -> tuple[float, ...]:
    """Check px py pz qw qx qy qz: finite and a unit quaternion."""
    pose = tuple(float(value) for value in values)
    if len(pose) != 7:
        reject("shape", f"{what} has {len(pose)} numbers, a pose has 7")
    if not all(map(isfinite, pose)):
        reject("non_finite", f"{what} = {pose} is not finite")
    norm = sum(q * q for q in pose[3:])
    if not 0.998 < norm < 1.002:
        reject("quaternion", f"{what} has a quaternion of squared norm {norm:.4g}, not 1")
    return pose


def pose_from_wire(msg: common_pb2.Pose, what: str) -> Pose:
    """Check and convert a pose."""
    p = pose_numbers(msg, what)
    return Pose((p[0], p[1], p[2]), (p[3], p[4], p[5], p[6]))


def pose_to_wire(pose: Pose, what: str) -> common_pb2.Pose:
    """Check and convert a pose."""
    px, py, pz, qw, qx, qy, qz = pose_values((*pose.position, *pose.orientation), what)
    return common_pb2.Pose(px=px, py=py, pz=pz, qw=qw, qx=qx, qy=qy, qz=qz)


def field_from_wire(
    values: object, width: int, what: str, *, rows: int | None = None, deviation: bool = False
) -> FloatArray:
    """Check and convert a packed float field to ``(V, width)`` or, with width 1, ``(V,)``."""
    array = np.asarray(values, dtype=np.float32)
    if width > 1:
        if array.size % width:
            reject("shape", f"{what} has {array.size} values, not a multiple of {width}")
        array = array.reshape(-1, width)
    return check_field(array, width, what, rows=rows, deviation=deviation)


def check_field(
    array: FloatArray, width: int, what: str, *, rows: int | None = None, deviation: bool = False
) -> FloatArray:
    """Check shape, type and finiteness of a field; a standard deviation is not negative."""
    shape_good = array.ndim == 1 if width == 1 else array.ndim == 2 and array.shape[1] == width
    if not shape_good or array.shape[0] == 0 or (rows is not None and array.shape[0] != rows):
        wanted = f"({rows or 'V'},)" if width == 1 else f"({rows or 'V'}, {width})"
        reject("shape", f"{what} has shape {array.shape}, not {wanted}")
    if array.dtype != np.float32:
        reject("dtype", f"{what} is {array.dtype}, not float32")
    if not np.isfinite(array).all():
        bad = int(np.argwhere(~np.isfinite(array))[0][0])
        reject("non_finite", f"{what} is not finite at row {bad}")
    if deviation and array.min() < 0:
        reject("negative_sd", f"{what} is negative")
    return array


def check_electrodes(array: FloatArray, what: str) -> FloatArray:
    """A value for each electrode of some kind of sensor, shape ``(19,)`` or ``(24,)``."""
    if array.shape[0] not in _ELECTRODES:
        kinds = " or ".join(f"{count} ({name})" for count, name in _ELECTRODES.items())
        reject("electrode_count", f"{what} has {array.shape[0]} values, not {kinds}")
    return array


def splice(number: int, array: FloatArray) -> bytes:
    """A packed ``repeated float`` field as the official encoder writes it, a hundred times faster.

    The wire format of a packed float field *is* tag, length, little-endian array. Protobuf allows
    fields in any order and messages to be concatenated, so a field may follow an encoded message.
    """
    if array.size == 0:
        return b""
    payload = np.ascontiguousarray(array, dtype="<f4").tobytes()
    return delimited(number, payload)


def delimited(number: int, payload: bytes) -> bytes:
    """Tag and length of a length-delimited field, then its payload."""
    return varint(number << 3 | 2) + varint(len(payload)) + payload


def varint(value: int) -> bytes:
    """Base-128 varint of a non-negative number."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)
