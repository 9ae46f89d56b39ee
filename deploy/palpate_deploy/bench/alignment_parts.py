"""The devices of ``palpate bench alignment``: emulators that all feel one signal, and a robot.

``python -m palpate_deploy.bench.alignment_parts finger CHANNEL PORT LATE`` is a BioTac on CAN,
``kms40 PORT LATE``, ``rdt PORT HTTP_PORT LATE`` and ``bota LINK LATE`` are force/torque sensors,
``robot ENDPOINT STATION LATE`` tells poses; ``LATE`` is a file for ``lateness``. Every device whose
clock can drift has one that does, by 200 ppm; the robot's is another than the host's altogether.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from palpate_deploy.bench.alignment_account import (
    LOW_COUNTS,
    LOW_N,
    SPAN_COUNTS,
    SPAN_M,
    SPAN_N,
)
from palpate_deploy.bench.harness import stop_on_sigterm
from palpate_deploy.bench.lateness import Lateness
from palpate_deploy.bench.ramp import share_at
from palpate_gateway.emulators.biotac_can import BiotacCanEmulator
from palpate_gateway.emulators.biotac_slots import Counts, CountTrack, Indices, Times
from palpate_gateway.emulators.bota import Bota
from palpate_gateway.emulators.emulator import Emulator, HostTimed
from palpate_gateway.emulators.kms40 import Kms40Emulator
from palpate_gateway.emulators.rdt import RdtEmulator

ROBOT_HZ = 250.0
_SLOT_RATE_HZ = 4400.0
_FAST = 200e-6
_ROBOT_FAST = 40e-6
_ROBOT_ORIGIN_S = 1e6
_FOR_EVER_S = 1e6


class RampCounts(CountTrack):
    """Every channel of a finger shows the signal."""

    def slots(self, times_s: Times, places: Indices, finger: int) -> Counts:
        """See ``CountTrack``."""
        return np.rint(LOW_COUNTS + SPAN_COUNTS * share_at(times_s + self.lead_s)).astype(np.int64)


class RampForce(HostTimed):
    """The force along z shows it."""

    def __init__(self, lateness: Lateness) -> None:
        self._lateness = lateness

    def __call__(self, t: float) -> Sequence[float]:
        """The wrench at a time of the emulator's own [s]."""
        self._lateness.note(t + self.lead_s)
        share = float(share_at(np.array(t + self.lead_s)))
        return (0.0, 0.0, LOW_N + SPAN_N * share, 0.0, 0.0, 0.0)


class RampFinger(BiotacCanEmulator):
    """A finger that notes when it was late."""

    def __init__(self, channel: str, port: int, lateness: Lateness) -> None:
        super().__init__(
            "udp_multicast",
            channel,
            fingers=1,
            counts=RampCounts(),
            slot_rate_hz=_SLOT_RATE_HZ * (1.0 + _FAST),
            options={"port": port},
        )
        self._lateness = lateness

    def _send(self, data: bytes) -> None:
        self._lateness.note(self._block_s + self._at * self._step_s)
        super()._send(data)


def serve(emulator: Emulator, stop: threading.Event) -> None:
    """Emulate until told to stop."""
    if not isinstance(emulator, RampFinger) and "clock_drift" in emulator.faults:
        emulator.inject("clock_drift", _FOR_EVER_S)
    with emulator:
        stop.wait()


def be_robot(endpoint: str, station: str, lateness: Lateness, stop: threading.Event) -> None:
    """Tell poses by a clock that is not the host's, at absolute deadlines."""
    from palpate.client import Client

    with Client(endpoint, station=station, timeout_s=20.0) as client:
        publisher = client.robot_pose_publisher("arm")
        due_s = time.monotonic()
        while not stop.is_set():
            due_s += 1.0 / ROBOT_HZ
            time.sleep(max(due_s - time.monotonic(), 0.0))
            travel_m = SPAN_M * float(share_at(np.array(due_s)))
            own_s = _ROBOT_ORIGIN_S + due_s * (1.0 + _ROBOT_FAST)
            publisher.put((travel_m, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), round(1e9 * own_s))
            lateness.note(due_s)


def main() -> None:
    """Be the device that the first argument names; the last is where to write when it was late."""
    stop, lateness = stop_on_sigterm(), Lateness()
    kind, *told, late_file = sys.argv[1:]
    if kind == "finger":
        serve(RampFinger(told[0], int(told[1]), lateness), stop)
    elif kind == "kms40":
        serve(Kms40Emulator(RampForce(lateness), port=int(told[0])), stop)
    elif kind == "rdt":
        source = RampForce(lateness)
        serve(RdtEmulator("netft", source, port=int(told[0]), http_port=int(told[1])), stop)
    elif kind == "bota":
        serve(Bota(RampForce(lateness), path=told[0]), stop)
    else:
        be_robot(told[0], told[1], lateness, stop)
    lateness.write(Path(late_file))


if __name__ == "__main__":
    main()
