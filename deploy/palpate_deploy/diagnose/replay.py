"""``palpate replay``: a file through gateway, features and recorder, and the account of it.

The run is independent of any other station: it has a router on a free port and a station name of
its own. With the pace ``fast`` it is lossless: as many frames must be recorded, and answered with
estimates or a reason, as were published. The counts are read back from the record.
"""

from __future__ import annotations

import contextlib
import json
import secrets
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from palpate.bus import Delivery, Session, Subscriber
from palpate.bus.topics import ELECTRODES, FEATURES, STATUS
from palpate.errors import LinkError, PalpateError, RecordingError, printable
from palpate.files.record import metadata_of, summarise
from palpate.messages import SensorState, ServiceState, Status
from palpate_deploy.diagnose.records import viewer_command
from palpate_deploy.station.host import join, private_profile
from palpate_deploy.station.logs import DEVICE, FAILED, print_error
from palpate_deploy.station.processes import FiniteRun
from palpate_deploy.station.profile import Profile
from palpate_deploy.station.status import ask_status


@dataclass(slots=True)
class ReplayAccount:
    """The account of a replay: what was published, estimated and recorded.

    ``gateway`` and ``features`` are the last counters of these services, ``recorded`` the messages
    by topic, read back from ``records``, the files written; ``error`` is why the file ended early.
    ``counted``: whether ``gateway`` are its counters at the end.
    """

    file: Path
    seconds: float = 0.0
    gateway: dict[str, int] = field(default_factory=dict)
    features: dict[str, int] = field(default_factory=dict)
    recorded: dict[str, int] = field(default_factory=dict)
    records: list[Path] = field(default_factory=list)
    error: PalpateError | None = None
    exit_status: int = 0
    counted: bool = False

    @property
    def published(self) -> int:
        """Frames the gateway published, over all sensors."""
        return total(self.gateway, "frames_published")

    @property
    def by_sensor(self) -> dict[str, int]:
        """The same for each of several sensors; with one there is nothing to tell."""
        end = ".frames_published"
        found = {k.removesuffix(end): n for k, n in self.gateway.items() if k.endswith(end)}
        return dict(sorted(found.items()))

    @property
    def estimated(self) -> int:
        """Estimates the features service published."""
        return self.features.get("estimates_published", 0)

    @property
    def answered(self) -> int:
        """Frames with an estimate, or without one for a reason that the service counted."""
        return self.estimated + sum(self.unanswered.values())

    @property
    def problems(self) -> list[str]:
        """Counts that differ and should be equal."""
        found = []
        frames = self.recorded.get(ELECTRODES.name, 0)
        estimates = self.recorded.get(FEATURES.name, 0)
        if not self.counted:
            found.append(
                f"the gateway ended after at least {self.published} frames, and did not say"
            )
        if not self.published:
            found.append("no frame was published")
        if frames != self.published:
            found.append(f"{self.published} frames published, {frames} recorded")
        if self.answered != self.published:
            found.append(f"{self.published} frames published, {self.answered} answered")
        if estimates != self.estimated:
            found.append(f"{self.estimated} estimates published, {estimates} recorded")
        if self.published and not self.estimated:
            found.append(f"no frame got an estimate: {self.unanswered}")
        return found

    @property
    def dropped(self) -> int:
        """Messages of the file that became no reading: too late in order, or not decodable."""
        return sum(total(self.gateway, name) for name in _DROPPED)

    @property
    def unanswered(self) -> dict[str, int]:
        """Frames that got no estimate, by the service's reason."""
        return {k: n for k, n in self.features.items() if n and k not in _NO_REASONS}


_NO_REASONS = frozenset(
    {
        "frames_received",
        "estimates_published",
        "restarts",
        "delivered",
        "received",
        # Frames that the file lacks, so that nobody published them; those that were published and
        # lost are the difference that is a problem.
        "lost_on_bus",
    }
)
"""Counters of the features service that do not stand for a published frame without estimate."""

_DROPPED = ("late_messages", "late_wrenches", "early_messages", "rejected_messages")


def total(counters: dict[str, int], name: str) -> int:
    """A counter summed over sensors: its name is bare with one sensor, prefixed with several."""
    return sum(n for key, n in counters.items() if key == name or key.endswith(f".{name}"))


def count_topics(records: list[Path]) -> dict[str, int]:
    """Messages of records by topic, read back."""
    counts: Counter[str] = Counter()
    for path in records:
        for key, count in summarise(path).counts.items():
            counts[key.rpartition("/")[2]] += count
    return dict(counts)


def as_plain(account: ReplayAccount) -> dict[str, Any]:
    """The account as plain values."""
    error = account.error
    return {
        "file": str(account.file),
        "seconds": round(account.seconds, 3),
        "samples": total(account.gateway, "samples"),
        "frames": account.published,
        "frames_by_sensor": account.by_sensor,
        "missing_frames": total(account.gateway, "missing_frames"),
        "time_jumps": total(account.gateway, "time_jumps"),
        "dropped_messages": account.dropped,
        "estimates": account.estimated,
        "recorded": account.recorded,
        "records": [str(path) for path in account.records],
        "lossless": not account.problems and not account.dropped,
        "gateway": account.gateway,
        "features": account.features,
        "error": None if error is None else {"problem": error.problem, "remedy": error.remedy},
    }


def print_account(account: ReplayAccount) -> None:
    """Print the account as a table, and the files."""
    table = Table(title=printable(account.file.name), title_justify="left", show_header=False)
    table.add_column()
    table.add_column(justify="right")
    plain = as_plain(account)
    for name in ("samples", "frames", "missing_frames", "time_jumps", "estimates"):
        table.add_row(name.replace("_", " "), f"{plain[name]:,}")
    if account.dropped:
        table.add_row("dropped messages", f"{account.dropped:,}")
    for reason, count in sorted(account.unanswered.items()):
        table.add_row(f"  without estimate: {reason}", f"{count:,}")
    for sensor, count in account.by_sensor.items():
        table.add_row(f"  frames of {sensor}", f"{count:,}")
    for topic, count in sorted(account.recorded.items()):
        table.add_row(f"recorded {topic}", f"{count:,}")
    table.add_row("seconds", f"{account.seconds:.1f}")
    Console().print(table)
    for path in account.records:
        print(path)
        if (view := path.with_suffix(".rrd")).is_file():
            print(f"{view}   look at it: {viewer_command(view)}")


_MCAP_MAGIC = b"\x89MCAP0\r\n"
_BAG_MAGIC = b"#ROSBAG"
_POLL_S = 0.1
_JOIN_S = 60.0
_SETTLED_S = 20.0
_LINGER_S = 1.0
_LEASE_S = 60.0
"""Of its links [s]: on a busy host one that waits for a slow reader is silent for seconds, and a
link that is given up loses what is on its way."""


def run_replay(file: Path, pace: str, out: Path, bundle: str, *, rrd: bool, as_json: bool) -> int:
    """Replay a vendor's text log or a palpate record at the pace ``fast`` or ``recorded``.

    Returns:
        0; 1 if something was lost on the way or dropped from the file; 3 if the file is damaged.

    Raises:
        PalpateError: The replay could not be run at all.
    """
    from palpate_services.inference.repository import Repository

    Repository.of_user().resolve(bundle)  # a missing bundle is an error before anything starts
    profile = replay_profile(file, pace, out, bundle, rrd=rrd)
    account = replay(profile, file, show=not as_json)
    if as_json:
        print(json.dumps(as_plain(account), indent=2))
    else:
        print_account(account)
    if account.error is not None:
        print_error(account.error)
        if account.published and pace == "fast":
            _print_problems(account)
        return DEVICE if account.exit_status == DEVICE else FAILED
    # At the recorded pace a slow host may drop frames, as it would live; they are only counted.
    if account.problems and (pace == "fast" or not account.estimated):
        _print_problems(account)
        return FAILED
    if account.dropped:
        print_error(
            RecordingError(
                f"{file}: {account.dropped} of its messages were dropped",
                remedy="their times are earlier than those of messages before them, or their bytes "
                "are no such message; the counters of --json tell which",
            )
        )
        return FAILED
    return 0


def _print_problems(account: ReplayAccount) -> None:
    for problem in account.problems:
        print_error(
            LinkError(
                problem,
                remedy="see the counters above, and report it: a replay must be lossless",
            )
        )


def replay_profile(file: Path, pace: str, out: Path, bundle: str, *, rrd: bool) -> Profile:
    """The profile of a replay, with its values checked.

    Raises:
        PalpateError: The file cannot be played, not even its beginning.
    """
    from palpate_gateway.drivers import make_device

    sensors = sensors_of(file)
    for sensor in sensors:
        # As the gateway will: an error now leaves no record without a frame behind.
        with make_device(sensor["driver"], sensor["options"]):
            pass
    fast = pace == "fast"
    delivery = "every" if fast else "newest"
    return private_profile(
        "replay",
        gateway={"pace": pace, "sensors": sensors, "linger_s": _LINGER_S},
        link={"lease_s": _LEASE_S},
        features={"bundle": bundle, "delivery": delivery, "accept_replayed": True},
        recorder={
            "out": str(out),
            "delivery": "every" if fast else "queue",
            "rrd": rrd,
            "run": secrets.token_hex(8),
        },
    )


def sensors_of(file: Path) -> list[dict[str, Any]]:
    """The gateway's sensors for a file: a record or bag (by its magic bytes), else a text log.

    A log or bag of one finger is the sensor ``finger``; one of several is a sensor for each, named
    by its port, e.g. ``finger-1`` and ``finger-3``. A folder is a bag of ROS 2.
    """
    if file.is_dir():
        return _fingers_of_bag(file)
    with open(file, "rb") as stream:
        head = stream.read(len(_MCAP_MAGIC))
    path = str(file.absolute())
    if head.startswith(_BAG_MAGIC):
        return _fingers_of_bag(file)
    if not head.startswith(_MCAP_MAGIC):
        return _fingers_of_log(file, path)
    from palpate_gateway.recordings.record import recorded_sensors

    names = []
    # Of a damaged record the driver delivers what is before the damage, then raises the error.
    with contextlib.suppress(RecordingError):
        names = recorded_sensors(file)
    if not names:
        return [{"name": "finger", "driver": "record", "options": {"path": path}}]
    # With the name of the sensor the driver need not search the whole record for it.
    return [
        {"name": name, "driver": "record", "options": {"path": path, "sensor": name}}
        for name in names
    ]


def _fingers_of_log(file: Path, path: str) -> list[dict[str, Any]]:
    from palpate_gateway.recordings.text_log import ports_of

    ports: tuple[int, ...] = ()
    with contextlib.suppress(RecordingError):  # the driver tells it
        ports = ports_of(file)
    if len(ports) < 2:
        return [{"name": "finger", "driver": "text_log", "options": {"path": path}}]
    return [
        {"name": f"finger-{port}", "driver": "text_log", "options": {"path": path, "port": port}}
        for port in ports
    ]


def _fingers_of_bag(file: Path) -> list[dict[str, Any]]:
    from palpate_gateway.ros.bag import fingers_of_bag

    path = str(file.absolute())
    found: list[tuple[str, int]] = []
    with contextlib.suppress(RecordingError):  # the driver tells it
        found = fingers_of_bag(file)
    if len(found) < 2:
        # Its place need not be the first.
        known = {"topic": found[0][0], "finger": found[0][1]} if found else {}
        return [{"name": "finger", "driver": "ros_bag", "options": {"path": path, **known}}]
    return [
        {
            "name": f"finger-{number}",
            "driver": "ros_bag",
            "options": {"path": path, "topic": topic, "finger": place},
        }
        for number, (topic, place) in enumerate(found, 1)
    ]


def replay(profile: Profile, file: Path, *, show: bool = False) -> ReplayAccount:
    """Run a replay with a profile of ``replay_profile`` to its end.

    Raises:
        LinkError: The bus cannot be joined.
        ProcessEnded: A process could not start.
    """
    account = ReplayAccount(file)
    out = profile.recorder.out
    before = set(out.glob("*.mcap"))
    began = time.monotonic()
    with FiniteRun("replay") as children:
        children.start_profile(profile)
        with join(profile, wait_s=_JOIN_S) as session, _progress(show) as bar:
            task = bar.add_task(file.name, total=None, frames=0)
            account.exit_status = _follow(children, session, account, bar, task)
    account.seconds = time.monotonic() - began
    # Meanwhile its recorder may have recovered an older one there, and another have closed its own.
    fresh = set(out.glob(f"{profile.station}-*.mcap")) - before
    run = profile.recorder.run
    account.records = sorted(path for path in fresh if metadata_of(path).get("run", "") == run)
    account.recorded = count_topics(account.records)
    if account.exit_status != 0:
        account.error = children.ended("gateway", account.exit_status)
    return account


def _follow(
    children: FiniteRun, session: Session, account: ReplayAccount, bar: Progress, task: Any
) -> int:
    """Update the counters until gateway and consumers have ended; the gateway's exit status."""
    settled_by, counted_ns = float("inf"), 0
    # An answer may take longer than the gateway stays after its last frame, so it is listened to.
    told = session.subscriber(STATUS, service="gateway", delivery=Delivery.QUEUE)
    while True:
        children.check(["router", "features", "recorder"])
        exit_status = children.status("gateway")
        statuses = {status.service: status for status in ask_status(session)}
        counters = {service: dict(status.counters) for service, status in statuses.items()}
        for status in (*_waiting(told), *statuses.values()):
            if status.service == "gateway" and status.monotonic_ns > counted_ns:
                counted_ns = status.monotonic_ns
                account.gateway = dict(status.counters)
                account.counted = _has_ended(status)
        account.features = counters.get("features", account.features)
        frames = account.published
        bar.update(task, completed=frames, frames=frames)
        # The gateway ends before its last frames are estimated and recorded; what is still missing
        # after the wait is reported as a loss.
        if exit_status is not None:
            settled_by = min(settled_by, time.monotonic() + _SETTLED_S)
            recorded = counters.get("recorder", {}).get("recorded_electrodes", 0)
            counted = account.counted or bool(exit_status)
            settled = counted and min(account.answered, recorded) >= frames
            if settled or time.monotonic() > settled_by:
                bar.update(task, total=max(frames, 1), completed=max(frames, 1), frames=frames)
                return exit_status
        time.sleep(_POLL_S)


def _has_ended(gateway: Status) -> bool:
    """Whether all sources have ended, one perhaps by damage: its counters are those at the end."""
    if gateway.state is ServiceState.FINISHED:
        return True
    ended = [one.name for one in gateway.sensor_states if one.state is SensorState.ENDED]
    return bool(ended) and len(ended) == len(gateway.sensors)


def _waiting(statuses: Subscriber[Status]) -> Iterator[Status]:
    """Those that have arrived."""
    with contextlib.suppress(PalpateError):
        while True:
            yield statuses.next(0.0).message


def _progress(show: bool) -> Progress:
    return Progress(
        TextColumn("replay {task.description}"),
        BarColumn(),
        TextColumn("{task.fields[frames]:,} frames"),
        TimeElapsedColumn(),
        disable=not show,
    )
