"""The twin: a unit of a tape, touched along simulated trajectories, with its ground truth."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from palpate.errors import ConfigError
from palpate.files.tape import Tape, TapeTrajectory, read_tape
from palpate.messages import FloatArray
from palpate_gateway.protocols import channels as ch
from palpate_gateway.readings import (
    ElectrodeReading,
    FieldReading,
    PoseReading,
    Reading,
    WrenchReading,
)
from palpate_gateway.virtual.geometry import Array
from palpate_gateway.virtual.options import BLOCK_FRAMES, UNTOUCHED_FRAMES, Group, VirtualOptions
from palpate_gateway.virtual.press import Press, between, order, poses, press
from palpate_gateway.virtual.sensor import TwinSensor
from palpate_gateway.virtual.signals import WRENCH_SERIAL

SHIPPED = Path(__file__).with_name("tapes")
"""Folder of the tapes that ship."""

DEFAULT = "twin"
"""Name of the shipped tape that is played when none is named."""


def find_tape(name: str) -> Path | None:
    """Path of a tape; None where none is named and none ships.

    Args:
        name: A path, or the name of a tape that ships; empty = the default one.

    Raises:
        ConfigError: There is no such tape.
    """
    path = SHIPPED / f"{name or DEFAULT}.npz"
    if path.is_file():
        return path
    if not name:
        return None
    if name.endswith(".npz") or "/" in name:
        return Path(name)
    known = sorted(file.stem for file in SHIPPED.glob("*.npz"))
    raise ConfigError(
        f"no tape {name!r} ships with palpate",
        remedy=f"take one of {', '.join(known)}" if known else "give the path of a tape, NAME.npz",
    )


class Twin:
    """The finger of a tape; see ``Model``.

    Args:
        options: The driver's.
        path: The tape.

    Raises:
        ConfigError: The tape is not there, or has no such unit, trajectory or indenter.
        DatasetError: It is damaged.
    """

    def __init__(self, options: VirtualOptions, path: Path) -> None:
        self._options = options
        self._tape = tape = read_tape(path)
        self._at = _unit_index(options.unit, tape, path)
        self._unit = tape.units[self._at]
        self._played = _chosen(options, tape, path)
        self._modes = tape.scaled_modes()
        self._line = f"digital twin {self._unit.name}, {len(self._played)} presses of {path.stem}"

    @property
    def line(self) -> str:
        """See ``Model``."""
        return self._line

    @property
    def serial(self) -> str:
        """See ``Model``."""
        # A serial number has at most 64 characters on the wire.
        return f"VIRTUAL-{self._unit.name[:32]}-S{self._options.seed}"

    def run(self) -> Iterator[list[Group]]:
        """See ``Model``."""
        options = self._options
        sensor = TwinSensor(
            self._unit, rate_hz=options.rate_hz, on_for_s=options.on_for_s, seed=options.seed
        )
        untouched_s = max(options.untouched_s, UNTOUCHED_FRAMES / options.rate_hz)
        first = number = 0
        while not options.episodes or number < options.episodes:
            which = order(len(self._played), options.seed, number)
            wait_s = 0.0 if number else untouched_s
            now = press(self._played[which], options.seed, number, wait_s=wait_s)
            length = max(1, math.ceil(now.duration_s * options.rate_hz - 1e-9))
            for start in range(0, length, BLOCK_FRAMES):
                count = min(BLOCK_FRAMES, length - start)
                yield self._block(now, start, first + start, count, sensor)
            first += length
            number += 1

    def _block(
        self, now: Press, start: int, tick: int, count: int, sensor: TwinSensor
    ) -> list[Group]:
        """Frames ``start`` to ``start + count - 1`` of a press, the first of which is ``tick``."""
        rate_hz = self._options.rate_hz
        one = now.trajectory
        # One more instant than frames, because PAC follows the pressure until the next frame.
        time_s = np.arange(start, start + count + 1) / rate_hz
        step = now.step(time_s)
        pressure = between(one.fluid_pressure_pa.astype(np.float64), step)
        step, time_s = step[:count], time_s[:count]
        counts = between(one.counts[self._at].astype(np.float64), step)
        sampled = sensor.sample(counts, pressure, tick)
        force = between(one.force.astype(np.float64), step).astype(np.float32)
        torque = between(one.torque.astype(np.float64), step).astype(np.float32)
        position, quaternion = poses(one.poses, step, now.distance(time_s))
        touching = [bool(one_force.any()) for one_force in force]
        slow = sampled.slow.tolist()
        groups: list[Group] = []
        for k, at in enumerate(range(tick, tick + count)):
            at_s = at / rate_hz
            pdc, tac, tdc = slow[k]
            readings: list[Reading] = [
                ElectrodeReading(
                    at, at_s, 0, sampled.electrodes[k], pdc, sampled.pac[k], tac, tdc, ch.ALL_VALID
                ),
                WrenchReading(at, at_s, force[k], torque[k], WRENCH_SERIAL),
                PoseReading(at, at_s, one.indenter, position[k], quaternion[k], touching[k]),
            ]
            if self._reads_field(at):
                readings.append(
                    FieldReading(
                        at, at_s, self._tape.mesh_sha256, self._field(one, step[k : k + 1])
                    )
                )
            groups.append(tuple(readings))
        return groups

    def _reads_field(self, tick: int) -> bool:
        """Whether a period of the field's rate begins with this frame."""
        share = min(self._options.field_rate_hz / self._options.rate_hz, 1.0)
        return share > 0.0 and (tick == 0 or _periods(tick, share) > _periods(tick - 1, share))

    def _field(self, one: TapeTrajectory, step: Array) -> FloatArray:
        """The displacement at one place among the steps [m], shape ``(V, 3)``."""
        coefficients = between(one.coefficients.astype(np.float64), step)[0].astype(np.float32)
        moved = (coefficients @ self._modes).reshape(self._tape.mean.shape)
        return np.asarray(self._tape.mean + moved, np.float32)


def _periods(tick: int, share: float) -> int:
    """Whole periods of a stream that begin up to this frame, of which it has a share."""
    return math.floor(tick * share + 1e-9)


def _unit_index(unit: int | str, tape: Tape, path: Path) -> int:
    names = [one.name for one in tape.units]
    if isinstance(unit, int) and 1 <= unit <= len(names):
        return unit - 1
    if unit in names:
        return names.index(str(unit))
    raise ConfigError(
        f"the tape {path} has no unit {unit!r}",
        remedy=f"take a number from 1 to {len(names)} or one of {', '.join(names)}",
    )


def _chosen(options: VirtualOptions, tape: Tape, path: Path) -> Sequence[TapeTrajectory]:
    """The trajectories that the options let through, in the tape's order."""
    known = [one.id for one in tape.trajectories]
    for wanted in options.trajectories:
        if wanted not in known:
            near = difflib.get_close_matches(wanted, known, n=1, cutoff=0.5)
            raise ConfigError(
                f"the tape {path} has no trajectory {wanted!r}",
                remedy=f"did you mean {near[0]!r}?" if near else f"its first is {known[0]!r}",
            )
    chosen = [
        one
        for one in tape.trajectories
        if (not options.trajectories or one.id in options.trajectories)
        and options.indenter in ("", one.indenter)
    ]
    if not chosen:
        there = sorted({one.indenter for one in tape.trajectories})
        raise ConfigError(
            f"the tape {path} has no such trajectory with indenter {options.indenter!r}",
            remedy=f"its indenters are {', '.join(there)}",
        )
    return chosen
