"""How a tape's trajectory is played: come, press, hold, let go along the same states, leave, wait.

The states of a tape are settled ones, so the finger may be moved through them at any speed and
back: what a real one does beyond that (viscous skin, sliding that does not return) is not there.
Between two steps of the tape everything runs straight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate.files.tape import TapeTrajectory
from palpate.rigid import rotation_matrices
from palpate_gateway.virtual.geometry import Array
from palpate_gateway.virtual.trajectory import CLEARANCE_M, ease

_SPEED_M_S = (3.0e-3, 8.0e-3)
"""Mean speed at which a person's or a robot's touch presses in [m/s]."""
_PRESS_S_MIN = 0.2


@dataclass(frozen=True, slots=True)
class Press:
    """One trajectory, timed.

    Attributes:
        trajectory: What is played.
        times_s: Ends of waiting, coming, pressing, holding, letting go and leaving [s] from the
            start.
    """

    trajectory: TapeTrajectory
    times_s: tuple[float, float, float, float, float, float]

    @property
    def duration_s(self) -> float:
        """Length [s]."""
        return self.times_s[-1]

    def step(self, time_s: Array) -> Array:
        """Place among the tape's steps, 0 to K - 1, at times from the start [s]."""
        _, come, press, hold, let_go, _ = self.times_s
        last = len(self.trajectory.poses) - 1
        return last * (ease(time_s, come, press) - ease(time_s, hold, let_go))

    def distance(self, time_s: Array) -> Array:
        """How far the indenter stands back from the pose of step 0 [m]."""
        wait, come, _, _, let_go, leave = self.times_s
        return CLEARANCE_M * (1.0 - ease(time_s, wait, come) + ease(time_s, let_go, leave))


def press(trajectory: TapeTrajectory, seed: int, number: int, *, wait_s: float = 0.0) -> Press:
    """Touch ``number`` of the finger with this seed.

    Args:
        trajectory: What is played.
        seed: Of the timing.
        number: Of the touch.
        wait_s: Least time before the indenter comes [s].
    """
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
    return Press(trajectory, (a, b, c, d, e, f))


def order(count: int, seed: int, number: int) -> int:
    """Which of ``count`` trajectories touch ``number`` plays: each once, shuffled, then anew."""
    through, at = divmod(number, count)
    return int(np.random.default_rng([seed, 6, through]).permutation(count)[at])


def between(values: Array, step: Array) -> Array:
    """Values of the tape ``(K, ...)`` at places among its steps ``(N,)``; exact at the steps."""
    lower = np.clip(np.floor(step).astype(np.int64), 0, len(values) - 2)
    share = (step - lower).reshape(-1, *[1] * (values.ndim - 1))
    mixed: Array = values[lower] * (1.0 - share) + values[lower + 1] * share
    return mixed


def poses(values: Array, step: Array, distance: Array) -> tuple[Array, Array]:
    """Position ``(N, 3)`` [m] and quaternion ``(N, 4)`` of an indenter on its way.

    Args:
        values: Poses of the tape, shape ``(K, 7)``.
        step: Place among them, shape ``(N,)``.
        distance: How far it stands back against its pressing direction [m], shape ``(N,)``.
    """
    # A quaternion and its negative are the same turn: straight between steps only with one sign.
    sign = np.cumprod(np.where(np.sum(values[1:, 3:] * values[:-1, 3:], axis=1) < 0.0, -1.0, 1.0))
    turns = values[:, 3:] * np.concatenate([[1.0], sign])[:, None]
    quaternion = between(turns, step)
    quaternion = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    towards = rotation_matrices(quaternion)[:, :, 2]
    return between(values[:, :3], step) - distance[:, None] * towards, quaternion
