"""The account of a replay: what was published, estimated and recorded, and whether it is equal."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from palpate.bus.topics import ELECTRODES, FEATURES
from palpate.errors import PalpateError
from palpate.files.record import summarise
from palpate_deploy.viewer import viewer_command


@dataclass(slots=True)
class Outcome:
    """What came of a replay.

    Attributes:
        file: What was replayed.
        seconds: How long it took [s].
        gateway: Last counters of the gateway.
        features: Last counters of the features service.
        recorded: Recorded messages by topic, read back from the records.
        records: The files written.
        error: Why the file ended early, if it did.
        exit_status: Of the gateway.
    """

    file: Path
    seconds: float = 0.0
    gateway: dict[str, int] = field(default_factory=dict)
    features: dict[str, int] = field(default_factory=dict)
    recorded: dict[str, int] = field(default_factory=dict)
    records: list[Path] = field(default_factory=list)
    error: PalpateError | None = None
    exit_status: int = 0

    @property
    def published(self) -> int:
        """Frames the gateway published, over all sensors."""
        return total(self.gateway, "frames_published")

    @property
    def estimated(self) -> int:
        """Estimates the features service published."""
        return self.features.get("estimates_published", 0)

    @property
    def problems(self) -> list[str]:
        """What is not equal and ought to be.

        A frame that got no estimate for a good reason is accounted for by the reason's counter.
        """
        found = []
        answered = self.estimated + sum(self.unanswered.values())
        frames = self.recorded.get(ELECTRODES.name, 0)
        estimates = self.recorded.get(FEATURES.name, 0)
        if not self.published:
            found.append("no frame was published")
        if frames != self.published:
            found.append(f"{self.published} frames published, {frames} recorded")
        if answered != self.published:
            found.append(f"{self.published} frames published, {answered} answered")
        if estimates != self.estimated:
            found.append(f"{self.estimated} estimates published, {estimates} recorded")
        if self.published and not self.estimated:
            found.append(f"no frame got an estimate: {self.unanswered}")
        return found

    @property
    def unanswered(self) -> dict[str, int]:
        """Frames that got no estimate, by the service's reason."""
        known = {"frames_received", "estimates_published", "restarts", "delivered", "received"}
        return {k: n for k, n in self.features.items() if n and k not in known}


def total(counters: dict[str, int], name: str) -> int:
    """A counter summed over sensors: one sensor's has the bare name, several have a prefix."""
    return sum(n for key, n in counters.items() if key == name or key.endswith(f".{name}"))


def count_topics(records: list[Path]) -> dict[str, int]:
    """Messages of records by topic, read back."""
    counts: Counter[str] = Counter()
    for path in records:
        for key, count in summarise(path).counts.items():
            counts[key.rpartition("/")[2]] += count
    return dict(counts)


def as_plain(outcome: Outcome) -> dict[str, Any]:
    """The account as plain values."""
    error = outcome.error
    return {
        "file": str(outcome.file),
        "seconds": round(outcome.seconds, 3),
        "samples": total(outcome.gateway, "samples"),
        "frames": outcome.published,
        "missing_frames": total(outcome.gateway, "missing_frames"),
        "time_jumps": total(outcome.gateway, "time_jumps"),
        "estimates": outcome.estimated,
        "recorded": outcome.recorded,
        "records": [str(path) for path in outcome.records],
        "lossless": not outcome.problems,
        "gateway": outcome.gateway,
        "features": outcome.features,
        "error": None if error is None else {"problem": error.problem, "remedy": error.remedy},
    }


def print_account(outcome: Outcome) -> None:
    """Print the account as a table, and the files."""
    table = Table(title=str(outcome.file), title_justify="left", show_header=False)
    table.add_column()
    table.add_column(justify="right")
    plain = as_plain(outcome)
    for name in ("samples", "frames", "missing_frames", "time_jumps", "estimates"):
        table.add_row(name.replace("_", " "), f"{plain[name]:,}")
    for reason, count in sorted(outcome.unanswered.items()):
        table.add_row(f"  without estimate: {reason}", f"{count:,}")
    for topic, count in sorted(outcome.recorded.items()):
        table.add_row(f"recorded {topic}", f"{count:,}")
    table.add_row("seconds", f"{outcome.seconds:.1f}")
    Console().print(table)
    for path in outcome.records:
        print(path)
        if (view := path.with_suffix(".rrd")).is_file():
            print(f"{view}   look at it: {viewer_command(view)}")
