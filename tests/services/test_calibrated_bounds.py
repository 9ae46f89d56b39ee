"""What a running service says of a sensor that its bundle was not made for, seen from outside."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import threading
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import pytest

from palpate import Client
from palpate.bus import Session, endpoints
from palpate.bus.topics import ELECTRODES, TARE
from palpate.config import LinkConfig
from palpate.errors import StreamTimeout
from palpate.files.bundle import read_bundle
from palpate.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    FloatArray,
    QualityFlag,
    Tare,
    TareRequest,
)
from palpate_deploy.diagnose.topics import plain
from palpate_services.config import FeaturesServiceConfig
from palpate_services.inference.estimates import estimate
from palpate_services.inference.model import load
from palpate_services.inference.repository import resolve
from palpate_services.inference.services import run_estimating
from palpate_services.ros_bridge import outputs_of

Frames = Callable[..., ElectrodeFrame]
Tares = Callable[..., Tare]
Until = Callable[[Callable[[], bool]], None]

UNCALIBRATED = QualityFlag.UNCALIBRATED
SHIPPED = ("features-virtual", "features-twin")


@contextlib.contextmanager
def _served(
    link: LinkConfig, bundle: str, until: Until, own: dict[str, str] | None = None
) -> Iterator[Session]:
    stop = threading.Event()
    settings = FeaturesServiceConfig(
        bundle=bundle, bundles=own or {}, unannounced=True, max_age_s=30.0
    )
    node = threading.Thread(target=run_estimating, args=(settings, link, "lab", stop))
    node.start()
    try:
        with Session.open(link) as session:
            until(lambda: any(a.service == "features" and a.ready for a in session.alive()))
            yield session
    finally:
        stop.set()
        node.join(timeout=60)
    assert not node.is_alive()


def _as(frame: ElectrodeFrame, serial: str, tared: FloatArray, tare: Tare) -> ElectrodeFrame:
    counts = np.clip(np.rint(tare.electrodes + tared), 1, 4094).astype(np.uint16)
    return dataclasses.replace(frame, sensor_serial=serial, electrodes=counts)


def _own_serial(name: str) -> str:
    """A sensor that the bundle was made for."""
    return read_bundle(resolve(name)).manifest.sensor_serials[0].replace("*", "9")


def _answer(tare: Tare, _: TareRequest) -> Tare:
    return tare


@pytest.mark.parametrize("name", SHIPPED)
def test_every_estimate_of_a_real_sensor_says_that_it_is_uncalibrated(
    link: LinkConfig, make_frame: Frames, make_tare: Tares, until: Until, name: str
) -> None:
    """A sensor of a lab and a virtual one get the same counts: only the serial number differs."""
    rows = read_bundle(resolve(name)).golden["electrodes"][::8]
    tare = make_tare()
    with (
        _served(link, name, until) as session,
        Client(link.connect[0], station="lab", timeout_s=20.0) as client,
    ):
        for sensor, serial, real in (
            ("finger", "BT000123", True),
            ("virtual", _own_serial(name), False),
        ):
            own = dataclasses.replace(tare, sensor_serial=serial)
            session.queryable(endpoints.TARE, partial(_answer, own), sensor=sensor)
            session.publisher(TARE, sensor=sensor).put(own)
            frames = session.publisher(ELECTRODES, sensor=sensor)
            with contextlib.suppress(StreamTimeout):  # subscribes
                client.next_features(sensor, timeout_s=0.5)
            for sequence, row in enumerate(rows, start=1):
                frames.put(_as(make_frame(sequence), serial, row, tare))
                answer = client.next_features(sensor, timeout_s=20.0).message
                assert (UNCALIBRATED in answer.quality) is real, (sensor, sequence)
                bounds = answer.bounds
                assert bounds is not None
                assert bounds.other_sensors is real
                assert answer.force_interval is not None
                if real:  # where it was pressed on other sensors, nobody has seen
                    assert bounds.contact_location is None
                # What `palpate topic` prints, and what ROS gets.
                assert ("uncalibrated" in plain(answer)["quality"]) is real
                (ros,) = (one for one in outputs_of(answer, "finger") if one.name == "features")
                assert (int(UNCALIBRATED) in list(ros.fields["quality"])) is real


def test_the_status_names_both_fingers_where_one_has_the_bundle_of_another(
    link: LinkConfig, make_frame: Frames, make_tare: Tares, until: Until
) -> None:
    """A finger was exchanged, and the station remembers the bundle of the one before."""
    name = "features-virtual"
    bundle = read_bundle(resolve(name)).manifest
    label, made_for = f"{name}:{bundle.version}", bundle.sensor_serials[0]
    tare = make_tare()
    with (
        _served(link, name, until, {"finger": name}) as session,
        Client(link.connect[0], station="lab", timeout_s=20.0) as client,
    ):
        sequences = itertools.count(1)
        frames, others = (session.publisher(ELECTRODES, sensor=one) for one in ("finger", "other"))

        def said(serial: str, tare_id: int) -> str:
            for sensor in ("finger", "other"):
                own = dataclasses.replace(tare, sensor_serial=serial, tare_id=tare_id)
                session.publisher(TARE, sensor=sensor).put(own)
            frame = make_frame(next(sequences), tare_id=tare_id)
            for publisher in (frames, others):
                publisher.put(dataclasses.replace(frame, sensor_serial=serial))
            (status,) = client.status()
            return status.message

        both = f"serving {label}, finger {label} (made for {made_for}; this is BT1)"
        until(lambda: said("BT1", 5) == both)
        until(lambda: said(_own_serial(name), 6) == f"serving {label}, finger {label}")


def test_a_drawn_specimen_is_another_sensor_than_the_three_that_ship(
    make_frame: Frames, make_tare: Tares
) -> None:
    runtime = load(read_bundle(resolve("features-twin")), "features")
    for serial, known in (("VIRTUAL-biotac-2-S7", True), ("VIRTUAL-unit-001-S7", False)):
        tare = dataclasses.replace(make_tare(), sensor_serial=serial)
        answer = estimate(dataclasses.replace(make_frame(1), sensor_serial=serial), tare, runtime)
        assert isinstance(answer, FeatureEstimate)
        assert (UNCALIBRATED not in answer.quality) is known


@pytest.mark.parametrize("name", SHIPPED)
def test_a_bound_of_another_sensor_is_no_narrower(
    make_frame: Frames, make_tare: Tares, name: str
) -> None:
    """What is not known is not told as if it held."""
    runtime = load(read_bundle(resolve(name)), "features")
    tare = make_tare()
    wider = 0
    rows = read_bundle(resolve(name)).golden["electrodes"]
    for row in rows:
        found = []
        for serial in (_own_serial(name), "BT000123"):
            frame = _as(make_frame(1), serial, row, tare)
            answer = estimate(frame, dataclasses.replace(tare, sensor_serial=serial), runtime)
            assert isinstance(answer, FeatureEstimate)
            assert answer.bounds is not None
            assert answer.bounds.force is not None
            found.append(answer.bounds.force)
        assert found[1] >= found[0]
        wider += found[1] > found[0]
    assert wider > 0.7 * len(rows)
