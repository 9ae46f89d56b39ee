"""Flags of an estimate: each on what it is for, none on what is in order."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.codec import FEATURE_ESTIMATE
from palpate.files.bundle import Bundle, read_bundle
from palpate.files.training_range import KnownInputs
from palpate.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    FloatArray,
    QualityFlag,
    SensorType,
    Tare,
    TrainingRange,
    ValueRange,
)
from palpate_services.inference.estimates import TARE_TDC_COUNTS, EstimateRefusal, estimate
from palpate_services.inference.model import MARGIN, RangeCheck, Runtime, load
from palpate_services.inference.repository import resolve

Frames = Callable[..., ElectrodeFrame]
Tares = Callable[..., Tare]

SATURATED, UNTARED = QualityFlag.SATURATED, QualityFlag.UNTARED
OUT_OF_RANGE, EXTRAPOLATING = QualityFlag.OUT_OF_RANGE, QualityFlag.EXTRAPOLATING
UNKNOWN_RANGE = QualityFlag.RANGE_UNKNOWN

ENDS = ValueRange("electrodes", "tared counts", (-100.0,) * 19, (50.0,) * 19)
FORCE = ValueRange("force", "N", (-5.0,) * 3, (5.0,) * 3, 6.0)
WHERE = ValueRange("contact_location", "m", (-0.01,) * 3, (0.01,) * 3)
KNOWN = TrainingRange("a test", "ab" * 32, 10, (ENDS,), (FORCE, WHERE), True)
INPUTS = KnownInputs(
    np.stack([np.zeros(19), np.full(19, -1.0)]).astype(np.float32), 30.0, distance_max=1.0
)


def _check(
    sample: FloatArray,
    *,
    force: tuple[float, float, float] = (1.0, 0.0, 0.0),
    location: tuple[float, float, float] = (0.0, 0.0, 0.0),
    without: tuple[str, ...] = (),
    check: RangeCheck | None = None,
) -> tuple[QualityFlag, ...]:
    outputs = {
        "force": np.array(force, np.float32),
        "contact_location": np.array(location, np.float32),
    }
    return (check or RangeCheck(KNOWN, INPUTS)).flags(sample, outputs, without=without)


def _sample(value: float = 0.0, **electrodes: float) -> FloatArray:
    sample = np.full(19, value, np.float32)
    for name, one in electrodes.items():
        sample[int(name[1:]) - 1] = one
    return sample


def test_what_was_trained_on_has_no_flag() -> None:
    assert _check(_sample()) == ()
    assert _check(_sample(np.sinh(-1.0) * 30.0)) == ()


def test_a_value_beyond_its_ends_is_out_of_range() -> None:
    only_ends = RangeCheck(KNOWN, None)
    beyond = -100.0 - MARGIN * 150.0
    assert _check(_sample(e7=beyond + 0.1), check=only_ends) == ()
    assert _check(_sample(e7=beyond - 0.1), check=only_ends) == (OUT_OF_RANGE,)
    assert _check(_sample(e1=50.0 + MARGIN * 150.0 + 0.1), check=only_ends) == (OUT_OF_RANGE,)


def test_values_that_never_occur_together_are_out_of_range() -> None:
    """Each electrode is within its ends; so many of them at once were never seen."""
    odd = np.where(np.arange(19) % 2, -90.0, 40.0).astype(np.float32)
    assert _check(odd, check=RangeCheck(KNOWN, None)) == ()
    assert _check(odd) == (OUT_OF_RANGE,)


def test_the_distance_is_from_the_nearest_representative() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        sample = rng.normal(-20, 25, 19).astype(np.float32)
        compressed = np.arcsinh(sample / 30.0)
        nearest = np.linalg.norm(INPUTS.prototypes - compressed, axis=1).min()
        ends = ((sample < -107.5) | (sample > 57.5)).any()
        assert (_check(sample) == (OUT_OF_RANGE,)) == bool(nearest > 1.0 or ends)


@pytest.mark.parametrize(
    ("outputs", "flags"),
    [
        ({"force": (0.0, 0.0, 5.4)}, ()),
        ({"force": (0.0, 0.0, 5.6)}, (EXTRAPOLATING,)),
        ({"force": (4.5, 4.5, 0.0)}, (EXTRAPOLATING,)),  # each within its ends, 6.4 N together
        ({"location": (0.0, 0.0115, 0.0)}, (EXTRAPOLATING,)),
        ({"location": (0.0, 0.0115, 0.0), "without": ("contact_location",)}, ()),
    ],
)
def test_an_output_beyond_the_training_is_extrapolated(
    outputs: dict[str, Any], flags: tuple[QualityFlag, ...]
) -> None:
    assert _check(_sample(), **outputs) == flags


def test_both_may_be_true() -> None:
    assert _check(_sample(e3=-500.0), force=(9.0, 0.0, 0.0)) == (OUT_OF_RANGE, EXTRAPOLATING)


def test_a_bundle_that_does_not_say_is_flagged_itself(
    bundle: Bundle, make_frame: Frames, make_tare: Tares
) -> None:
    runtime = load(bundle, "features")
    answer = estimate(make_frame(60), make_tare(), runtime)
    assert isinstance(answer, FeatureEstimate)
    assert answer.quality == (UNKNOWN_RANGE,)
    assert (answer.bundle_name, answer.bundle_version) == ("test", 1)
    assert runtime.metadata().training_range is None


@pytest.fixture
def runtime(make_bundle: Callable[..., Path]) -> Runtime:
    """A bundle whose range is so wide that nothing is beyond it."""
    wide = dataclasses.replace(ENDS, low=(-5000.0,) * 19, high=(5000.0,) * 19)
    known = TrainingRange("a test", "ab" * 32, 10, (wide,), (), False)
    return load(read_bundle(make_bundle(training_range=known)), "features")


def _flags(frame: ElectrodeFrame, tare: Tare, runtime: Runtime) -> tuple[QualityFlag, ...]:
    answer = estimate(frame, tare, runtime)
    assert isinstance(answer, FeatureEstimate)
    FEATURE_ESTIMATE.encode(answer)
    return answer.quality


@pytest.mark.parametrize(
    ("counts", "flagged"), [(0, True), (1, False), (4094, False), (4095, True)]
)
def test_an_electrode_at_an_end_of_the_converter(
    runtime: Runtime, make_frame: Frames, make_tare: Tares, counts: int, flagged: bool
) -> None:
    frame = make_frame(60)
    electrodes = frame.electrodes.copy()
    electrodes[11] = counts
    frame = dataclasses.replace(frame, electrodes=electrodes)
    assert _flags(frame, make_tare(), runtime) == ((SATURATED,) if flagged else ())


@pytest.mark.parametrize("away", [TARE_TDC_COUNTS, -TARE_TDC_COUNTS])
def test_a_tare_of_another_temperature_is_doubtful(
    runtime: Runtime, make_frame: Frames, make_tare: Tares, away: int
) -> None:
    frame, tare = make_frame(60), make_tare()
    tare = dataclasses.replace(tare, tdc=float(frame.tdc))
    assert _flags(frame, tare, runtime) == ()
    assert _flags(dataclasses.replace(frame, tdc=frame.tdc + away), tare, runtime) == ()
    further = dataclasses.replace(frame, tdc=frame.tdc + away + (1 if away > 0 else -1))
    assert _flags(further, tare, runtime) == (UNTARED,)
    # A TDC that is marked bad says nothing.
    bit = SensorType.BIOTAC.layout.tdc_bit
    deaf = dataclasses.replace(further, validity=further.validity & ~(1 << bit))
    assert _flags(deaf, tare, runtime) == ()
    # Nor does a tare without any valid TDC.
    assert _flags(further, dataclasses.replace(tare, tdc=0.0), runtime) == ()


def test_the_tare_of_another_finger_is_none(
    runtime: Runtime, make_frame: Frames, make_tare: Tares
) -> None:
    tare = dataclasses.replace(make_tare(), sensor_serial="BT-OTHER")
    assert estimate(make_frame(60), tare, runtime) is EstimateRefusal.WRONG_TARE


def _shipped(name: str) -> Runtime:
    bundle = read_bundle(resolve(name))
    return load(bundle, bundle.manifest.task)


def _quality_of(runtime: Runtime, rows: FloatArray) -> list[tuple[QualityFlag, ...]]:
    found = []
    for row in rows:
        outputs = runtime.run(row)
        assert outputs is not None
        found.append(runtime.range.flags(row, outputs, without=()))
    return found


def test_the_shipped_features_bundle_knows_its_own_rows() -> None:
    """Golden rows are test rows: never trained on, and of the same finger."""
    runtime = _shipped("features-virtual")
    rows = read_bundle(resolve("features-virtual")).golden["electrodes"]
    flagged = sum(bool(flags) for flags in _quality_of(runtime, rows))
    assert flagged <= 2, f"{flagged} of {len(rows)} rows of the same finger are flagged"


@pytest.mark.parametrize("finger", [1, 2])
def test_the_shipped_features_bundle_knows_that_a_real_finger_is_another(
    shared_data: Path, finger: int
) -> None:
    path = shared_data / "lasa_force_calibration" / "force_calibration.npz"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    with np.load(path) as archive:
        raw = archive[f"finger{finger}_electrodes_raw"][::25].astype(np.float32)
        force = np.linalg.norm(archive[f"finger{finger}_force_N"][::25], axis=1)
        tared = raw - archive[f"finger{finger}_baseline_mean"].astype(np.float32)
    runtime = _shipped("features-virtual")
    wrong = flagged = 0
    for row, truth in zip(tared, force, strict=True):
        outputs = runtime.run(row)
        assert outputs is not None
        if abs(float(np.linalg.norm(outputs["force"])) - truth) > max(0.5, 0.5 * truth):
            wrong += 1
            flags = runtime.range.flags(row, outputs, without=())
            flagged += bool(set(flags) & {OUT_OF_RANGE, EXTRAPOLATING})
    assert wrong > 0.9 * len(tared)  # a model of another finger is no use here
    assert flagged >= 0.99 * wrong


@pytest.mark.parametrize(
    ("serials", "flagged"),
    [
        ((), True),
        (("BT-OTHER",), True),
        (("BT-TES",), True),  # the beginning alone is another sensor
        (("BT-OTHER", "BT-TEST"), False),
        (("BT-*",), False),
        (("*",), False),
    ],
)
def test_a_sensor_that_the_bundle_was_not_made_for(
    make_bundle: Callable[..., Path],
    make_frame: Frames,
    make_tare: Tares,
    serials: tuple[str, ...],
    *,
    flagged: bool,
) -> None:
    runtime = load(read_bundle(make_bundle(sensor_serials=serials)), "features")
    for _ in range(2):
        flags = _flags(make_frame(60), make_tare(), runtime)
        assert (QualityFlag.UNCALIBRATED in flags) is flagged
        assert list(flags) == sorted(flags)
