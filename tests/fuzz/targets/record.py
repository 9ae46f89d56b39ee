"""A palpate record (MCAP) from file to messages."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

from mcap.writer import CompressionType, Writer
from tests.fuzz.streams import has_remedy
from tests.gateway.pipelines import pushed

from palpate.bus.topics import TOPICS, sensor_key
from palpate.codec import ELECTRODE_FRAME
from palpate.errors import ConfigError, RecordingError
from palpate.files.record import summarise
from palpate.files.record_writer import descriptor_set
from palpate_gateway.clock.stamps import FileClock
from palpate_gateway.drivers import make_device
from palpate_gateway.readings import RecordedMessage
from palpate_gateway.recordings.record import RecordOptions, RecordReplay
from palpate_gateway.service.pipeline import Pipeline

_FOLDER = tempfile.TemporaryDirectory(prefix="fuzz-record-")
_PATH = Path(_FOLDER.name, "a.mcap")


def check(data: bytes) -> None:
    """All bytes are the file."""
    _PATH.write_bytes(data)
    try:
        summary = summarise(_PATH)
        assert all(count > 0 for count in summary.counts.values())
    except RecordingError as error:
        has_remedy(error)
    device = RecordReplay(RecordOptions(path=_PATH))
    try:
        device.open()
    except (RecordingError, ConfigError) as error:
        has_remedy(error)
        return
    assert device.identity.slot_period_s > 0
    messages = []
    for _ in range(2):  # damage is told once, and only after all that came before it
        try:
            while got := device.read(1.0):
                messages += got
            break
        except RecordingError as error:
            has_remedy(error)
    assert device.read(1.0) == []
    assert device.counters["messages"] == len(messages)
    device.close()
    for message in messages:
        assert isinstance(message, RecordedMessage)
        assert message.topic in TOPICS


def _payloads(frames: int) -> list[bytes]:
    """Frames of a virtual finger as they are recorded."""
    device = make_device("virtual", {"model": "formula", "realtime": False, "frames": frames})
    pipeline = Pipeline(device.info)
    payloads = []
    with device:
        pipeline.begin(device.identity, FileClock("a", 10**18))
        while readings := device.read(1.0):
            for item in pushed(pipeline, readings, 0):
                if item.topic == "electrodes":
                    payloads.append(TOPICS[item.topic].codec.encode(item.message))
    return payloads


def _mcap(payloads: list[bytes], *, chunks: bool, sums: bool, sensors: tuple[str, ...]) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.NONE, use_chunking=chunks, enable_crcs=sums)
    writer.start(profile="", library="seed")
    descriptor = descriptor_set(ELECTRODE_FRAME.message_type)
    schema = writer.register_schema(ELECTRODE_FRAME.schema, "protobuf", descriptor)
    for sensor in sensors:
        channel = writer.register_channel(
            sensor_key("lab", sensor, "electrodes"), "protobuf", schema
        )
        for number, payload in enumerate(payloads):
            writer.add_message(channel, log_time=number, data=payload, publish_time=number)
    writer.finish()
    return stream.getvalue()


def seeds() -> list[bytes]:
    """Small records without checksums, so that what is inside can be damaged; and one with."""
    payloads = _payloads(2)
    plain = _mcap(payloads, chunks=False, sums=False, sensors=("a",))
    return [
        plain,
        plain[: len(plain) // 2],
        _mcap(payloads, chunks=True, sums=False, sensors=("a",)),
        _mcap(payloads, chunks=False, sums=False, sensors=("a", "b")),
        _mcap(payloads, chunks=True, sums=True, sensors=("a",)),
        _mcap([b"\x08\x01"], chunks=False, sums=False, sensors=("a",)),
        _mcap([], chunks=False, sums=False, sensors=("a",)),
    ]
