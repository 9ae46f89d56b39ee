"""Electrodes -> field -> electrodes as pure functions: right, the same again, or refused."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.codec import FIELD_ESTIMATE, SYNTHESIS_ESTIMATE
from palpate.errors import BundleError
from palpate.files.bundle import read_bundle
from palpate.messages import (
    ElectrodeFrame,
    FieldEstimate,
    SensorType,
    SynthesisEstimate,
    Tare,
)
from palpate_services.inference.estimates import (
    EstimateRefusal,
    estimate_field,
    synthesise,
    tared_counts,
)
from palpate_services.inference.model import Runtime, load

bundles: Any = importlib.import_module("field_bundles")

Frames = Callable[..., ElectrodeFrame]
Tares = Callable[..., Tare]


@pytest.fixture
def field_runtime(tmp_path: Path) -> Runtime:
    return load(read_bundle(bundles.write(tmp_path / "field", "field")), "field")


@pytest.fixture
def synthesis_runtime(tmp_path: Path) -> Runtime:
    return load(read_bundle(bundles.write(tmp_path / "synthesis", "synthesis")), "synthesis")


def test_field_is_the_models_answer_on_its_mesh(
    field_runtime: Runtime, make_frame: Frames, make_tare: Tares
) -> None:
    frame, tare = make_frame(60), make_tare()
    answer = estimate_field(frame, tare, field_runtime)
    assert isinstance(answer, FieldEstimate)
    assert answer.source == frame.stamp
    assert (answer.sensor_serial, answer.tare_id) == (frame.sensor_serial, tare.tare_id)
    assert answer.bundle_sha256 == field_runtime.sha256
    assert answer.mesh_sha256 == bundles.skin().sha256
    sample = tared_counts(frame, tare)
    found = bundles.matrices("field")
    wanted = (sample @ found["displacement"]).reshape(bundles.NODES, 3)
    np.testing.assert_allclose(answer.displacement, wanted, rtol=1e-4, atol=1e-9)
    assert answer.displacement_sd is not None
    np.testing.assert_allclose(
        answer.displacement_sd, np.abs(sample @ found["displacement_sd"]), rtol=1e-4, atol=1e-9
    )
    FIELD_ESTIMATE.encode(answer)


def test_field_without_deviations(tmp_path: Path, make_frame: Frames, make_tare: Tares) -> None:
    folder = bundles.write(tmp_path / "field", "field", deviation=False)
    answer = estimate_field(make_frame(), make_tare(), load(read_bundle(folder), "field"))
    assert isinstance(answer, FieldEstimate)
    assert answer.displacement_sd is None


def test_synthesis_of_a_known_and_of_an_estimated_field(
    synthesis_runtime: Runtime, make_frame: Frames
) -> None:
    stamp = make_frame(3).stamp
    known = synthesise(bundles.truth(stamp), synthesis_runtime)
    estimated = synthesise(bundles.guess(stamp), synthesis_runtime)
    assert isinstance(known, SynthesisEstimate)
    assert isinstance(estimated, SynthesisEstimate)
    assert known.source == stamp
    assert known.mesh_sha256 == bundles.skin().sha256
    wanted = bundles.pressed(1e-3).reshape(-1) @ bundles.matrices("synthesis")["tared_counts"]
    np.testing.assert_allclose(known.tared_counts, wanted, rtol=1e-3, atol=1e-4)
    assert SYNTHESIS_ESTIMATE.encode(known) == SYNTHESIS_ESTIMATE.encode(estimated)


def test_the_same_input_gives_the_same_bytes(
    tmp_path: Path, make_frame: Frames, make_tare: Tares
) -> None:
    folders = [bundles.write(tmp_path / task, task) for task in ("field", "synthesis")]
    frames, tare = [make_frame(n, monotonic_ns=n) for n in range(1, 60)], make_tare()

    def payloads() -> list[bytes]:
        to_field = load(read_bundle(folders[0]), "field")
        to_counts = load(read_bundle(folders[1]), "synthesis")
        out = []
        for frame in frames:
            field = estimate_field(frame, tare, to_field)
            assert isinstance(field, FieldEstimate)
            counts = synthesise(field, to_counts)
            assert isinstance(counts, SynthesisEstimate)
            out += [FIELD_ESTIMATE.encode(field), SYNTHESIS_ESTIMATE.encode(counts)]
        return out

    first = payloads()
    assert first == payloads()
    assert len(set(first)) == len(first)


def test_frames_that_get_no_field(
    field_runtime: Runtime, make_frame: Frames, make_tare: Tares
) -> None:
    good, tare = make_frame().validity, make_tare()

    def refusal(frame: ElectrodeFrame, of: Tare | None = tare) -> object:
        return estimate_field(frame, of, field_runtime)

    assert refusal(make_frame(), None) is EstimateRefusal.UNTARED
    assert refusal(make_frame(tare_id=0)) is EstimateRefusal.UNTARED
    assert refusal(make_frame(tare_id=6)) is EstimateRefusal.UNTARED
    assert refusal(make_frame(validity=good ^ 4)) is EstimateRefusal.INVALID_CHANNELS
    assert refusal(make_frame(sensor_type=SensorType.BIOTAC_SP)) is EstimateRefusal.WRONG_SENSOR
    tare.electrodes[3] = np.inf
    assert refusal(make_frame()) is EstimateRefusal.NON_FINITE


def test_negative_deviation_among_many_values_is_no_answer(
    tmp_path: Path, make_frame: Frames, make_tare: Tares
) -> None:
    folder = bundles.write(tmp_path / "field", "field", signed=True)
    runtime = load(read_bundle(folder), "field")
    assert estimate_field(make_frame(60), make_tare(), runtime) is EstimateRefusal.NON_FINITE


def test_fields_that_get_no_counts(synthesis_runtime: Runtime, make_frame: Frames) -> None:
    field = bundles.truth(make_frame().stamp)
    other = dataclasses.replace(field, mesh_sha256=bytes(32))
    short = dataclasses.replace(field, displacement=field.displacement[:-1])
    broken = dataclasses.replace(field, displacement=field.displacement.copy())
    broken.displacement[7, 1] = np.nan
    assert synthesise(other, synthesis_runtime) is EstimateRefusal.WRONG_MESH
    assert synthesise(short, synthesis_runtime) is EstimateRefusal.WRONG_MESH
    assert synthesise(broken, synthesis_runtime) is EstimateRefusal.NON_FINITE


def test_a_model_wider_than_its_mesh_is_not_served(tmp_path: Path) -> None:
    spoiled = bundles.model("field", deviation=True, extra=3)
    folder = bundles.write(tmp_path / "field", "field", spoiled=spoiled)
    with pytest.raises(BundleError, match=r"displacement float32\[-1, 183\]"):
        load(read_bundle(folder), "field")
