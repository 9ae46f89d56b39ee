"""Fields are thinned on their way to the disk, by the clock of the frames; nothing else is."""

from __future__ import annotations

import dataclasses
import importlib
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from palpate.bus import TapSample
from palpate.bus.topics import ELECTRODES, FIELD, FIELD_TRUTH, Topic, sensor_key
from palpate.files.record import read_record
from palpate.health import Health
from palpate.messages import Stamp
from palpate_services.config import EVERYTHING, RecorderConfig
from palpate_services.recorder.writer import RecordFiles

bundles: Any = importlib.import_module("field_bundles")

PERIOD_NS = 50_000_000
SECONDS = 3


def sample_of(topic: Topic[Any], message: Any, sensor: str) -> TapSample:
    key = sensor_key("lab", sensor, topic.name)
    payload = topic.codec.encode(message)
    return TapSample(
        topic.name, "lab", sensor, key, topic.encoding, payload, time.monotonic_ns(), time.time_ns()
    )


def later(stamp: Stamp, number: int) -> Stamp:
    begin_ns = 5_000_000_000
    return dataclasses.replace(
        stamp, monotonic_ns=begin_ns + number * PERIOD_NS, sequence=stamp.sequence + number
    )


@pytest.mark.parametrize(("rate_hz", "kept"), [(1.0, SECONDS), (4.0, 4 * SECONDS), (0.0, 60)])
def test_fields_of_each_sensor_and_kind_at_their_rate(
    make_frame: Any, tmp_path: Path, rate_hz: float, kept: int
) -> None:
    health = Health("recorder", "recorder")
    keys: dict[str, Any] = {**EVERYTHING, "field_rate_hz": rate_hz}
    files = RecordFiles(
        RecorderConfig(out=tmp_path, rrd=False, min_free_bytes=0, **keys), "lab", health
    )
    files.start()
    frame = make_frame()
    for number in range(60):
        stamp = later(frame.stamp, number)
        for sensor in ("left", "right"):
            files.write(sample_of(FIELD, bundles.guess(stamp), sensor))
            files.write(sample_of(FIELD_TRUTH, bundles.truth(stamp), sensor))
            files.write(sample_of(ELECTRODES, dataclasses.replace(frame, stamp=stamp), sensor))
    files.close()
    (record,) = tmp_path.iterdir()
    counts = Counter((item.address.sensor, item.address.topic) for item in read_record(record))
    for sensor in ("left", "right"):
        assert counts[sensor, "electrodes"] == 60
        assert counts[sensor, "field"] == counts[sensor, "field_truth"] == kept
    assert health.counters.get("skipped_field_rate", 0) == 4 * (60 - kept)
    assert health.counters.get("lost_disk_full", 0) == 0
