"""The devices of ``palpate bench alignment``: emulators that measure one signal, and a robot.

``python -m palpate_deploy.bench.alignment_parts finger CHANNEL PORT LATE`` is a BioTac on CAN,
``kms40 PORT LATE``, ``rdt PORT HTTP_PORT LATE`` and ``bota LINK LATE`` are force/torque sensors,
``robot ENDPOINT STATION LATE`` publishes poses; ``LATE`` is a file for the times at which it was
late. Every device with a clock of its own drifts by 200 ppm; the robot has a clock of its own, too.

The signal rises and falls evenly, twice a second, by the host's monotonic clock: a value, and the
time to a tenth of a ramp, give the exact time at which it was taken.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate_deploy.bench.harness import stop_on_sigterm
from palpate_gateway.emulators.biotac_can import BiotacCanEmulator
from palpate_gateway.emulators.biotac_slots import Counts, CountTrack, Indices, Times
from palpate_gateway.emulators.bota import BotaEmulator
from palpate_gateway.emulators.emulator import Emulator, HostTimed
from palpate_gateway.emulators.kms40 import Kms40Emulator
from palpate_gateway.emulators.rdt import RdtEmulator

Floats = npt.NDArray[np.float64]

LOW_COUNTS, SPAN_COUNTS = 300, 3500
"""Counts of an electrode that is not pressed, and how many more when it is."""
LOW_N, SPAN_N = 1.0, 20.0
"""Force likewise [N]."""
SPAN_M = 0.02
"""Travel of the indenter [m]."""

RAMP_S = 0.25
"""Duration of one rise or fall [s]."""

MARGIN_S = 0.025
"""Readings this close to a turning point are left out, because a value has two times there [s]."""


def share_at(time_s: Floats) -> Floats:
    """The signal, 0..1, at monotonic times [s]."""
    place = np.mod(time_s / RAMP_S, 2.0)
    return np.asarray(1.0 - np.abs(place - 1.0))


def time_of(share: Floats, about_s: Floats) -> Floats:
    """When the signal had a value, 0..1 [s]; NaN near turning points.

    ``about_s`` is that time to a tenth of a ramp [s], of the same shape.
    """
    ramp = np.floor(about_s / RAMP_S)
    rising = np.mod(ramp, 2.0) == 0.0
    time_s = RAMP_S * (ramp + np.where(rising, share, 1.0 - share))
    past_s = about_s - RAMP_S * ramp
    clear = (past_s > MARGIN_S) & (past_s < RAMP_S - MARGIN_S)
    return np.where(clear, time_s, np.nan)


LATE_S = 5e-3
"""A sample that is later than this came from an emulator that got no CPU time: a busy host delays
emulators as it never delays a sensor, so such times are not measured [s]."""

_BEFORE_S, _AFTER_S = 0.05, 0.3
"""Margins around such times: slots then come in a burst, and the clock model needs time [s]."""


class Lateness:
    """Notes the times at which one process was late."""

    def __init__(self) -> None:
        self._spans: list[tuple[float, float]] = []

    def note(self, due_s: float) -> None:
        """A sample that was due at ``due_s`` [s, monotonic] is sent now."""
        now_s = time.monotonic()
        if now_s - due_s <= LATE_S:
            return
        if self._spans and due_s <= self._spans[-1][1]:
            self._spans[-1] = (min(self._spans[-1][0], due_s), now_s)
        else:
            self._spans.append((due_s, now_s))

    def write(self, path: Path) -> None:
        """Write the noted times."""
        made = path.with_suffix(".part")
        with made.open("wb") as file:
            np.save(file, np.array(self._spans, np.float64).reshape(-1, 2))
        made.rename(path)


class OnTime:
    """Selects the instants at which no emulator was late.

    Args:
        spans_s: Beginnings and ends of the late times [s, monotonic], shape ``(N, 2)``.
    """

    def __init__(self, spans_s: Floats) -> None:
        wide = spans_s + np.array([-_BEFORE_S, _AFTER_S])
        wide = wide[np.argsort(wide[:, 0])]
        self._starts = wide[:, 0]
        self._ends = np.maximum.accumulate(wide[:, 1]) if len(wide) else wide[:, 1]

    @classmethod
    def of(cls, paths: list[Path]) -> OnTime:
        """From the files of all devices."""
        return cls(np.concatenate([np.zeros((0, 2)), *(np.load(path) for path in paths)]))

    def __call__(self, time_s: Floats) -> npt.NDArray[np.bool_]:
        """Whether each instant counts; of the shape of the times [s, monotonic]."""
        last = np.searchsorted(self._starts, time_s, side="right") - 1
        if not len(self._ends):
            return np.ones(np.shape(time_s), np.bool_)
        inside = (last >= 0) & (time_s <= self._ends[np.maximum(last, 0)])
        return np.asarray(~inside)


ROBOT_HZ = 250.0
_SLOT_RATE_HZ = 4400.0
_FAST = 200e-6
_ROBOT_FAST = 40e-6
_ROBOT_ORIGIN_S = 1e6
_FOR_EVER_S = 1e6


class RampCounts(CountTrack):
    """Counts of a finger, every channel of which is the signal."""

    def slots(self, times_s: Times, places: Indices, finger: int) -> Counts:
        """See ``CountTrack``."""
        return np.rint(LOW_COUNTS + SPAN_COUNTS * share_at(times_s + self.lead_s)).astype(np.int64)


class RampForce(HostTimed):
    """A wrench whose force along z is the signal."""

    def __init__(self, lateness: Lateness) -> None:
        self._lateness = lateness

    def __call__(self, t: float) -> Sequence[float]:
        """The wrench at a time of the emulator's own [s]."""
        self._lateness.note(t + self.lead_s)
        share = float(share_at(np.array(t + self.lead_s)))
        return (0.0, 0.0, LOW_N + SPAN_N * share, 0.0, 0.0, 0.0)


class RampFinger(BiotacCanEmulator):
    """A finger on CAN that notes when it was late."""

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
    """Emulate until ``stop`` is set."""
    if not isinstance(emulator, RampFinger) and "clock_drift" in emulator.faults:
        emulator.inject("clock_drift", _FOR_EVER_S)
    with emulator:
        stop.wait()


def publish_poses(endpoint: str, station: str, lateness: Lateness, stop: threading.Event) -> None:
    """Publish poses at absolute deadlines, stamped by a clock of its own."""
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
    """Run the device that the first argument names; the last one is the file of late times."""
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
        serve(BotaEmulator(RampForce(lateness), path=told[0]), stop)
    else:
        publish_poses(told[0], told[1], lateness, stop)
    lateness.write(Path(late_file))


if __name__ == "__main__":
    main()
