"""Codec of what a gateway says of its sensors, and of the zero of a force/torque sensor."""

from __future__ import annotations

from collections.abc import Iterable

from palpate.codec.base import Codec, codec_of
from palpate.codec.checks import check_serial, reject, vector3_from_wire, vector3_to_wire
from palpate.messages import (
    ChannelFault,
    FaultKind,
    SensorState,
    SensorStatus,
    WrenchZero,
    WrenchZeroRequest,
)
from palpate.v1 import service_pb2

# A newer gateway may know more of them.
_STATES = {int(state): state for state in SensorState}
_KINDS = {int(kind): kind for kind in FaultKind}
_TEXT_MAX = 1024
_TIME_MAX = (1 << 63) - 1


def sensor_status_from_wire(msg: service_pb2.SensorStatus) -> SensorStatus:
    """Check and convert the status of one sensor."""
    return SensorStatus(
        check_serial(msg.name, "name of a sensor"),
        _STATES.get(msg.state, SensorState.UNKNOWN),
        _time(msg.since_monotonic_ns),
        tuple(
            ChannelFault(_KINDS.get(fault.kind, FaultKind.UNKNOWN), tuple(fault.channels))
            for fault in msg.faults
        ),
        _text(msg.message, "message of a sensor"),
    )


def sensor_states_to_wire(
    states: Iterable[SensorStatus],
) -> list[service_pb2.SensorStatus]:
    """Check and fill the status of each sensor."""
    return [
        service_pb2.SensorStatus(
            name=check_serial(one.name, "name of a sensor"),
            state=int(one.state),  # type: ignore[arg-type]
            since_monotonic_ns=_time(one.since_monotonic_ns),
            faults=[
                service_pb2.ChannelFault(
                    kind=int(fault.kind),  # type: ignore[arg-type]
                    channels=list(fault.channels),
                )
                for fault in one.faults
            ],
            message=one.message[:_TEXT_MAX],
        )
        for one in states
    ]


def _text(text: str, what: str) -> str:
    if len(text) > _TEXT_MAX:
        reject("text", f"{what} has {len(text)} characters, at most {_TEXT_MAX} are allowed")
    return text


def _time(time_ns: int) -> int:
    if not 0 <= time_ns <= _TIME_MAX:
        reject("time", f"time {time_ns} ns is not in int64")
    return time_ns


def _zero_from_wire(msg: service_pb2.WrenchZero) -> WrenchZero:
    if msg.readings_averaged == 0:
        reject("readings_averaged", "a zero of no readings")
    return WrenchZero(
        check_serial(msg.sensor_serial),
        _text(msg.device, "device"),
        _time(msg.monotonic_ns),
        _time(msg.wall_ns),
        vector3_from_wire(msg.force_before, "force_before"),
        vector3_from_wire(msg.torque_before, "torque_before"),
        vector3_from_wire(msg.force_after, "force_after"),
        vector3_from_wire(msg.torque_after, "torque_after"),
        msg.readings_averaged,
    )


def _zero_encode(zero: WrenchZero) -> bytes:
    msg = service_pb2.WrenchZero(
        sensor_serial=zero.sensor_serial,
        device=zero.device[:_TEXT_MAX],
        monotonic_ns=_time(zero.monotonic_ns),
        wall_ns=_time(zero.wall_ns),
        readings_averaged=zero.readings_averaged,
    )
    vector3_to_wire(zero.force_before, msg.force_before, "force_before")
    vector3_to_wire(zero.torque_before, msg.torque_before, "torque_before")
    vector3_to_wire(zero.force_after, msg.force_after, "force_after")
    vector3_to_wire(zero.torque_after, msg.torque_after, "torque_after")
    _zero_from_wire(msg)  # rare message: one set of checks serves both ways
    return msg.SerializeToString()


WRENCH_ZERO: Codec[WrenchZero] = codec_of(service_pb2.WrenchZero, _zero_encode, _zero_from_wire)
WRENCH_ZERO_REQUEST: Codec[WrenchZeroRequest] = codec_of(
    service_pb2.WrenchZeroRequest,
    lambda r: service_pb2.WrenchZeroRequest(readings=r.readings).SerializeToString(),
    lambda msg: WrenchZeroRequest(msg.readings),
)
