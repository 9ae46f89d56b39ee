"""Fields on a real bus: their rate, their mesh, and questions that a robot asks."""

from __future__ import annotations

import dataclasses
import importlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bus import Delivery, Session, endpoints
from palpate.bus.topics import ELECTRODES, FIELD, FIELD_TRUTH, SYNTHESIS, TARE
from palpate.client import Client
from palpate.config import LinkConfig
from palpate.errors import ErrorCode, LinkError, RemoteError
from palpate.files.bundle import read_bundle
from palpate.messages import ElectrodeFrame, Origin, Tare
from palpate_services.config import FieldServiceConfig, SynthesisServiceConfig
from palpate_services.inference.estimates import estimate_field
from palpate_services.inference.loop import RateLimit
from palpate_services.inference.model import load
from palpate_services.inference.services import run_estimating

bundles: Any = importlib.import_module("field_bundles")

Frames = Callable[..., ElectrodeFrame]
Until = Callable[[Callable[[], bool]], None]


@pytest.fixture
def station(link: LinkConfig, tmp_path: Path, until: Until) -> Iterator[Client]:
    """Field and synthesis services; the synthesis takes what the field service estimates."""
    stop = threading.Event()
    replay: dict[str, Any] = {"delivery": "every", "accept_replayed": True}
    fields = FieldServiceConfig(bundle=str(bundles.write(tmp_path / "f", "field")), **replay)
    counts = SynthesisServiceConfig(
        bundle=str(bundles.write(tmp_path / "s", "synthesis")), source="estimate", **replay
    )
    nodes = [
        threading.Thread(target=run_estimating, args=(fields, link, "lab", stop)),
        threading.Thread(target=run_estimating, args=(counts, link, "lab", stop)),
    ]
    for node in nodes:
        node.start()
    try:
        with Client(link.connect[0], timeout_s=5.0) as robot:
            until(lambda: sum(a.ready for a in robot.alive()) == 2)
            yield robot
    finally:
        stop.set()
        for node in nodes:
            node.join(timeout=30)
    assert not any(node.is_alive() for node in nodes)


def announce(session: Session, tare: Tare) -> None:
    session.queryable(endpoints.TARE, lambda _: tare, sensor="finger")
    session.publisher(TARE, sensor="finger", lossless=True).put(tare)


def counters(robot: Client, service: str) -> dict[str, int]:
    (status,) = [status for status in robot.status() if status.service == service]
    return dict(status.counters)


def test_fields_come_at_their_rate_by_the_clock_of_the_frames_and_become_electrodes(
    station: Client, make_frame: Frames, make_tare: Callable[..., Tare], until: Until
) -> None:
    """100 Hz of frames, faster than they were taken: 20 fields a second, 20 syntheses."""
    session = station.session
    fields = session.subscriber(FIELD, delivery=Delivery.EVERY)
    synthesised = session.subscriber(SYNTHESIS, delivery=Delivery.EVERY)
    announce(session, make_tare())
    frames = session.publisher(ELECTRODES, sensor="finger", lossless=True)
    for sequence in range(1, 101):
        taken_ns = 10_000_000 * (sequence - 1)
        frames.put(make_frame(sequence, origin=Origin.REPLAYED, monotonic_ns=taken_ns))
    wanted = list(range(1, 101, 5))
    assert [fields.next(5.0).message.source.sequence for _ in wanted] == wanted
    assert [synthesised.next(5.0).message.source.sequence for _ in wanted] == wanted
    until(lambda: counters(station, "field").get("skipped_rate") == 80)
    assert counters(station, "field")["estimates_published"] == 20


def test_pace_is_each_sensors_own_and_takes_no_turn_for_a_refused_frame(
    make_frame: Frames,
) -> None:
    pace = RateLimit(20.0)
    first, second = (make_frame(monotonic_ns=ns).stamp for ns in (0, 49_999_999))
    assert not pace.reached("finger", first)
    assert not pace.reached("finger", second)
    pace.note("finger", first)
    assert pace.reached("finger", second)
    assert not pace.reached("thumb", second)
    assert not pace.reached("finger", make_frame(monotonic_ns=50_000_000).stamp)
    assert not RateLimit(None).reached("finger", first)


def test_untared_and_unknown_tares_are_counted(
    station: Client, make_frame: Frames, until: Until
) -> None:
    frames = station.session.publisher(ELECTRODES, sensor="finger", lossless=True)
    frames.put(make_frame(1, tare_id=0, origin=Origin.REPLAYED))
    until(lambda: counters(station, "field").get("untared") == 1)
    frames.put(make_frame(2, tare_id=77, origin=Origin.REPLAYED))
    until(lambda: counters(station, "field").get("tare_unknown") == 1)
    assert "estimates_published" not in counters(station, "field")


def test_a_field_of_another_mesh_is_refused_and_counted(
    station: Client, make_frame: Frames, until: Until
) -> None:
    synthesised = station.session.subscriber(SYNTHESIS, delivery=Delivery.QUEUE)
    fields = station.session.publisher(FIELD, sensor="finger", lossless=True)
    stamps = [make_frame(n, origin=Origin.REPLAYED, monotonic_ns=n).stamp for n in range(1, 5)]
    fields.put(bundles.guess(stamps[0], mesh="another"))
    until(lambda: counters(station, "synthesis").get("wrong_mesh") == 1)
    fields.put(bundles.guess(stamps[1]))
    assert synthesised.next(5.0).message.source.sequence == 2
    # It takes estimates, so it does not hear of what is known.
    truths = station.session.publisher(FIELD_TRUTH, sensor="finger", lossless=True)
    truths.put(bundles.truth(stamps[2]))
    fields.put(bundles.guess(stamps[3]))
    assert synthesised.next(5.0).message.source.sequence == 4
    until(lambda: counters(station, "synthesis").get("fields_received") == 3)


def test_a_robot_asks_for_one_field_and_for_its_electrodes(
    station: Client, make_frame: Frames, make_tare: Callable[..., Tare], tmp_path: Path
) -> None:
    tare = make_tare()
    announce(station.session, tare)
    # Far over max_age_s, and yet after the start of a host that was just switched on.
    frame = make_frame(7, age_s=30.0)
    answer = station.estimate_field("finger", frame)
    wanted = estimate_field(frame, tare, load(read_bundle(tmp_path / "f"), "field"))
    assert not isinstance(wanted, str)
    assert answer.source == frame.stamp
    np.testing.assert_array_equal(answer.displacement, wanted.displacement)
    counts = station.synthesise(answer)
    assert counts.source == frame.stamp
    known = bundles.truth(frame.stamp)
    assert station.synthesise(known).tared_counts.shape == (19,)
    assert counters(station, "field")["asked"] == 1
    assert counters(station, "synthesis")["asked"] == 2
    assert station.model(service="field").task == "field"


def test_questions_without_an_answer_say_why(
    station: Client, make_frame: Frames, make_tare: Callable[..., Tare]
) -> None:
    announce(station.session, make_tare())
    good = make_frame().validity
    for frame, code, word in (
        (make_frame(tare_id=0), ErrorCode.INVALID_REQUEST, "before any tare"),
        (make_frame(validity=good ^ 1), ErrorCode.INVALID_REQUEST, "marked bad"),
        (make_frame(tare_id=6), ErrorCode.NOT_FOUND, "no gateway knows the tare"),
    ):
        with pytest.raises(RemoteError, match=word) as caught:
            station.estimate_field("finger", frame)
        assert caught.value.code is code
    with pytest.raises(RemoteError, match="no gateway knows the tare") as caught:
        station.estimate_field("thumb", make_frame())
    assert caught.value.code is ErrorCode.NOT_FOUND
    stamp = make_frame().stamp
    with pytest.raises(RemoteError, match="another mesh") as caught:
        station.synthesise(bundles.truth(stamp, mesh="another"))
    assert caught.value.code is ErrorCode.WRONG_CONTRACT
    known = bundles.truth(stamp)
    short = dataclasses.replace(known, displacement=known.displacement[1:])
    with pytest.raises(RemoteError, match="another mesh"):
        station.synthesise(short)
    assert counters(station, "synthesis")["asked_wrong_mesh"] == 2


def test_nobody_to_ask(link: LinkConfig, make_frame: Frames) -> None:
    with (
        Client(link.connect[0], timeout_s=5.0) as robot,
        pytest.raises(LinkError, match="no service answers"),
    ):
        robot.estimate_field("finger", make_frame())
