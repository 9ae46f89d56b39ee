"""The training of the bundle for the virtual finger."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from palpate.bus.topics import ELECTRODES, TOPICS, sensor_key
from palpate.errors import BundleError
from palpate.files.record_writer import RecordWriter
from palpate.process import require
from palpate_gateway.clock.stamps import DueMessage, FileClock
from palpate_gateway.drivers import make_device
from palpate_gateway.service.pipeline import Pipeline
from palpate_services.inference.repository import PACKAGED
from palpate_training import EXTRA_MODULES

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
    """Record the virtual finger as a gateway publishes it, with tare and ground truth.

    ``unit`` is the number of the specimen; a lower ``rate_hz`` of the finger's time [Hz] gives more
    indentations for as many frames; ``on_frames`` is called with the frames written so far. Returns
    the electrode frames written.

    Raises:
        RecordingError: The disk is full or refuses to write.
    """
    options = {
        "model": "formula",  # new indentations without end; a tape would repeat its own
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

        def write(item: DueMessage) -> None:
            nonlocal written
            topic = TOPICS[item.topic]
            stamp = topic.stamp_of(item.message)
            message = item.message
            writer.write(
                keys[item.topic],
                topic.codec.schema,
                message if isinstance(message, bytes) else topic.codec.encode(message),
                # A record is ordered by log time; here it is the time of the reading.
                log_time_ns=0 if stamp is None else stamp.wall_ns,
                sequence=0 if stamp is None else stamp.sequence,
            )
            written += item.topic == ELECTRODES.name

        while readings := device.read(timeout_s=1.0):
            pipeline.push(readings, 0, write)
            if on_frames is not None:
                on_frames(written)
        pipeline.finish(write)
    return written


NAME = "features-virtual"

RATE_HZ = 20.0
"""Rate at which the finger is recorded for training [Hz]: successive frames at 100 Hz are nearly
alike, so the same number of frames is better used for five times as many indentations."""


def make_virtual_bundle(out: Path | None, *, frames: int, seed: int) -> None:
    """Record the virtual finger, ingest the record, train, and write the bundle.

    ``out`` None means the next free version of the packaged bundle.

    Raises:
        MissingExtraError: The training extra is not installed.
        BundleError: The folder exists, or the exported model differs from the trained one.
    """
    for module in EXTRA_MODULES:
        require(module, extra="training")
    from palpate_training.datasets.features import write_dataset
    from palpate_training.datasets.ingest import ingest_record
    from palpate_training.tasks.features import train_features

    folder = PACKAGED / NAME / str(_next_version()) if out is None else out
    version = int(folder.name) if folder.name.isdigit() else 1
    if folder.exists():
        raise BundleError(
            f"{folder} exists and bundles are immutable", remedy="write the next version"
        )
    with tempfile.TemporaryDirectory(prefix="palpate-bundle-") as temporary, _progress() as bar:
        record = Path(temporary) / "virtual.mcap"
        step = bar.add_task("virtual finger", total=frames)
        write_virtual_record(
            record,
            frames=frames,
            seed=seed,
            rate_hz=RATE_HZ,
            on_frames=lambda n: bar.update(step, completed=n),
        )
        step = bar.add_task("ingest", total=None)
        command = f"palpate bundle virtual --frames {frames} --seed {seed}"
        dataset = Path(temporary) / "virtual.h5"
        data = ingest_record(record, command=command, licence="Apache-2.0, made by palpate")
        write_dataset(dataset, data)
        bar.update(step, total=1, completed=1)
        steps: dict[str, TaskID] = {}

        def on_epoch(quantity: str, done: int, at_most: int) -> None:
            if quantity not in steps:
                steps[quantity] = bar.add_task(f"train {quantity}", total=at_most)
            bar.update(steps[quantity], completed=done)

        report = train_features(
            dataset,
            folder,
            name=NAME,
            version=version,
            seed=seed,
            serials=("VIRTUAL-*",),
            on_epoch=on_epoch,
        )
        for task in steps.values():  # training may stop before the last epoch
            bar.update(task, total=1, completed=1)
    print(f"{NAME}:{version}  {report.digest.hex()[:12]}  {folder}")
    print("rows: train {:,}, validation {:,}, test {:,}".format(*report.rows))
    for name, value in sorted(report.metrics.items()):
        print(f"  {name:40} {value:.4g}")


def _next_version() -> int:
    """The version after the newest."""
    there = [int(path.name) for path in (PACKAGED / NAME).glob("*") if path.name.isdigit()]
    return max(there, default=0) + 1


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description:24}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
