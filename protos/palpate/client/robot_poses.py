"""Publishing the poses of a robot's flange from inside its control loop, which must never wait.

``put`` checks, encodes and hands over; a thread of its own publishes. Made by
``Client.robot_pose_publisher``.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import Counter
from collections.abc import Iterable

from palpate.bus import Publisher, Session
from palpate.bus.delivery import NewestQueue
from palpate.bus.topics import ROBOT_POSE
from palpate.bus.zenoh_session import check_process
from palpate.errors import LinkError, WireError
from palpate.messages import Pose, RobotPoseFrame
from palpate.process import Closing

WAITING = 1024
"""Poses that may wait for the bus: a second at 1 kHz. Beyond that the oldest is dropped."""

_POLL_S = 0.1
_LAST_S = 1.0
"""How long closing waits for poses that are still to be published [s]."""


class RobotPosePublisher(Closing):
    """Publishes one robot's poses; ``put`` belongs to one thread.

    ``counters``: ``put``, ``published``, and ``dropped`` of poses that waited too long for the bus.
    A dropped pose leaves a hole in the sequence, so the gateway counts it, too. ``client`` is whose
    it is; it stays open until the publisher is closed.
    """

    def __init__(
        self, session: Session, robot: str, *, waiting: int = WAITING, client: object = None
    ) -> None:
        self._client = client
        self._robot = robot
        self._run_id = secrets.randbits(64) or 1
        self._sequence = 0
        self._counters: Counter[str] = Counter({"put": 0, "published": 0, "dropped": 0})
        self._waiting: NewestQueue[bytes] = NewestQueue(self._counters, waiting)
        self._encode = ROBOT_POSE.codec.encode
        self._error: LinkError | None = None
        self._closed = threading.Event()
        self._publisher: Publisher[RobotPoseFrame] = session.publisher(ROBOT_POSE, sensor=robot)
        self._thread = threading.Thread(target=self._run, name=f"poses of {robot}", daemon=True)
        self._thread.start()

    @property
    def counters(self) -> dict[str, int]:
        """Events since it was made."""
        return dict(self._counters)

    def put(
        self,
        position: Iterable[float],
        orientation_wxyz: Iterable[float],
        time_ns: int | None = None,
        *,
        wall_ns: int | None = None,
    ) -> None:
        """Publish where the flange is; never waits for the bus.

        Args:
            position: Of the flange in the robot's base frame [m], three numbers.
            orientation_wxyz: Unit quaternion of the flange in the base frame.
            time_ns: When the robot was there, by a clock that only goes forward [ns], the same for
                every pose: best the robot controller's own. None = now, by this host's clocks.
            wall_ns: Wall clock at that instant [ns since the Unix epoch], where it is known.

        Raises:
            WireError: Not three and four finite numbers, or no unit quaternion; nothing is sent.
            LinkError: The client is closed, or was opened before a fork.
        """
        check_process()
        if self._error is not None or self._closed.is_set():
            raise self._error or LinkError(
                f"the pose publisher of {self._robot!r} is closed", remedy="make another one"
            )
        if time_ns is None:
            time_ns = time.monotonic_ns()
            wall_ns = time.time_ns() if wall_ns is None else wall_ns
        frame = RobotPoseFrame(
            self._robot,
            self._sequence + 1,
            time_ns,
            _pose(position, orientation_wxyz),
            self._run_id,
            wall_ns or 0,
        )
        payload = self._encode(frame)
        self._sequence += 1
        self._counters["put"] += 1
        self._waiting.put(self._robot, payload)

    def matched(self) -> bool:
        """Whether a gateway, recorder or other process subscribes at present."""
        return self._publisher.matched()

    def close(self) -> None:
        """Publish what still waits, for a second at most, and stop."""
        self._closed.set()
        self._thread.join(_LAST_S)
        self._publisher.close()

    @property
    def closed(self) -> bool:
        """Whether it was closed."""
        return self._closed.is_set()

    def _run(self) -> None:
        while True:
            item = self._waiting.get(_POLL_S)
            if item is None:
                if self._closed.is_set():
                    return
                continue
            try:
                self._publisher.put_payload(item[0])
            except LinkError as error:
                self._error = error
                return
            self._counters["published"] += 1


def _pose(position: Iterable[float], orientation_wxyz: Iterable[float]) -> Pose:
    try:
        x, y, z = map(float, position)
        qw, qx, qy, qz = map(float, orientation_wxyz)
    except (TypeError, ValueError) as error:
        raise WireError(
            f"position {position!r} and orientation {orientation_wxyz!r} are no pose: {error}",
            remedy="give three numbers [m] and a unit quaternion w x y z",
            reason="shape",
        ) from error
    return Pose((x, y, z), (qw, qx, qy, qz))
