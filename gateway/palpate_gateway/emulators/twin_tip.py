"""The digital twin's indenter as what an emulated robot carries.

It plays the presses of ``emulators.twin``: with the same seed, trajectories and epoch the tip is
where the finger that is played beside it is pressed.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from palpate.errors import ConfigError
from palpate.messages import Pose
from palpate.rigid import Quaternion, Vector, normalised
from palpate_gateway.emulators.emulator import HostTimed
from palpate_gateway.emulators.twin import RATE_HZ, Told, loop_options
from palpate_gateway.readings import PoseReading
from palpate_gateway.virtual.options import VirtualOptions
from palpate_gateway.virtual.tape import Twin, find_tape


@dataclass(frozen=True, slots=True)
class TipLoop:
    """Poses of the indenter for a while.

    Attributes:
        tips: At each frame, and at the first again.
        indenters: Names of what presses, in order.
    """

    tips: Sequence[Pose]
    indenters: tuple[str, ...]


def tip_loop(options: VirtualOptions | None = None, told: Told = lambda _: None) -> TipLoop:
    """Compute a loop.

    Raises:
        ConfigError: No tape ships, or it has no such unit or trajectory.
    """
    options = options or loop_options()
    path = find_tape("")
    if path is None:
        raise ConfigError("no tape ships with this palpate", remedy="play idle or press instead")
    tips: list[Pose] = []
    indenters: dict[str, None] = {}
    for block in Twin(options, path).run():
        for reading in (reading for group in block for reading in group):
            if isinstance(reading, PoseReading):
                x, y, z = reading.position.tolist()
                w, qx, qy, qz = reading.orientation.tolist()
                tips.append(Pose((x, y, z), (w, qx, qy, qz)))
                indenters[reading.indenter] = None
        told(min(len(tips) / RATE_HZ / (3.0 * max(options.episodes, 1)), 1.0))
    return TipLoop([*tips, tips[0]], tuple(indenters))


class TwinTip(HostTimed):
    """Where the tip is; a ``TipSource``.

    Args:
        loop: Of the finger that is pressed.
        epoch_s: A host's time at which every loop begins [s since 1970].
    """

    def __init__(self, loop: TipLoop, epoch_s: float = 0.0) -> None:
        # Once: a clock that is set while this runs must not make the robot jump.
        self._since_epoch_s = time.time() - time.monotonic() - epoch_s
        self._tips = loop.tips
        self._duration_s = (len(loop.tips) - 1) / RATE_HZ

    def __call__(self, t: float) -> Pose:
        """The tip at a time of the emulator's own [s]; straight between frames."""
        at = (t + self._since_epoch_s + self.lead_s) % self._duration_s * RATE_HZ
        lower = min(int(at), len(self._tips) - 2)
        share = at - lower
        a, b = self._tips[lower], self._tips[lower + 1]
        near = sum(p * q for p, q in zip(a.orientation, b.orientation, strict=True)) >= 0.0
        ax, ay, az = a.position
        bx, by, bz = b.position
        position: Vector = (ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az))
        sign = share if near else -share
        w, x, y, z = (
            (1.0 - share) * p + sign * q for p, q in zip(a.orientation, b.orientation, strict=True)
        )
        turn: Quaternion = (w, x, y, z)
        return normalised(Pose(position, turn))
