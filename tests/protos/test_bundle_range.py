"""What a bundle says it was trained on: kept, checked, and absent where it is not known."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.protos.changed_manifest import change

from palpate.errors import BundleError
from palpate.files.bundle import MANIFEST, read_bundle, write_bundle
from palpate.files.manifest import Manifest
from palpate.files.tasks import TASKS
from palpate.files.training_range import (
    KnownInputs,
    known_inputs_from_bytes,
    known_inputs_to_bytes,
)
from palpate.messages import TrainingRange, ValueRange

FEATURES = TASKS["features"]
RANGE = TrainingRange(
    "rows of a test",
    "ab" * 32,
    1000,
    (ValueRange("electrodes", "tared counts", (-400.0,) * 19, (50.5,) * 19),),
    (ValueRange("force", "N", length_max=31.5),),
    True,
)
KNOWN = KnownInputs(np.linspace(-3, 1, 5 * 19, dtype=np.float32).reshape(5, 19), 30.0, 2.5)


def _manifest(**changes: Any) -> Manifest:
    manifest = Manifest(
        name="test",
        version=1,
        task="features",
        inputs=FEATURES.inputs,
        outputs=FEATURES.outputs,
        sensor_type="BIOTAC",
        contact_threshold_n=0.1,
        training_data_sha256="ab" * 32,
        trained_on="nothing",
        metrics={},
        model_sha256="",
        golden_sha256="",
        created="2026-01-01T00:00:00Z",
        palpate_version="0",
        opset=17,
    )
    return dataclasses.replace(manifest, **changes)


def _write(folder: Path, known: KnownInputs | None = KNOWN, **changes: Any) -> Path:
    golden = {t.name: np.zeros((1, t.shape[1]), np.float32) for t in FEATURES.outputs}
    golden["electrodes"] = np.zeros((1, 19), np.float32)
    write_bundle(
        folder, model=b"onnx", golden=golden, manifest=_manifest(**changes), known_inputs=known
    )
    return folder


def test_a_range_comes_back_as_it_was_written(tmp_path: Path) -> None:
    bundle = read_bundle(_write(tmp_path / "1", training_range=RANGE))
    assert bundle.manifest.training_range == RANGE
    assert bundle.known_inputs is not None
    np.testing.assert_array_equal(bundle.known_inputs.prototypes, KNOWN.prototypes)
    assert (bundle.known_inputs.scale, bundle.known_inputs.distance_max) == (30.0, 2.5)


def test_a_bundle_that_does_not_say_keeps_the_manifest_that_it_had(tmp_path: Path) -> None:
    bundle = read_bundle(_write(tmp_path / "1", None))
    assert (bundle.manifest.training_range, bundle.known_inputs) == (None, None)
    written = json.loads((tmp_path / "1" / MANIFEST).read_text())
    assert not written.keys() & {"training_range", "range_file_sha256", "basis", "mesh_sha256"}


def test_representatives_belong_to_a_range(tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="do not agree"):
        _write(tmp_path / "1", None, training_range=RANGE)
    with pytest.raises(BundleError, match="do not agree"):
        _write(tmp_path / "2", KNOWN)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("where", "value", "problem"),
    [
        (("rows",), 0, "rows is 0"),
        (("rows",), True, "rows is True"),
        (("inputs",), {}, "no list"),
        (("inputs", 0, "name"), "pressure", "no tensor 'pressure'"),
        (("inputs", 0, "low"), [1.0], "1 and 19 ends"),
        (("inputs", 0, "low"), [60.0] * 19, "wrong side"),
        (("inputs", 0, "high"), ["x"] * 19, "no list of finite numbers"),
        (("outputs", 0, "length_max"), -1.0, "says nothing"),
        (("outputs", 0, "length_max"), 0.0, "says nothing"),
        (("source",), 7, "source is not a text"),
        (("combinations",), "yes", "combinations is not true or false"),
    ],
)
def test_a_range_that_is_none(
    tmp_path: Path, where: tuple[Any, ...], value: object, problem: str
) -> None:
    folder = _write(tmp_path / "1", training_range=RANGE)
    change(folder, ("training_range", *where), value)
    with pytest.raises(BundleError) as caught:
        read_bundle(folder)
    assert problem in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"prototypes": np.zeros((5, 18), np.float32)}, r"not float32\[P, 19\]"),
        ({"prototypes": np.zeros((5, 19))}, "float64"),
        ({"prototypes": np.zeros((0, 19), np.float32)}, "0 prototypes"),
        ({"prototypes": np.zeros((5000, 19), np.float32)}, "5000 prototypes"),
        ({"prototypes": np.full((5, 19), np.nan, np.float32)}, "NaN"),
        ({"scale": 0.0}, "scale is 0"),
        ({"distance_max": float("inf")}, "distance_max is inf"),
    ],
)
def test_representatives_that_are_none(changes: dict[str, Any], problem: str) -> None:
    data = known_inputs_to_bytes(dataclasses.replace(KNOWN, **changes))
    with pytest.raises(BundleError, match=problem):
        known_inputs_from_bytes(data, 19, "range.npz")


@pytest.mark.parametrize("data", [b"", b"no archive", b"PK\x03\x04broken"])
def test_bytes_that_are_no_range(data: bytes) -> None:
    with pytest.raises(BundleError, match=r"range\.npz is not a training range"):
        known_inputs_from_bytes(data, 19, "range.npz")


def test_a_range_file_of_another_bundle_is_refused(tmp_path: Path) -> None:
    folder = _write(tmp_path / "1", training_range=RANGE)
    other = dataclasses.replace(KNOWN, distance_max=1e9)
    (folder / "range.npz").write_bytes(known_inputs_to_bytes(other))
    with pytest.raises(BundleError, match="digest differs"):
        read_bundle(folder)
