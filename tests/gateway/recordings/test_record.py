from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from palpate.bus.topics import ELECTRODES, FEATURES, sensor_key
from palpate.errors import ConfigError, RecordingError
from palpate.files.record import read_record
from palpate.files.record_writer import RecordWriter
from palpate_gateway.drivers import make_device
from palpate_gateway.readings import RecordedMessage
from palpate_gateway.recordings.record import recorded_sensors


def messages(path: Path, sensor: str = "") -> list[RecordedMessage]:
    out: list[RecordedMessage] = []
    with make_device("record", {"path": path, "sensor": sensor}) as device:
        while got := device.read(1.0):
            out += [r for r in got if isinstance(r, RecordedMessage)]
    return out


def test_payloads_and_order_are_unchanged(record: Callable[..., Path]) -> None:
    path = record(60)
    wanted = [(item.address.topic, item.payload) for item in read_record(path)]
    assert [(m.topic, m.payload) for m in messages(path)] == wanted
    assert {topic for topic, _ in wanted} == {"electrodes", "wrench", "pose", "tare"}


def test_estimates_are_not_replayed(record: Callable[..., Path], tmp_path: Path) -> None:
    other = tmp_path / "more.mcap"
    with RecordWriter(other) as writer:
        for item in read_record(record(60)):
            writer.write(item.key, item.schema, item.payload, log_time_ns=item.log_time_ns)
        writer.write(
            sensor_key("lab", "finger", FEATURES.name), FEATURES.codec.schema, b"x", log_time_ns=1
        )
    assert "features" not in {m.topic for m in messages(other)}


def test_a_first_frame_that_breaks_the_contract_does_not_prevent_a_replay(
    record: Callable[..., Path], tmp_path: Path
) -> None:
    path, spoilt = record(60), tmp_path / "spoilt.mcap"
    with RecordWriter(spoilt) as writer:
        key = sensor_key("lab", "finger", ELECTRODES.name)
        writer.write(key, ELECTRODES.codec.schema, b"no frame", log_time_ns=1)
        for item in read_record(path):
            writer.write(item.key, item.schema, item.payload, log_time_ns=item.log_time_ns)
    with (
        make_device("record", {"path": path}) as whole,
        make_device("record", {"path": spoilt}) as device,
    ):
        assert device.identity == whole.identity


def test_one_of_several_sensors(record: Callable[..., Path]) -> None:
    path = record(60, sensors=("index", "thumb"))
    assert recorded_sensors(path) == ["index", "thumb"]
    with pytest.raises(ConfigError, match="2 sensors: index, thumb -> choose one with the option"):
        messages(path)
    assert messages(path, "thumb") != messages(path, "index")
    tactile = "no electrode frames of sensor 'ring' -> name a tactile sensor .*: index, thumb"
    with pytest.raises(RecordingError, match=tactile):
        messages(path, "ring")


@pytest.mark.parametrize("sensor", ["", "finger"])
def test_two_stations_do_not_become_one_finger(
    record: Callable[..., Path], tmp_path: Path, sensor: str
) -> None:
    both = tmp_path / "both.mcap"
    with RecordWriter(both) as writer:
        for item in read_record(record(60)):
            for station in ("lab", "other"):
                key = sensor_key(station, item.address.sensor, item.address.topic)
                writer.write(key, item.schema, item.payload, log_time_ns=item.log_time_ns)
    for read in (recorded_sensors, lambda path: messages(path, sensor)):
        with pytest.raises(RecordingError, match="holds the stations lab, other"):
            read(both)


def test_cut_record_delivers_and_then_says_so(record: Callable[..., Path]) -> None:
    path = record(60)
    whole = messages(path)
    path.write_bytes(path.read_bytes()[:-100])
    out: list[RecordedMessage] = []

    def drain() -> None:
        while got := device.read(1.0):
            out.extend(r for r in got if isinstance(r, RecordedMessage))

    with make_device("record", {"path": path}) as device:
        with pytest.raises(RecordingError, match="damaged or cut off after"):
            drain()
        assert device.read(1.0) == []
    assert out == whole


def test_not_a_record(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"hello")
    with pytest.raises(RecordingError, match=r"a\.mcap is no MCAP file"):
        messages(path)
    with pytest.raises(RecordingError, match="does not exist"):
        messages(tmp_path / "no.mcap")
