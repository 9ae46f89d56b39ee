"""Options of the virtual finger, and the interface of the models that move it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from pydantic import Field

from palpate.config import StrictConfig
from palpate.messages import CountArray, FloatArray
from palpate_gateway.device import SerialOption
from palpate_gateway.protocols import channels as ch
from palpate_gateway.readings import ElectrodeReading, PoseReading, Reading, WrenchReading
from palpate_gateway.virtual.faults import VirtualFault

Array = npt.NDArray[np.float64]

UNTOUCHED_FRAMES = 50
"""Fewest frames before the first contact: a tare needs as many."""

BLOCK_FRAMES = 16
"""Frames computed at once: NumPy's cost per call is shared, and no read takes long."""

CLEARANCE_M = 3.0e-3
"""Distance of the waiting indenter from the skin [m]."""

WRENCH_SERIAL = "VIRTUAL-FT"
"""Serial number of the virtual force/torque sensor."""

Group = tuple[Reading, ...]
"""All readings of one instant: electrodes first, then the ground truth."""


class VirtualOptions(StrictConfig):
    """Options of the ``virtual`` driver.

    Attributes:
        model: What moves the finger: ``tape`` plays simulated indentations, ``formula`` is a closed
            formula with the right signs and orders of magnitude; ``auto`` = the tape if one is
            named or ships, else the formula.
        tape: Path of a tape, or the name of one that ships; empty = the default one that ships.
        trajectories: Ids of the tape's trajectories to play; empty = all.
        seed: Seed of the order of indentations, their timing, and noise.
        unit: Which specimen. Formula: any number. Tape: its name, or its number from 1.
        serial: Serial number; empty = made from specimen and seed.
        indenter: Name of the indenter. Formula: a sphere, empty = ``sphere_14mm``. Tape: empty =
            all.
        rate_hz: Frames per second [Hz].
        realtime: Paced by the host's clock, as hardware is; False = as fast as it is read.
        untouched_s: Time before the first contact [s]; at least 50 frames.
        on_for_s: Time since power-on when the finger is opened [s]; for a tape only.
        field_rate_hz: Rate of the true displacement field [Hz]; 0 = never; for a tape only.
        episodes: Number of indentations, then the source ends; 0 = endless.
        frames: Number of frames, then the source ends; 0 = endless. A lost frame counts.
        duration_s: Device time, then the source ends [s]; 0 = endless.
        faults: Faults and their times.
    """

    model: Literal["auto", "tape", "formula"] = "auto"
    tape: str = ""
    trajectories: tuple[str, ...] = ()
    seed: int = Field(default=0, ge=0)
    unit: int | str = 1
    serial: SerialOption = ""
    indenter: str = ""
    rate_hz: float = Field(default=100.0, ge=1.0, le=2000.0)
    realtime: bool = True
    untouched_s: float = Field(default=1.0, ge=0.0)
    on_for_s: float = Field(default=1800.0, ge=0.0)
    field_rate_hz: float = Field(default=20.0, ge=0.0)
    episodes: int = Field(default=0, ge=0)
    frames: int = Field(default=0, ge=0)
    duration_s: float = Field(default=0.0, ge=0.0)
    faults: tuple[VirtualFault, ...] = ()


class FingerModel(Protocol):
    """Source of a virtual finger's readings; each run gives the same ones."""

    line: str
    """Description in one line."""
    serial: str
    """Serial number where the options give none."""

    def run(self) -> Iterator[list[Group]]:
        """Groups of readings from the beginning, in blocks; tick and time count from 0."""
        ...


class SampledFrames(NamedTuple):
    """N frames of counts.

    Attributes:
        electrodes: Shape ``(N, 19)``.
        pac: Shape ``(N, 22)``.
        slow: PDC, TAC, TDC, shape ``(N, 3)``.
    """

    electrodes: CountArray
    pac: CountArray
    slow: CountArray


def groups_of(
    first: int,
    rate_hz: float,
    frames: SampledFrames,
    *,
    wrench: tuple[FloatArray, FloatArray],
    indenter: str,
    poses: tuple[Array, Sequence[Array] | Array],
    in_contact: Sequence[bool],
) -> list[Group]:
    """Readings of N frames, of which the first has the tick ``first``.

    Args:
        first: Tick of the first frame.
        rate_hz: Frames per second [Hz].
        frames: Counts.
        wrench: Force [N] and torque [N m] on the finger, shape ``(N, 3)`` each.
        indenter: Name of the indenter.
        poses: Its positions [m], shape ``(N, 3)``, and quaternions, shape ``(N, 4)``.
        in_contact: Whether it touches the skin.
    """
    (force, torque), (position, quaternion) = wrench, poses
    groups: list[Group] = []
    for k, (pdc, tac, tdc) in enumerate(frames.slow.tolist()):
        at = first + k
        at_s = at / rate_hz
        electrodes, pac = frames.electrodes[k], frames.pac[k]
        groups.append(
            (
                ElectrodeReading(at, at_s, 0, electrodes, pdc, pac, tac, tdc, ch.ALL_VALID),
                WrenchReading(at, at_s, force[k], torque[k], WRENCH_SERIAL),
                PoseReading(at, at_s, indenter, position[k], quaternion[k], in_contact[k]),
            )
        )
    return groups


def ease(time_s: Array, start_s: float, end_s: float) -> Array:
    """Smooth step from 0 at ``start_s`` to 1 at ``end_s``, without a jump of the velocity."""
    share = np.clip((time_s - start_s) / max(end_s - start_s, 1e-9), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)
