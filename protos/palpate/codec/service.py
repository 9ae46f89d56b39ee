"""Codec of what services say and are asked: tare, status, model metadata, typed error."""

from __future__ import annotations

from math import isfinite

import numpy as np

from palpate.codec.base import Codec, codec_of
from palpate.codec.checks import (
    check_digest,
    check_electrodes,
    check_serial,
    delimited,
    field_from_wire,
    reject,
    stamp_from_wire,
    stamp_to_wire,
)
from palpate.codec.frames import ELECTRODE_FRAME, electrodes_from_wire
from palpate.codec.sensors import sensor_states_to_wire, sensor_status_from_wire
from palpate.errors import ConfigError, ErrorCode
from palpate.messages import (
    NO_TARE,
    ErrorReply,
    FieldRequest,
    ModelMetadata,
    ServiceRequest,
    ServiceState,
    Status,
    Tare,
    TareRequest,
    TensorInfo,
)
from palpate.names import check_name
from palpate.v1 import service_pb2

_STATES = {int(state): state for state in ServiceState}
_CODES = {int(code): code for code in ErrorCode}
_TEXT_MAX = 4096


def _check_text(text: str, what: str) -> str:
    if len(text) > _TEXT_MAX:
        reject("text", f"{what} has {len(text)} characters, at most {_TEXT_MAX} are allowed")
    return text


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


def _fill_error(error: ErrorReply, msg: service_pb2.Error) -> service_pb2.Error:
    msg.code = int(error.code)  # type: ignore[assignment]
    msg.message = error.message[:_TEXT_MAX]
    msg.remedy = error.remedy[:_TEXT_MAX]
    msg.retry_after_ms = max(0, round(error.retry_after_s * 1e3))
    return msg


def _status_from_wire(msg: service_pb2.Status) -> Status:
    state = _STATES.get(msg.state)
    if state is None:
        reject("state", f"state {msg.state} is not known")
    return Status(
        check_serial(msg.service, "service"),
        check_serial(msg.instance, "instance"),
        state,
        msg.monotonic_ns,
        msg.wall_ns,
        msg.uptime_s,
        msg.version,
        dict(msg.counters),
        dict(msg.gauges),
        tuple(msg.sensors),
        _check_text(msg.message, "message"),
        _error_from_wire(msg.last_error) if msg.HasField("last_error") else None,
        tuple(map(sensor_status_from_wire, msg.sensor_states)),
    )


def _status_encode(status: Status) -> bytes:
    msg = service_pb2.Status(
        service=check_serial(status.service, "service"),
        instance=check_serial(status.instance, "instance"),
        state=int(status.state),  # type: ignore[arg-type]
        monotonic_ns=status.monotonic_ns,
        wall_ns=status.wall_ns,
        uptime_s=status.uptime_s,
        version=status.version,
        counters=dict(status.counters),
        gauges=dict(status.gauges),
        sensors=list(status.sensors),
        message=status.message[:_TEXT_MAX],
        sensor_states=sensor_states_to_wire(status.sensor_states),
    )
    if status.last_error is not None:
        _fill_error(status.last_error, msg.last_error)
    return msg.SerializeToString()


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
        trained_on=metadata.trained_on[:_TEXT_MAX],
    ).SerializeToString()


def _check_sensor(sensor: str) -> str:
    try:
        return check_name(sensor, "sensor")
    except ConfigError as error:
        reject("sensor", error.problem)


def _field_request_from_wire(msg: service_pb2.FieldRequest) -> FieldRequest:
    return FieldRequest(_check_sensor(msg.sensor), electrodes_from_wire(msg.frame))


def _field_request_encode(request: FieldRequest) -> bytes:
    head = service_pb2.FieldRequest(sensor=_check_sensor(request.sensor))
    return head.SerializeToString() + delimited(2, ELECTRODE_FRAME.encode(request.frame))


TARE: Codec[Tare] = codec_of(service_pb2.Tare, _tare_encode, _tare_from_wire)
TARE_REQUEST: Codec[TareRequest] = codec_of(
    service_pb2.TareRequest,
    lambda r: service_pb2.TareRequest(tare_id=r.tare_id, frames=r.frames).SerializeToString(),
    lambda msg: TareRequest(msg.tare_id, msg.frames),
)
SERVICE_REQUEST: Codec[ServiceRequest] = codec_of(
    service_pb2.ServiceRequest, lambda _: b"", lambda _: ServiceRequest()
)
FIELD_REQUEST: Codec[FieldRequest] = codec_of(
    service_pb2.FieldRequest, _field_request_encode, _field_request_from_wire
)
STATUS: Codec[Status] = codec_of(service_pb2.Status, _status_encode, _status_from_wire)
MODEL_METADATA: Codec[ModelMetadata] = codec_of(
    service_pb2.ModelMetadata, _metadata_encode, _metadata_from_wire
)
ERROR: Codec[ErrorReply] = codec_of(
    service_pb2.Error,
    lambda error: _fill_error(error, service_pb2.Error()).SerializeToString(),
    _error_from_wire,
)
