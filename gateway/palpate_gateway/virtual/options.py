"""Options of the virtual finger, and how one of its models plugs into it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, Protocol

from pydantic import Field

from palpate.config import StrictConfig
from palpate_gateway.readings import Reading
from palpate_gateway.virtual.faults import Fault

UNTOUCHED_FRAMES = 50
"""At least so many frames before the first touch: a tare takes as many."""

BLOCK_FRAMES = 16
"""Frames computed at once: NumPy's cost per call is shared, yet no read stalls for long."""

Group = tuple[Reading, ...]
"""All readings of one instant: electrodes first, then the truth."""


class VirtualOptions(StrictConfig):
    """Options of the ``virtual`` driver.

    Attributes:
        model: What moves the finger: ``tape`` plays simulated trajectories, ``formula`` is a closed
            formula with the right signs and orders of magnitude; ``auto`` = the tape if one is
            named or ships, else the formula.
        tape: Path of a tape, or the name of one that ships; empty = the one that ships.
        trajectories: Ids of the tape's trajectories to play; empty = all.
        seed: Of the order of touches, their timing, and noise.
        unit: Which finger. Formula: any number. Tape: a unit's name, or its number from 1.
        serial: Serial number; empty = made from unit and seed.
        indenter: What presses. Formula: a sphere, empty = ``sphere_14mm``. Tape: empty = all.
        rate_hz: Frames per second [Hz].
        realtime: Paced by the host's clock, as hardware is; False = as fast as it is read.
        untouched_s: Time before the first touch [s]; at least 50 frames.
        on_for_s: How long the finger has been switched on when it is opened [s]; of a tape only.
        field_rate_hz: How often the true displacement field is read [Hz]; 0 = never; of a tape
            only.
        episodes: Touches, then the source ends; 0 = endless.
        frames: Frames, then the source ends; 0 = endless. A lost frame counts.
        duration_s: Device time, then the source ends [s]; 0 = endless.
        faults: What goes wrong, and when.
    """

    model: Literal["auto", "tape", "formula"] = "auto"
    tape: str = ""
    trajectories: tuple[str, ...] = ()
    seed: int = Field(default=0, ge=0)
    unit: int | str = 1
    serial: str = ""
    indenter: str = ""
    rate_hz: float = Field(default=100.0, ge=1.0, le=2000.0)
    realtime: bool = True
    untouched_s: float = Field(default=1.0, ge=0.0)
    on_for_s: float = Field(default=1800.0, ge=0.0)
    field_rate_hz: float = Field(default=20.0, ge=0.0)
    episodes: int = Field(default=0, ge=0)
    frames: int = Field(default=0, ge=0)
    duration_s: float = Field(default=0.0, ge=0.0)
    faults: tuple[Fault, ...] = ()


class Model(Protocol):
    """What a virtual finger is made of; every run of it is the same."""

    @property
    def line(self) -> str:
        """One line for people."""
        ...

    @property
    def serial(self) -> str:
        """Serial number where the options give none."""
        ...

    def run(self) -> Iterator[list[Group]]:
        """Groups of readings from the beginning, in blocks; tick and time count from 0."""
        ...
