"""Codec of messages of services and requests to them: tare, zero, status, metadata, error."""

from __future__ import annotations

from collections.abc import Iterable
from math import isfinite

import numpy as np

from palpate.codec.base import (
    Codec,
    check_digest,
    check_electrodes,
    check_request_id,
    check_serial,
    codec_of,
    field_from_wire,
    reject,
    stamp_from_wire,
    stamp_to_wire,
    vector3_from_wire,
    vector3_to_wire,
)
from palpate.codec.models import served_from_wire, served_to_wire
from palpate.errors import ErrorCode
from palpate.messages import (
    GAUGE_MAX,
    NO_TARE,
    UPTIME_MAX_S,
    ChannelFault,
    ErrorReply,
    FaultKind,
    ModelMetadata,
    SensorState,
    SensorStatus,
    ServiceRequest,
    ServiceState,
    Status,
    SupervisedProcess,
    Tare,
    TareRequest,
    TensorInfo,
    TrainingRange,
    ValueRange,
    WrenchZero,
    WrenchZeroRequest,
)
from palpate.v1 import service_pb2

# A newer gateway may know more states and faults than this palpate: they become UNKNOWN.
_SENSOR_STATES = {int(state): state for state in SensorState}
_FAULT_KINDS = {int(kind): kind for kind in FaultKind}
_STATES = {int(state): state for state in ServiceState}
_CODES = {int(code): code for code in ErrorCode}
_LINE_MAX, _TEXT_MAX = 1024, 4096  # [characters]
_TIME_MAX = (1 << 63) - 1
_COUNT_MAX = (1 << 64) - 1


def sensor_status_from_wire(msg: service_pb2.SensorStatus) -> SensorStatus:
    """Check and convert the status of one sensor."""
    return SensorStatus(
        check_serial(msg.name, "name of a sensor"),
        _SENSOR_STATES.get(msg.state, SensorState.UNKNOWN),
        _check_time(msg.since_monotonic_ns),
        tuple(
            ChannelFault(_FAULT_KINDS.get(fault.kind, FaultKind.UNKNOWN), tuple(fault.channels))
            for fault in msg.faults
        ),
        _check_text(msg.message, "message of a sensor", most=_LINE_MAX),
    )


def sensor_states_to_wire(
    states: Iterable[SensorStatus],
) -> list[service_pb2.SensorStatus]:
    """Check and fill the status of each sensor."""
    return [
        service_pb2.SensorStatus(
            name=check_serial(one.name, "name of a sensor"),
            state=int(one.state),  # type: ignore[arg-type]
            since_monotonic_ns=_check_time(one.since_monotonic_ns),
            faults=[
                service_pb2.ChannelFault(
                    kind=int(fault.kind),  # type: ignore[arg-type]
                    channels=list(fault.channels),
                )
                for fault in one.faults
            ],
            message=_sendable(one.message, _LINE_MAX),
        )
        for one in states
    ]


def _sendable(text: str, most: int = _TEXT_MAX) -> str:
    # Lone surrogates, e.g. of a file name that is no UTF-8, cannot be sent.
    return text.encode("utf-8", "backslashreplace").decode()[:most]


def _check_text(text: str, what: str, *, most: int = _TEXT_MAX) -> str:
    if len(text) > most:
        reject("text", f"{what} has {len(text)} characters, at most {most} are allowed")
    return text


def _check_time(time_ns: int) -> int:
    if not 0 <= time_ns <= _TIME_MAX:
        reject("time", f"time {time_ns} ns is not in int64")
    return time_ns


def _check_uptime(uptime_s: float) -> float:
    if not 0.0 <= uptime_s <= UPTIME_MAX_S:  # NaN is refused, too
        reject("uptime", f"uptime {uptime_s} s is not in [0, {UPTIME_MAX_S:g}]")
    return uptime_s


def _zero_from_wire(msg: service_pb2.WrenchZero) -> WrenchZero:
    if msg.readings_averaged == 0:
        reject("readings_averaged", "a zero of no readings")
    return WrenchZero(
        check_serial(msg.sensor_serial),
        _check_text(msg.device, "device", most=_LINE_MAX),
        _check_time(msg.monotonic_ns),
        _check_time(msg.wall_ns),
        vector3_from_wire(msg.force_before, "force_before"),
        vector3_from_wire(msg.torque_before, "torque_before"),
        vector3_from_wire(msg.force_after, "force_after"),
        vector3_from_wire(msg.torque_after, "torque_after"),
        msg.readings_averaged,
    )


def _zero_encode(zero: WrenchZero) -> bytes:
    msg = service_pb2.WrenchZero(
        sensor_serial=zero.sensor_serial,
        device=_sendable(zero.device, _LINE_MAX),
        monotonic_ns=_check_time(zero.monotonic_ns),
        wall_ns=_check_time(zero.wall_ns),
        readings_averaged=zero.readings_averaged,
    )
    vector3_to_wire(zero.force_before, msg.force_before, "force_before")
    vector3_to_wire(zero.torque_before, msg.torque_before, "torque_before")
    vector3_to_wire(zero.force_after, msg.force_after, "force_after")
    vector3_to_wire(zero.torque_after, msg.torque_after, "torque_after")
    _zero_from_wire(msg)  # rare message: one set of checks serves both ways
    return msg.SerializeToString()


WRENCH_ZERO = codec_of(service_pb2.WrenchZero, _zero_encode, _zero_from_wire)
WRENCH_ZERO_REQUEST: Codec[WrenchZeroRequest] = codec_of(
    service_pb2.WrenchZeroRequest,
    lambda r: service_pb2.WrenchZeroRequest(
        readings=r.readings, request_id=check_request_id(r.request_id)
    ).SerializeToString(),
    lambda msg: WrenchZeroRequest(msg.readings, check_request_id(msg.request_id)),
)


def _tare_from_wire(msg: service_pb2.Tare) -> Tare:
    electrodes = check_electrodes(
        field_from_wire(msg.electrodes, 1, "electrodes"), "electrodes of the tare"
    )
    if msg.tare_id == NO_TARE:
        reject("tare_id", "tare_id is 0, which means no tare")
    if not isfinite(msg.pdc + msg.pac + msg.tac + msg.tdc):
        reject("non_finite", "pdc, pac, tac or tdc of the tare is not finite")
    return Tare(
        msg.tare_id,
        stamp_from_wire(msg.stamp),
        check_serial(msg.sensor_serial),
        electrodes,
        field_from_wire(msg.electrodes_sd, 1, "electrodes_sd", rows=electrodes.shape[0]),
        msg.pdc,
        msg.pac,
        msg.tac,
        msg.tdc,
        msg.frames_averaged,
    )


def _tare_encode(tare: Tare) -> bytes:
    msg = service_pb2.Tare(
        tare_id=tare.tare_id,
        sensor_serial=tare.sensor_serial,
        electrodes=np.asarray(tare.electrodes, np.float32).tolist(),
        electrodes_sd=np.asarray(tare.electrodes_sd, np.float32).tolist(),
        pdc=tare.pdc,
        pac=tare.pac,
        tac=tare.tac,
        tdc=tare.tdc,
        frames_averaged=tare.frames_averaged,
    )
    stamp_to_wire(tare.stamp, msg.stamp)
    _tare_from_wire(msg)  # rare message: one set of checks serves both ways
    return msg.SerializeToString()


def _error_from_wire(msg: service_pb2.Error) -> ErrorReply:
    code = _CODES.get(msg.code, ErrorCode.UNSPECIFIED)  # a newer code is still an error
    return ErrorReply(
        code,
        _check_text(msg.message, "message"),
        _check_text(msg.remedy, "remedy"),
        msg.retry_after_ms * 1e-3,
    )


def _error_to_wire(error: ErrorReply) -> service_pb2.Error:
    return service_pb2.Error(
        code=int(error.code),  # type: ignore[arg-type]
        message=_sendable(error.message),
        remedy=_sendable(error.remedy),
        retry_after_ms=max(0, round(error.retry_after_s * 1e3)),
    )


def _process_from_wire(msg: service_pb2.SupervisedProcess) -> SupervisedProcess:
    return SupervisedProcess(
        check_serial(msg.service, "service"),
        check_serial(msg.instance, "instance"),
        check_serial(msg.state, "state of a process"),
        msg.pid,
        msg.restarts,
        _check_uptime(msg.uptime_s),
    )


def _process_to_wire(process: SupervisedProcess) -> service_pb2.SupervisedProcess:
    return service_pb2.SupervisedProcess(
        service=check_serial(process.service, "service"),
        instance=check_serial(process.instance, "instance"),
        state=check_serial(process.state, "state of a process"),
        pid=process.pid,
        restarts=process.restarts,
        uptime_s=_check_uptime(process.uptime_s),
    )


def _status_from_wire(msg: service_pb2.Status) -> Status:
    state = _STATES.get(msg.state)
    if state is None:
        reject("state", f"state {msg.state} is not known")
    return Status(
        check_serial(msg.service, "service"),
        check_serial(msg.instance, "instance"),
        state,
        _check_time(msg.monotonic_ns),
        _check_time(msg.wall_ns),
        _check_uptime(msg.uptime_s),
        msg.version,
        dict(msg.counters),
        # Not refused: all else that the process says of itself is still to be known.
        {name: value for name, value in msg.gauges.items() if abs(value) <= GAUGE_MAX},
        tuple(msg.sensors),
        _check_text(msg.message, "message"),
        _error_from_wire(msg.last_error) if msg.HasField("last_error") else None,
        tuple(map(sensor_status_from_wire, msg.sensor_states)),
        tuple(map(_process_from_wire, msg.processes)),
        tuple(check_serial(model, "model") for model in msg.models),
    )


def _status_encode(status: Status) -> bytes:
    for name, value in status.gauges.items():
        if not abs(value) <= GAUGE_MAX:  # NaN is refused, too
            reject("gauge", f"gauge {name!r} = {value} is not in [-{GAUGE_MAX:g}, {GAUGE_MAX:g}]")
    for name, count in status.counters.items():
        if not 0 <= count <= _COUNT_MAX:
            reject("counter", f"counter {name!r} = {count} is not in uint64")
    return service_pb2.Status(
        service=check_serial(status.service, "service"),
        instance=check_serial(status.instance, "instance"),
        state=int(status.state),  # type: ignore[arg-type]
        monotonic_ns=_check_time(status.monotonic_ns),
        wall_ns=_check_time(status.wall_ns),
        uptime_s=_check_uptime(status.uptime_s),
        version=status.version,
        counters=dict(status.counters),
        gauges=dict(status.gauges),
        sensors=list(status.sensors),
        message=_sendable(status.message),
        last_error=None if status.last_error is None else _error_to_wire(status.last_error),
        sensor_states=sensor_states_to_wire(status.sensor_states),
        processes=map(_process_to_wire, status.processes),
        models=[check_serial(model, "model") for model in status.models],
    ).SerializeToString()


def _check_digest_or_none(digest: bytes, what: str) -> bytes:
    return check_digest(digest, what) if digest else b""


def _value_range_from_wire(msg: service_pb2.ValueRange) -> ValueRange:
    if len(msg.low) != len(msg.high) or not isfinite(sum(msg.low) + sum(msg.high)):
        reject("training_range", f"range of {msg.name!r} has no finite low and high for each value")
    if not (isfinite(msg.length_max) and msg.length_max >= 0):
        reject("training_range", f"range of {msg.name!r}: length_max = {msg.length_max}")
    return ValueRange(msg.name, msg.unit, tuple(msg.low), tuple(msg.high), msg.length_max)


def _value_range_to_wire(one: ValueRange) -> service_pb2.ValueRange:
    return service_pb2.ValueRange(
        name=one.name, unit=one.unit, low=one.low, high=one.high, length_max=one.length_max
    )


def _range_from_wire(msg: service_pb2.TrainingRange) -> TrainingRange:
    return TrainingRange(
        _check_text(msg.source, "source of the training range"),
        msg.data_sha256,
        msg.rows,
        tuple(map(_value_range_from_wire, msg.inputs)),
        tuple(map(_value_range_from_wire, msg.outputs)),
        msg.combinations,
    )


def _range_to_wire(known: TrainingRange) -> service_pb2.TrainingRange:
    return service_pb2.TrainingRange(
        source=_sendable(known.source),
        data_sha256=known.data_sha256,
        rows=known.rows,
        inputs=map(_value_range_to_wire, known.inputs),
        outputs=map(_value_range_to_wire, known.outputs),
        combinations=known.combinations,
    )


def _metadata_from_wire(msg: service_pb2.ModelMetadata) -> ModelMetadata:
    return ModelMetadata(
        check_serial(msg.name, "name"),
        msg.version,
        check_serial(msg.task, "task"),
        check_digest(msg.bundle_sha256, "bundle_sha256"),
        msg.contract_version,
        tuple(TensorInfo(t.name, t.dtype, tuple(t.shape), t.unit) for t in msg.inputs),
        tuple(TensorInfo(t.name, t.dtype, tuple(t.shape), t.unit) for t in msg.outputs),
        msg.training_data_sha256,
        dict(msg.metrics),
        _check_text(msg.trained_on, "trained_on"),
        served_from_wire(msg.served),
        _range_from_wire(msg.training_range) if msg.HasField("training_range") else None,
        _check_digest_or_none(msg.mesh_sha256, "mesh_sha256"),
        _check_digest_or_none(msg.basis_sha256, "basis_sha256"),
        msg.modes,
    )


def _tensor(info: TensorInfo) -> service_pb2.TensorInfo:
    return service_pb2.TensorInfo(
        name=info.name, dtype=info.dtype, shape=list(info.shape), unit=info.unit
    )


def _metadata_encode(metadata: ModelMetadata) -> bytes:
    return service_pb2.ModelMetadata(
        name=check_serial(metadata.name, "name"),
        version=metadata.version,
        task=check_serial(metadata.task, "task"),
        bundle_sha256=check_digest(metadata.bundle_sha256, "bundle_sha256"),
        contract_version=metadata.contract_version,
        inputs=[_tensor(info) for info in metadata.inputs],
        outputs=[_tensor(info) for info in metadata.outputs],
        training_data_sha256=metadata.training_data_sha256,
        metrics=dict(metadata.metrics),
        trained_on=_sendable(metadata.trained_on),
        served=served_to_wire(metadata.served),
        training_range=(
            None if metadata.training_range is None else _range_to_wire(metadata.training_range)
        ),
        mesh_sha256=_check_digest_or_none(metadata.mesh_sha256, "mesh_sha256"),
        basis_sha256=_check_digest_or_none(metadata.basis_sha256, "basis_sha256"),
        modes=metadata.modes,
    ).SerializeToString()


TARE = codec_of(service_pb2.Tare, _tare_encode, _tare_from_wire)
TARE_REQUEST: Codec[TareRequest] = codec_of(
    service_pb2.TareRequest,
    lambda r: service_pb2.TareRequest(
        tare_id=r.tare_id,
        frames=r.frames,
        request_id=check_request_id(r.request_id),
        anyway=r.anyway,
    ).SerializeToString(),
    lambda msg: TareRequest(msg.tare_id, msg.frames, check_request_id(msg.request_id), msg.anyway),
)
SERVICE_REQUEST: Codec[ServiceRequest] = codec_of(
    service_pb2.ServiceRequest, lambda _: b"", lambda _: ServiceRequest()
)
STATUS = codec_of(service_pb2.Status, _status_encode, _status_from_wire)
MODEL_METADATA = codec_of(service_pb2.ModelMetadata, _metadata_encode, _metadata_from_wire)
ERROR: Codec[ErrorReply] = codec_of(
    service_pb2.Error,
    lambda error: _error_to_wire(error).SerializeToString(),
    _error_from_wire,
)
