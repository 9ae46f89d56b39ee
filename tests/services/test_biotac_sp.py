"""A BioTac SP at a station whose bundles are made for 19 electrodes: seen, recorded, refused."""

from __future__ import annotations

import importlib
import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bus import Delivery, Session, TapSample, endpoints
from palpate.bus.topics import ELECTRODES, FEATURES, TARE, TOPICS, sensor_key
from palpate.client import Client
from palpate.config import LinkConfig
from palpate.errors import BundleError, ErrorCode, RemoteError
from palpate.files.bundle import read_bundle
from palpate.files.record import read_record
from palpate.health import Health
from palpate.messages import ElectrodeFrame, SensorType, ServiceState, Tare
from palpate_services.config import FeaturesServiceConfig, FieldServiceConfig, RecorderConfig
from palpate_services.inference.estimates import EstimateRefusal, estimate, estimate_field
from palpate_services.inference.model import load
from palpate_services.inference.services import run_estimating
from palpate_services.recorder.writer import RecordFiles

bundles: Any = importlib.import_module("field_bundles")

Frames = Callable[..., ElectrodeFrame]
Tares = Callable[..., Tare]
Until = Callable[[Callable[[], bool]], None]
SP = SensorType.BIOTAC_SP


@contextmanager
def running(node: Callable[..., None], config: Any, link: LinkConfig) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=node, args=(config, link, "lab", stop))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(timeout=30)
    assert not thread.is_alive()


def announce(session: Session, sensor: str, tare: Tare) -> None:
    session.queryable(endpoints.TARE, lambda _: tare, sensor=sensor)
    session.publisher(TARE, sensor=sensor, lossless=True).put(tare)


@pytest.mark.parametrize("task", ["features", "field"])
def test_no_estimate_from_an_sp(
    task: str,
    make_bundle: Callable[..., Path],
    make_frame: Frames,
    make_tare: Tares,
    tmp_path: Path,
) -> None:
    folder = make_bundle() if task == "features" else bundles.write(tmp_path / "f", "field")
    runtime = load(read_bundle(folder), task)
    ask: Any = estimate if task == "features" else estimate_field
    frame, tare = make_frame(sensor_type=SP), make_tare(sensor_type=SP)
    assert ask(frame, tare, runtime) is EstimateRefusal.WRONG_SENSOR
    # After a finger was exchanged: the frame is right, its tare is the other finger's.
    assert ask(make_frame(), tare, runtime) is EstimateRefusal.WRONG_TARE


def test_a_bundle_that_claims_an_sp_is_refused(make_bundle: Callable[..., Path]) -> None:
    with pytest.raises(BundleError, match=r"BIOTAC_SP has 24 electrodes, the tasks .* have 19"):
        read_bundle(make_bundle(sensor_type="BIOTAC_SP"))


def test_features_service_names_the_sensor_and_serves_the_others(
    link: LinkConfig,
    make_bundle: Callable[..., Path],
    make_frame: Frames,
    make_tare: Tares,
    until: Until,
) -> None:
    config = FeaturesServiceConfig(bundle=str(make_bundle()), max_age_s=10.0, unannounced=True)
    with running(run_estimating, config, link), Client(link.connect[0], timeout_s=5.0) as robot:
        until(lambda: any(one.ready for one in robot.alive()))
        session = robot.session
        estimates = session.subscriber(FEATURES, delivery=Delivery.QUEUE)
        announce(session, "thumb", make_tare(sensor_type=SP))
        announce(session, "finger", make_tare())
        thumb = session.publisher(ELECTRODES, sensor="thumb", lossless=True)
        finger = session.publisher(ELECTRODES, sensor="finger", lossless=True)
        for sequence in range(1, 4):
            thumb.put(make_frame(sequence, sensor_type=SP))
            finger.put(make_frame(sequence))
            got = estimates.next(5.0)
            assert (got.sensor, got.message.source.sequence) == ("finger", sequence)
        until(lambda: robot.status()[0].counters.get("wrong_sensor") == 3)
        (status,) = robot.status()
        assert status.sensors == ("finger",)
        assert status.last_error is not None
        assert "sensor 'thumb' is a BIOTAC_SP with 24 electrodes" in status.last_error.message
        assert "is made for a BIOTAC" in status.last_error.message
        assert status.last_error.code is ErrorCode.INVALID_REQUEST
        # The client reads its frames as those of any other finger.
        subscribed = robot.session.subscriber(ELECTRODES, sensor="thumb", delivery=Delivery.QUEUE)
        thumb.put(make_frame(4, sensor_type=SP))
        assert subscribed.next(5.0).message.electrodes.shape == (24,)
        # A service that refuses all of a sensor says so until somebody chooses what it serves.
        later = itertools.count(5)

        def refused() -> bool:
            thumb.put(make_frame(next(later), sensor_type=SP))
            return robot.status()[0].state is ServiceState.DEGRADED

        until(refused)
        error = robot.status()[0].last_error
        assert error is not None
        assert "everything of sensor 'thumb' is refused" in error.message
        assert "sensors = [...]" in error.remedy


def test_field_service_answers_by_an_error(
    link: LinkConfig, make_frame: Frames, make_tare: Tares, until: Until, tmp_path: Path
) -> None:
    config = FieldServiceConfig(
        bundle=str(bundles.write(tmp_path / "f", "field")), unannounced=True
    )
    with running(run_estimating, config, link), Client(link.connect[0], timeout_s=5.0) as robot:
        until(lambda: any(one.ready for one in robot.alive()))
        announce(robot.session, "thumb", make_tare(sensor_type=SP))
        with pytest.raises(RemoteError, match="made for another type of sensor") as caught:
            robot.estimate_field("thumb", make_frame(sensor_type=SP))
        assert caught.value.code is ErrorCode.INVALID_REQUEST


def samples(sensor: str, messages: list[Any]) -> list[TapSample]:
    out = []
    for message in messages:
        topic = TOPICS["tare" if isinstance(message, Tare) else "electrodes"]
        wall_ns = message.stamp.wall_ns
        key = sensor_key("lab", sensor, topic.name)
        payload = topic.codec.encode(message)
        out.append(
            TapSample(topic.name, "lab", sensor, key, topic.encoding, payload, wall_ns, wall_ns)
        )
    return out


def test_recorded_and_drawn(make_frame: Frames, make_tare: Tares, tmp_path: Path) -> None:
    """Two fingers, of which one is exchanged for an SP while the recorder runs."""
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    from palpate_services.viewer.record_view import review

    def frames(kind: SensorType, first: int) -> list[Any]:
        sequences = range(first, first + 40)
        return [
            make_tare(kind, sensor_type=kind),
            *[make_frame(n, sensor_type=kind, tare_id=int(kind)) for n in sequences],
        ]

    health = Health("recorder", "recorder")
    keeper = RecordFiles(RecorderConfig(out=tmp_path, min_free_bytes=0), "lab", health)
    keeper.start()
    came = samples("thumb", frames(SP, 1))
    came += samples("finger", frames(SensorType.BIOTAC, 1) + frames(SP, 41))
    for sample in came:
        keeper.write(sample)
    keeper.close()
    assert health.counters["recorded_electrodes"] == 120
    assert health.counters["recorded_tare"] == 3
    assert "view_failed" not in health.counters
    (record,) = tmp_path.glob("*.mcap")
    assert [item.payload for item in read_record(record)] == [item.payload for item in came]
    live, again = record.with_suffix(".rrd"), review(record, tmp_path / "again.rrd")
    # A live view draws two of a frame's PAC samples, a review all.
    for view, thumb, finger in ((live, 80, 160), (again, 40 * 27, 40 * 22 + 40 * 27)):
        rows: dict[str, int] = {}
        for chunk in RrdReader(str(view)).stream():
            rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
        assert thumb <= rows["/thumb/pac"] < thumb + 10
        assert finger <= rows["/finger/pac"] < finger + 10
        assert rows["/thumb/electrodes/tared"] >= 40
        assert rows["/finger/electrodes/tared"] >= 80


def test_a_lost_pac_sample_is_a_gap_in_the_picture(make_frame: Frames) -> None:
    from palpate_services.viewer.timeline import SensorTimeline

    layout = SP.layout
    frame = make_frame(sensor_type=SP)
    lost = layout.first_pac_bit + 5
    frame = replace(frame, validity=frame.validity & ~(1 << lost))
    scene = SensorTimeline()
    scene.add(frame)
    (row,) = scene.take()["pressure"]
    assert np.flatnonzero(np.isnan(row.values)).tolist() == [1 + 5]
    assert row.values.shape == (28,)
    assert scene.sensor_type is SP


def test_a_lost_electrode_is_a_gap_in_the_picture(make_frame: Frames, make_tare: Tares) -> None:
    """Its counts are 0: drawn as they are, they would be a press that did not happen."""
    from palpate_services.viewer.timeline import SensorTimeline

    frame = make_frame(sensor_type=SP)
    frame = replace(frame, validity=frame.validity & ~(1 << 4))
    scene = SensorTimeline()
    scene.add(frame)
    scene.add(make_tare(sensor_type=SP))
    scene.add(frame)
    rows = scene.take()
    for kind in ("raw", "tared"):
        (row,) = rows[f"electrodes/{kind}"]
        assert np.flatnonzero(np.isnan(row.values)).tolist() == [4], kind
        assert row.values.shape == (24,)
        assert row.values.dtype == np.float32
    assert not np.isnan(rows["pressure"][0].values).any()


def test_the_extremes_of_a_frame_come_in_order_of_time() -> None:
    from palpate_services.viewer.record_view import _extremes

    nan = np.nan
    samples = np.array([[5.0, 1.0, 9.0, 2.0], [nan, 7.0, nan, 3.0], [4.0, 4.0, 4.0, 4.0]])
    assert _extremes(samples)[:2].tolist() == [[1, 2], [1, 3]]
    lost = np.full((1, 4), nan)
    assert np.isnan(np.take_along_axis(lost, _extremes(lost), axis=1)).all()
