"""``palpate calibrate``: a finger's own features bundle, from presses against a force sensor.

The presses are recorded first, whole, and learned from afterwards. So nothing is lost where
something fails: ``--from`` takes the record again.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

from palpate.admin import read_token, token_file
from palpate.bus import Delivery, Session
from palpate.bus.topics import ELECTRODES, WRENCH, Topic
from palpate.client.estimates import ask_tare
from palpate.client.models import ModelAdmin
from palpate.config import LinkConfig, parse_config
from palpate.errors import ConfigError, LinkError, RecordingError, RemoteError, StreamTimeout
from palpate.process import check_installed, stop_on_signals
from palpate_deploy.station.profile import Profile
from palpate_services.config import EVERYTHING, ModelsConfig, RecorderConfig
from palpate_services.inference.repository import Repository
from palpate_services.recorder.service import run_recorder
from palpate_training import EXTRA_MODULES

if TYPE_CHECKING:
    from palpate_training.datasets.features import FeatureDataset
    from palpate_training.tasks.finger import FingerReport

PRESS_N = 0.5
"""A force above this is a press [N]."""

RELEASE_N = 0.2
"""Below this the finger is let go [N]; as where a record is read (``TOUCH_N``)."""

HELD_S = 0.3
"""A shorter press does not count [s]."""

HINTS = (
    "straight onto the pad, gently",
    "straight onto the pad, firmly",
    "onto the pad, leaning to the left",
    "onto the pad, leaning to the right",
    "onto the tip",
    "onto the pad, then towards the tip",
    "onto the left side of the pad",
    "onto the right side of the pad",
    "far back on the pad",
    "gently, then firmly, then gently",
)
"""What to do for the next press: the estimator knows nothing of what was not pressed."""

_SEEN_S = 5.0
"""A stream that brings nothing for this long is not there [s]."""

_LET_GO_S = 60.0
"""How long is waited until nobody touches the finger [s]."""

_TARE_S = 10.0
_LINE_S = 2.0
_AGAIN_S = 0.5


class PressCounter:
    """Counts presses in a stream of forces: each begins, is held, and ends."""

    def __init__(self) -> None:
        self.count = 0
        self.largest_n = 0.0
        self._since_s: float | None = None

    @property
    def pressed(self) -> bool:
        """Whether one is under way."""
        return self._since_s is not None

    def take(self, now_s: float, force_n: float) -> bool:
        """One reading: its time [s] and the magnitude [N]; whether it ended a press that counts."""
        if self._since_s is None:
            if force_n >= PRESS_N:
                self._since_s, self.largest_n = now_s, force_n
            return False
        self.largest_n = max(self.largest_n, force_n)
        if force_n >= RELEASE_N:
            return False
        held, self._since_s = now_s - self._since_s >= HELD_S, None
        self.count += held
        return held


@dataclass(frozen=True, slots=True)
class CalibrationOrder:
    """What ``palpate calibrate`` is to do.

    Attributes:
        sensor: Name of the finger at the station, or in the file.
        presses: How many presses to record.
        out: Folder of the record.
        source: A record or data set to learn from, instead of recording one.
        name: Of the bundle; empty = by the serial number.
        serve: Whether the station serves the bundle for this finger afterwards.
    """

    sensor: str
    presses: int
    out: Path
    source: Path | None
    name: str
    serve: bool


def calibrate_finger(
    link: LinkConfig,
    station: str,
    order: CalibrationOrder,
    *,
    token: Path | None,
    profile: Profile | None,
    as_json: bool,
) -> None:
    """Record presses, learn from them, and serve what was learned.

    ``token`` None is that of the station, as the ``profile`` or the default says where.

    Raises:
        LinkError: There is no router, or no such finger, or no force sensor for it.
        DatasetError: Too few presses.
        BundleError: The bundle cannot be written.
        MissingExtraError: The training extra is not installed.
    """
    for module in EXTRA_MODULES:
        check_installed(module, extra="training")
    console = Console(stderr=as_json)
    kept = ModelsConfig() if profile is None else profile.models
    # Before the presses: nobody wants to press twenty times for a bundle that cannot be served.
    secret = b""
    if order.serve:
        secret = read_token(token_file(kept.memory_folder, station) if token is None else token)
    source = order.source
    if source is None:
        source = record_presses(link, station, order, console)
    data, serials = _read(source, order.sensor)
    name = order.name or f"features-{_plain(serials[0] if serials else order.sensor)}"
    report, label, folder = _learn(data, serials, name, kept.repository_folder, console)
    if as_json:
        print(
            json.dumps(
                {
                    "bundle": label,
                    "folder": str(folder),
                    "source": str(source),
                    "serials": serials,
                    **asdict(report),
                    "digest": report.digest.hex(),
                },
                indent=2,
            )
        )
    else:
        _show(report, label, console)
    if order.serve:
        with Session.open(link, station=station) as session:
            ModelAdmin(session, secret).load("features", label, sensor=order.sensor)
        console.print(
            f"{label} serves {order.sensor}; back: palpate model rollback --sensor {order.sensor}",
            markup=False,
        )
    else:
        console.print(f"serve it: palpate model load {label} --sensor {order.sensor}", markup=False)


def record_presses(
    link: LinkConfig, station: str, order: CalibrationOrder, console: Console
) -> Path:
    """Guide through the presses while they are recorded; the record.

    Ctrl-C ends before the last press; what was recorded then is learned from.

    Raises:
        LinkError: There is no router, or no such finger, or no force sensor for it.
        RemoteError: The gateway takes no tare.
        StreamTimeout: A stream ends, or the finger is not let go.
        RecordingError: The record cannot be written.
    """
    interrupted = stop_on_signals()
    with Session.open(link, station=station) as session:
        for topic, remedy in (
            (ELECTRODES, "see palpate status, and palpate gateway list"),
            (WRENCH, f'give the force/torque sensor of = "{order.sensor}" in the profile'),
        ):
            _require_stream(session, topic, order.sensor, remedy)
        with _recording(link, station, order) as recording:
            console.print("let go of the finger: it is tared", markup=False)
            _tare(session, order.sensor, interrupted)
            if not interrupted.is_set():
                _guide(session, order, interrupted, console, check=recording.check)
        return recording.path()


def _require_stream(session: Session, topic: Topic[Any], sensor: str, remedy: str) -> None:
    with session.subscriber(topic, sensor=sensor) as stream:
        try:
            stream.next(_SEEN_S)
        except StreamTimeout as error:
            raise LinkError(
                f"nothing comes on {topic.name} of {sensor!r} in {_SEEN_S:g} s", remedy=remedy
            ) from error


class _Recording:
    """A recorder in a thread of its own.

    Attributes:
        failure: What ended it before its time; None = nothing.
    """

    def __init__(self, out: Path) -> None:
        self._out = out
        self._before = set(out.glob("*.mcap"))
        self.failure: BaseException | None = None

    def check(self) -> None:
        """Raise what ended it: nobody shall press for nothing."""
        if self.failure is not None:
            raise self.failure

    def path(self) -> Path:
        """The finished record.

        Raises:
            RecordingError: There is none.
        """
        self.check()
        new = sorted(set(self._out.glob("*.mcap")) - self._before)
        if not new:
            raise RecordingError(
                f"no record was written to {self._out}", remedy="check the disk's free space"
            )
        return new[-1]


@contextlib.contextmanager
def _recording(link: LinkConfig, station: str, order: CalibrationOrder) -> Iterator[_Recording]:
    """Record the finger inside the block."""
    settings = {
        **EVERYTHING,
        "out": str(order.out),
        "topics": ("electrodes", "wrench", "pose", "tare"),
        "sensor": order.sensor,
        "rrd": False,
    }
    config = parse_config(RecorderConfig, settings, where="command line")
    recording, stop = _Recording(config.out), threading.Event()

    def run() -> None:
        try:
            run_recorder(config, link, station, stop, instance=f"calibrate-{os.getpid()}")
        except BaseException as error:
            recording.failure = error

    thread = threading.Thread(target=run, name="record", daemon=True)
    thread.start()
    try:
        yield recording
    finally:
        stop.set()
        thread.join()


def _tare(session: Session, sensor: str, interrupted: threading.Event) -> None:
    """Tare the finger as soon as nobody touches it."""
    give_up_s = time.monotonic() + _LET_GO_S
    while not interrupted.is_set():
        try:
            ask_tare(session, sensor, frames=0, timeout_s=_TARE_S)
            return
        except RemoteError:  # it is touched
            if time.monotonic() >= give_up_s:
                raise
            interrupted.wait(_AGAIN_S)


def _guide(
    session: Session,
    order: CalibrationOrder,
    interrupted: threading.Event,
    console: Console,
    *,
    check: Callable[[], None],
) -> None:
    """Show what to press next until enough presses are recorded; ``check`` raises what is wrong."""
    counter, hints = PressCounter(), itertools.cycle(HINTS)
    hint = next(hints)
    bar = Progress(
        TextColumn("press"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}")
    )
    task = bar.add_task("", total=order.presses)
    lines_s = time.monotonic()
    with (
        session.subscriber(WRENCH, sensor=order.sensor, delivery=Delivery.QUEUE) as forces,
        Live(bar, console=console, refresh_per_second=10),
    ):
        while counter.count < order.presses and not interrupted.is_set():
            batch = forces.next_batch(_SEEN_S)
            check()
            if not batch:
                raise StreamTimeout(
                    f"the force of {order.sensor!r} stopped for {_SEEN_S:g} s",
                    remedy=f"see palpate status; {order.out} keeps what was recorded, for --from",
                )
            for received in batch:
                wrench = received.message
                force_n = float(np.linalg.norm(wrench.force))
                if counter.take(1e-9 * wrench.stamp.monotonic_ns, force_n):
                    hint = next(hints)
                    if not console.is_terminal:
                        console.print(
                            f"press {counter.count} of {order.presses}: {counter.largest_n:.1f} N",
                            markup=False,
                        )
            what = "let go" if counter.pressed else hint
            bar.update(task, completed=counter.count, description=f"{force_n:5.2f} N   {what}")
            if not console.is_terminal and time.monotonic() >= lines_s:
                lines_s = time.monotonic() + _LINE_S
                console.print(f"{force_n:.2f} N, next: {what}", markup=False)


def _read(source: Path, sensor: str) -> tuple[FeatureDataset, list[str]]:
    """The finger's rows of a record or data set, and its serial numbers where they are known."""
    from palpate_training.datasets.features import open_dataset
    from palpate_training.datasets.ingest import read_streams, rows_of_streams

    if source.suffix != ".mcap":
        return open_dataset(source), []
    streams = read_streams(source)
    if sensor not in streams:
        raise ConfigError(
            f"{source} holds no sensor {sensor!r}",
            remedy=f"it holds: {', '.join(sorted(streams)) or 'none'}",
        )
    serials = sorted({frame.sensor_serial for frame in streams[sensor].frames} - {""})
    return rows_of_streams(source, {sensor: streams[sensor]}), serials


def _learn(
    data: FeatureDataset,
    serials: list[str],
    name: str,
    bundles: Path,
    console: Console,
) -> tuple[FingerReport, str, Path]:
    from palpate_training.tasks.finger import STEPS, train_finger

    known = [label.partition(":") for label in Repository(bundles).available()]
    version = 1 + max((int(number) for other, _, number in known if other == name), default=0)
    folder = bundles / name / str(version)
    with Progress(
        TextColumn("learn, and hold presses out"), BarColumn(), console=console
    ) as progress:
        task = progress.add_task("", total=STEPS)
        report = train_finger(
            data,
            folder,
            name=name,
            version=version,
            serials=serials,
            on_step=lambda: progress.advance(task),
        )
    return report, f"{name}:{version}", folder


def _show(report: FingerReport, label: str, console: Console) -> None:
    found = report.metrics
    table = Table(title=label, title_justify="left")
    table.add_column(f"{report.presses} presses, each held out")
    table.add_column("magnitude [N]", justify="right")
    table.add_column("angle [rad]", justify="right")
    for words, prefix in (
        ("this bundle", ""),
        ("a line", "linear_"),
        ("always the mean", "constant_"),
    ):
        table.add_row(
            words,
            f"{found[f'{prefix}force_magnitude_median_n']:.3f}",
            f"{found[f'{prefix}force_angle_median_rad']:.3f}",
        )
    console.print(table)
    console.print(
        f"medians; 95 % of the magnitudes within {found['force_magnitude_p95_n']:.2f} N\n"
        f"90 % intervals hold {found['coverage_90']:.0%} of the errors\n"
        f"it holds: {report.estimator}",
        markup=False,
    )


def _plain(serial: str) -> str:
    """A serial number as part of a bundle's name."""
    return re.sub(r"[^a-z0-9_-]+", "-", serial.lower()).strip("-")[:40] or "finger"
