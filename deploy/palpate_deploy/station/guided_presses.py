"""Presses of a finger, guided and recorded while they are made; and its tare."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from palpate.bus import Delivery, Session
from palpate.bus.topics import ELECTRODES, WRENCH, Topic
from palpate.config import LinkConfig, parse_config
from palpate.errors import LinkError, RecordingError, StreamTimeout
from palpate.health import Health
from palpate.messages import NO_TARE, ElectrodeFrame, ServiceState, Tare
from palpate.process import stop_on_signals
from palpate_deploy.station.host import check_room
from palpate_deploy.station.tare import tare_at_rest
from palpate_services.config import EVERYTHING, RecorderConfig
from palpate_services.recorder.service import SERVICE, run_recorder

Message = TypeVar("Message")

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

_LINE_S = 2.0
_AGAIN_S = 0.5


class PressCounter:
    """Counts presses in a stream of forces: each begins, is held, is seen, and ends."""

    def __init__(self) -> None:
        self.count = 0
        self.largest_n = 0.0
        self._since_s: float | None = None
        self._seen = False

    @property
    def pressed(self) -> bool:
        """Whether one is under way."""
        return self._since_s is not None

    def take(self, now_s: float, force_n: float, *, seen: bool) -> bool:
        """One reading: its time [s] and the magnitude [N]; whether it ended a press that counts.

        ``seen``: Whether electrodes came with it. Nothing is learned from a force without them.
        """
        if self._since_s is None:
            if force_n < PRESS_N:
                return False
            self._since_s, self.largest_n, self._seen = now_s, force_n, False
        self.largest_n = max(self.largest_n, force_n)
        self._seen |= seen and force_n >= PRESS_N
        if force_n >= RELEASE_N:
            return False
        counts = self._seen and now_s - self._since_s >= HELD_S
        self._since_s = None
        self.count += counts
        return counts


def untouched(link: LinkConfig, station: str, sensor: str, console: Console) -> Tare:
    """The finger's state as it is let go.

    Raises:
        LinkError: There is no router, or no such finger.
        RemoteError: The gateway takes no tare.
        StreamTimeout: It does not answer.
    """
    with Session.open(link, station=station) as session:
        _first(session, ELECTRODES, sensor, _NO_ELECTRODES)
        console.print("let go of the finger: it is tared", markup=False)
        tare = tare_at_rest(session, sensor, threading.Event(), again_s=_AGAIN_S, console=console)
        assert tare is not None, "nothing interrupts it"
        return tare


def record_presses(
    link: LinkConfig,
    station: str,
    sensor: str,
    presses: int,
    out: Path,
    console: Console,
    *,
    least: int,
    check: Callable[[str], None] = lambda _: None,
) -> tuple[Path, str]:
    """Guide through so many presses while they are recorded; the record, and the serial number.

    Ctrl-C ends before the last press; what was recorded then is learned from, if that is enough.

    Args:
        link: To the router.
        station: Name of the station.
        sensor: Name of the finger.
        presses: How many.
        out: Folder of the record.
        console: Where the guide is shown.
        least: Fewer presses are not enough to learn from.
        check: Given the finger's serial number before it is pressed; may refuse it.

    Raises:
        LinkError: There is no router, or no such finger, or no force sensor for it.
        RemoteError: The gateway takes no tare.
        StreamTimeout: A stream ends, or the finger is not let go.
        RecordingError: The disk has no room, or the record cannot be written or has holes.
        KeyboardInterrupt: It was interrupted before ``least`` presses.
    """
    check_room(out, RecorderConfig().min_free_bytes)
    count = 0
    with _until_recorded() as interrupted, Session.open(link, station=station) as session:
        serial = _first(session, ELECTRODES, sensor, _NO_ELECTRODES).sensor_serial
        check(serial)
        no_force = f'give the force/torque sensor of = "{sensor}" in the profile'
        _first(session, WRENCH, sensor, no_force)
        with _recording(link, station, sensor, out) as recording:
            console.print("let go of the finger: it is tared", markup=False)
            tare_at_rest(session, sensor, interrupted, again_s=_AGAIN_S, console=console)
            if not interrupted.is_set():
                count = _guide(
                    session, sensor, presses, out, interrupted, console, check=recording.check
                )
        if interrupted.is_set() and count < least:
            kept = f"the record is {recording.record}" if recording.record else "nothing is kept"
            console.print(f"stopped after {count} presses; {kept}", markup=False, soft_wrap=True)
            raise KeyboardInterrupt
        return recording.path(), serial


@contextlib.contextmanager
def _until_recorded() -> Iterator[threading.Event]:
    """An event that Ctrl-C sets inside the block; what comes after it is ended as ever."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        yield stop_on_signals()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


_NO_ELECTRODES = "see palpate status, and palpate gateway list"


def _first(session: Session, topic: Topic[Message], sensor: str, remedy: str) -> Message:
    """The first message of a stream that must be there."""
    with session.subscriber(topic, sensor=sensor) as stream:
        try:
            return stream.next(_SEEN_S).message
        except StreamTimeout as error:
            raise LinkError(
                f"nothing comes on {topic.name} of {sensor!r} in {_SEEN_S:g} s", remedy=remedy
            ) from error


class _Recording:
    """A recorder in a thread and a folder of its own: others may record to ``out`` meanwhile.

    Attributes:
        folder: What it writes to.
        health: Of the recorder.
        failure: What ended it before its time; None = nothing.
    """

    def __init__(self, out: Path) -> None:
        self._out = out
        self._records: list[Path] = []
        self.health = Health(SERVICE, f"calibrate-{os.getpid()}")
        self.folder = out / self.health.instance
        self.failure: BaseException | None = None

    def close(self) -> None:
        """Move what was written to ``out``.

        Raises:
            RecordingError: The disk refused.
        """
        try:
            for file in sorted(self.folder.glob("*.mcap*")):
                moved = file.rename(self._out / file.name)
                if moved.suffix == ".mcap":
                    self._records.append(moved)
            if self.folder.exists():
                self.folder.rmdir()
        except OSError as error:
            raise RecordingError(
                f"{self.folder}: {error.strerror}", remedy=f"what was recorded is in {self.folder}"
            ) from error

    def check(self) -> None:
        """Raise what ended it, or what it loses messages by: nobody shall press for nothing."""
        if self.failure is not None:
            raise self.failure
        status = self.health.status()
        error = status.last_error
        # One that stops is not DEGRADED, whatever happens then.
        if error is not None and status.state is not ServiceState.READY:
            raise RecordingError(
                error.message,
                remedy=f"{error.remedy}; {self._out} keeps what was recorded, for --from",
            )

    @property
    def record(self) -> Path | None:
        """The finished record; None = there is none."""
        return self._records[-1] if self._records else None

    def path(self) -> Path:
        """The finished record, which must be there and hold every press.

        Raises:
            RecordingError: There is none, or it has holes.
        """
        self.check()
        if self.record is None:
            raise RecordingError(
                f"no record was written to {self._out}", remedy="check the disk's free space"
            )
        if len(self._records) > 1:
            names = ", ".join(map(str, self._records))
            raise RecordingError(
                f"the recorder paused, and presses are missing between its records: {names}",
                remedy="press again, or learn from one of them: --from",
            )
        return self.record


@contextlib.contextmanager
def _recording(link: LinkConfig, station: str, sensor: str, out: Path) -> Iterator[_Recording]:
    """Record the finger inside the block, which begins when the recorder records or has failed."""
    recording, stop = _Recording(out), threading.Event()
    settings = {
        **EVERYTHING,
        "out": str(recording.folder),
        "topics": ("electrodes", "wrench", "pose", "tare"),
        "sensor": sensor,
        "rrd": False,
    }
    config = parse_config(RecorderConfig, settings, where="command line")

    def run() -> None:
        try:
            health = recording.health
            run_recorder(config, link, station, stop, instance=health.instance, health=health)
        except BaseException as error:
            recording.failure = error

    thread = threading.Thread(target=run, name="record", daemon=True)
    thread.start()
    try:
        # What is pressed before would be counted, and missing in the record.
        while thread.is_alive() and recording.health.state is ServiceState.STARTING:
            time.sleep(0.02)
        yield recording
    finally:
        stop.set()
        thread.join()
        recording.close()


_OVERLOADED = "the force/torque sensor is overloaded: press more gently"


def _guide(
    session: Session,
    sensor: str,
    presses: int,
    out: Path,
    interrupted: threading.Event,
    console: Console,
    *,
    check: Callable[[], None],
) -> int:
    """Show what to press next until enough presses are recorded; returns how many are.

    ``check`` raises what is wrong.
    """
    counter, hints = PressCounter(), itertools.cycle(HINTS)
    hint = next(hints)
    bar = Progress(
        TextColumn("press"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}")
    )
    task = bar.add_task("", total=presses)
    told = False
    lines_s = seen_s = time.monotonic()
    remedy = f"see palpate status; {out} keeps what was recorded, for --from"
    with (
        session.subscriber(ELECTRODES, sensor=sensor) as frames,
        session.subscriber(WRENCH, sensor=sensor, delivery=Delivery.QUEUE) as forces,
        # In a file the bar would be the beginning of whatever is written next.
        Live(bar, console=console, refresh_per_second=10, transient=not console.is_terminal),
    ):
        while counter.count < presses and not interrupted.is_set():
            batch = forces.next_batch(_SEEN_S)
            check()
            if not batch:
                raise StreamTimeout(
                    f"the force of {sensor!r} stopped for {_SEEN_S:g} s", remedy=remedy
                )
            seen = any(_is_learned_from(one.message) for one in frames.next_batch(0.0))
            if seen:
                seen_s = time.monotonic()
            elif time.monotonic() - seen_s > _SEEN_S:
                raise StreamTimeout(
                    f"no valid, tared electrodes of {sensor!r} came for {_SEEN_S:g} s",
                    remedy=remedy,
                )
            overloaded = any(received.message.overload for received in batch)
            if overloaded and not told:
                console.print(f"{_OVERLOADED}; such readings are not learned from", markup=False)
            told = overloaded or (told and counter.pressed)
            for received in batch:
                wrench = received.message
                force_n = float(np.linalg.norm(wrench.force))
                if counter.take(1e-9 * wrench.stamp.monotonic_ns, force_n, seen=seen):
                    hint = next(hints)
                    if not console.is_terminal:
                        console.print(
                            f"press {counter.count} of {presses}: {counter.largest_n:.1f} N",
                            markup=False,
                        )
            what = _OVERLOADED if overloaded else "let go" if counter.pressed else hint
            bar.update(task, completed=counter.count, description=f"{force_n:5.2f} N   {what}")
            if not console.is_terminal and time.monotonic() >= lines_s:
                lines_s = time.monotonic() + _LINE_S
                console.print(f"{force_n:.2f} N, next: {what}", markup=False)
    return counter.count


def _is_learned_from(frame: ElectrodeFrame) -> bool:
    return frame.electrodes_valid and frame.tare_id != NO_TARE
