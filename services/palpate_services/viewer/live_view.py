"""The view beside a running record, drawn by a process of its own that ends with it.

Rerun keeps some memory of all that it ever drew, and a fault in its native code ends the process
that it runs in. So a recorder, which may run for months, does not load it: ``LiveView`` sends
messages to a child, which draws one view. They talk over a socket; when it closes, because the
recorder was killed, the child completes the view and ends.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

from palpate.bus.topics import TOPICS
from palpate.errors import PalpateError
from palpate.heartbeat import without_watch
from palpate.process import use_few_resources
from palpate_services.viewer.layout import SensorContents

_log = logging.getLogger(__name__)

PERIOD_S = 2.0
"""Time between two updates of a live view [s]: short enough to follow, long enough for batches.
Each costs 2 kB for each of twenty curves, at 0.5 s a third of the file."""

CAPACITY_BYTES = 40_000_000
"""Messages that may wait for the child [bytes]: 480 fields of 7,000 nodes. Further ones are counted
and left out."""

MESSAGE_BYTES = 400
"""What a waiting message takes in memory besides its payload [bytes]."""

ANSWER_S = 30.0
"""A child that takes longer for one update hangs, and is ended [s]; its start takes about one."""

_CHILD = f"from {__name__} import draw_view; draw_view"
_NICENESS = 5  # a picture may wait, the hand may not


@dataclass(frozen=True, slots=True)
class ViewPlan:
    """What a live view is to be.

    Attributes:
        path: Its ``.rrd``; None = no file, the drawn parts are handed over.
        title: Shown as the recording's name.
        max_bytes: It is closed at this size [bytes].
        bundles: Names or folders of bundles with meshes of its fields, beside the packaged ones.
        period_s: Time between two updates [s].
        recording_id: Views with the same one are one recording to the viewer; None = its own.
        known: What has been laid out before; a layout is drawn where there is more to show.
    """

    path: Path | None
    title: str
    max_bytes: int
    bundles: tuple[str, ...]
    period_s: float = PERIOD_S
    recording_id: str | None = None
    known: Mapping[str, SensorContents] = field(default_factory=dict)


class ViewMessage(NamedTuple):
    """A message to draw: topics of ``SensorTimeline``, with its payload as it was published."""

    sensor: str
    topic: str
    payload: bytes


@dataclass(frozen=True, slots=True)
class DrawnPart:
    """A piece of a view without a file.

    Attributes:
        data: A complete ``.rrd`` of what came since the last part.
        layout: A complete ``.rbl`` where the layout has changed; else empty.
        contents: What the layout shows, by sensor.
    """

    data: bytes
    layout: bytes
    contents: Mapping[str, SensorContents]


@dataclass(frozen=True, slots=True)
class ViewReport:
    """The child's answer to each batch: what it counted since the last one, or why it gave up."""

    counts: Mapping[str, int]
    problem: str | None = None
    part: DrawnPart | None = None


class LiveView:
    """Has a record's view drawn; it may fail, hang or crash, the record goes on.

    Counts ``view_dropped`` (messages came too fast), ``view_failed`` (the view was given up), and
    what the view counts, e.g. ``view_no_mesh``. The parts of a view without a file are handed to
    ``take_part``, in a thread of this object.
    """

    def __init__(
        self, plan: ViewPlan, take_part: Callable[[DrawnPart], None] | None = None
    ) -> None:
        self._plan = plan
        self._take_part = take_part
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._waiting: deque[ViewMessage] = deque()
        self._waiting_bytes = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._given_up = False
        self._patience_s: float | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)
        self._thread.start()

    def offer(self, message: ViewMessage) -> None:
        """Hand over a message; never waits for the child and never raises."""
        size = MESSAGE_BYTES + len(message.payload)
        with self._lock:
            if self._given_up:
                return
            if self._waiting_bytes + size > CAPACITY_BYTES:
                self._counts["view_dropped"] += 1
                return
            self._waiting.append(message)
            self._waiting_bytes += size

    def take_counts(self) -> Counter[str]:
        """Counts since the last call."""
        with self._lock:
            counts, self._counts = self._counts, Counter()
        return counts

    def finish(self) -> None:
        """Draw the rest and close the file, without waiting for it."""
        self._stop.set()

    def join(self, timeout_s: float) -> bool:
        """Wait for the file to be closed; returns whether it is."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def close(self, timeout_s: float) -> None:
        """Finish; a child that is not done within ``timeout_s`` is ended."""
        self.finish()
        if not self.join(timeout_s):
            with self._lock:
                process = self._process
            if process is not None:
                self._patience_s = timeout_s
                process.kill()
                self.join(timeout_s)

    def _run(self) -> None:
        try:
            with self._started() as connection:
                self._tell(connection, self._plan)
                while not self._stop.wait(self._plan.period_s):
                    self._update(connection)
                self._update(connection)
                self._tell(connection, None)
        except Exception as error:
            # A defect of the picture must be visible in the log, and must not stop the record.
            why = str(error) if isinstance(error, _ViewLost) else repr(error)
            if self._patience_s is not None:
                why = f"it was not done {self._patience_s:g} s after the record"
            if self._plan.path is None:
                _log.warning("the live view is given up: %s", why)
            else:
                _log.warning(
                    "the view is given up, the record goes on: %s: %s; when it is closed, make a "
                    "view of it with: palpate review",
                    self._plan.path,
                    why,
                )
            with self._lock:
                self._counts["view_failed"] += 1
                self._given_up = True
                self._waiting.clear()

    @contextlib.contextmanager
    def _started(self) -> Iterator[Connection]:
        ours, theirs = socket.socketpair()
        # A child that is stopped reads nothing: without a limit the thread would wait for ever.
        limit = struct.pack("@ll", int(ANSWER_S), 0)
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
        with theirs:
            # -P: no module may come from the working directory.
            process = subprocess.Popen(
                [sys.executable, "-P", "-c", f"{_CHILD}({theirs.fileno()})"],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                env=without_watch(os.environ),
            )
        with self._lock:
            self._process = process
        try:
            with Connection(ours.detach()) as connection:
                yield connection
            process.wait(ANSWER_S)
        finally:
            process.kill()
            process.wait()

    def _update(self, connection: Connection) -> None:
        with self._lock:
            batch = list(self._waiting)
            self._waiting.clear()
            self._waiting_bytes = 0
        if batch:
            self._tell(connection, batch)

    def _tell(self, connection: Connection, what: ViewPlan | list[ViewMessage] | None) -> None:
        """Send something and wait for the report about it."""
        try:
            # A child that has ended may have reported before why.
            with contextlib.suppress(ConnectionError):
                connection.send(what)
            if not connection.poll(ANSWER_S):
                raise BlockingIOError
            report: ViewReport = connection.recv()
        except BlockingIOError:
            raise _ViewLost(f"its process hangs, it did nothing for {ANSWER_S:g} s") from None
        except (EOFError, OSError):
            raise _ViewLost("its process has ended") from None
        with self._lock:
            self._counts.update(report.counts)
        if report.problem is not None:
            raise _ViewLost(report.problem)
        if report.part is not None and self._take_part is not None:
            self._take_part(report.part)


class _ViewLost(Exception):
    """The child has given up, or is gone; the text says why."""


def draw_view(descriptor: int) -> None:
    """Draw one view: the whole life of the child; ``descriptor`` is that of its socket."""
    # What comes to the whole group: the recorder says when it ends.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # Rerun's warning that a view has no footer, as is meant, would stand between the lines of a
    # command.
    os.environ.setdefault("RUST_LOG", "error")
    with contextlib.suppress(OSError):  # a strict unit forbids it
        os.nice(_NICENESS)
    use_few_resources()
    with Connection(descriptor) as connection, contextlib.suppress(ConnectionError):
        try:
            _draw(connection.recv(), connection)
        except Exception as error:
            if not isinstance(error, PalpateError | ConnectionError):
                _log.exception("a defect of the view")
            connection.send(ViewReport({}, str(error) or repr(error)))


def _draw(plan: ViewPlan, connection: Connection) -> None:
    # Rerun takes half a second to load, and the recorder imports this module.
    from palpate_services.inference.repository import MeshLibrary
    from palpate_services.viewer.record_view import RerunView

    meshes = MeshLibrary(plan.bundles)
    with RerunView(
        plan.path,
        title=plan.title,
        max_bytes=plan.max_bytes,
        meshes=meshes,
        live=True,
        recording_id=plan.recording_id,
        known=plan.known,
    ) as view:
        connection.send(ViewReport({}))
        for batch in _batches(connection):
            for sensor, topic, payload in batch:
                view.add(sensor, TOPICS[topic].codec.decode(payload))
            view.flush()
            counts = dict(view.counters)
            view.counters.clear()
            part = None if plan.path is not None else DrawnPart(*view.take(), view.contents)
            connection.send(ViewReport(counts, part=part))
    connection.send(ViewReport({}))


def _batches(connection: Connection) -> Iterator[list[ViewMessage]]:
    with contextlib.suppress(EOFError, ConnectionError):  # the recorder was killed
        while (batch := connection.recv()) is not None:
            yield batch
