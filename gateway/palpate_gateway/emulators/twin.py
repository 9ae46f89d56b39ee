"""The digital twin as what emulated devices measure: counts of fingers, wrenches on them.

Each finger has a loop of presses, computed at the start by the virtual finger (``virtual.tape``)
with the same options and therefore the same counts, and from then on only looked up. A loop is
played by the host's clock: its place at an instant is the time since an epoch, modulo its length.
So emulators that were started at different times, in several processes, on hosts whose clocks
agree, play the same press: whoever has a finger's seed and trajectories has its wrench.

Between two frames everything runs straight; PAC has the nearest of its own 2200 instants a second.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.errors import ConfigError
from palpate.files.tape import read_tape
from palpate.messages import PAC_SAMPLES
from palpate_gateway.emulators.biotac_slots import CHANNELS, Counts, CountTrack, Indices, Times
from palpate_gateway.emulators.emulator import HostTimed, Wrench
from palpate_gateway.readings import ElectrodeReading, WrenchReading
from palpate_gateway.virtual.options import VirtualOptions
from palpate_gateway.virtual.tape import Twin, find_tape

PRESSES = 10
"""Presses of a loop: 20 to 40 s."""

UNTOUCHED_S = 2.0
"""How long a finger is left alone where its loop begins [s]."""

RATE_HZ = 100.0
"""Frames of a loop each second."""

Told = Callable[[float], None]
"""Takes the share of the work that is done."""


@dataclass(frozen=True, slots=True)
class Loop:
    """One finger for a while.

    Attributes:
        frames: E1..E19, PDC, TAC, TDC at each frame and at the first again, shape ``(N + 1, 22)``.
        pac: PAC, 22 of each frame, shape ``(22 N,)``.
        wrench: Force [N] and torque [N m] on the BioTac at the same instants, ``N + 1`` of them.
    """

    frames: npt.NDArray[np.float64]
    pac: npt.NDArray[np.int64]
    wrench: Sequence[Wrench]

    @property
    def duration_s(self) -> float:
        """Length [s]."""
        return (len(self.wrench) - 1) / RATE_HZ


def loop_options(
    finger: int = 0, *, unit: int | str = 0, trajectories: Sequence[str] = (), seed: int = 0
) -> VirtualOptions:
    """The virtual finger that a loop is made of.

    Args:
        finger: Which of several, from 0: it is the first finger of the seed that is so much higher.
        unit: Unit of the tape, by name or number from 1; 0 = by the seed, so that fingers differ.
        trajectories: Ids of those that are played; () = all.
        seed: Of the first finger.

    Raises:
        ConfigError: No tape ships.
    """
    if unit == 0:
        unit = 1 + (seed + finger) % len(read_tape(_tape()).units)
    return VirtualOptions(
        model="tape",
        unit=unit,
        trajectories=tuple(trajectories),
        seed=seed + finger,
        rate_hz=RATE_HZ,
        untouched_s=UNTOUCHED_S,
        field_rate_hz=0.0,
        episodes=PRESSES,
        realtime=False,
    )


def make_loop(options: VirtualOptions, told: Told = lambda _: None) -> Loop:
    """Compute a loop.

    Raises:
        ConfigError: No tape ships, or it has no such unit or trajectory.
    """
    frames: list[list[int]] = []
    pac: list[npt.NDArray[np.uint16]] = []
    wrench: list[Wrench] = []
    for block in Twin(options, _tape()).run():
        for reading in (reading for group in block for reading in group):
            if isinstance(reading, ElectrodeReading):
                slow = (reading.pdc, reading.tac, reading.tdc)
                frames.append([*reading.electrodes.tolist(), *slow])
                pac.append(reading.pac)
            elif isinstance(reading, WrenchReading):
                fx, fy, fz = reading.force.tolist()
                tx, ty, tz = reading.torque.tolist()
                wrench.append((fx, fy, fz, tx, ty, tz))
        told(min(len(frames) / RATE_HZ / (3.0 * PRESSES), 1.0))
    return Loop(
        np.array([*frames, frames[0]], np.float64),
        np.concatenate(pac).astype(np.int64),
        [*wrench, wrench[0]],
    )


def _tape() -> Path:
    path = find_tape("")
    if path is None:
        raise ConfigError("no tape ships with this palpate", remedy="play idle or press instead")
    return path


class _Played(HostTimed):
    """Where a loop is.

    Args:
        epoch_s: A host's time at which every loop begins [s since 1970].
    """

    def __init__(self, epoch_s: float) -> None:
        # Once: a clock that is set while this runs must not make the finger jump.
        self._since_epoch_s = time.time() - time.monotonic() - epoch_s

    @property
    def _ahead_s(self) -> float:
        """Time since the epoch less the emulator's own [s]."""
        return self._since_epoch_s + self.lead_s


class TwinCounts(CountTrack, _Played):
    """Counts of several fingers.

    Args:
        loops: Of each finger.
        epoch_s: See ``_Played``.
    """

    def __init__(self, loops: Sequence[Loop], epoch_s: float = 0.0) -> None:
        _Played.__init__(self, epoch_s)
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
        nearest = np.rint(at * PAC_SAMPLES).astype(np.int64) % len(loop.pac)
        return np.where(dynamic, loop.pac[nearest], frame)


class TwinWrench(_Played):
    """The wrench on one finger; a ``WrenchSource``.

    Args:
        loop: Of that finger.
        epoch_s: See ``_Played``.
    """

    def __init__(self, loop: Loop, epoch_s: float = 0.0) -> None:
        super().__init__(epoch_s)
        self._wrench, self._duration_s = loop.wrench, loop.duration_s

    def __call__(self, t: float) -> Wrench:
        """The wrench at a time of the emulator's own [s]."""
        at = (t + self._ahead_s) % self._duration_s * RATE_HZ
        lower = min(int(at), len(self._wrench) - 2)
        share = at - lower
        a, b = self._wrench[lower], self._wrench[lower + 1]
        mixed = [one + share * (other - one) for one, other in zip(a, b, strict=True)]
        return (mixed[0], mixed[1], mixed[2], mixed[3], mixed[4], mixed[5])
