"""The client of a robot: current features and fields, tare, simulations, its own pose.

Five lines::

    from palpate import Client

    with Client() as robot:
        estimate = robot.features("finger", max_age_s=0.05)
        print(estimate.force, estimate.contact_location)

Every failure is a ``PalpateError``; no call hangs, and no old reading is returned as a new one.
Links, subscriptions and streams come back by themselves when a router or a service does.

A client does not survive a fork, which is how ``multiprocessing`` starts processes on Linux before
Python 3.14: in a process that was forked after a client was opened, that client and every new one
raise a ``LinkError``. Start processes with ``multiprocessing.get_context("spawn")``, or open the
client in the child only.
"""

from __future__ import annotations

import atexit
import contextlib
import math
import os
import threading
import time
import weakref
from pathlib import Path
from typing import Any, TypeVar

from palpate.bus import AliveService, Delivery, ReceivedMessage, Session, Subscriber, endpoints
from palpate.bus.attachments import OnTimings
from palpate.bus.query import LONGEST_S
from palpate.bus.topics import ELECTRODES, FEATURES, FIELD, SYNTHESIS, WRENCH, Topic
from palpate.bus.zenoh_session import check_process, is_inherited
from palpate.census import ProcessReport, take_census
from palpate.client.estimates import OnSynthesis, ask_basis, ask_synthesis, ask_tare, ask_zero
from palpate.client.robot_poses import RobotPosePublisher
from palpate.client.simulations import (
    GRACE_S,
    OnProgress,
    OnStep,
    ask_cancellation,
    ask_simulation,
)
from palpate.client.streams import TURN_S, SameSensor, Stream, check_depth, is_cancelled
from palpate.config import (
    STATION_VARIABLE,
    TlsConfig,
    check_duration,
    check_name,
    joining_link,
)
from palpate.errors import ConfigError, LinkError, StaleError, StreamTimeout
from palpate.messages import (
    ContactDescription,
    ElectrodeFrame,
    FeatureEstimate,
    FeatureRequest,
    FieldEstimate,
    FieldFrame,
    FieldRequest,
    ModeBasis,
    ModelMetadata,
    ServiceRequest,
    SimulationReply,
    SimulationRequest,
    Status,
    SynthesisEstimate,
    SynthesisReply,
    SynthesisRequest,
    Tare,
    WrenchFrame,
    WrenchZero,
    as_field_frame,
)
from palpate.process import Closing

M = TypeVar("M")

FRAME_AGE_S = 0.05
"""Age of the oldest reading that is "now" by default [s]."""

STREAM_AGE_S = 0.2
"""Age of the oldest reading that a stream delivers by default [s]."""

STREAM_TIMEOUT_S = 10.0
"""Longest silence of a stream by default [s]: a restarted service is back earlier."""

_LEAST_S = 1e-3


_open: weakref.WeakSet[Client] = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    """Close what a program has left open, before the session under it."""
    for client in list(_open):
        client.close()


def _leave(session: Session) -> None:
    """Leave the bus for a client that nobody holds any more, in whatever thread that is noticed."""
    if not is_inherited():
        threading.Thread(target=session.close, name="leaving").start()


class Client(Closing):
    """A robot's view of a station. Open one and keep it: joining and leaving take time.

    One that is neither closed nor held leaves the bus in the background. What it has made and is in
    use, a stream or a publisher of poses, holds it.

    Methods take the name of a ``sensor``, and as ``timeout_s`` how long an answer may take [s];
    None = the client's timeout.

    Args:
        connect: Endpoint of the router; None = ``$PALPATE_CONNECT``, else the one on this host.
        station: Name of the station; None = ``$PALPATE_STATION``, else ``lab``.
        timeout_s: How long joining the bus, and by default a question, may take [s].
        tls: Certificates or the folder that holds them, for a router ``tls/HOST:PORT`` on another
            host; None = ``$PALPATE_TLS``.

    Raises:
        ConfigError: One of these is none.
        LinkError: No router at ``connect``, or a client was opened before this process was forked.
            Of every method: the client is closed, or was opened before the fork.
    """

    def __init__(
        self,
        connect: str | None = None,
        *,
        station: str | None = None,
        timeout_s: float = 2.0,
        tls: TlsConfig | Path | str | None = None,
    ) -> None:
        self._timeout_s = check_duration(timeout_s, "timeout_s", most=LONGEST_S)
        name = station or os.environ.get(STATION_VARIABLE) or "lab"
        self._lock = threading.Lock()
        # By topic and sensor, with a lock each: a subscriber belongs to one thread at a time.
        self._newest: dict[tuple[str, str], tuple[Subscriber[Any], SameSensor, threading.Lock]] = {}
        self._unseen: dict[tuple[str, str], tuple[Subscriber[Any], SameSensor, threading.Lock]] = {}
        self._streams: list[Stream[Any]] = []
        self._publishers: list[RobotPosePublisher] = []
        self._session = Session.open(
            joining_link(connect, wait_s=timeout_s, tls=tls), station=check_name(name, "station")
        )
        self._closed = False
        self._dropped = weakref.finalize(self, _leave, self._session)
        self._dropped.atexit = False  # then it is closed
        _open.add(self)

    @property
    def session(self) -> Session:
        """What the client is connected by; it is closed with it."""
        if self._closed:
            raise LinkError("the client is closed", remedy="open a new Client")
        return self._session

    def features(self, sensor: str, *, max_age_s: float = FRAME_AGE_S) -> FeatureEstimate:
        """Contact location and force of one finger now.

        The first call subscribes and waits up to the client's timeout for a first estimate. The
        oldest reading that may be used was taken ``max_age_s`` ago.

        Raises:
            StaleError: There is none, or the newest is older.
            SensorChanged: It is of another sensor than the last one; told once.
        """
        return self._latest(FEATURES, sensor, max_age_s)

    def electrodes(self, sensor: str, *, max_age_s: float = FRAME_AGE_S) -> ElectrodeFrame:
        """Raw counts of one finger now; see ``features``."""
        return self._latest(ELECTRODES, sensor, max_age_s)

    def field(self, sensor: str, *, max_age_s: float = 0.2) -> FieldEstimate:
        """Displacement of each skin node now; see ``features``."""
        return self._latest(FIELD, sensor, max_age_s)

    def synthesis(self, sensor: str, *, max_age_s: float = 0.2) -> SynthesisEstimate:
        """Synthesised tared counts now; see ``features``."""
        return self._latest(SYNTHESIS, sensor, max_age_s)

    def stream_features(
        self,
        sensor: str,
        *,
        max_age_s: float = STREAM_AGE_S,
        timeout_s: float | None = STREAM_TIMEOUT_S,
        depth: int = 1,
    ) -> Stream[FeatureEstimate]:
        """Contact locations and forces of one finger as they come.

        ``for estimate in robot.stream_features("finger")`` iterates,
        ``robot.stream_features("finger").call(function)`` calls back. A loop that is left before
        its end leaves the stream open, until it or the client is closed: write
        ``with robot.stream_features("finger") as estimates:`` around it. The newest wins: a slow
        consumer finds the last ``depth`` messages, none older than ``max_age_s``. A silence of
        ``timeout_s`` is an error; None = wait for ever. See ``Stream``.
        """
        return self._stream(FEATURES, sensor, max_age_s, timeout_s, depth)

    def stream_electrodes(
        self,
        sensor: str,
        *,
        max_age_s: float = STREAM_AGE_S,
        timeout_s: float | None = STREAM_TIMEOUT_S,
        depth: int = 1,
    ) -> Stream[ElectrodeFrame]:
        """Raw counts of one finger as they come; see ``stream_features``."""
        return self._stream(ELECTRODES, sensor, max_age_s, timeout_s, depth)

    def stream_field(
        self,
        sensor: str,
        *,
        max_age_s: float = STREAM_AGE_S,
        timeout_s: float | None = STREAM_TIMEOUT_S,
        depth: int = 1,
    ) -> Stream[FieldEstimate]:
        """Displacements of each skin node as they come; see ``stream_features``."""
        return self._stream(FIELD, sensor, max_age_s, timeout_s, depth)

    def stream_synthesis(
        self,
        sensor: str,
        *,
        max_age_s: float = STREAM_AGE_S,
        timeout_s: float | None = STREAM_TIMEOUT_S,
        depth: int = 1,
    ) -> Stream[SynthesisEstimate]:
        """Synthesised tared counts as they come; see ``stream_features``."""
        return self._stream(SYNTHESIS, sensor, max_age_s, timeout_s, depth)

    def stream_wrench(
        self,
        sensor: str,
        *,
        max_age_s: float = STREAM_AGE_S,
        timeout_s: float | None = STREAM_TIMEOUT_S,
        depth: int = 1,
    ) -> Stream[WrenchFrame]:
        """Measured forces and torques as they come; see ``stream_features``."""
        return self._stream(WRENCH, sensor, max_age_s, timeout_s, depth)

    def estimate_features(
        self,
        sensor: str,
        frame: ElectrodeFrame | None = None,
        *,
        timeout_s: float | None = None,
        on_timings: OnTimings | None = None,
    ) -> FeatureEstimate:
        """Ask for the features of one frame, however old it is; old ones are flagged ``STALE``.

        Without a frame it is the sensor's newest, see ``electrodes``; waiting for the first one is
        part of ``timeout_s``. ``on_timings`` is told where the time went.

        Raises:
            LinkError: No features service runs.
            RemoteError: It has no estimate for this frame, e.g. because the frame is not tared.
            StaleError: No frame is given and none is young enough.
        """
        frame, left_s = self._frame_to_ask_about(sensor, frame, timeout_s)
        return self.session.query(
            endpoints.ESTIMATE_FEATURES,
            FeatureRequest(sensor, frame),
            service="features",
            timeout_s=left_s,
            on_timings=on_timings,
        )

    def estimate_field(
        self,
        sensor: str,
        frame: ElectrodeFrame | None = None,
        *,
        reduced: bool = False,
        timeout_s: float | None = None,
        on_timings: OnTimings | None = None,
    ) -> FieldEstimate:
        """Ask for the displacement of each skin node of one frame; see ``estimate_features``.

        With ``reduced`` the answer has the coefficients of the field and not the field, which is a
        few hundred times smaller; ``field_basis`` decodes them.

        Raises:
            LinkError: No field service runs.
            RemoteError: It has no field for this frame, e.g. because the frame is not tared, or its
                bundle has no reduced form.
            StaleError: No frame is given and none is young enough.
        """
        frame, left_s = self._frame_to_ask_about(sensor, frame, timeout_s)
        return self.session.query(
            endpoints.ESTIMATE_FIELD,
            FieldRequest(sensor, frame, reduced),
            service="field",
            timeout_s=left_s,
            on_timings=on_timings,
        )

    def field_basis(
        self, basis_sha256: bytes = b"", *, timeout_s: float | None = None
    ) -> ModeBasis:
        """The basis of the coefficients of fields, some megabytes: ask once and keep it.

        ``basis_sha256`` is that of an estimate; empty = that of the served bundle.

        Raises:
            LinkError: No field service runs.
            RemoteError: It has no such basis.
        """
        wait_s = self._timeout_s if timeout_s is None else timeout_s
        return ask_basis(self.session, basis_sha256, timeout_s=wait_s)

    def synthesise(
        self, field: FieldFrame | FieldEstimate, *, timeout_s: float | None = None
    ) -> SynthesisEstimate:
        """Ask for the tared counts of a field, known or estimated, on the served bundle's mesh.

        Raises:
            LinkError: No synthesis service runs.
            RemoteError: It has no answer for this field, e.g. because the mesh is another.
        """
        return self.session.query(
            endpoints.SYNTHESISE,
            as_field_frame(field),
            service="synthesis",
            timeout_s=self._timeout_s if timeout_s is None else timeout_s,
        )

    def synthesise_from(
        self,
        source: ContactDescription | SimulationRequest | FieldFrame,
        *,
        simulator: str = "twin",
        timeout_s: float = 60.0,
        on_step: OnSynthesis | None = None,
    ) -> SynthesisReply:
        """Ask for the tared counts that a contact would give, without any finger.

        The synthesis service has the contact simulated by the finite-element service and
        synthesises its steps.

        Args:
            source: A contact, a simulation, or a field (see ``synthesise``).
            simulator: Name under which the finite-element service answers.
            timeout_s: How long it may take, time in the queue included [s].
            on_step: Called, in this thread, with the electrodes of each step before the last.

        Returns:
            The electrodes of the last step, how the simulation ended and why.

        Raises:
            LinkError: No synthesis service runs.
            RemoteError: It, or the finite-element service, refuses or cannot go on.
        """
        # The simulation ends in time for its last steps to be sent.
        request = SynthesisRequest(source, simulator, timeout_s, on_step is not None)
        return ask_synthesis(self.session, request, timeout_s=timeout_s + GRACE_S, on_step=on_step)

    def next_features(
        self, sensor: str, *, timeout_s: float = 1.0
    ) -> ReceivedMessage[FeatureEstimate]:
        """Wait for the next estimate that was not returned yet.

        Raises:
            StreamTimeout: None came in time.
            SensorChanged: It is the first of another sensor; told once.
        """
        check_process()  # before the lock, which a thread that is not here may hold
        session = self.session
        check_duration(timeout_s, "timeout_s", most=LONGEST_S)
        key = (FEATURES.name, check_name(sensor, "sensor"))
        with self._lock:
            if key not in self._unseen:
                made = session.subscriber(FEATURES, sensor=sensor)
                self._unseen[key] = made, SameSensor(made.key), threading.Lock()
            subscriber, same, lock = self._unseen[key]
        end_s = time.monotonic() + timeout_s
        while not is_cancelled() and (left_s := end_s - time.monotonic()) > 0.0:
            turn_s = min(left_s, TURN_S)
            if not lock.acquire(timeout=turn_s):  # another thread waits for the same
                continue
            try:
                received: list[ReceivedMessage[FeatureEstimate]] = subscriber.next_batch(
                    turn_s, most=1
                )
            finally:
                lock.release()
            if received:
                same.check(received[0].message)
                return received[0]
        raise StreamTimeout(
            f"no features on {subscriber.key} within {timeout_s:g} s",
            remedy="check that its publisher runs: palpate status",
        )

    def robot_pose_publisher(self, robot: str) -> RobotPosePublisher:
        """A publisher of the poses of a robot's flange: call ``put`` from the control loop.

        A gateway with the driver ``pose_zenoh``, whose option ``robot`` has the same name, turns
        them into poses of the indenter.
        """
        publisher = RobotPosePublisher(self.session, check_name(robot, "robot"), client=self)
        with self._lock:
            self._publishers = [one for one in self._publishers if not one.closed]
            self._publishers.append(publisher)
        return publisher

    def tare(
        self, sensor: str, *, frames: int = 0, timeout_s: float = 5.0, anyway: bool = False
    ) -> Tare:
        """Tare: take the present counts of the untouched finger as its baseline.

        So many ``frames`` are averaged; 0 = the gateway's own number. A finger that is still, but
        farther from where it last rested than it drifts, counts as held: it is tared if ``anyway``.

        Raises:
            ConfigError: A negative number.
            RemoteError: The gateway refuses, e.g. because the finger is touched.
        """
        _check_count(frames, "frames")
        return ask_tare(self.session, sensor, frames=frames, timeout_s=timeout_s, anyway=anyway)

    def zero(self, sensor: str, *, readings: int = 0, timeout_s: float = 5.0) -> WrenchZero:
        """Take the present load of a force/torque sensor as zero.

        So many ``readings`` are averaged before and after; 0 = the gateway's own number.

        Raises:
            LinkError: No gateway serves a force/torque sensor of this name.
            RemoteError: The gateway refuses, e.g. because the load is not still.
        """
        _check_count(readings, "readings")
        return ask_zero(self.session, sensor, readings=readings, timeout_s=timeout_s)

    def simulate(
        self,
        request: SimulationRequest,
        *,
        sensor: str = "twin",
        timeout_s: float = 60.0,
        on_progress: OnProgress | None = None,
        on_step: OnStep | None = None,
    ) -> SimulationReply:
        """Indent the finite-element fingertip.

        Any service that serves ``sensor`` may answer. If it ends, hangs or has no room, another one
        is asked for all of it again, within ``timeout_s``; each step is told once.

        Args:
            request: What to simulate; ``palpate.client.simulations.straight_path`` makes paths.
            sensor: Name under which the service serves.
            timeout_s: How long it may take, time in the queue included [s]. What has converged by
                then is returned, and ``outcome`` says that it is not all.
            on_progress: Called, in this thread, whenever the service says how far it is.
            on_step: Called, in this thread, with number and values of each step as it converges.

        Raises:
            LinkError: No finite-element service runs.
            RemoteError: It refuses (``retry_after_s`` says when to ask again), or cannot go on.
                Steps that had converged were given to ``on_step``.
        """
        check_duration(timeout_s, "timeout_s", most=LONGEST_S - GRACE_S)
        return ask_simulation(
            self.session,
            request,
            sensor=sensor,
            timeout_s=timeout_s,
            on_progress=on_progress,
            on_step=on_step,
        )

    def cancel_simulation(
        self, request_id: str, *, sensor: str = "twin", timeout_s: float = 5.0
    ) -> bool:
        """Stop a simulation; its caller gets the steps that have converged.

        Returns:
            Whether it was waiting or running.
        """
        return ask_cancellation(self.session, request_id, sensor=sensor, timeout_s=timeout_s)

    def model(self, *, service: str = "features") -> ModelMetadata:
        """Description of the served bundle."""
        return self.session.query(
            endpoints.MODEL, ServiceRequest(), service=service, timeout_s=self._timeout_s
        )

    def alive(self) -> list[AliveService]:
        """Which processes are alive, and which of them are ready."""
        return self.session.alive()

    def status(self) -> list[Status]:
        """Status of every process of the station that answers; as ``census``, also in errors."""
        return [one.status for one in self.census() if one.status is not None]

    def census(self) -> list[ProcessReport]:
        """Every process that lives or should live, with its status, or that it does not answer.

        Raises:
            LinkError: There is no router, or it is gone or hangs and nothing is known.
        """
        return take_census(self.session, timeout_s=self._timeout_s)

    def close(self) -> None:
        """Leave the bus; streams end. Done at the end of a program that has left it open, too.

        In a forked process nothing happens: the client is its parent's.
        """
        _open.discard(self)
        self._dropped.detach()
        if is_inherited():
            return
        self._closed = True
        for publisher in self._publishers:
            publisher.close()
        with self._lock:
            streams, self._streams = self._streams, []
        for stream in streams:
            stream.close()
        for stream in streams:
            stream.wait_for_calls()
        self._session.close()

    def _stream(
        self, topic: Topic[M], sensor: str, max_age_s: float, timeout_s: float | None, depth: int
    ) -> Stream[M]:
        check_depth(depth)
        subscriber = self.session.subscriber(
            topic, sensor=check_name(sensor, "sensor"), delivery=Delivery.NEWEST, depth=depth
        )
        stream = Stream(
            subscriber,
            max_age_s=max_age_s,
            timeout_s=timeout_s,
            wall_clock_error_s=self.session.wall_clock_error_s,
            client=self,
        )
        with self._lock:
            self._streams = [one for one in self._streams if not one.closed]
            self._streams.append(stream)
        return stream

    def _frame_to_ask_about(
        self, sensor: str, frame: ElectrodeFrame | None, timeout_s: float | None
    ) -> tuple[ElectrodeFrame, float]:
        """The given frame, or the newest, and how much of the time is left then [s]."""
        wait_s = self._timeout_s if timeout_s is None else timeout_s
        if frame is not None:
            return frame, wait_s
        end_s = time.monotonic() + check_duration(wait_s, "timeout_s", most=LONGEST_S)
        newest = self._latest(ELECTRODES, sensor, FRAME_AGE_S, wait_s=wait_s)
        return newest, max(end_s - time.monotonic(), _LEAST_S)

    def _latest(
        self, topic: Topic[M], sensor: str, max_age_s: float, *, wait_s: float | None = None
    ) -> M:
        check_process()
        session = self.session
        check_duration(max_age_s, "max_age_s", most=math.inf)
        key = (topic.name, check_name(sensor, "sensor"))
        with self._lock:
            first = key not in self._newest
            if first:
                made = session.subscriber(topic, sensor=sensor, delivery=Delivery.NEWEST)
                self._newest[key] = made, SameSensor(made.key), threading.Lock()
            subscriber, same, lock = self._newest[key]
        first_s = self._timeout_s if wait_s is None else wait_s
        end_s = time.monotonic() + (first_s if first else 0.0)
        with lock:
            while True:
                try:
                    message: M = subscriber.latest(max_age_s).message
                except StaleError:
                    left_s = end_s - time.monotonic()
                    if left_s <= 0.0 or is_cancelled():
                        raise
                else:
                    same.check(message)
                    return message
                with contextlib.suppress(StreamTimeout):
                    subscriber.next(min(left_s, TURN_S))


def _check_count(number: int, what: str) -> None:
    if number < 0:
        raise ConfigError(
            f"{what} = {number} is negative", remedy="give 1 or more, or 0 for the gateway's number"
        )
