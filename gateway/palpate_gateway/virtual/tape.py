"""The digital twin: one specimen of a tape, indented along simulated trajectories.

Each trajectory is played as: wait, come, press, hold, release along the same states, leave. The
states of a tape are settled ones, so the indenter may move through them at any speed and back. What
a real finger does beyond that (viscous skin, sliding that does not return) is missing. Between two
steps of the tape everything is linear.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from palpate.errors import ConfigError
from palpate.files.tape import Tape, TapeTrajectory, read_tape
from palpate.messages import FloatArray
from palpate.rigid import rotation_matrices
from palpate_gateway.readings import FieldReading
from palpate_gateway.virtual.model import (
    BLOCK_FRAMES,
    CLEARANCE_M,
    UNTOUCHED_FRAMES,
    Array,
    Group,
    VirtualOptions,
    ease,
    groups_of,
)
from palpate_gateway.virtual.sensor import TwinSensor

SHIPPED = Path(__file__).with_name("tapes")
"""Folder of the tapes that ship."""

DEFAULT = "twin"
"""Name of the tape that is played when none is named."""

_SPEED_M_S = (3.0e-3, 8.0e-3)
"""Mean speed at which a person or a robot indents the finger [m/s]."""
_PRESS_S_MIN = 0.2


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
        remedy=f"choose one of {', '.join(known)}" if known else "give the path NAME.npz of a tape",
    )


@dataclass(frozen=True, slots=True)
class TrajectoryPlayback:
    """One trajectory with the times at which it is played.

    Attributes:
        trajectory: The trajectory.
        times_s: Ends of waiting, coming, pressing, holding, releasing and leaving [s] from the
            start.
    """

    trajectory: TapeTrajectory
    times_s: tuple[float, float, float, float, float, float]

    @property
    def duration_s(self) -> float:
        """Length [s]."""
        return self.times_s[-1]

    def step(self, time_s: Array) -> Array:
        """Position among the tape's steps, 0 to K - 1, at times from the start [s]."""
        _, come, press, hold, let_go, _ = self.times_s
        last = len(self.trajectory.poses) - 1
        return last * (ease(time_s, come, press) - ease(time_s, hold, let_go))

    def distance(self, time_s: Array) -> Array:
        """Distance of the indenter from the pose of step 0, against its direction [m]."""
        wait, come, _, _, let_go, leave = self.times_s
        return CLEARANCE_M * (1.0 - ease(time_s, wait, come) + ease(time_s, let_go, leave))


def playback(
    trajectory: TapeTrajectory, seed: int, number: int, *, wait_s: float = 0.0
) -> TrajectoryPlayback:
    """Times for indentation ``number`` of this seed; the indenter waits ``wait_s`` or longer."""
    random = np.random.default_rng([seed, 5, number])
    travel_m = float(np.linalg.norm(np.diff(trajectory.poses[:, :3], axis=0), axis=1).sum())
    there, back = random.uniform(*_SPEED_M_S, 2).tolist()
    wait, come, hold, leave = random.uniform((0.2, 0.3, 0.2, 0.2), (0.5, 0.5, 0.6, 0.4)).tolist()
    spans = (
        max(wait, wait_s),
        come,
        max(travel_m / there, _PRESS_S_MIN),
        hold,
        max(travel_m / back, _PRESS_S_MIN),
        leave,
    )
    a, b, c, d, e, f = np.cumsum(spans).tolist()
    return TrajectoryPlayback(trajectory, (a, b, c, d, e, f))


def order(count: int, seed: int, number: int) -> int:
    """Index of the trajectory of indentation ``number``: all once, shuffled, then all again."""
    through, at = divmod(number, count)
    return int(np.random.default_rng([seed, 6, through]).permutation(count)[at])


def between(values: Array, step: Array) -> Array:
    """Values of the tape ``(K, ...)`` at positions among its steps ``(N,)``; exact at the steps."""
    lower = np.clip(np.floor(step).astype(np.int64), 0, len(values) - 2)
    share = (step - lower).reshape(-1, *[1] * (values.ndim - 1))
    mixed: Array = values[lower] * (1.0 - share) + values[lower + 1] * share
    return mixed


def poses(values: Array, step: Array, distance: Array) -> tuple[Array, Array]:
    """Position ``(N, 3)`` [m] and quaternion ``(N, 4)`` of a moving indenter.

    Args:
        values: Poses of the tape, shape ``(K, 7)``.
        step: Position among them, shape ``(N,)``.
        distance: Distance from that pose against the pressing direction [m], shape ``(N,)``.
    """
    # A quaternion and its negative are the same rotation: interpolation needs neighbours with the
    # same sign.
    sign = np.cumprod(np.where(np.sum(values[1:, 3:] * values[:-1, 3:], axis=1) < 0.0, -1.0, 1.0))
    turns = values[:, 3:] * np.concatenate([[1.0], sign])[:, None]
    quaternion = between(turns, step)
    quaternion = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    towards = rotation_matrices(quaternion)[:, :, 2]
    return between(values[:, :3], step) - distance[:, None] * towards, quaternion


class TapeModel:
    """The finger of a tape; see ``FingerModel``.

    Raises:
        ConfigError: There is no such tape, or it has no such specimen, trajectory or indenter.
        DatasetError: The tape is damaged.
    """

    def __init__(self, options: VirtualOptions, path: Path) -> None:
        self._options = options
        self._tape = tape = read_tape(path)
        self._at = _specimen_index(options.unit, tape, path)
        self._specimen = tape.specimens[self._at]
        self._played = _chosen(options, tape, path)
        self._modes = tape.scaled_modes()
        name = self._specimen.name
        self.line = f"digital twin {name}, {len(self._played)} presses of {path.stem}"
        # A serial number has at most 64 characters on the wire.
        self.serial = f"VIRTUAL-{name[:32]}-S{options.seed}"

    def run(self) -> Iterator[list[Group]]:
        """See ``FingerModel``."""
        options = self._options
        sensor = TwinSensor(
            self._specimen, rate_hz=options.rate_hz, on_for_s=options.on_for_s, seed=options.seed
        )
        untouched_s = max(options.untouched_s, UNTOUCHED_FRAMES / options.rate_hz)
        first = number = 0
        while not options.episodes or number < options.episodes:
            which = order(len(self._played), options.seed, number)
            wait_s = 0.0 if number else untouched_s
            now = playback(self._played[which], options.seed, number, wait_s=wait_s)
            length = max(1, math.ceil(now.duration_s * options.rate_hz - 1e-9))
            for start in range(0, length, BLOCK_FRAMES):
                count = min(BLOCK_FRAMES, length - start)
                yield self._block(now, start, first + start, count, sensor)
            first += length
            number += 1

    def _block(
        self, now: TrajectoryPlayback, start: int, tick: int, count: int, sensor: TwinSensor
    ) -> list[Group]:
        """``count`` frames of a playback from frame ``start`` on, which has tick ``tick``."""
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
        groups = groups_of(
            tick,
            rate_hz,
            sampled,
            wrench=(force, torque),
            indenter=one.indenter,
            poses=poses(one.poses, step, now.distance(time_s)),
            in_contact=[bool(one_force.any()) for one_force in force],
        )
        for k, at in enumerate(range(tick, tick + count)):
            if self._reads_field(at):
                field = self._field(one, step[k : k + 1])
                groups[k] += (FieldReading(at, at / rate_hz, self._tape.mesh_sha256, field),)
        return groups

    def _reads_field(self, tick: int) -> bool:
        """Whether a period of the field begins at this frame."""
        share = min(self._options.field_rate_hz / self._options.rate_hz, 1.0)
        return share > 0.0 and (tick == 0 or _periods(tick, share) > _periods(tick - 1, share))

    def _field(self, one: TapeTrajectory, step: Array) -> FloatArray:
        """Nodal displacement at one position among the steps [m], shape ``(V, 3)``."""
        coefficients = between(one.coefficients.astype(np.float64), step)[0].astype(np.float32)
        moved = (coefficients @ self._modes).reshape(self._tape.mean.shape)
        return np.asarray(self._tape.mean + moved, np.float32)


def _periods(tick: int, share: float) -> int:
    """Whole periods up to this frame, of a stream that has ``share`` periods per frame."""
    return math.floor(tick * share + 1e-9)


def _specimen_index(unit: int | str, tape: Tape, path: Path) -> int:
    names = [one.name for one in tape.specimens]
    if isinstance(unit, int) and 1 <= unit <= len(names):
        return unit - 1
    if unit in names:
        return names.index(str(unit))
    raise ConfigError(
        f"the tape {path} has no specimen {unit!r}",
        remedy=f"choose a number from 1 to {len(names)} or one of {', '.join(names)}",
    )


def _chosen(options: VirtualOptions, tape: Tape, path: Path) -> Sequence[TapeTrajectory]:
    """The trajectories that the options select, in the order of the tape."""
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
