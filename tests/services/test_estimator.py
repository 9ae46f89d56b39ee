"""The estimator: pure, and silent rather than wrong."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.codec import FEATURE_ESTIMATE
from palpate.errors import BundleError
from palpate.files.bundle import Bundle, read_bundle
from palpate.files.tasks import TASKS
from palpate.messages import ElectrodeFrame, FeatureEstimate, SensorType, Tare
from palpate_services.inference.estimates import EstimateRefusal, estimate, tared_counts
from palpate_services.inference.model import Runtime, load

Frames = Callable[..., ElectrodeFrame]

FEATURES = TASKS["features"]
EVERY_OUTPUT = tuple(tensor.name for tensor in (*FEATURES.outputs, *FEATURES.optional))


@pytest.fixture
def runtime(bundle: Bundle) -> Runtime:
    return load(bundle, "features")


def test_tared_counts_are_raw_minus_baseline(
    make_frame: Frames, make_tare: Callable[..., Tare]
) -> None:
    frame, tare = make_frame(30), make_tare()
    tared = tared_counts(frame, tare)
    assert tared.dtype == np.float32
    np.testing.assert_array_equal(tared, frame.electrodes.astype(np.float32) - tare.electrodes)


def test_estimate_carries_its_source(
    runtime: Runtime, make_frame: Frames, make_tare: Callable[..., Tare]
) -> None:
    frame, tare = make_frame(60), make_tare()
    answer = estimate(frame, tare, runtime)
    assert isinstance(answer, FeatureEstimate)
    assert answer.source == frame.stamp
    assert answer.sensor_serial == frame.sensor_serial
    assert answer.bundle_sha256 == runtime.sha256
    assert answer.tare_id == tare.tare_id
    model = runtime.run(tared_counts(frame, tare))
    assert model is not None
    np.testing.assert_array_equal(answer.force, model["force"])


def test_same_input_gives_the_same_bytes(
    bundle: Bundle, make_frame: Frames, make_tare: Callable[..., Tare]
) -> None:
    frames, tare = [make_frame(n, monotonic_ns=n) for n in range(1, 200)], make_tare()

    def payloads() -> list[bytes]:
        runtime = load(bundle, "features")
        answers = (estimate(frame, tare, runtime) for frame in frames)
        return [FEATURE_ESTIMATE.encode(a) for a in answers if isinstance(a, FeatureEstimate)]

    assert payloads() == payloads()


def test_no_contact_no_location(
    make_bundle: Callable[..., Path], make_frame: Frames, make_tare: Callable[..., Tare]
) -> None:
    frame, tare = make_frame(60), make_tare()
    deaf = load(read_bundle(make_bundle(contact_threshold_n=1e3)), "features")
    keen = load(read_bundle(make_bundle(contact_threshold_n=0.0)), "features")
    below, above = estimate(frame, tare, deaf), estimate(frame, tare, keen)
    assert isinstance(below, FeatureEstimate)
    assert isinstance(above, FeatureEstimate)
    assert not below.in_contact
    assert below.contact_location is None
    assert below.contact_location_sd is None
    assert above.in_contact
    assert above.contact_location is not None
    assert above.contact_location_sd is not None


@pytest.mark.parametrize("tare_id", [0, 6])
def test_frame_without_its_tare(
    runtime: Runtime, make_frame: Frames, make_tare: Callable[..., Tare], tare_id: int
) -> None:
    assert estimate(make_frame(tare_id=tare_id), make_tare(5), runtime) is EstimateRefusal.UNTARED
    assert estimate(make_frame(), None, runtime) is EstimateRefusal.UNTARED


def test_one_bad_electrode_is_enough(
    runtime: Runtime, make_frame: Frames, make_tare: Callable[..., Tare]
) -> None:
    good = make_frame().validity
    bad_electrode = make_frame(validity=good & ~(1 << 7))
    bad_pac = make_frame(validity=good & ~(1 << 30))
    assert estimate(bad_electrode, make_tare(), runtime) is EstimateRefusal.INVALID_CHANNELS
    assert isinstance(estimate(bad_pac, make_tare(), runtime), FeatureEstimate)


def test_another_type_of_sensor(
    runtime: Runtime, make_frame: Frames, make_tare: Callable[..., Tare]
) -> None:
    frame = make_frame(sensor_type=SensorType.BIOTAC_SP)
    assert estimate(frame, make_tare(), runtime) is EstimateRefusal.WRONG_SENSOR


def test_answer_that_is_not_finite(
    runtime: Runtime, make_frame: Frames, make_tare: Callable[..., Tare]
) -> None:
    tare = make_tare()
    tare.electrodes[3] = np.inf  # the codec refuses such a tare; the estimator does not rely on it
    assert estimate(make_frame(), tare, runtime) is EstimateRefusal.NON_FINITE


def test_centre_of_pressure_and_contact_normal_are_those_of_the_model(
    make_bundle: Callable[..., Path],
    recipe: Any,
    make_frame: Frames,
    make_tare: Callable[..., Tare],
) -> None:
    every = recipe(outputs=EVERY_OUTPUT)
    frame, tare = make_frame(60), make_tare()
    keen = load(read_bundle(make_bundle(every, contact_threshold_n=0.0)), "features")
    answer = estimate(frame, tare, keen)
    model = keen.run(tared_counts(frame, tare))
    assert isinstance(answer, FeatureEstimate)
    assert model is not None
    np.testing.assert_array_equal(answer.centre_of_pressure, model["centre_of_pressure"])
    np.testing.assert_array_equal(answer.centre_of_pressure_sd, model["centre_of_pressure_sd"])
    np.testing.assert_array_equal(answer.contact_normal, model["contact_normal"])
    assert answer.contact_normal_sd == model["contact_normal_sd"][0]
    assert FEATURE_ESTIMATE.decode(FEATURE_ESTIMATE.encode(answer)).contact_normal is not None
    deaf = load(read_bundle(make_bundle(every, contact_threshold_n=1e3)), "features")
    nothing = estimate(frame, tare, deaf)
    assert isinstance(nothing, FeatureEstimate)
    for name in EVERY_OUTPUT[2:]:
        assert getattr(nothing, name) is None, name


def test_a_contact_normal_that_is_no_unit_vector_is_no_estimate(
    make_bundle: Callable[..., Path], recipe: Any
) -> None:
    bundle = read_bundle(make_bundle(recipe(outputs=EVERY_OUTPUT, long_normal=True)))
    with pytest.raises(BundleError, match="no unit vector"):
        load(bundle, "features")
