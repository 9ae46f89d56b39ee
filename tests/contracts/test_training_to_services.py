"""What training exports, services serve: record -> data set -> network -> bundle -> estimate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from palpate.codec import ELECTRODE_FRAME, FEATURE_ESTIMATE, TARE, WRENCH_FRAME
from palpate.errors import BundleError
from palpate.files.bundle import read_bundle
from palpate.files.record import read_record
from palpate.messages import ElectrodeFrame, FeatureEstimate, Tare
from palpate_deploy.demo.bundles import write_virtual_record
from palpate_services.inference.estimates import estimate
from palpate_services.inference.model import load
from palpate_services.inference.repository import resolve


def _frames(record: Path) -> tuple[list[ElectrodeFrame], dict[int, Tare], list[float]]:
    frames: list[ElectrodeFrame] = []
    tares: dict[int, Tare] = {}
    magnitudes: list[float] = []
    for item in read_record(record):
        if item.schema == ELECTRODE_FRAME.schema:
            frames.append(ELECTRODE_FRAME.decode(item.payload))
        elif item.schema == TARE.schema:
            tare = TARE.decode(item.payload)
            tares[tare.tare_id] = tare
        elif item.schema == WRENCH_FRAME.schema:
            force = WRENCH_FRAME.decode(item.payload).force
            magnitudes.append(float(np.linalg.norm(force)))
    return frames, tares, magnitudes


@pytest.mark.slow
@pytest.mark.essential
def test_a_bundle_that_training_writes_is_served(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from palpate_training.datasets.features import write_dataset
    from palpate_training.datasets.ingest import ingest_record
    from palpate_training.learning.features_net import FeaturesNetConfig
    from palpate_training.tasks.features import train_features

    record = tmp_path / "virtual.mcap"
    write_virtual_record(record, frames=6000, seed=3)
    dataset = tmp_path / "virtual.h5"
    write_dataset(dataset, ingest_record(record, command="test", licence="Apache-2.0"))
    config = FeaturesNetConfig(members=1, width=64, blocks=1, epochs=4, patience=4)
    report = train_features(dataset, tmp_path / "bundle" / "1", config=config)
    bundle = read_bundle(tmp_path / "bundle" / "1")
    assert bundle.sha256 == report.digest
    runtime = load(bundle, "features")
    frames, tares, _ = _frames(record)
    answer = estimate(frames[-1], tares[frames[-1].tare_id], runtime)
    assert isinstance(answer, FeatureEstimate)
    assert answer.bundle_sha256 == report.digest
    FEATURE_ESTIMATE.encode(answer)
    with pytest.raises(BundleError, match="immutable"):
        train_features(dataset, tmp_path / "bundle" / "1", config=config)


def test_the_shipped_bundle_knows_the_virtual_finger(tmp_path: Path) -> None:
    """Presses it was not trained on (another seed): far better than saying nothing."""
    record = tmp_path / "virtual.mcap"
    write_virtual_record(record, frames=3000, seed=20261121)
    runtime = load(read_bundle(resolve("features-virtual")), "features")
    frames, tares, magnitudes = _frames(record)
    errors, silent = [], []
    for frame, magnitude in zip(frames, magnitudes, strict=True):
        answer = estimate(frame, tares[frame.tare_id], runtime)
        assert isinstance(answer, FeatureEstimate)
        if magnitude > 0.5:
            errors.append(abs(float(np.linalg.norm(answer.force)) - magnitude))
            silent.append(magnitude)
    assert len(errors) > 300
    assert np.median(errors) < 0.25 * np.median(silent)


def test_the_same_frame_gives_the_same_bytes(tmp_path: Path) -> None:
    record = tmp_path / "virtual.mcap"
    write_virtual_record(record, frames=400, seed=5)
    frames, tares, _ = _frames(record)

    def answers() -> list[bytes]:
        runtime = load(read_bundle(resolve("features-virtual")), "features")
        out = []
        for frame in frames:
            answer = estimate(frame, tares[frame.tare_id], runtime)
            assert isinstance(answer, FeatureEstimate)
            out.append(FEATURE_ESTIMATE.encode(answer))
        return out

    assert answers() == answers()
