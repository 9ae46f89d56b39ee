"""Bounds of errors: how they travel, how a bundle keeps their formulas, and what is refused."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.protos.changed_manifest import change

from palpate import codec
from palpate.errors import BundleError, WireError
from palpate.files.bundle import MANIFEST, read_bundle, write_bundle
from palpate.files.intervals import (
    DISTANCE_MOST,
    TERMS,
    BoundFormula,
    Intervals,
    bound_terms,
    bounds_of,
)
from palpate.files.manifest import Manifest
from palpate.files.tasks import TASKS
from palpate.files.training_range import (
    InputPattern,
    KnownInputs,
    known_inputs_from_bytes,
    known_inputs_to_bytes,
    pattern_terms,
)
from palpate.messages import ErrorBounds, FeatureEstimate, TrainingRange, ValueRange

BOUNDS = ErrorBounds(0.9, 0.25, 0.5, 0.0015)
FORCE = BoundFormula("force", "N", (-1.0, 0.5, 0.0, 0.0, 0.25))
PLACE = BoundFormula("contact_location", "m", (-6.0, 0.0, 0.0, 0.0, 0.0))
INTERVALS = Intervals(0.9, "presses of a test", "cd" * 32, 40, (FORCE, PLACE), (FORCE,), "fingers")


def test_bounds_travel(examples: dict[str, Any]) -> None:
    told = dataclasses.replace(examples["FeatureEstimate"], bounds=BOUNDS)
    payload = codec.FEATURE_ESTIMATE.encode(told)
    came = codec.FEATURE_ESTIMATE.decode(payload).bounds
    assert came is not None
    assert came.displacement is None
    assert not came.other_sensors
    for name in ("level", "force_magnitude", "force", "contact_location"):
        assert getattr(came, name) == pytest.approx(getattr(BOUNDS, name), rel=1e-6), name
    official = codec.FEATURE_ESTIMATE.message_type.FromString(payload)
    assert official.SerializeToString() == payload


def test_bounds_of_a_field_travel(examples: dict[str, Any]) -> None:
    bounds = ErrorBounds(0.5, displacement=2.5e-5, other_sensors=True)
    field = examples["FieldEstimate"]
    for told in (
        dataclasses.replace(field, bounds=bounds),
        dataclasses.replace(
            field, bounds=bounds, coefficients=np.ones(3, np.float32), basis_sha256=b"b" * 32
        ),
    ):
        payload = codec.FIELD_ESTIMATE.encode(told)
        came = codec.FIELD_ESTIMATE.decode(payload).bounds
        assert came is not None
        assert (came.level, came.other_sensors, came.force) == (0.5, True, None)
        assert came.displacement == pytest.approx(2.5e-5)
        official = codec.FIELD_ESTIMATE.message_type.FromString(payload)
        assert official.SerializeToString() == payload


@pytest.mark.parametrize("name", ["FeatureEstimate", "FieldEstimate"])
def test_an_estimate_of_an_older_service_has_no_bounds(name: str, examples: dict[str, Any]) -> None:
    of: Any = codec.FEATURE_ESTIMATE if name == "FeatureEstimate" else codec.FIELD_ESTIMATE
    came: Any = of.decode(of.encode(examples[name]))
    assert came.bounds is None


@pytest.mark.parametrize(
    "changes",
    [
        {"level": 0.0},
        {"level": 1.0},
        {"level": math.nan},
        {"force": -0.1},
        {"force": math.nan},
        {"force_magnitude": math.inf},
        {"contact_location": -1e-9},
        {"displacement": 1e38},
    ],
)
def test_bounds_that_are_none(examples: dict[str, Any], changes: dict[str, Any]) -> None:
    told = dataclasses.replace(
        examples["FeatureEstimate"], bounds=dataclasses.replace(BOUNDS, **changes)
    )
    with pytest.raises(WireError) as caught:
        codec.FEATURE_ESTIMATE.encode(told)
    assert caught.value.reason == "bounds"
    message: Any = codec.FEATURE_ESTIMATE.message_type.FromString(
        codec.FEATURE_ESTIMATE.encode(dataclasses.replace(told, bounds=BOUNDS))
    )
    for key, value in changes.items():
        setattr(message.bounds, key, value)
    with pytest.raises(WireError) as caught:
        codec.FEATURE_ESTIMATE.decode(message.SerializeToString())
    assert caught.value.reason == "bounds"


def test_no_bound_of_a_place_without_a_place(examples: dict[str, Any]) -> None:
    nowhere = dataclasses.replace(
        examples["FeatureEstimate"], contact_location=None, contact_location_sd=None, bounds=BOUNDS
    )
    with pytest.raises(WireError, match="contact_location"):
        codec.FEATURE_ESTIMATE.encode(nowhere)
    message: Any = codec.FEATURE_ESTIMATE.message_type.FromString(
        codec.FEATURE_ESTIMATE.encode(dataclasses.replace(nowhere, bounds=None))
    )
    message.bounds.level, message.bounds.contact_location = 0.9, 0.001
    with pytest.raises(WireError, match="contact_location"):
        codec.FEATURE_ESTIMATE.decode(message.SerializeToString())


def test_the_interval_of_a_force_does_not_go_below_zero(examples: dict[str, Any]) -> None:
    estimate: FeatureEstimate = examples["FeatureEstimate"]
    length = float(np.linalg.norm(estimate.force))
    assert estimate.force_interval is None
    close = dataclasses.replace(estimate, bounds=BOUNDS).force_interval
    assert close == pytest.approx((length - 0.25, length + 0.25))
    wide = dataclasses.replace(estimate, bounds=ErrorBounds(0.9, 100.0))
    assert wide.force_interval == pytest.approx((0.0, length + 100.0))


def test_a_formula_is_an_exponential_of_its_terms() -> None:
    terms = bound_terms(math.e - 1.0, -2.0, 0.5)
    assert terms == pytest.approx((1.0, 1.0, 0.0, -2.0, 0.5))
    assert bound_terms(7.0, 0.0, 0.0)[1:3] == pytest.approx((math.log(8.0), math.log(2.0)))
    assert FORCE.bound(terms) == pytest.approx(math.exp(-1.0 + 0.5 + 0.125))
    # Far away nothing is known: it does not go on growing, and is finite in any case.
    far, farther = (FORCE.bound(bound_terms(1.0, 0.0, d)) for d in (DISTANCE_MOST, 1e9))
    assert far == farther
    steep = BoundFormula("force", "N", (1e6, 0.0, 0.0, 0.0, 0.0))
    assert math.isfinite(steep.bound(terms))


def test_which_bounds_an_estimate_gets() -> None:
    terms = bound_terms(1.0, 0.0, 0.2)
    own = bounds_of(INTERVALS, terms, others=False)
    assert own is not None
    assert (own.level, own.other_sensors) == (0.9, False)
    assert own.contact_location == pytest.approx(math.exp(-6.0))
    untouched = bounds_of(INTERVALS, terms, others=False, contact=False)
    assert untouched is not None
    assert untouched.contact_location is None
    other = bounds_of(INTERVALS, terms, others=True)
    assert other is not None
    assert (other.other_sensors, other.contact_location) == (True, None)
    assert other.force == own.force  # never closer than for its own sensors
    silent = dataclasses.replace(INTERVALS, others=())
    assert bounds_of(silent, terms, others=True) is None


PATTERN = InputPattern(60.0, np.zeros(209, np.float32), np.eye(209, dtype=np.float32), 2.0)
KNOWN = KnownInputs(np.zeros((1, 19), np.float32), 30.0, 1.0, PATTERN)
RANGE = TrainingRange(
    "a test",
    "ab" * 32,
    10,
    (ValueRange("electrodes", "tared counts", (-9.0,) * 19, (9.0,) * 19),),
    (),
    True,
)


def _write(folder: Path, known: KnownInputs | None = KNOWN, **changes: Any) -> Path:
    task = TASKS["features"]
    golden = {t.name: np.zeros((1, t.shape[1]), np.float32) for t in task.outputs}
    golden["electrodes"] = np.zeros((1, 19), np.float32)
    manifest = Manifest(
        "test", 1, "features", task.inputs, task.outputs, "BIOTAC", 0.1, "ab" * 32, "nothing", {},
        "", "", "2026-01-01T00:00:00Z", "0", 17,
    )  # fmt: skip
    known_range = None if known is None else RANGE
    manifest = dataclasses.replace(manifest, training_range=known_range, **changes)
    write_bundle(folder, model=b"onnx", golden=golden, manifest=manifest, known_inputs=known)
    return folder


def test_a_bundle_keeps_formulas_and_pattern(tmp_path: Path) -> None:
    bundle = read_bundle(_write(tmp_path / "1", intervals=INTERVALS))
    assert bundle.manifest.intervals == INTERVALS
    assert bundle.known_inputs is not None
    pattern = bundle.known_inputs.pattern
    assert pattern is not None
    assert (pattern.scale, pattern.most) == (60.0, 2.0)
    np.testing.assert_array_equal(pattern.weights, PATTERN.weights)
    older = _write(tmp_path / "2", dataclasses.replace(KNOWN, pattern=None))
    assert read_bundle(older).manifest.intervals is None
    assert "intervals" not in json.loads((older / MANIFEST).read_text())


def test_formulas_need_the_distance_that_they_are_of(tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="intervals need the distance"):
        _write(tmp_path / "1", None, intervals=INTERVALS)


@pytest.mark.parametrize(
    ("where", "value", "problem"),
    [
        (("level",), 1.0, "level is 1"),
        (("level",), "high", "level is 'high'"),
        (("presses",), 0, "presses is 0"),
        (("presses",), True, "presses is True"),
        (("source",), 7, "source is no text"),
        (("formulas",), {}, "no list"),
        (("formulas", 0), 5, "no formula"),
        (("formulas", 0, "name"), "displacement", "no bound here"),
        (("formulas", 0, "name"), "contact_location", "no bound here"),
        (("formulas", 0, "unit"), "mN", "no bound here"),
        (("formulas", 1, "weights"), [1.0], f"not {len(TERMS)} finite"),
        (("formulas", 1, "weights"), [1e9] * len(TERMS), f"not {len(TERMS)} finite"),
        (("formulas", 1, "weights"), [True] * len(TERMS), f"not {len(TERMS)} finite"),
        (("others", 0, "weights"), "12345", f"not {len(TERMS)} finite"),
        (("formulas",), [dataclasses.asdict(FORCE)] * 2, "two formulas"),
        (("others_source",), None, "others_source is no text"),
    ],
)
def test_intervals_that_are_none(
    tmp_path: Path, where: tuple[Any, ...], value: object, problem: str
) -> None:
    folder = _write(tmp_path / "1", intervals=INTERVALS)
    change(folder, ("intervals", *where), value)
    with pytest.raises(BundleError) as caught:
        read_bundle(folder)
    assert problem in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"centre": np.zeros(208, np.float32)}, r"pattern_centre is float32\[208\]"),
        ({"weights": np.zeros((209, 19), np.float32)}, "pattern_weights is"),
        ({"weights": np.zeros((209, 209))}, "float64"),
        ({"weights": np.full((209, 209), np.nan, np.float32)}, "pattern_weights holds NaN"),
        ({"most": 0.0}, "pattern_most is 0"),
        ({"scale": math.inf}, "pattern_scale is inf"),
    ],
)
def test_a_pattern_that_is_none(changes: dict[str, Any], problem: str) -> None:
    pattern = dataclasses.replace(PATTERN, **changes)
    data = known_inputs_to_bytes(dataclasses.replace(KNOWN, pattern=pattern))
    with pytest.raises(BundleError, match=problem):
        known_inputs_from_bytes(data, 19, "range.npz")


def test_half_a_pattern_is_none(tmp_path: Path) -> None:
    path = tmp_path / "range.npz"
    np.savez(
        path,
        prototypes=KNOWN.prototypes,
        scale=30.0,
        distance_max=1.0,
        pattern_centre=PATTERN.centre,
    )
    with pytest.raises(BundleError, match="not a training range"):
        known_inputs_from_bytes(path.read_bytes(), 19, "range.npz")


def test_terms_of_a_pattern_are_values_and_products() -> None:
    terms = pattern_terms(np.array([2.0, 3.0, 5.0], np.float32))
    assert terms.tolist() == [2, 3, 5, 4, 6, 10, 9, 15, 25]
    rows = np.arange(6, dtype=np.float32).reshape(2, 3)
    together = pattern_terms(rows)
    assert together.shape == (2, 9)
    np.testing.assert_array_equal(together[1], pattern_terms(rows[1]))
