"""Flags, names and coefficients of estimates, and the questions for one: what the contract says."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from palpate import codec
from palpate.errors import WireError
from palpate.messages import (
    ContactDescription,
    FieldEstimate,
    ModeBasis,
    QualityFlag,
    SimulationParameters,
    SimulationRequest,
    StageTimings,
    SynthesisRequest,
    TrainingRange,
    ValueRange,
)
from palpate.v1 import estimates_pb2, requests_pb2

ESTIMATES = ("FeatureEstimate", "FieldEstimate", "SynthesisEstimate")
CODECS: dict[str, codec.Codec[Any]] = {one.schema.rpartition(".")[2]: one for one in codec.CODECS}
FLAGS = (QualityFlag.SATURATED, QualityFlag.OUT_OF_RANGE, QualityFlag.EXTRAPOLATING)


@pytest.mark.parametrize("name", ESTIMATES)
def test_flags_and_the_bundles_name_travel(name: str, examples: dict[str, Any]) -> None:
    told = dataclasses.replace(
        examples[name], quality=FLAGS, bundle_name="features-virtual", bundle_version=7
    )
    payload = CODECS[name].encode(told)
    came = CODECS[name].decode(payload)
    assert (came.quality, came.bundle_name, came.bundle_version) == (FLAGS, "features-virtual", 7)
    official = CODECS[name].message_type.FromString(payload)
    assert official.SerializeToString() == payload


@pytest.mark.parametrize("name", ESTIMATES)
def test_an_estimate_of_an_older_service_has_no_flags(name: str, examples: dict[str, Any]) -> None:
    came = CODECS[name].decode(CODECS[name].encode(examples[name]))
    assert (came.quality, came.bundle_name, came.bundle_version) == ((), "", 0)


@pytest.mark.parametrize("name", ESTIMATES)
def test_a_flag_of_a_newer_service_is_a_flag(name: str, examples: dict[str, Any]) -> None:
    message: Any = CODECS[name].message_type.FromString(CODECS[name].encode(examples[name]))
    message.quality.extend([77, 5, 78])
    came = CODECS[name].decode(message.SerializeToString())
    assert came.quality == (QualityFlag.UNKNOWN, QualityFlag.EXTRAPOLATING)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"quality": FLAGS[::-1]}, "quality"),
        ({"quality": (FLAGS[0], FLAGS[0])}, "quality"),
        ({"bundle_name": "x" * 65}, "bundle"),
        ({"bundle_name": "evil\x1b[2J"}, "bundle"),
        ({"bundle_version": -1}, "bundle"),
    ],
)
@pytest.mark.parametrize("name", ESTIMATES)
def test_what_an_estimate_may_not_say(
    name: str, changes: dict[str, Any], reason: str, examples: dict[str, Any]
) -> None:
    with pytest.raises(WireError) as caught:
        CODECS[name].encode(dataclasses.replace(examples[name], **changes))
    assert caught.value.reason == reason


def _reduced(whole: FieldEstimate) -> FieldEstimate:
    return dataclasses.replace(
        whole,
        displacement=np.zeros((0, 3), np.float32),
        displacement_sd=None,
        contact_force=None,
        coefficients=np.array([1e-3, -2e-4], np.float32),
        basis_sha256=bytes(range(32)),
    )


def test_a_field_travels_with_its_coefficients_or_as_them_alone(examples: dict[str, Any]) -> None:
    whole: FieldEstimate = examples["FieldEstimate"]
    reduced = _reduced(whole)
    both = dataclasses.replace(
        whole, coefficients=reduced.coefficients, basis_sha256=reduced.basis_sha256
    )
    for sent in (both, reduced):
        payload = codec.FIELD_ESTIMATE.encode(sent)
        official = estimates_pb2.FieldEstimate.FromString(payload)
        assert official.SerializeToString() == payload
        came = codec.FIELD_ESTIMATE.decode(payload)
        assert came.coefficients is not None
        np.testing.assert_array_equal(came.coefficients, sent.coefficients)
        np.testing.assert_array_equal(came.displacement, sent.displacement)
        assert came.basis_sha256 == sent.basis_sha256


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"coefficients": None}, "basis"),
        ({"basis_sha256": b""}, "digest"),
        ({"coefficients": None, "basis_sha256": b""}, "shape"),
        ({"displacement_sd": np.zeros(0, np.float32)}, "shape"),
        ({"coefficients": np.array([np.nan], np.float32)}, "non_finite"),
    ],
)
def test_a_reduced_field_that_says_too_little(
    changes: dict[str, Any], reason: str, examples: dict[str, Any]
) -> None:
    with pytest.raises(WireError) as caught:
        codec.FIELD_ESTIMATE.encode(
            dataclasses.replace(_reduced(examples["FieldEstimate"]), **changes)
        )
    assert caught.value.reason == reason


def test_a_basis_in_parts_and_what_it_decodes(examples: dict[str, Any]) -> None:
    part: ModeBasis = examples["FieldBasis"]
    assert part.mean is not None
    later = ModeBasis(part.basis_sha256, part.mesh_sha256, None, part.modes[:1] * 2, 3, 2)
    came = [codec.FIELD_BASIS.decode(codec.FIELD_BASIS.encode(one)) for one in (part, later)]
    assert [len(one.modes) for one in came] == [2, 1]
    modes = np.concatenate([one.modes for one in came])
    whole = dataclasses.replace(part, modes=modes, more=False)
    field = whole.decode(np.array([1.0, 0.5, -0.25], np.float32))
    np.testing.assert_allclose(
        field, part.mean + modes[0] + 0.5 * modes[1] - 0.25 * modes[2], rtol=1e-6
    )
    with pytest.raises(ValueError, match="part of a basis"):
        part.decode(np.zeros(3, np.float32))
    with pytest.raises(ValueError, match="of 3 modes"):
        whole.decode(np.zeros(2, np.float32))


@pytest.mark.parametrize(
    "changes",
    [{"more": False}, {"modes_total": 1}, {"first_mode": 1}, {"mean": None}],
)
def test_parts_of_a_basis_that_do_not_fit(
    changes: dict[str, Any], examples: dict[str, Any]
) -> None:
    with pytest.raises(WireError):
        codec.FIELD_BASIS.encode(dataclasses.replace(examples["FieldBasis"], **changes))


def test_a_synthesis_is_asked_for_from_three_sources(examples: dict[str, Any]) -> None:
    contact = ContactDescription("cube", (0.0, 0.0, -0.01), (0.0, 0.1, 2.0), depth_m=0.001)
    simulation: SimulationRequest = examples["SimulationRequest"]
    for source in (examples["FieldFrame"], contact, simulation):
        request = SynthesisRequest(source, "slow-twin", 12.5, request_id="mine")
        payload = codec.SYNTHESIS_REQUEST.encode(request)
        came = codec.SYNTHESIS_REQUEST.decode(payload)
        assert type(came.source) is type(source)
        assert (came.simulator, came.deadline_s, came.every_step) == ("slow-twin", 12.5, False)
        assert came.request_id == "mine"
    assert codec.SYNTHESIS_REQUEST.decode(payload).source == simulation
    assert isinstance(simulation.parameters, SimulationParameters)
    nameless = requests_pb2.SynthesisRequest.FromString(payload)
    nameless.ClearField("simulator")
    assert codec.SYNTHESIS_REQUEST.decode(nameless.SerializeToString()).simulator == "twin"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"depth_m": None}, "contact"),
        ({"force_n": 2.0}, "contact"),
        ({"depth_m": -1e-3}, "contact"),
        ({"depth_m": float("nan")}, "contact"),
        ({"location": (0.0, 1.0)}, "shape"),
        ({"direction": (0.0, 0.0, 0.0)}, "contact"),
        ({"direction": (0.0, float("inf"), 0.0)}, "shape"),
        ({"indenter": ""}, "serial"),
    ],
)
def test_contacts_that_describe_nothing(changes: dict[str, Any], reason: str) -> None:
    contact = ContactDescription("cube", (0.0, 0.0, -0.01), depth_m=0.001)
    with pytest.raises(WireError) as caught:
        codec.SYNTHESIS_REQUEST.encode(SynthesisRequest(dataclasses.replace(contact, **changes)))
    assert caught.value.reason == reason


def test_a_request_without_a_source_is_refused() -> None:
    with pytest.raises(WireError) as caught:
        codec.SYNTHESIS_REQUEST.decode(requests_pb2.SynthesisRequest().SerializeToString())
    assert caught.value.reason == "source"


def test_timings_are_finite_and_not_negative() -> None:
    good = StageTimings(None, 0.0, 1e-5, 2e-5, 3e-4, 1e-5)
    assert codec.STAGE_TIMINGS.decode(codec.STAGE_TIMINGS.encode(good)).age_at_arrival_s is None
    for bad in (float("nan"), float("inf"), -1e-6):
        with pytest.raises(WireError):
            codec.STAGE_TIMINGS.encode(dataclasses.replace(good, infer_s=bad))


def test_metadata_says_what_the_bundle_was_trained_on(examples: dict[str, Any]) -> None:
    known = TrainingRange(
        "the virtual finger",
        "ab" * 32,
        112_139,
        (ValueRange("electrodes", "tared counts", (-400.0,) * 19, (50.0,) * 19),),
        (ValueRange("force", "N", length_max=31.5),),
        True,
    )
    told = dataclasses.replace(
        examples["ModelMetadata"],
        training_range=known,
        mesh_sha256=bytes(32),
        basis_sha256=bytes(range(32)),
        modes=64,
    )
    came = codec.MODEL_METADATA.decode(codec.MODEL_METADATA.encode(told))
    assert came.training_range == known
    assert (came.mesh_sha256, came.basis_sha256, came.modes) == (bytes(32), bytes(range(32)), 64)
    uneven = dataclasses.replace(known, inputs=(ValueRange("electrodes", "", (1.0,), ()),))
    with pytest.raises(WireError):
        codec.MODEL_METADATA.decode(
            codec.MODEL_METADATA.encode(dataclasses.replace(told, training_range=uneven))
        )
