"""``palpate info``, ``review`` and ``recover``: records on disk."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console
from rich.table import Table

from palpate.deploy.status import duration_text
from palpate.deploy.viewer import viewer_command
from palpate.protos.record import RecordSummary, check_readable, recover, summarise


def show_info(path: Path, *, as_json: bool) -> None:
    """Print the contents of a record.

    Raises:
        RecordingError: It is damaged or not palpate's.
    """
    if not as_json:
        print_contents(path)
        return
    summary = summarise(path)
    print(
        json.dumps(
            {
                "file": str(path),
                "bytes": path.stat().st_size,
                "complete": summary.complete,
                "start_wall_ns": summary.start_wall_ns,
                "end_wall_ns": summary.end_wall_ns,
                "counts": dict(summary.counts),
                "metadata": dict(summary.metadata),
            },
            indent=2,
        )
    )


def print_contents(path: Path) -> RecordSummary:
    """Print one row for each stream of a record.

    Raises:
        RecordingError: It is damaged or not palpate's.
    """
    summary = summarise(path)
    if summary.complete:
        check_readable(path)
    seconds = max(0, summary.end_wall_ns - summary.start_wall_ns) * 1e-9
    began = datetime.fromtimestamp(summary.start_wall_ns * 1e-9, UTC)
    table = Table(title=str(path), title_justify="left")
    table.add_column("stream", overflow="fold")
    table.add_column("messages", justify="right")
    table.add_column("Hz", justify="right")
    for key, count in sorted(summary.counts.items()):
        rate = f"{(count - 1) / seconds:.2f}" if seconds and count > 1 else "-"
        table.add_row(key, f"{count:,}", rate)
    table.caption = (
        f"{path.stat().st_size / 1e6:.2f} MB, from {began:%Y-%m-%d %H:%M:%S} UTC, "
        f"{duration_text(seconds)}" + ("" if summary.complete else ", cut off: palpate recover")
    )
    Console().print(table)
    return summary


def review_record(path: Path, view: Path | None, picture: Path | None) -> None:
    """Write the Rerun view of a record, and on request the picture.

    Raises:
        RecordingError: The record is damaged or not palpate's.
        MissingExtraError: Rerun or matplotlib is not installed.
    """
    from palpate.services.view import review

    written = review(path, view)
    print(f"{written}  ({written.stat().st_size / 1e6:.1f} MB)")
    if picture is not None:
        from palpate.services.plot import plot_record

        for name, value in plot_record(path, picture).items():
            print(f"  {name:24} {value:.4g}")
        print(picture)
    print(f"look at it: {viewer_command(written)}")


def recover_record(part: Path) -> None:
    """Write ``NAME.recovered.mcap`` from ``NAME.mcap.part``.

    Raises:
        RecordingError: Nothing in it can be read.
    """
    print_contents(recover(part))
