"""Questions for one estimate: flags, timings, contact forces, coefficients and their basis."""

from __future__ import annotations

import dataclasses
import importlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bus import Session, endpoints
from palpate.bus.topics import ELECTRODES, FEATURES, TARE
from palpate.client import Client
from palpate.codec import FEATURE_ESTIMATE
from palpate.config import LinkConfig
from palpate.errors import BundleError, ErrorCode, RemoteError
from palpate.files.bundle import read_bundle
from palpate.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    FieldEstimate,
    Origin,
    QualityFlag,
    StageTimings,
    Tare,
)
from palpate_services.config import FeaturesServiceConfig, FieldServiceConfig
from palpate_services.inference.estimates import estimate, estimate_field
from palpate_services.inference.model import load
from palpate_services.inference.services import run_estimating

bundles: Any = importlib.import_module("field_bundles")

Frames = Callable[..., ElectrodeFrame]
Tares = Callable[..., Tare]
Until = Callable[[Callable[[], bool]], None]


LIVE_S = 20.0
"""What is fresh: no host is so busy that a frame waits longer."""


@pytest.fixture
def station(
    link: LinkConfig, tmp_path: Path, make_bundle: Callable[..., Path], until: Until
) -> Iterator[Client]:
    """Features, and fields with contact forces and coefficients."""
    stop = threading.Event()
    whole = bundles.write(tmp_path / "f", "field", more=bundles.WHOLE)
    configs = (
        FeaturesServiceConfig(bundle=str(make_bundle()), max_age_s=LIVE_S, unannounced=True),
        FieldServiceConfig(bundle=str(whole), max_age_s=LIVE_S, unannounced=True),
    )
    nodes = [
        threading.Thread(target=run_estimating, args=(config, link, "lab", stop))
        for config in configs
    ]
    for node in nodes:
        node.start()
    try:
        with Client(link.connect[0], timeout_s=10.0) as robot:
            until(lambda: sum(a.ready for a in robot.alive()) == 2)
            yield robot
    finally:
        stop.set()
        for node in nodes:
            node.join(timeout=30)


def announce(session: Session, tare: Tare) -> None:
    session.queryable(endpoints.TARE, lambda _: tare, sensor="finger")
    session.publisher(TARE, sensor="finger", lossless=True).put(tare)


def test_the_features_of_one_frame_and_where_the_time_went(
    station: Client, make_frame: Frames, make_tare: Tares, make_bundle: Callable[..., Path]
) -> None:
    tare, found = make_tare(), list[StageTimings]()
    announce(station.session, tare)
    frame = make_frame(60, age_s=30.0)
    answer = station.estimate_features("finger", frame, on_timings=found.append)
    wanted = estimate(frame, tare, load(read_bundle(make_bundle()), "features"))
    assert isinstance(wanted, FeatureEstimate)
    assert answer.quality == (QualityFlag.STALE, QualityFlag.RANGE_UNKNOWN)
    pure = dataclasses.replace(answer, quality=wanted.quality)
    assert FEATURE_ESTIMATE.encode(pure) == FEATURE_ESTIMATE.encode(wanted)
    (timings,) = found
    assert timings.age_at_arrival_s is not None
    assert 30.0 <= timings.age_at_arrival_s < 60.0
    assert timings.infer_s > 0.0
    assert timings.encode_s > 0.0


@pytest.mark.parametrize(("age_s", "origin"), [(0.0, Origin.SIMULATED), (30.0, Origin.REPLAYED)])
def test_a_fresh_frame_and_a_replayed_one_are_not_stale(
    station: Client, make_frame: Frames, make_tare: Tares, age_s: float, origin: Origin
) -> None:
    announce(station.session, make_tare())
    station.estimate_features("finger", make_frame(1))  # now the tare is known
    answer = station.estimate_features("finger", make_frame(60, age_s=age_s, origin=origin))
    assert QualityFlag.STALE not in answer.quality


def test_a_frame_without_estimate_is_a_typed_error(
    station: Client, make_frame: Frames, make_tare: Tares
) -> None:
    """A frame that is not tared, and one of another finger than the tare that it names."""
    announce(station.session, make_tare())
    other = dataclasses.replace(make_frame(60), sensor_serial="BT-OTHER")
    for frame, says in (
        (make_frame(60, tare_id=0), "before any tare"),
        (other, "is of another finger than the frame"),
    ):
        with pytest.raises(RemoteError, match=says) as caught:
            station.estimate_features("finger", frame)
        assert caught.value.code is ErrorCode.INVALID_REQUEST


def test_a_stream_says_where_the_time_went(
    station: Client, make_frame: Frames, make_tare: Tares
) -> None:
    """The payload is the same for the same frame; its timings are not part of it."""
    session = station.session
    announce(session, make_tare())
    estimates = session.subscriber(FEATURES)
    frames = session.publisher(ELECTRODES, sensor="finger", lossless=True)
    station.estimate_features("finger", make_frame(1))  # the tare is known to the service
    frames.put(make_frame(60))
    received = estimates.next(LIVE_S)
    timings = received.timings
    assert timings is not None
    assert timings.infer_s > 0.0
    assert timings.age_at_arrival_s is not None
    assert FEATURE_ESTIMATE.encode(received.message) == received.payload


def test_a_field_with_contact_forces_and_coefficients(
    station: Client, make_frame: Frames, make_tare: Tares, tmp_path: Path
) -> None:
    tare = make_tare()
    announce(station.session, tare)
    frame = make_frame(60)
    whole = station.estimate_field("finger", frame)
    wanted = estimate_field(frame, tare, load(read_bundle(tmp_path / "f"), "field"))
    assert isinstance(wanted, FieldEstimate)
    assert wanted.contact_force is not None
    assert whole.contact_force is not None
    np.testing.assert_array_equal(whole.contact_force, wanted.contact_force)
    assert whole.contact_force.shape == whole.displacement.shape == (bundles.NODES, 3)
    assert whole.coefficients is not None
    assert whole.coefficients.shape == (bundles.MODES,)


def test_a_reduced_field_and_what_decodes_it(
    station: Client, make_frame: Frames, make_tare: Tares
) -> None:
    announce(station.session, make_tare())
    frame = make_frame(60)
    whole = station.estimate_field("finger", frame)
    reduced = station.estimate_field("finger", frame, reduced=True)
    assert reduced.displacement.shape == (0, 3)
    assert reduced.displacement_sd is None
    assert reduced.contact_force is None
    assert reduced.coefficients is not None
    basis = station.field_basis(reduced.basis_sha256)
    assert basis.mesh_sha256 == reduced.mesh_sha256
    assert basis.basis_sha256 == reduced.basis_sha256
    scale = np.abs(whole.displacement).max()
    np.testing.assert_allclose(
        basis.decode(reduced.coefficients), whole.displacement, atol=1e-3 * scale
    )
    metadata = station.model(service="field")
    assert (metadata.basis_sha256, metadata.modes) == (reduced.basis_sha256, bundles.MODES)
    with pytest.raises(RemoteError) as caught:
        station.field_basis(bytes(32))
    assert caught.value.code is ErrorCode.NOT_FOUND


def test_a_bundle_without_a_basis_has_no_reduced_form(
    link: LinkConfig, tmp_path: Path, make_frame: Frames, make_tare: Tares, until: Until
) -> None:
    stop = threading.Event()
    config = FieldServiceConfig(bundle=str(bundles.write(tmp_path / "p", "field")))
    node = threading.Thread(target=run_estimating, args=(config, link, "lab", stop))
    node.start()
    try:
        with Client(link.connect[0], timeout_s=10.0) as robot:
            until(lambda: any(a.ready for a in robot.alive()))
            announce(robot.session, make_tare())
            whole = robot.estimate_field("finger", make_frame(60))
            assert (whole.coefficients, whole.basis_sha256) == (None, b"")
            for ask in (
                lambda: robot.estimate_field("finger", make_frame(60), reduced=True),
                robot.field_basis,
            ):
                with pytest.raises(RemoteError, match="has no basis") as caught:
                    ask()
                assert caught.value.code is ErrorCode.INVALID_REQUEST
    finally:
        stop.set()
        node.join(timeout=30)


@pytest.mark.parametrize(
    ("basis", "problem"),
    [
        ({"mean": "some_mean", "modes": "absent"}, "has no constants"),
        ({"mean": "some_modes", "modes": "some_mean"}, "has no constants"),
        ({"mean": "some_mean", "modes": "w_displacement"}, "has no constants"),
    ],
)
def test_a_basis_that_is_not_in_the_graph(
    tmp_path: Path, basis: dict[str, str], problem: str
) -> None:
    folder = bundles.write(tmp_path / "f", "field", more=bundles.WHOLE, manifest={"basis": basis})
    with pytest.raises(BundleError, match=problem):
        load(read_bundle(folder), "field")


def test_a_basis_of_another_model_is_not_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    true = bundles.modes
    built = bundles.model("field", more=bundles.WHOLE)
    monkeypatch.setattr(bundles, "modes", lambda: 2 * true())
    other = bundles.model("field", more=bundles.WHOLE)
    monkeypatch.undo()
    assert built != other
    # Its constants are twice as large, its answers are those of the golden vectors.
    import onnx

    graph, doubled = (onnx.load_from_string(one) for one in (built, other))
    for mine, theirs in zip(graph.graph.initializer, doubled.graph.initializer, strict=True):
        if mine.name == "some_modes":
            mine.CopyFrom(theirs)
    folder = bundles.write(
        tmp_path / "f", "field", more=bundles.WHOLE, spoiled=graph.SerializeToString()
    )
    with pytest.raises(BundleError, match="does not decode"):
        load(read_bundle(folder), "field")
