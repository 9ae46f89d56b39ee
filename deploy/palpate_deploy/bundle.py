"""``palpate bundle virtual``: the bundle of the demo, trained on the virtual finger."""

from __future__ import annotations

import tempfile
from pathlib import Path

from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from palpate.errors import BundleError
from palpate.extras import require
from palpate_deploy.training import EXTRA_MODULES
from palpate_deploy.virtual_record import write_virtual_record
from palpate_services.repository import PACKAGED

NAME = "features-virtual"

RATE_HZ = 20.0
"""Rate at which the finger is recorded for training: neighbouring frames of a press say nearly the
same, so the same number of frames is better spent on five times as many presses."""


def make_virtual_bundle(out: Path | None, *, frames: int, seed: int) -> None:
    """Record the virtual finger, ingest, train, and write the bundle whole or not at all.

    Args:
        out: Folder to write; None = the next free version of the one that ships.
        frames: Frames of the virtual finger.
        seed: Of the finger, and of training.

    Raises:
        MissingExtraError: The training extra is not installed.
        BundleError: The folder exists, or the exported model is not the trained one.
    """
    for module in EXTRA_MODULES:
        require(module, extra="training")
    from palpate_training.ingest_record import ingest_record
    from palpate_training.schema import write_dataset
    from palpate_training.train_features import train_features

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
            on_epoch=on_epoch,
        )
        for task in steps.values():  # training may stop before the last epoch
            bar.update(task, total=1, completed=1)
    print(f"{NAME}:{version}  {report.digest.hex()[:12]}  {folder}")
    print("rows: train {:,}, validation {:,}, test {:,}".format(*report.rows))
    for name, value in sorted(report.metrics.items()):
        print(f"  {name:40} {value:.4g}")


def _next_version() -> int:
    """The version after the newest that is there."""
    there = [int(path.name) for path in (PACKAGED / NAME).glob("*") if path.name.isdigit()]
    return max(there, default=0) + 1


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description:24}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
