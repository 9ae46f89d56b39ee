"""Codec of the messages about the models of an estimating service."""

from __future__ import annotations

from collections.abc import Iterable
from math import isfinite

from palpate.codec.base import Codec, check_digest, check_serial, codec_of, reject
from palpate.config import check_name
from palpate.errors import ConfigError
from palpate.messages import ModelAction, ModelCommand, ModelInventory, ModelRequest, ServedModel
from palpate.v1 import models_pb2

NONCE_BYTES = 16
MAC_BYTES = 32

_ACTIONS = {int(action): action for action in ModelAction}
_BUNDLE_MAX = 80  # [characters] of name:version
_COMMAND_MAX = 1024  # [bytes]
_ENTRIES_MAX = 4096
_TIME_MAX = (1 << 63) - 1


def _check_key_part(name: str, what: str, *, optional: bool = False) -> str:
    if optional and not name:
        return name
    try:
        return check_name(name, what)
    except ConfigError as error:
        reject("name", error.problem)


def _check_bundle(bundle: str, what: str = "bundle") -> str:
    if len(bundle) > _BUNDLE_MAX or not (bundle.isascii() and bundle.isprintable()):
        reject("bundle", f"{what} {bundle[:100]!r} is not name or name:version")
    return bundle


def _check_wall(wall_ns: int) -> int:
    if not 0 <= wall_ns <= _TIME_MAX:
        reject("time", f"time {wall_ns} ns is not in int64")
    return wall_ns


def _command_from_wire(msg: models_pb2.ModelCommand) -> ModelCommand:
    action = _ACTIONS.get(msg.action)
    if action is None:
        reject("action", f"action {msg.action} of a model command is not known")
    if len(msg.nonce) != NONCE_BYTES:
        reject("nonce", f"nonce has {len(msg.nonce)} bytes, not {NONCE_BYTES}")
    return ModelCommand(
        action,
        _check_key_part(msg.station, "station"),
        _check_key_part(msg.service, "service"),
        msg.nonce,
        _check_wall(msg.wall_ns),
        _check_key_part(msg.instance, "instance", optional=True),
        _check_bundle(msg.bundle),
        _check_key_part(msg.sensor, "sensor", optional=True),
    )


def _command_encode(command: ModelCommand) -> bytes:
    msg = models_pb2.ModelCommand(
        action=int(command.action),  # type: ignore[arg-type]
        station=command.station,
        service=command.service,
        instance=command.instance,
        bundle=command.bundle,
        sensor=command.sensor,
        nonce=command.nonce,
        wall_ns=_check_wall(command.wall_ns),
    )
    _command_from_wire(msg)  # rare message: one set of checks serves both ways
    return msg.SerializeToString()


def _request_from_wire(msg: models_pb2.ModelRequest) -> ModelRequest:
    if not 0 < len(msg.command) <= _COMMAND_MAX:
        reject("size", f"command has {len(msg.command)} bytes, not 1-{_COMMAND_MAX}")
    if len(msg.mac) != MAC_BYTES:
        reject("mac", f"mac has {len(msg.mac)} bytes, not {MAC_BYTES}")
    return ModelRequest(msg.command, msg.mac)


def _request_encode(request: ModelRequest) -> bytes:
    msg = models_pb2.ModelRequest(command=request.command, mac=request.mac)
    _request_from_wire(msg)
    return msg.SerializeToString()


def served_from_wire(msgs: Iterable[models_pb2.ServedModel]) -> tuple[ServedModel, ...]:
    """Check and convert which bundle serves which sensor."""
    return tuple(
        ServedModel(
            _check_key_part(one.sensor, "sensor", optional=True),
            check_serial(one.name, "name of a bundle") if one.name else "",
            one.version,
            check_digest(one.bundle_sha256, "bundle_sha256") if one.name else b"",
            _check_wall(one.since_wall_ns),
            _check_bundle(one.previous, "previous"),
        )
        for one in msgs
    )


def served_to_wire(served: Iterable[ServedModel]) -> list[models_pb2.ServedModel]:
    """Check and fill which bundle serves which sensor."""
    msgs = [
        models_pb2.ServedModel(
            sensor=one.sensor,
            name=one.name,
            version=one.version,
            bundle_sha256=one.bundle_sha256,
            since_wall_ns=_check_wall(one.since_wall_ns),
            previous=one.previous,
        )
        for one in served
    ]
    served_from_wire(msgs)
    return msgs


def _inventory_from_wire(msg: models_pb2.ModelInventory) -> ModelInventory:
    if max(len(msg.served), len(msg.available)) > _ENTRIES_MAX:
        reject("size", f"an inventory has more than {_ENTRIES_MAX} entries")
    if not (isfinite(msg.change_s) and msg.change_s >= 0):
        reject("non_finite", f"change_s is {msg.change_s}")
    return ModelInventory(
        _check_key_part(msg.instance, "instance"),
        served_from_wire(msg.served),
        tuple(_check_bundle(entry, "available") for entry in msg.available),
        msg.change_s,
    )


def _inventory_encode(inventory: ModelInventory) -> bytes:
    msg = models_pb2.ModelInventory(
        instance=inventory.instance,
        served=served_to_wire(inventory.served),
        available=list(inventory.available),
        change_s=inventory.change_s,
    )
    _inventory_from_wire(msg)
    return msg.SerializeToString()


MODEL_COMMAND: Codec[ModelCommand] = codec_of(
    models_pb2.ModelCommand, _command_encode, _command_from_wire
)
MODEL_REQUEST: Codec[ModelRequest] = codec_of(
    models_pb2.ModelRequest, _request_encode, _request_from_wire
)
MODEL_INVENTORY: Codec[ModelInventory] = codec_of(
    models_pb2.ModelInventory, _inventory_encode, _inventory_from_wire
)
