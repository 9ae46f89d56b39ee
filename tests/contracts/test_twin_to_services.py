"""The twin as it ships: sample -> networks -> services, and tape -> frames -> estimates."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from tests.gateway.pipelines import finished, pushed

from palpate.codec import FIELD_ESTIMATE, SYNTHESIS_ESTIMATE
from palpate.files.bundle import read_bundle
from palpate.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    FieldEstimate,
    FieldFrame,
    SynthesisEstimate,
    Tare,
    WrenchFrame,
)
from palpate_gateway.clock.stamps import FileClock
from palpate_gateway.drivers import make_device
from palpate_gateway.service.pipeline import Pipeline
from palpate_services.inference.estimates import estimate, estimate_field, synthesise
from palpate_services.inference.model import Runtime, load
from palpate_services.inference.repository import resolve


def shipped(task: str) -> Runtime:
    return load(read_bundle(resolve(f"{task}-twin")), task)


@pytest.fixture(scope="module")
def played() -> list[object]:
    """Twenty seconds of the shipped tape on the unit that the demo plays."""
    options = {"seed": 11, "unit": "biotac-2", "frames": 2000, "realtime": False}
    messages: list[object] = []
    with make_device("virtual", options) as device:
        pipeline = Pipeline(device.info)
        pipeline.begin(device.identity, FileClock(device.identity.serial, None))
        while readings := device.read(timeout_s=1.0):
            messages += [item.message for item in pushed(pipeline, readings, 0)]
        messages += [item.message for item in finished(pipeline)]
    return messages


def test_all_shipped_bundles_know_one_another_and_the_tape(played: list[object]) -> None:
    fields = [message for message in played if isinstance(message, FieldFrame)]
    meshes = {field.mesh_sha256 for field in fields}
    for task in ("field", "synthesis"):
        bundle = read_bundle(resolve(f"{task}-twin"))
        assert bundle.mesh is not None
        assert {bundle.mesh.sha256} == meshes
    twins = [resolve(f"{task}-twin") for task in ("features", "field", "synthesis")]
    folders = [resolve("features-virtual"), *twins]
    size = sum(file.stat().st_size for folder in folders for file in folder.iterdir())
    assert size <= 25e6, "the goal for all that ships"


def test_shipped_networks_feel_presses_that_they_were_not_trained_on(
    played: list[object],
) -> None:
    features, field, synthesis = (shipped(task) for task in ("features", "field", "synthesis"))
    tares = {message.tare_id: message for message in played if isinstance(message, Tare)}
    wrench = {m.stamp.monotonic_ns: m for m in played if isinstance(m, WrenchFrame)}
    truth = {m.stamp.monotonic_ns: m for m in played if isinstance(m, FieldFrame)}
    force, pressed, moved, missed, counts = [], [], [], [], []
    for frame in played:
        if not isinstance(frame, ElectrodeFrame):
            continue
        known = truth.get(frame.stamp.monotonic_ns)
        tare = tares.get(frame.tare_id)
        if known is None or tare is None:
            continue
        size = np.linalg.norm(known.displacement, axis=1).mean()
        if size < 0.05e-3:  # untouched
            continue
        felt = estimate(frame, tare, features)
        seen = estimate_field(frame, tare, field)
        back = synthesise(known, synthesis)
        assert isinstance(felt, FeatureEstimate)
        assert isinstance(seen, FieldEstimate)
        assert isinstance(back, SynthesisEstimate)
        FIELD_ESTIMATE.encode(seen)
        SYNTHESIS_ESTIMATE.encode(back)
        true_force = wrench[frame.stamp.monotonic_ns].force
        pressed.append(np.linalg.norm(true_force))
        force.append(np.linalg.norm(felt.force - true_force))
        moved.append(size)
        missed.append(np.linalg.norm(seen.displacement - known.displacement, axis=1).mean())
        tared = np.asarray(frame.electrodes, np.float64) - tare.electrodes
        counts.append(np.abs(back.tared_counts - tared).mean())
    assert len(force) > 100
    assert np.median(np.array(force) / (0.2 + np.array(pressed))) < 0.3
    assert np.median(missed) < 0.35 * np.median(moved)
    assert np.median(counts) < 40


@pytest.mark.slow
@pytest.mark.essential
def test_the_shipped_sample_trains_a_field_that_services_serve(
    played: list[object], tmp_path: Path
) -> None:
    pytest.importorskip("torch")
    from palpate_training.datasets.experiment import read_mixed
    from palpate_training.tasks.fields import FieldFitConfig, field_bundle

    path = Path(str(resources.files("palpate_training").joinpath("samples/twin.h5")))
    assert path.stat().st_size < 1.5e6
    sample = read_mixed(path)
    assert set(sample.experiment.unit_names) == {"biotac-1", "biotac-2", "biotac-3"}
    metrics = field_bundle(sample, tmp_path / "field", config=FieldFitConfig(epochs=3))
    assert metrics["nodal_all_m"] < 0.5e-3
    runtime = load(read_bundle(tmp_path / "field"), "field")
    tares = {message.tare_id: message for message in played if isinstance(message, Tare)}
    frame = next(m for m in reversed(played) if isinstance(m, ElectrodeFrame))
    answer = estimate_field(frame, tares[frame.tare_id], runtime)
    assert isinstance(answer, FieldEstimate)
    assert answer.displacement.shape == sample.mesh.nodes.shape
