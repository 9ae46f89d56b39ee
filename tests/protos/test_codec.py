"""Bytes to values and back: round trips, golden payloads, refusal of what breaks the contract."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import json_format
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from palpate.codec import (
    CODECS,
    ELECTRODE_FRAME,
    FEATURE_ESTIMATE,
    FIELD_ESTIMATE,
    FIELD_FRAME,
    FIELD_REQUEST,
    Codec,
)
from palpate.errors import PalpateError, WireError
from palpate.messages import ElectrodeFrame, FeatureEstimate, FieldFrame, Origin, Stamp
from palpate.v1 import common_pb2, estimates_pb2, frames_pb2, service_pb2

GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "v1"
BY_NAME = {codec.schema.rpartition(".")[2]: codec for codec in CODECS}


def same(a: Any, b: Any) -> bool:
    """Equality that looks into arrays and nested values."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return bool(a.dtype == b.dtype and np.array_equal(a, b))
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(
            same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a)
        )
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


@pytest.mark.parametrize("name", sorted(BY_NAME))
def test_round_trip(name: str, examples: dict[str, Any]) -> None:
    codec: Codec[Any] = BY_NAME[name]
    payload = codec.encode(examples[name])
    assert same(codec.decode(payload), examples[name])


@pytest.mark.parametrize("name", sorted(BY_NAME))
def test_own_encoder_writes_what_the_official_one_writes(
    name: str, examples: dict[str, Any]
) -> None:
    """Splicing of float arrays is a shortcut, not another format."""
    codec = BY_NAME[name]
    payload = codec.encode(examples[name])
    if name in ("Status", "ModelMetadata"):
        pytest.skip("maps have no order on the wire")
    assert codec.message_type.FromString(payload).SerializeToString() == payload


@pytest.mark.parametrize("name", sorted(BY_NAME))
def test_golden_payloads(
    name: str, examples: dict[str, Any], request: pytest.FixtureRequest
) -> None:
    """Bytes that were published once decode for ever, and mean what their JSON says."""
    codec = BY_NAME[name]
    binary, readable = GOLDEN / f"{name}.bin", GOLDEN / f"{name}.json"
    if request.config.getoption("--update-golden"):
        GOLDEN.mkdir(parents=True, exist_ok=True)
        message = codec.message_type.FromString(codec.encode(examples[name]))
        binary.write_bytes(message.SerializeToString(deterministic=True))
        readable.write_text(json_format.MessageToJson(message, sort_keys=True) + "\n")
    payload = binary.read_bytes()
    parsed = codec.message_type.FromString(payload)
    assert json_format.Parse(readable.read_text(), codec.message_type()) == parsed
    assert same(codec.decode(payload), examples[name])


def test_golden_corpus_is_complete() -> None:
    assert {p.stem for p in GOLDEN.glob("*.bin")} == set(BY_NAME)


def test_unknown_fields_of_a_newer_minor_version_are_tolerated(examples: dict[str, Any]) -> None:
    payload = ELECTRODE_FRAME.encode(examples["ElectrodeFrame"]) + b"\xc2\x3e\x03new"
    assert same(ELECTRODE_FRAME.decode(payload), examples["ElectrodeFrame"])


def _broken(examples: dict[str, Any], **changes: Any) -> ElectrodeFrame:
    frame: ElectrodeFrame = dataclasses.replace(examples["ElectrodeFrame"], **changes)
    return frame


@pytest.mark.parametrize(
    ("changes", "reason", "named"),
    [
        ({"electrodes": np.zeros(18, np.uint16)}, "electrode_count", "18 values, not 19"),
        ({"electrodes": np.full(19, 4096, np.uint16)}, "counts_range", "electrode[0]"),
        ({"electrodes": np.zeros(19, np.float32)}, "dtype", "uint16"),
        ({"pac": np.zeros(21, np.uint16)}, "pac_count", "21 values, not 22"),
        ({"pdc": 5000}, "counts_range", "pdc 5000"),
        ({"tdc": -1}, "counts_range", "tdc -1"),
        ({"validity": 1 << 44}, "validity", "44 channels"),
        ({"sensor_serial": ""}, "serial", "printable"),
        ({"slot_period_ns": 0}, "slot_period", "slot_period_ns"),
    ],
)
def test_a_bad_frame_is_refused_on_both_sides(
    examples: dict[str, Any], changes: dict[str, Any], reason: str, named: str
) -> None:
    with pytest.raises(WireError) as caught:
        ELECTRODE_FRAME.encode(_broken(examples, **changes))
    assert caught.value.reason == reason
    assert named in str(caught.value)
    assert caught.value.remedy.startswith("correct the value"), "who sends is not another"
    message = frames_pb2.ElectrodeFrame.FromString(
        ELECTRODE_FRAME.encode(examples["ElectrodeFrame"])
    )
    for field, value in changes.items():
        if isinstance(value, np.ndarray):
            if value.dtype != np.uint16:
                return  # the wire cannot say it
            value = value.tobytes()
        if isinstance(value, int) and value < 0:
            return
        setattr(message, field, value)
    with pytest.raises(WireError) as caught:
        ELECTRODE_FRAME.decode(message.SerializeToString())
    assert caught.value.reason == reason
    assert named in str(caught.value)
    assert caught.value.remedy.startswith("the sender breaks contract")


def touched(estimate: FeatureEstimate) -> FeatureEstimate:
    """With a centre of pressure and a contact normal, which the published example has not."""
    return dataclasses.replace(
        estimate,
        centre_of_pressure=np.array([0.001, -0.001, -0.007], np.float32),
        centre_of_pressure_sd=np.array([0.0001, 0.0002, 0.0003], np.float32),
        contact_normal=np.array([0.0, 0.6, -0.8], np.float32),
        contact_normal_sd=0.0625,
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    "field",
    [
        "force",
        "force_sd",
        "contact_location",
        "centre_of_pressure",
        "centre_of_pressure_sd",
        "contact_normal",
    ],
)
def test_non_finite_estimates_are_refused(
    examples: dict[str, Any], field: str, value: float
) -> None:
    good = touched(examples["FeatureEstimate"])
    bad = getattr(good, field).copy()
    bad[1] = value
    with pytest.raises(WireError, match=field) as caught:
        FEATURE_ESTIMATE.encode(dataclasses.replace(good, **{field: bad}))
    assert caught.value.reason == "non_finite"


def test_a_normal_and_a_centre_of_pressure_are_complete_and_of_a_contact(
    examples: dict[str, Any],
) -> None:
    good = touched(examples["FeatureEstimate"])
    decoded = FEATURE_ESTIMATE.decode(FEATURE_ESTIMATE.encode(good))
    assert decoded.contact_normal_sd == good.contact_normal_sd
    np.testing.assert_array_equal(decoded.centre_of_pressure, good.centre_of_pressure)
    lone = {"contact_location": None, "contact_location_sd": None}
    for changes, reason in (
        ({"contact_normal": np.array([0, 0, -2], np.float32)}, "normal"),
        ({"contact_normal_sd": None}, "normal"),
        ({"contact_normal_sd": -0.1}, "negative_sd"),
        ({"contact_normal_sd": np.nan}, "non_finite"),
        ({"centre_of_pressure_sd": None}, "centre"),
        ({**lone, "in_contact": False}, "centre"),
        ({**lone, "in_contact": False, "centre_of_pressure": None}, "normal"),
    ):
        with pytest.raises(WireError) as caught:
            FEATURE_ESTIMATE.encode(dataclasses.replace(good, **changes))
        assert caught.value.reason == reason, changes
    message = estimates_pb2.FeatureEstimate.FromString(FEATURE_ESTIMATE.encode(good))
    message.contact_normal.z = -2.0
    with pytest.raises(WireError, match="no unit vector"):
        FEATURE_ESTIMATE.decode(message.SerializeToString())
    message.contact_normal.z = -0.8
    message.ClearField("centre_of_pressure_sd")
    with pytest.raises(WireError, match="without centre_of_pressure_sd"):
        FEATURE_ESTIMATE.decode(message.SerializeToString())


def test_nan_in_a_field_is_refused_with_its_row(examples: dict[str, Any]) -> None:
    estimate = examples["FieldEstimate"]
    bad = estimate.displacement.copy()
    bad[2, 1] = np.nan
    with pytest.raises(WireError, match="row 2"):
        FIELD_ESTIMATE.encode(dataclasses.replace(estimate, displacement=bad))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"displacement": np.full((4, 3), np.inf, np.float32)}, "non_finite"),
        ({"displacement": np.zeros((4, 2), np.float32)}, "shape"),
        ({"displacement": np.zeros((0, 3), np.float32)}, "shape"),
        ({"displacement": np.zeros((4, 3))}, "dtype"),
        ({"mesh_sha256": bytes(31)}, "digest"),
        ({"sensor_serial": ""}, "serial"),
    ],
)
def test_a_bad_field_is_refused_on_both_sides(
    examples: dict[str, Any], changes: dict[str, Any], reason: str
) -> None:
    with pytest.raises(WireError) as caught:
        FIELD_FRAME.encode(dataclasses.replace(examples["FieldFrame"], **changes))
    assert caught.value.reason == reason
    message = frames_pb2.FieldFrame.FromString(FIELD_FRAME.encode(examples["FieldFrame"]))
    for name, value in changes.items():
        if name != "displacement":
            setattr(message, name, value)
            continue
        if value.dtype != np.float32:
            return  # the wire cannot say it
        del message.displacement[:]
        message.displacement.extend(value.ravel().tolist())
    with pytest.raises(WireError) as caught:
        FIELD_FRAME.decode(message.SerializeToString())
    assert caught.value.reason == reason


@given(
    arrays(
        np.float32,
        st.tuples(st.integers(1, 40), st.just(3)),
        elements=st.floats(width=32, allow_nan=False, allow_infinity=False),
    )
)
def test_any_finite_field_comes_through(field: Any) -> None:
    stamp = Stamp(1, 0, 0, 0, 0, Origin.SIMULATED)
    frame = FieldFrame(stamp, "BT", bytes(32), field)
    payload = FIELD_FRAME.encode(frame)
    assert same(FIELD_FRAME.decode(payload), frame)
    assert frames_pb2.FieldFrame.FromString(payload).SerializeToString() == payload


@pytest.mark.parametrize("sensor", ["", "*", "a/b", "Finger"])
def test_a_request_for_a_field_names_a_sensor_and_holds_a_frame(
    examples: dict[str, Any], sensor: str
) -> None:
    request = examples["FieldRequest"]
    with pytest.raises(WireError) as caught:
        FIELD_REQUEST.encode(dataclasses.replace(request, sensor=sensor))
    assert caught.value.reason == "sensor"
    message = service_pb2.FieldRequest.FromString(FIELD_REQUEST.encode(request))
    message.sensor = sensor
    with pytest.raises(WireError) as caught:
        FIELD_REQUEST.decode(message.SerializeToString())
    assert caught.value.reason == "sensor"
    with pytest.raises(WireError):
        FIELD_REQUEST.decode(service_pb2.FieldRequest(sensor="finger").SerializeToString())


def test_nan_on_the_wire_is_refused(examples: dict[str, Any]) -> None:
    message = frames_pb2.WrenchFrame.FromString(
        BY_NAME["WrenchFrame"].encode(examples["WrenchFrame"])
    )
    message.torque.z = float("nan")
    with pytest.raises(WireError, match="torque"):
        BY_NAME["WrenchFrame"].decode(message.SerializeToString())


@pytest.mark.parametrize(
    "stamp",
    [
        common_pb2.Stamp(),
        common_pb2.Stamp(sequence=1),
        common_pb2.Stamp(sequence=1, origin=9),  # type: ignore[arg-type]
        common_pb2.Stamp(sequence=1, origin=1, monotonic_ns=1 << 63),  # type: ignore[arg-type]
    ],
)
def test_a_stamp_without_meaning_is_refused(
    examples: dict[str, Any], stamp: common_pb2.Stamp
) -> None:
    message = frames_pb2.ElectrodeFrame.FromString(
        ELECTRODE_FRAME.encode(examples["ElectrodeFrame"])
    )
    message.stamp.CopyFrom(stamp)
    with pytest.raises(WireError) as caught:
        ELECTRODE_FRAME.decode(message.SerializeToString())
    assert caught.value.reason == "stamp"


def _flip(payload: bytes, bit: int) -> bytes:
    changed = bytearray(payload)
    changed[bit >> 3] ^= 1 << (bit & 7)
    return bytes(changed)


@pytest.mark.slow
def test_a_million_random_and_bit_flipped_payloads(examples: dict[str, Any]) -> None:
    """No crash, no exception but WireError, every reject counted, and what passes is valid."""
    random = np.random.default_rng(20261121)
    total = 1_000_000
    codecs = [(codec, codec.encode(examples[name])) for name, codec in sorted(BY_NAME.items())]
    # The hot-path message gets half of them.
    hot = (ELECTRODE_FRAME, ELECTRODE_FRAME.encode(examples["ElectrodeFrame"]))
    noise = random.bytes(1 << 20)
    accepted = 0
    rejected: dict[str, int] = {}
    choices = random.integers(0, 2 * len(codecs), total).tolist()
    kinds = random.integers(0, 4, total).tolist()
    where = random.integers(0, 1 << 19, total).tolist()
    sizes = random.integers(0, 300, total).tolist()
    for choice, kind, at, size in zip(choices, kinds, where, sizes, strict=True):
        codec, good = codecs[choice] if choice < len(codecs) else hot
        if kind == 0 or not good:
            payload = noise[at : at + size]
        elif kind == 1:
            payload = good[: size % len(good)]
        else:
            payload = _flip(good, at % (8 * len(good)))
            if kind == 3:
                payload = _flip(payload, (at * 7919) % (8 * len(good)))
        try:
            value = codec.decode(payload)
        except WireError as error:
            rejected[error.reason] = rejected.get(error.reason, 0) + 1
            continue
        accepted += 1
        if accepted % 64 == 0:  # what is accepted can be said again
            codec.decode(codec.encode(value))
    assert accepted + sum(rejected.values()) == total
    assert {"parse", "stamp", "counts_range", "electrode_count"} <= set(rejected)
    assert 0 < accepted < total


def test_every_reject_reason_is_a_name(examples: dict[str, Any]) -> None:
    with pytest.raises(PalpateError) as caught:
        ELECTRODE_FRAME.decode(b"\xff\xff")
    assert "-> " in str(caught.value)
    assert "ElectrodeFrame" in str(caught.value)
