"""The devices of ``palpate bench alignment``: emulators that all feel one signal, and a robot.

``python -m palpate.deploy.bench.alignment_parts finger CHANNEL PORT`` is a BioTac on CAN, ``kms40
PORT``, ``rdt PORT HTTP_PORT`` and ``bota LINK`` are force/torque sensors, ``robot ENDPOINT
STATION`` tells poses. Every device whose clock can drift has one that does, by 200 ppm; the robot's
is another than the host's altogether.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence

import numpy as np

from palpate.deploy.bench.alignment_account import (
    LOW_COUNTS,
    LOW_N,
    SPAN_COUNTS,
    SPAN_M,
    SPAN_N,
)
from palpate.deploy.bench.harness import stop_on_sigterm
from palpate.deploy.bench.ramp import share_at
from palpate.gateway.emulators.biotac_can import BiotacCanEmulator
from palpate.gateway.emulators.biotac_slots import Counts, CountTrack, Indices, Times
from palpate.gateway.emulators.bota import Bota
from palpate.gateway.emulators.emulator import Emulator, HostTimed
from palpate.gateway.emulators.kms40 import Kms40Emulator
from palpate.gateway.emulators.rdt import RdtEmulator

ROBOT_HZ = 250.0
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

    def __call__(self, t: float) -> Sequence[float]:
        """The wrench at a time of the emulator's own [s]."""
        share = float(share_at(np.array(t + self.lead_s)))
        return (0.0, 0.0, LOW_N + SPAN_N * share, 0.0, 0.0, 0.0)


def serve(emulator: Emulator, stop: threading.Event) -> None:
    """Emulate until told to stop."""
    if "clock_drift" in emulator.faults:
        emulator.inject("clock_drift", _FOR_EVER_S)
    with emulator:
        stop.wait()


def be_robot(endpoint: str, station: str, stop: threading.Event) -> None:
    """Tell poses by a clock that is not the host's, at absolute deadlines."""
    from palpate.protos.client import Client

    with Client(endpoint, station=station, timeout_s=20.0) as client:
        publisher = client.robot_pose_publisher("arm")
        due_s = time.monotonic()
        while not stop.is_set():
            due_s += 1.0 / ROBOT_HZ
            if time.monotonic() - due_s > 0.5:  # this process stood still; a robot would not have
                due_s = time.monotonic()
            time.sleep(max(due_s - time.monotonic(), 0.0))
            travel_m = SPAN_M * float(share_at(np.array(due_s)))
            own_s = _ROBOT_ORIGIN_S + due_s * (1.0 + _ROBOT_FAST)
            publisher.put((travel_m, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), round(1e9 * own_s))


def main() -> None:
    """Be the device that the first argument names."""
    stop = stop_on_sigterm()
    kind, *told = sys.argv[1:]
    if kind == "finger":
        channel, port = told
        options = {"port": int(port)}
        serve(
            BiotacCanEmulator(
                "udp_multicast", channel, fingers=1, counts=RampCounts(), options=options
            ),
            stop,
        )
    elif kind == "kms40":
        serve(Kms40Emulator(RampForce(), port=int(told[0])), stop)
    elif kind == "rdt":
        serve(RdtEmulator("netft", RampForce(), port=int(told[0]), http_port=int(told[1])), stop)
    elif kind == "bota":
        serve(Bota(RampForce(), path=told[0]), stop)
    else:
        be_robot(told[0], told[1], stop)


if __name__ == "__main__":
    main()
