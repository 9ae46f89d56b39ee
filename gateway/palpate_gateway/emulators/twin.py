"""The digital twin as the source of emulated devices: counts, wrench and indenter pose of fingers.

Each finger has a loop of indentations. The virtual finger (``virtual.tape``) computes it once at
the start, with the same options and therefore the same counts; from then on it is only looked up.
The host's clock plays a loop: the position in it is the time since an epoch, modulo its length. So
emulators in several processes, started at different times on hosts whose clocks agree, play the
same scene: two that have the same seed and trajectories measure the same finger.

Between two frames everything is linear; PAC takes the nearest of its own 2200 instants per second.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from palpate.errors import ConfigError
from palpate.files.tape import read_tape
from palpate.messages import PAC_SAMPLES, Pose
from palpate.rigid import Quaternion, Vector, normalised
from palpate_gateway.emulators.biotac_slots import CHANNELS, Counts, CountTrack, Indices, Times
from palpate_gateway.emulators.emulator import HostTimed, Wrench
from palpate_gateway.readings import ElectrodeReading, PoseReading, WrenchReading
from palpate_gateway.virtual.model import VirtualOptions
from palpate_gateway.virtual.tape import TapeModel, find_tape

INDENTATIONS = 10
"""Indentations of a loop, which last 20 to 40 s."""

UNTOUCHED_S = 2.0
"""Time without contact at the start of a loop [s]."""

RATE_HZ = 100.0
"""Frames of a loop each second."""

Row = TypeVar("Row")

Progress = Callable[[float], None]
"""Takes the share of the work that is done."""


@dataclass(frozen=True, slots=True)
class TwinLoop:
    """One finger and its indenter for a while. The first frame is repeated at the end.

    Attributes:
        frames: E1..E19, PDC, TAC, TDC at each frame, shape ``(N + 1, 22)``.
        pac: PAC, 22 values of each frame, shape ``(22 N,)``.
        wrench: Force [N] and torque [N m] on the BioTac at each frame, ``N + 1`` of them.
        tips: Pose of the indenter in the sensor frame at each frame, ``N + 1`` of them.
        indenters: Names of the indenters, in order of their first contact.
    """

    frames: npt.NDArray[np.float64]
    pac: npt.NDArray[np.int64]
    wrench: Sequence[Wrench]
    tips: Sequence[Pose]
    indenters: tuple[str, ...]

    @property
    def duration_s(self) -> float:
        """Length [s]."""
        return (len(self.wrench) - 1) / RATE_HZ


def loop_options(
    finger: int = 0, *, unit: int | str = 0, trajectories: Sequence[str] = (), seed: int = 0
) -> VirtualOptions:
    """Options of the virtual finger that computes a loop.

    Args:
        finger: Which of several fingers, from 0; its seed is ``seed + finger``.
        unit: Specimen of the tape, by name or number from 1; 0 = chosen by the seed, so that
            fingers differ.
        trajectories: Ids of the trajectories to play; () = all.
        seed: Seed of the first finger.

    Raises:
        ConfigError: No tape ships.
    """
    if unit == 0:
        unit = 1 + (seed + finger) % len(read_tape(_tape()).specimens)
    return VirtualOptions(
        model="tape",
        unit=unit,
        trajectories=tuple(trajectories),
        seed=seed + finger,
        rate_hz=RATE_HZ,
        untouched_s=UNTOUCHED_S,
        field_rate_hz=0.0,
        episodes=INDENTATIONS,
        realtime=False,
    )


def make_loop(options: VirtualOptions, progress: Progress = lambda _: None) -> TwinLoop:
    """Compute a loop.

    Raises:
        ConfigError: No tape ships, or it has no such specimen or trajectory.
    """
    frames: list[list[int]] = []
    pac: list[npt.NDArray[np.uint16]] = []
    wrench: list[Wrench] = []
    tips: list[Pose] = []
    indenters: dict[str, None] = {}
    for block in TapeModel(options, _tape()).run():
        for reading in (reading for group in block for reading in group):
            if isinstance(reading, ElectrodeReading):
                slow = (reading.pdc, reading.tac, reading.tdc)
                frames.append([*reading.electrodes.tolist(), *slow])
                pac.append(reading.pac)
            elif isinstance(reading, WrenchReading):
                fx, fy, fz = reading.force.tolist()
                tx, ty, tz = reading.torque.tolist()
                wrench.append((fx, fy, fz, tx, ty, tz))
            elif isinstance(reading, PoseReading):
                x, y, z = reading.position.tolist()
                w, qx, qy, qz = reading.orientation.tolist()
                tips.append(Pose((x, y, z), (w, qx, qy, qz)))
                indenters[reading.indenter] = None
        # An indentation lasts about 3 s.
        progress(min(len(frames) / RATE_HZ / (3.0 * max(options.episodes, 1)), 1.0))
    return TwinLoop(
        np.array([*frames, frames[0]], np.float64),
        np.concatenate(pac).astype(np.int64),
        [*wrench, wrench[0]],
        [*tips, tips[0]],
        tuple(indenters),
    )


def _tape() -> Path:
    path = find_tape("")
    if path is None:
        raise ConfigError("no tape ships with this palpate", remedy="play idle or press instead")
    return path


class _LoopPlayer(HostTimed):
    """A source that plays a loop by the host's clock.

    Args:
        epoch_s: Host time at which every loop begins [s since 1970].
    """

    def __init__(self, epoch_s: float) -> None:
        # Read once: a host clock that is set while this runs must not make the finger jump.
        self._since_epoch_s = time.time() - time.monotonic() - epoch_s

    @property
    def _ahead_s(self) -> float:
        """Time since the epoch less the emulator's own time [s]."""
        return self._since_epoch_s + self.lead_s


class TwinCounts(CountTrack, _LoopPlayer):
    """Counts of several fingers."""

    def __init__(self, loops: Sequence[TwinLoop], epoch_s: float = 0.0) -> None:
        _LoopPlayer.__init__(self, epoch_s)
        self._loops = loops

    def slots(self, times_s: Times, places: Indices, finger: int) -> Counts:
        """See ``CountTrack``."""
        loop = self._loops[finger]
        at = np.mod(times_s + self._ahead_s, loop.duration_s) * RATE_HZ
        lower = np.minimum(at.astype(np.int64), len(loop.frames) - 2)
        dynamic = places == CHANNELS - 1
        column = np.where(dynamic, 0, places)
        before, after = loop.frames[lower, column], loop.frames[lower + 1, column]
        frame = np.rint(before + (at - lower) * (after - before)).astype(np.int64)
        # PAC has 22 samples in each frame, so it is not interpolated.
        nearest = np.rint(at * PAC_SAMPLES).astype(np.int64) % len(loop.pac)
        return np.where(dynamic, loop.pac[nearest], frame)


class _LoopRows(_LoopPlayer, Generic[Row]):
    """A source of one row for each frame of a loop, with the first row again at its end."""

    def __init__(self, rows: Sequence[Row], epoch_s: float = 0.0) -> None:
        super().__init__(epoch_s)
        self._rows = rows

    def _around(self, t: float) -> tuple[Row, Row, float]:
        """The rows before and after a time of the emulator's own [s], and the share of the way."""
        frames = len(self._rows)
        at = (t + self._ahead_s) % ((frames - 1) / RATE_HZ) * RATE_HZ
        lower = min(int(at), frames - 2)
        return self._rows[lower], self._rows[lower + 1], at - lower


class TwinWrench(_LoopRows[Wrench]):
    """The wrench on one finger; a ``WrenchSource``."""

    def __call__(self, t: float) -> Wrench:
        """The wrench at a time of the emulator's own [s]."""
        a, b, share = self._around(t)
        mixed = [one + share * (other - one) for one, other in zip(a, b, strict=True)]
        return (mixed[0], mixed[1], mixed[2], mixed[3], mixed[4], mixed[5])


class TwinTip(_LoopRows[Pose]):
    """The pose of the indenter on one finger, for an emulated robot; a ``TipSource``."""

    def __call__(self, t: float) -> Pose:
        """The pose in the sensor frame at a time of the emulator's own [s]."""
        a, b, share = self._around(t)
        ax, ay, az = a.position
        bx, by, bz = b.position
        position: Vector = (ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az))
        # A quaternion and its negative are the same rotation; the nearer one is taken.
        near = sum(p * q for p, q in zip(a.orientation, b.orientation, strict=True)) >= 0.0
        sign = share if near else -share
        w, x, y, z = (
            (1.0 - share) * p + sign * q for p, q in zip(a.orientation, b.orientation, strict=True)
        )
        turn: Quaternion = (w, x, y, z)
        return normalised(Pose(position, turn))
