"""The client of a robot: current features and fields, tare, simulations, its own pose.

Five lines::

    from palpate import Client

    with Client() as robot:
        estimate = robot.features("finger", max_age_s=0.05)
        print(estimate.force, estimate.contact_location)

Every failure is a ``PalpateError``; no call hangs, and no old reading is returned as a new one.
"""

from __future__ import annotations

import time
from typing import Any, TypeVar

from palpate.bus import AliveService, Delivery, ReceivedMessage, Session, Subscriber, endpoints
from palpate.bus.topics import ELECTRODES, FEATURES, FIELD, SYNTHESIS, Topic
from palpate.census import ProcessReport, take_census
from palpate.client.robot_poses import RobotPosePublisher
from palpate.client.simulations import OnProgress, OnStep, ask_simulation
from palpate.config import DEFAULT_ROUTER, LinkConfig, TlsConfig
from palpate.errors import StaleError
from palpate.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    FieldEstimate,
    FieldFrame,
    FieldRequest,
    ModelMetadata,
    ServiceRequest,
    SimulationCancelRequest,
    SimulationReply,
    SimulationRequest,
    Status,
    SynthesisEstimate,
    Tare,
    TareRequest,
    WrenchZero,
    WrenchZeroRequest,
    as_field_frame,
)
from palpate.process import Closing

M = TypeVar("M")


class Client(Closing):
    """A robot's view of a station.

    Methods take the name of a ``sensor``, and as ``timeout_s`` how long an answer may take [s];
    None = the client's timeout.

    Args:
        connect: Endpoint of the router.
        station: Name of the station.
        timeout_s: How long joining the bus, and by default a question, may take [s].
        tls: Certificates, for a router on another host.

    Raises:
        LinkError: No router at ``connect``.
    """

    def __init__(
        self,
        connect: str = DEFAULT_ROUTER,
        *,
        station: str = "lab",
        timeout_s: float = 2.0,
        tls: TlsConfig | None = None,
    ) -> None:
        self._timeout_s = timeout_s
        self._subscribers: dict[tuple[str, str], Subscriber[Any]] = {}
        self._publishers: list[RobotPosePublisher] = []
        link = LinkConfig(connect=(connect,), wait_for_router_s=timeout_s, tls=tls)
        self.session = Session.open(link, station=station)

    def features(self, sensor: str, *, max_age_s: float = 0.05) -> FeatureEstimate:
        """Contact location and force of one finger now.

        The first call subscribes and waits up to the client's timeout for a first estimate. The
        oldest reading that may be used was taken ``max_age_s`` ago.

        Raises:
            StaleError: There is none, or the newest is older.
        """
        return self._latest(FEATURES, sensor, max_age_s)

    def electrodes(self, sensor: str, *, max_age_s: float = 0.05) -> ElectrodeFrame:
        """Raw counts of one finger now; see ``features``."""
        return self._latest(ELECTRODES, sensor, max_age_s)

    def field(self, sensor: str, *, max_age_s: float = 0.2) -> FieldEstimate:
        """Displacement of each skin node now; see ``features``."""
        return self._latest(FIELD, sensor, max_age_s)

    def synthesis(self, sensor: str, *, max_age_s: float = 0.2) -> SynthesisEstimate:
        """Synthesised tared counts now; see ``features``."""
        return self._latest(SYNTHESIS, sensor, max_age_s)

    def estimate_field(
        self, sensor: str, frame: ElectrodeFrame | None = None, *, timeout_s: float | None = None
    ) -> FieldEstimate:
        """Ask for the displacement of each skin node of one frame, however old it is.

        Without a frame it is the sensor's newest, see ``electrodes``.

        Raises:
            LinkError: No field service runs.
            RemoteError: It has no field for this frame, e.g. because the frame is not tared.
            StaleError: No frame is given and none is young enough.
        """
        return self.session.query(
            endpoints.ESTIMATE_FIELD,
            FieldRequest(sensor, frame if frame is not None else self.electrodes(sensor)),
            service="field",
            timeout_s=self._timeout_s if timeout_s is None else timeout_s,
        )

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

    def next_features(
        self, sensor: str, *, timeout_s: float = 1.0
    ) -> ReceivedMessage[FeatureEstimate]:
        """Wait for the next estimate that was not returned yet.

        Raises:
            StreamTimeout: None came in time.
        """
        return self._subscriber(FEATURES, sensor).next(timeout_s)

    def robot_pose_publisher(self, robot: str) -> RobotPosePublisher:
        """A publisher of the poses of a robot's flange: call ``put`` from the control loop.

        A gateway with the driver ``pose_zenoh``, whose option ``robot`` has the same name, turns
        them into poses of the indenter.
        """
        self._publishers.append(RobotPosePublisher(self.session, robot))
        return self._publishers[-1]

    def tare(self, sensor: str, *, frames: int = 0, timeout_s: float = 5.0) -> Tare:
        """Tare: take the present counts of the untouched finger as its baseline.

        So many ``frames`` are averaged; 0 = the gateway's own number.

        Raises:
            RemoteError: The gateway refuses, e.g. because the finger is touched.
        """
        return self.session.query(
            endpoints.TARE, TareRequest(frames=frames), sensor=sensor, timeout_s=timeout_s
        )

    def zero(self, sensor: str, *, readings: int = 0, timeout_s: float = 5.0) -> WrenchZero:
        """Take the present load of a force/torque sensor as zero.

        So many ``readings`` are averaged before and after; 0 = the gateway's own number.

        Raises:
            LinkError: No gateway serves a force/torque sensor of this name.
            RemoteError: The gateway refuses, e.g. because the load is not still.
        """
        return self.session.query(
            endpoints.ZERO, WrenchZeroRequest(readings=readings), sensor=sensor, timeout_s=timeout_s
        )

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
        return self.session.query(
            endpoints.CANCEL_SIMULATION,
            SimulationCancelRequest(request_id),
            sensor=sensor,
            timeout_s=timeout_s,
        ).found

    def model(self, *, service: str = "features") -> ModelMetadata:
        """Description of the served bundle."""
        return self.session.query(
            endpoints.MODEL, ServiceRequest(), service=service, timeout_s=self._timeout_s
        )

    def alive(self) -> list[AliveService]:
        """Which processes are alive, and which of them are ready."""
        return self.session.alive()

    def status(self) -> list[Status]:
        """Status of every process of the station that answers; complete as ``census`` is."""
        return [one.status for one in self.census() if one.status is not None]

    def census(self) -> list[ProcessReport]:
        """Every process that lives or should live, with its status, or that it does not answer.

        Raises:
            LinkError: There is no router.
        """
        return take_census(self.session, timeout_s=self._timeout_s)

    def close(self) -> None:
        """Leave the bus."""
        for publisher in self._publishers:
            publisher.close()
        self.session.close()

    def _subscriber(self, topic: Topic[M], sensor: str) -> Subscriber[M]:
        key = (topic.name, sensor)
        if key not in self._subscribers:
            self._subscribers[key] = self.session.subscriber(
                topic, sensor=sensor, delivery=Delivery.NEWEST
            )
        return self._subscribers[key]

    def _latest(self, topic: Topic[M], sensor: str, max_age_s: float) -> M:
        first = (topic.name, sensor) not in self._subscribers
        subscriber = self._subscriber(topic, sensor)
        deadline = time.monotonic() + (self._timeout_s if first else 0.0)
        while True:
            try:
                return subscriber.latest(max_age_s).message
            except StaleError:
                if time.monotonic() >= deadline:
                    raise
                time.sleep(0.005)
