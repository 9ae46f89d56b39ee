"""A bundle is written only if ONNX Runtime gives torch's answers, else nothing is left."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch

from palpate.errors import BundleError, ConfigError, DatasetError
from palpate.files.bundle import read_bundle
from palpate_training.datasets.features import FeatureDataset, write_dataset
from palpate_training.learning import export
from palpate_training.learning.export import (
    check_parity,
    export_features,
    features_scale,
    onnx_bytes,
)
from palpate_training.learning.features_net import FeaturesNetConfig
from palpate_training.learning.graphs import FeaturesGraph
from palpate_training.learning.networks import Mlp, round_to_half
from palpate_training.learning.splits import by_group
from palpate_training.tasks.features import train_features

MakeData = Callable[..., FeatureDataset]
QUICK = FeaturesNetConfig(members=2, width=32, blocks=1, epochs=25, batch_rows=64)


def make_graph(*, contact: bool = True) -> FeaturesGraph:
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    inputs = rng.normal(0, 300, (200, 19)).astype(np.float32)
    sizes = np.repeat([3.0, 0.004, 0.003, 0.6], 3)[: 12 if contact else 3]
    net = Mlp(outputs=len(sizes))
    net.normalise_from(inputs, (sizes * rng.normal(size=(200, len(sizes)))).astype(np.float32))
    sd = np.array([0.1, 0.2, 0.3], dtype=np.float32)
    small = np.float32(0.01) * sd
    spreads = {
        "contact_location": small,
        "centre_of_pressure": small,
        "contact_normal": sd[:1],
    }
    return FeaturesGraph(net, sd, spreads if contact else None)


def to_onnx(graph: FeaturesGraph) -> bytes:
    names = [tensor.name for tensor in graph.outputs]
    return onnx_bytes(graph, "electrodes", torch.zeros(4, 19), names)


def parity(
    graph: FeaturesGraph, model: bytes, inputs: np.ndarray[Any, np.dtype[np.float32]]
) -> float:
    names = [tensor.name for tensor in graph.outputs]
    return check_parity(graph, model, "electrodes", names, inputs, features_scale(graph, inputs))


def rows(count: int = 16) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    return np.random.default_rng(1).normal(0, 300, (count, 19)).astype(np.float32)


def write(folder: Path, graph: FeaturesGraph) -> bytes:
    return export_features(
        folder,
        graph,
        rows(),
        name="test",
        version=1,
        contact_threshold_n=0.1,
        training_data_sha256="0" * 64,
        trained_on="a test",
        metrics={"force_magnitude_median_n": 0.1},
    )


@pytest.mark.parametrize("contact", [True, False])
def test_bundle_round_trip(tmp_path: Path, *, contact: bool) -> None:
    digest = write(tmp_path / "b", make_graph(contact=contact))
    bundle = read_bundle(tmp_path / "b")
    assert bundle.sha256 == digest
    assert bundle.manifest.metrics["parity_max"] < export.PARITY_MAX
    session = onnxruntime.InferenceSession(bundle.model, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    assert names == [info.name for info in bundle.manifest.outputs]
    assert len(names) == (8 if contact else 2)
    for name, values in zip(
        names, session.run(None, {"electrodes": bundle.golden["electrodes"]}), strict=True
    ):
        assert values.dtype == np.float32
        np.testing.assert_allclose(values, bundle.golden[name], atol=1e-5)
    assert bundle.golden["force_sd"].shape == (16, 3)


def test_weights_that_half_precision_holds_are_stored_in_it() -> None:
    """And are what torch computes with; others are not rounded behind its back."""
    plain, rounded = make_graph(), make_graph()
    round_to_half(rounded.net)
    whole, half = to_onnx(plain), to_onnx(rounded)
    assert len(half) < 0.6 * len(whole)
    assert parity(rounded, half, rows()) < export.PARITY_MAX
    assert parity(plain, whole, rows()) < export.PARITY_MAX
    with torch.inference_mode():
        given = torch.from_numpy(rows())
        change = (plain(given)[0] - rounded(given)[0]).abs().max()
    assert 0 < change < 0.01 * plain(given)[0].abs().max()


def test_export_is_deterministic_and_names_no_machine() -> None:
    graph = make_graph()
    first = to_onnx(graph)
    assert hashlib.sha256(first).digest() == hashlib.sha256(to_onnx(graph)).digest()
    assert b".py" not in first, "no stack traces of the exporting machine"


def test_a_model_that_differs_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = make_graph()
    other = make_graph()
    with torch.no_grad():
        next(iter(other.net.parameters()))[0, 0] += 0.05
    wrong = to_onnx(other)
    with pytest.raises(BundleError, match=r"differs from torch by .* in force"):
        parity(graph, wrong, rows())
    monkeypatch.setattr(export, "onnx_bytes", lambda *_: wrong)
    with pytest.raises(BundleError):
        write(tmp_path / "b", graph)
    assert not list(tmp_path.iterdir())


def test_a_normal_is_as_exact_as_the_vector_that_it_is_made_of() -> None:
    """Where networks disagree their mean is short, and a unit vector of it doubles its rounding."""
    graph, other = make_graph(), make_graph()
    with torch.no_grad():
        other.net.get_buffer("output_mean")[9:] += 3e-6
    with torch.inference_mode():
        given = torch.from_numpy(rows())
        normal, shifted = graph(given)[6], other(given)[6]
    assert (normal - shifted).abs().max() > export.PARITY_MAX
    assert parity(graph, to_onnx(other), rows()) < export.PARITY_MAX


def test_a_model_that_is_not_one_is_refused() -> None:
    with pytest.raises(BundleError, match="ONNX Runtime refuses"):
        parity(make_graph(), b"not a model", rows())


def test_nan_is_refused() -> None:
    graph = make_graph()
    model = to_onnx(graph)
    bad = rows()
    bad[3, 3] = np.nan
    with pytest.raises(BundleError, match="differs"):
        parity(graph, model, bad)


def test_train_features(press_data: MakeData, tmp_path: Path) -> None:
    data = press_data(presses=20)
    write_dataset(tmp_path / "presses.h5", data)
    seen: dict[str, int] = {}
    report = train_features(
        tmp_path / "presses.h5",
        tmp_path / "bundle",
        name="tiny",
        config=QUICK,
        on_epoch=lambda quantity, done, total: seen.__setitem__(quantity, done),
    )
    bundle = read_bundle(tmp_path / "bundle")
    metrics = bundle.manifest.metrics
    assert bundle.sha256 == report.digest
    assert set(seen) == {"features", "features, mirror images", "features, other members"}
    assert bundle.manifest.training_data_sha256 == data.content_sha256()
    assert metrics["force_magnitude_median_n"] < metrics["constant_force_magnitude_median_n"]
    for headline in (
        "location_distance_median_m",
        "centre_of_pressure_distance_median_m",
        "normal_angle_median_rad",
    ):
        assert metrics[headline] < 0.7 * metrics[f"constant_{headline}"]
        stem, _, unit = headline.rpartition("_")
        low, high = (metrics[f"{stem}_ci95_{end}_{unit}"] for end in ("low", "high"))
        assert low < metrics[headline] < high
    normals = bundle.golden["contact_normal"]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    assert metrics["contact_found_share"] > 0.8
    assert 0.05 <= bundle.manifest.contact_threshold_n < 1.0
    known = bundle.manifest.training_range
    assert known is not None
    assert known.rows == report.rows[0]
    assert known.data_sha256 == data.content_sha256()
    assert bundle.known_inputs is not None
    force, location, centre = known.outputs
    assert centre.name == "centre_of_pressure"
    assert 0 < force.length_max <= np.linalg.norm(data.force, axis=1).max() * 1.00001
    assert data.contact_location is not None
    low, high = np.nanmin(data.contact_location, axis=0), np.nanmax(data.contact_location, axis=0)
    assert (np.array(location.low) >= low - 1e-6).all()
    assert (np.array(location.high) <= high + 1e-6).all()
    with pytest.raises(BundleError, match="immutable"):
        train_features(tmp_path / "presses.h5", tmp_path / "bundle", config=QUICK)


def test_a_name_that_no_bundle_can_have_is_refused_before_training(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--name"):
        train_features(tmp_path / "not-read.h5", tmp_path / "bundle", name="a b/../c")
    assert not list(tmp_path.iterdir())


def test_one_tested_press_tells_nothing_of_how_sure_its_error_is(
    press_data: MakeData, tmp_path: Path
) -> None:
    write_dataset(tmp_path / "presses.h5", press_data(presses=3))
    train_features(tmp_path / "presses.h5", tmp_path / "bundle", config=QUICK)
    metrics = read_bundle(tmp_path / "bundle").manifest.metrics
    assert "force_magnitude_median_n" in metrics
    assert not [name for name in metrics if "ci95" in name]


@pytest.mark.parametrize(("step_ms", "guard"), [(10, 100), (None, 100), (50, 20)])
def test_blocks_of_a_single_group_are_its_presses(
    press_data: MakeData, tmp_path: Path, step_ms: int | None, guard: int
) -> None:
    data = press_data(presses=12, rows=240)
    time_ns = None if step_ms is None else 1_000_000 * step_ms * np.arange(len(data))
    one = replace(data, group=np.zeros_like(data.group), time_ns=time_ns)
    write_dataset(tmp_path / "one.h5", one)
    config = FeaturesNetConfig(members=1, width=8, blocks=1, epochs=1)
    train_features(tmp_path / "one.h5", tmp_path / "bundle", config=config)
    manifest = read_bundle(tmp_path / "bundle").manifest
    dealt = by_group(data.group)
    tested = np.concatenate([dealt.validation, dealt.test])
    apart = np.abs(dealt.train[:, None] - tested).min(axis=1) > guard  # a second
    assert f"{apart.sum()} rows of 9 presses; tested on 2 other presses" in manifest.trained_on
    assert "force_magnitude_median_ci95_low_n" in manifest.metrics


def test_bounds_leave_untouched_rows_out_where_contact_is_not_known(
    press_data: MakeData, tmp_path: Path
) -> None:
    data = press_data(presses=12)
    unknown = replace(
        data,
        in_contact=None,
        contact_location=None,
        centre_of_pressure=None,
        contact_normal=None,
    )
    write_dataset(tmp_path / "unknown.h5", unknown)
    train_features(tmp_path / "unknown.h5", tmp_path / "bundle", config=QUICK)
    manifest = read_bundle(tmp_path / "bundle").manifest
    force = data.force[by_group(data.group).test]
    pressed = np.linalg.norm(force, axis=1) > manifest.contact_threshold_n
    assert manifest.intervals is not None
    assert manifest.intervals.source.startswith(f"{pressed.sum()} rows of 2 presses")
    assert pressed.sum() < len(force)


def test_contacts_are_learned_from_a_set_that_is_always_touched(
    press_data: MakeData, tmp_path: Path
) -> None:
    data = press_data(presses=20)
    assert data.in_contact is not None
    columns: dict[str, Any] = {name: rows[data.in_contact] for name, rows in data.arrays().items()}
    write_dataset(tmp_path / "touched.h5", replace(data, **{**columns, "in_contact": None}))
    train_features(tmp_path / "touched.h5", tmp_path / "bundle", config=QUICK)
    manifest = read_bundle(tmp_path / "bundle").manifest
    outputs = {tensor.name for tensor in manifest.outputs}
    assert {"contact_location", "centre_of_pressure", "contact_normal"} <= outputs
    metrics, headline = manifest.metrics, "location_distance_median_m"
    assert metrics[headline] < 0.7 * metrics[f"constant_{headline}"]


def test_forces_that_never_change_are_refused_before_training(
    press_data: MakeData, tmp_path: Path
) -> None:
    data = press_data(presses=6)
    write_dataset(tmp_path / "still.h5", replace(data, force=np.ones_like(data.force)))
    with pytest.raises(DatasetError, match="force is the same in all 360 rows"):
        train_features(tmp_path / "still.h5", tmp_path / "bundle", config=QUICK)


def test_too_few_presses_are_named(press_data: MakeData, tmp_path: Path) -> None:
    write_dataset(tmp_path / "two.h5", press_data(presses=2))
    with pytest.raises(DatasetError, match="2 groups"):
        train_features(tmp_path / "two.h5", tmp_path / "bundle", config=QUICK)
    assert not (tmp_path / "bundle").exists()
