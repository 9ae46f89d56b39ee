"""A record of the virtual finger without bus and clock: as fast as it can be computed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from palpate.bus.topics import ELECTRODES, TOPICS, sensor_key
from palpate.files.record import RecordWriter
from palpate_gateway.drivers import make_device
from palpate_gateway.pipeline import Outgoing, Pipeline
from palpate_gateway.timing.clock_map import FileClock

SENSOR = "virtual-finger"
_STATION = "virtual"


def write_virtual_record(
    path: Path,
    *,
    frames: int,
    seed: int,
    unit: int = 1,
    rate_hz: float = 100.0,
    on_frames: Callable[[int], None] | None = None,
) -> int:
    """Record the virtual finger as a gateway would publish it, tare and ground truth included.

    Args:
        path: ``NAME.mcap``.
        frames: How many electrode frames.
        seed: Of trajectories and noise.
        unit: Number of the finger.
        rate_hz: Frames per second of the finger's time; fewer give more presses for as many frames.
        on_frames: Called with the frames written so far, for a progress bar.

    Returns:
        The electrode frames written.

    Raises:
        RecordingError: The disk refuses.
    """
    options = {
        "model": "formula",  # endless different presses; a tape repeats its own
        "seed": seed,
        "unit": unit,
        "frames": frames,
        "realtime": False,
        "rate_hz": rate_hz,
    }
    keys = {name: sensor_key(_STATION, SENSOR, name) for name in TOPICS}
    written = 0
    facts = {"station": _STATION, "source": f"virtual finger, seed {seed}, unit {unit}"}
    with make_device("virtual", options) as device, RecordWriter(path, facts) as writer:
        pipeline = Pipeline(device.info)
        clock = FileClock(device.identity.serial, None)
        pipeline.begin(device.identity, clock)

        def write(items: list[Outgoing]) -> None:
            nonlocal written
            for item in items:
                topic = TOPICS[item.topic]
                stamp = topic.stamp_of(item.message)
                payload = (
                    item.message
                    if isinstance(item.message, bytes)
                    else topic.codec.encode(item.message)
                )
                writer.write(
                    keys[item.topic],
                    topic.codec.schema,
                    payload,
                    # A record is in order of its log times; here they are the readings' own.
                    log_time_ns=0 if stamp is None else stamp.wall_ns,
                    sequence=0 if stamp is None else stamp.sequence,
                )
                written += item.topic == ELECTRODES.name
            if on_frames is not None:
                on_frames(written)

        while readings := device.read(timeout_s=1.0):
            write(pipeline.push(readings, arrival_ns=0))
        write(pipeline.finish())
    return written
