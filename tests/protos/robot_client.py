"""What the tests of the robot's client share: a finger on the bus, and every call."""

from __future__ import annotations

import dataclasses
import inspect
import threading
from collections.abc import Callable
from typing import Any

from palpate.bus import Session
from palpate.bus.topics import FEATURES
from palpate.client.simulations import straight_path
from palpate.messages import ElectrodeFrame, FeatureEstimate, SimulationRequest

FrameOf = Callable[..., ElectrodeFrame]
WaitUntil = Callable[..., None]
LIVE_S = 20.0
"""Longest wait for what has to happen."""


def public_names(kind: type) -> set[str]:
    return {name for name, _ in inspect.getmembers(kind, callable) if name[0] != "_"}


class Finger:
    """Publishes features of ``finger`` 100 times a second, as a service does."""

    def __init__(self, session: Session, frame_of: FrameOf, estimate: FeatureEstimate) -> None:
        self._publisher = session.publisher(FEATURES, sensor="finger")
        self._frame_of, self._estimate = frame_of, estimate
        self.delay_ns = 0
        self.silent = False
        self.serial = estimate.sensor_serial
        self._stop = threading.Event()
        self.sequence = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            if not self.silent:
                self.sequence += 1
                stamp = self._frame_of(self.sequence).stamp
                stamp = dataclasses.replace(
                    stamp, monotonic_ns=max(stamp.monotonic_ns - self.delay_ns, 1)
                )
                self._publisher.put(
                    dataclasses.replace(self._estimate, source=stamp, sensor_serial=self.serial)
                )

    def close(self) -> None:
        self._stop.set()
        self._thread.join(LIVE_S)


def simulation_request() -> SimulationRequest:
    path = straight_path((-0.004, 0.0, -0.011), (-0.004, 0.0, -0.007), 2)
    return SimulationRequest("r-1", "sphere_7mm", path)


CALLS: dict[str, Callable[[Any, dict[str, Any]], object]] = {
    "features": lambda robot, _: robot.features("finger"),
    "electrodes": lambda robot, _: robot.electrodes("finger"),
    "field": lambda robot, _: robot.field("finger"),
    "synthesis": lambda robot, _: robot.synthesis("finger"),
    "stream_features": lambda robot, _: robot.stream_features("finger"),
    "stream_electrodes": lambda robot, _: robot.stream_electrodes("finger"),
    "stream_field": lambda robot, _: robot.stream_field("finger"),
    "stream_synthesis": lambda robot, _: robot.stream_synthesis("finger"),
    "stream_wrench": lambda robot, _: robot.stream_wrench("finger"),
    "estimate_features": lambda robot, of: robot.estimate_features("finger", of["ElectrodeFrame"]),
    "estimate_field": lambda robot, of: robot.estimate_field("finger", of["ElectrodeFrame"]),
    "field_basis": lambda robot, _: robot.field_basis(),
    "synthesise": lambda robot, of: robot.synthesise(of["FieldFrame"]),
    "synthesise_from": lambda robot, of: robot.synthesise_from(of["FieldFrame"]),
    "next_features": lambda robot, _: robot.next_features("finger"),
    "robot_pose_publisher": lambda robot, _: robot.robot_pose_publisher("arm"),
    "tare": lambda robot, _: robot.tare("finger"),
    "zero": lambda robot, _: robot.zero("finger"),
    "simulate": lambda robot, _: robot.simulate(simulation_request()),
    "cancel_simulation": lambda robot, _: robot.cancel_simulation("r-1"),
    "model": lambda robot, _: robot.model(),
    "alive": lambda robot, _: robot.alive(),
    "status": lambda robot, _: robot.status(),
    "census": lambda robot, _: robot.census(),
}
"""Every call of a client, of its name."""
