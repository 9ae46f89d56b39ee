"""Codec of frames: what gateways and robots publish. Hot path: checks are inlined on purpose."""

from __future__ import annotations

import numpy as np

from palpate.codec.base import (
    check_digest,
    check_field,
    check_serial,
    codec_of,
    field_from_wire,
    pose_from_wire,
    pose_numbers,
    pose_to_wire,
    pose_values,
    reject,
    splice,
    stamp_from_wire,
    stamp_to_wire,
    vector3_from_wire,
    vector3_to_wire,
)
from palpate.config import check_name
from palpate.errors import ConfigError, WireError
from palpate.messages import (
    COUNTS_MAX,
    ElectrodeFrame,
    FieldFrame,
    IndenterPoseFrame,
    RobotPoseFrame,
    SensorType,
    WrenchFrame,
)
from palpate.v1 import frames_pb2, robot_pb2

_SENSOR_TYPES = {
    int(kind): (kind, kind.layout.electrodes, kind.layout.pac_samples, kind.layout.slots)
    for kind in SensorType
}
_HIGH = slice(1, None, 2)  # high bytes of little-endian uint16: >= 16 means more than 12 bits


def _check_counts(raw: bytes, count: int, what: str) -> None:
    if len(raw) != 2 * count:
        reject(f"{what}_count", f"{what} has {len(raw) / 2:g} values, not {count}")
    if max(raw[_HIGH]) > 15:
        at = next(i for i, high in enumerate(raw[_HIGH]) if high > 15)
        reject("counts_range", f"{what}[{at}] exceeds 12 bits ({COUNTS_MAX} counts)")


def electrodes_from_wire(msg: frames_pb2.ElectrodeFrame) -> ElectrodeFrame:
    """Check and convert an electrode frame."""
    kind = _SENSOR_TYPES.get(msg.sensor_type)
    if kind is None:
        reject("sensor_type", f"sensor_type {msg.sensor_type} is not known")
    sensor_type, count, pac_samples, bits = kind
    electrodes, pac = msg.electrodes, msg.pac
    _check_counts(electrodes, count, "electrode")
    _check_counts(pac, pac_samples, "pac")
    pdc, tac, tdc = msg.pdc, msg.tac, msg.tdc
    if pdc > COUNTS_MAX or tac > COUNTS_MAX or tdc > COUNTS_MAX:
        reject("counts_range", f"pdc {pdc}, tac {tac} or tdc {tdc} exceeds {COUNTS_MAX} counts")
    validity, slot_period_ns = msg.validity, msg.slot_period_ns
    if validity >> bits:
        reject("validity", f"validity {validity:#x} has bits beyond the {bits} channels")
    if slot_period_ns == 0:
        reject("slot_period", "slot_period_ns is 0")
    return ElectrodeFrame(
        stamp_from_wire(msg.stamp),
        check_serial(msg.sensor_serial),
        sensor_type,
        np.frombuffer(electrodes, "<u2"),
        pdc,
        np.frombuffer(pac, "<u2"),
        tac,
        tdc,
        validity,
        slot_period_ns,
        msg.tare_id,
    )


def _electrodes_encode(frame: ElectrodeFrame) -> bytes:
    _, count, pac_samples, bits = _SENSOR_TYPES[frame.sensor_type]
    electrodes, pac = frame.electrodes, frame.pac
    if electrodes.dtype != np.uint16 or pac.dtype != np.uint16:
        reject("dtype", f"electrodes {electrodes.dtype} and pac {pac.dtype} must be uint16")
    electrode_bytes, pac_bytes = electrodes.tobytes(), pac.tobytes()
    _check_counts(electrode_bytes, count, "electrode")
    _check_counts(pac_bytes, pac_samples, "pac")
    if frame.validity >> bits:
        reject("validity", f"validity {frame.validity:#x} has bits beyond the {bits} channels")
    if frame.slot_period_ns <= 0:
        reject("slot_period", f"slot_period_ns is {frame.slot_period_ns}")
    if not (0 <= frame.pdc <= COUNTS_MAX and 0 <= frame.tac <= COUNTS_MAX):
        reject("counts_range", f"pdc {frame.pdc} or tac {frame.tac} is not 0..{COUNTS_MAX}")
    if not 0 <= frame.tdc <= COUNTS_MAX:
        reject("counts_range", f"tdc {frame.tdc} is not 0..{COUNTS_MAX}")
    msg = frames_pb2.ElectrodeFrame(
        sensor_serial=check_serial(frame.sensor_serial),
        sensor_type=int(frame.sensor_type),  # type: ignore[arg-type]
        electrodes=electrode_bytes,
        pdc=frame.pdc,
        pac=pac_bytes,
        tac=frame.tac,
        tdc=frame.tdc,
        validity=frame.validity,
        slot_period_ns=frame.slot_period_ns,
        tare_id=frame.tare_id,
    )
    stamp_to_wire(frame.stamp, msg.stamp)
    return msg.SerializeToString()


def _wrench_from_wire(msg: frames_pb2.WrenchFrame) -> WrenchFrame:
    return WrenchFrame(
        stamp_from_wire(msg.stamp),
        check_serial(msg.sensor_serial),
        vector3_from_wire(msg.force, "force"),
        vector3_from_wire(msg.torque, "torque"),
        msg.overload,
    )


def _wrench_encode(frame: WrenchFrame) -> bytes:
    msg = frames_pb2.WrenchFrame(
        sensor_serial=check_serial(frame.sensor_serial), overload=frame.overload
    )
    stamp_to_wire(frame.stamp, msg.stamp)
    vector3_to_wire(frame.force, msg.force, "force")
    vector3_to_wire(frame.torque, msg.torque, "torque")
    return msg.SerializeToString()


def _pose_from_wire(msg: frames_pb2.IndenterPoseFrame) -> IndenterPoseFrame:
    values = pose_numbers(msg.pose_sensor_indenter, "pose_sensor_indenter")
    if msg.in_contact and msg.contact_unknown:
        reject("contact", "in_contact is true and contact_unknown too")
    return IndenterPoseFrame(
        stamp_from_wire(msg.stamp),
        check_serial(msg.indenter, "indenter"),
        np.array(values[:3]),
        np.array(values[3:]),
        None if msg.contact_unknown else msg.in_contact,
    )


def _pose_encode(frame: IndenterPoseFrame) -> bytes:
    if frame.position.shape != (3,) or frame.orientation.shape != (4,):
        raise WireError(
            f"pose has shapes {frame.position.shape} and {frame.orientation.shape}",
            remedy="give position (3,) and quaternion w x y z (4,)",
            reason="shape",
        )
    values = pose_values((*frame.position.tolist(), *frame.orientation.tolist()), "pose")
    msg = frames_pb2.IndenterPoseFrame(
        indenter=check_serial(frame.indenter, "indenter"),
        in_contact=bool(frame.in_contact),
        contact_unknown=frame.in_contact is None,
    )
    stamp_to_wire(frame.stamp, msg.stamp)
    pose = msg.pose_sensor_indenter
    pose.px, pose.py, pose.pz, pose.qw, pose.qx, pose.qy, pose.qz = values
    return msg.SerializeToString()


def field_frame_from_wire(msg: frames_pb2.FieldFrame) -> FieldFrame:
    """Check and convert a field."""
    return FieldFrame(
        stamp_from_wire(msg.stamp),
        check_serial(msg.sensor_serial),
        check_digest(msg.mesh_sha256, "mesh_sha256"),
        field_from_wire(msg.displacement, 3, "displacement"),
    )


def _field_encode(frame: FieldFrame) -> bytes:
    msg = frames_pb2.FieldFrame(
        sensor_serial=check_serial(frame.sensor_serial),
        mesh_sha256=check_digest(frame.mesh_sha256, "mesh_sha256"),
    )
    stamp_to_wire(frame.stamp, msg.stamp)
    displacement = check_field(frame.displacement, 3, "displacement")
    return msg.SerializeToString() + splice(4, displacement)


ELECTRODE_FRAME = codec_of(frames_pb2.ElectrodeFrame, _electrodes_encode, electrodes_from_wire)
WRENCH_FRAME = codec_of(frames_pb2.WrenchFrame, _wrench_encode, _wrench_from_wire)
INDENTER_POSE_FRAME = codec_of(frames_pb2.IndenterPoseFrame, _pose_encode, _pose_from_wire)
FIELD_FRAME = codec_of(frames_pb2.FieldFrame, _field_encode, field_frame_from_wire)


_TIMES = 1 << 63


def _check_robot(robot: str, sequence: int, time_ns: int, wall_ns: int) -> None:
    try:
        check_name(robot, "robot")
    except ConfigError as error:
        raise WireError(error.problem, remedy=error.remedy, reason="robot") from error
    if sequence < 1:
        reject("sequence", f"sequence is {sequence}, sequences start at 1")
    # Beyond int64 no clock of ours can be; and consumers store times as int64.
    if not (0 <= time_ns < _TIMES and 0 <= wall_ns < _TIMES):
        reject("time", f"times {time_ns}, {wall_ns} ns are negative or exceed int64")


def _robot_from_wire(msg: robot_pb2.RobotPoseFrame) -> RobotPoseFrame:
    robot, sequence, time_ns, wall_ns = msg.robot, msg.sequence, msg.time_ns, msg.wall_ns
    _check_robot(robot, sequence, time_ns, wall_ns)
    pose = pose_from_wire(msg.pose_base_flange, "pose_base_flange")
    return RobotPoseFrame(robot, sequence, time_ns, pose, msg.run_id, wall_ns)


def _robot_encode(frame: RobotPoseFrame) -> bytes:
    _check_robot(frame.robot, frame.sequence, frame.time_ns, frame.wall_ns)
    try:
        msg = robot_pb2.RobotPoseFrame(
            robot=frame.robot,
            run_id=frame.run_id,
            sequence=frame.sequence,
            time_ns=frame.time_ns,
            wall_ns=frame.wall_ns,
            pose_base_flange=pose_to_wire(frame.pose_base_flange, "pose_base_flange"),
        )
    except (TypeError, ValueError) as error:
        if isinstance(error, WireError):
            raise
        raise WireError(
            f"{frame}: {error}",
            remedy="give whole numbers of nanoseconds, and three and four numbers of a pose",
            reason="parse",
        ) from error
    return msg.SerializeToString()


ROBOT_POSE_FRAME = codec_of(robot_pb2.RobotPoseFrame, _robot_encode, _robot_from_wire)
