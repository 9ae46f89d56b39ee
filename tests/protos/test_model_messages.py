"""Commands to an estimating service about its models: what the contract refuses."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from palpate import codec
from palpate.errors import WireError
from palpate.v1 import models_pb2, service_pb2


def test_a_description_of_an_older_service_names_no_sensors(examples: dict[str, Any]) -> None:
    old = service_pb2.ModelMetadata.FromString(
        codec.MODEL_METADATA.encode(examples["ModelMetadata"])
    )
    old.ClearField("served")
    assert codec.MODEL_METADATA.decode(old.SerializeToString()).served == ()


def test_a_description_tells_who_serves_which_sensor(examples: dict[str, Any]) -> None:
    served = examples["ModelInventory"].served
    metadata = dataclasses.replace(examples["ModelMetadata"], served=served)
    assert codec.MODEL_METADATA.decode(codec.MODEL_METADATA.encode(metadata)).served == served


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("action", 0, "action"),
        ("action", 99, "action"),
        ("station", "", "name"),
        ("service", "../evil", "name"),
        ("instance", "*", "name"),
        ("sensor", "a/b", "name"),
        ("bundle", "n" * 81, "bundle"),
        ("bundle", "\x1b[2J", "bundle"),
        ("nonce", b"short", "nonce"),
        ("wall_ns", 1 << 63, "time"),
    ],
)
def test_a_command_that_breaks_the_contract(
    examples: dict[str, Any], field: str, value: Any, reason: str
) -> None:
    msg = models_pb2.ModelCommand.FromString(codec.MODEL_COMMAND.encode(examples["ModelCommand"]))
    setattr(msg, field, value)
    with pytest.raises(WireError) as caught:
        codec.MODEL_COMMAND.decode(msg.SerializeToString())
    assert caught.value.reason == reason


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"command": b""}, "size"),
        ({"command": bytes(1025)}, "size"),
        ({"mac": bytes(31)}, "mac"),
    ],
)
def test_a_request_that_breaks_the_contract(
    examples: dict[str, Any], changes: dict[str, bytes], reason: str
) -> None:
    with pytest.raises(WireError) as caught:
        codec.MODEL_REQUEST.encode(dataclasses.replace(examples["ModelRequest"], **changes))
    assert caught.value.reason == reason


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda msg: msg.served.add(sensor="a b"), "name"),
        (lambda msg: msg.served.add(name="x", bundle_sha256=b"1"), "digest"),
        (lambda msg: msg.available.append("\n"), "bundle"),
        (lambda msg: msg.available.extend(["a:1"] * 5000), "size"),
        (lambda msg: setattr(msg, "change_s", float("nan")), "non_finite"),
        (lambda msg: setattr(msg, "instance", ""), "name"),
    ],
)
def test_an_inventory_that_breaks_the_contract(
    examples: dict[str, Any], spoil: Any, reason: str
) -> None:
    msg = models_pb2.ModelInventory.FromString(
        codec.MODEL_INVENTORY.encode(examples["ModelInventory"])
    )
    spoil(msg)
    with pytest.raises(WireError) as caught:
        codec.MODEL_INVENTORY.decode(msg.SerializeToString())
    assert caught.value.reason == reason
