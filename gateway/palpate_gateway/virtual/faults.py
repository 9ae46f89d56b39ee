"""Faults of the virtual finger at chosen times, with the symptoms that they have on a real wire.

A fault changes finished readings, while the model runs on: lost frames stay lost, and the ground
truth (wrench, pose, field) stays correct. Times count from the opening of the device; a restart
does not stop them.

========= =========================================== ==================================
kind      symptom                                     ``value``
========= =========================================== ==================================
stuck     electrodes repeat their last counts
saturated electrodes read 4095
dead      electrodes read 0
invalid   parity errors: one bit wrong, validity off
noise     more noise on electrodes                    standard deviation [counts], 50
jump      a constant is added to electrodes           that constant [counts], 100
lost      electrode frames are lost                   share of them, 1
silence   nothing comes; ``read`` times out
restart   ``DeviceLost``; opened again, the device
          counts from 0 and the model runs on
========= =========================================== ==================================
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from palpate.config import StrictConfig
from palpate.messages import COUNTS_MAX
from palpate_gateway.protocols import channels as ch
from palpate_gateway.readings import ElectrodeReading, Reading

Kind = Literal[
    "stuck", "saturated", "dead", "invalid", "noise", "jump", "lost", "silence", "restart"
]

_VALUES = {"noise": 50.0, "jump": 100.0, "lost": 1.0}
_WHOLE_DEVICE = ("lost", "silence", "restart")
_ADC_BITS = 12


class VirtualFault(StrictConfig):
    """One fault.

    Attributes:
        kind: Kind; see the table above.
        at_s: Begin, from the opening of the device [s].
        for_s: Duration [s]; 0 = for ever. Of a restart: how long the device is away and cannot be
            opened, 0 = it is back at once. With ``realtime = false`` the model skips that time.
        electrode: Which electrode, 1..19; None = all 19.
        value: Size; None = the default of the table.
    """

    kind: Kind
    at_s: float = Field(ge=0.0)
    for_s: float = Field(default=0.0, ge=0.0)
    electrode: int | None = Field(default=None, ge=1, le=ch.ELECTRODES)
    value: float | None = Field(default=None, allow_inf_nan=False)

    @model_validator(mode="after")
    def _makes_sense(self) -> VirtualFault:
        if self.electrode is not None and self.kind in _WHOLE_DEVICE:
            raise ValueError(
                f"a fault {self.kind!r} has no electrode: it concerns the whole device"
            )
        if self.value is not None:
            if self.kind not in _VALUES:
                raise ValueError(f"a fault {self.kind!r} has no value")
            if self.value < 0.0 and self.kind != "jump":
                raise ValueError(f"the value of a fault {self.kind!r} is not negative")
            if self.value > 1.0 and self.kind == "lost":
                raise ValueError("the value of a fault 'lost' is a share, 0 to 1")
        return self


class _ActiveFault:
    """State of one fault during a run."""

    def __init__(self, fault: VirtualFault, rate_hz: float, seed: list[int]) -> None:
        self.kind = fault.kind
        # The margin keeps a time such as 0.3 s at 100 Hz on frame 30 in spite of rounding.
        self.first = math.ceil(fault.at_s * rate_hz - 1e-6)
        frames = max(1, round(fault.for_s * rate_hz)) if fault.for_s else None
        self.end = math.inf if frames is None else self.first + frames
        self.away = frames or 0
        self.random = np.random.default_rng(seed)
        self.value = _VALUES.get(fault.kind, 0.0) if fault.value is None else fault.value
        self._which = (
            slice(None) if fault.electrode is None else slice(fault.electrode - 1, fault.electrode)
        )
        self._held: npt.NDArray[np.uint16] | None = None

    def on(self, tick: int) -> bool:
        return self.first <= tick < self.end

    def change(self, reading: ElectrodeReading) -> ElectrodeReading:
        """The reading with this fault of its electrodes."""
        counts = reading.electrodes.copy()
        part = counts[self._which]  # a view: what is written to it changes counts
        validity = reading.validity
        if self.kind == "stuck":
            if self._held is None:
                self._held = part.copy()
            part[:] = self._held
        elif self.kind == "saturated":
            part[:] = COUNTS_MAX
        elif self.kind == "dead":
            part[:] = 0
        elif self.kind == "invalid":
            flipped = self.random.integers(_ADC_BITS, size=len(part))
            part ^= np.left_shift(1, flipped).astype(np.uint16)
            for bit in range(ch.ELECTRODES)[self._which]:
                validity &= ~(1 << bit)
        else:
            more = (
                self.random.normal(0.0, self.value, len(part))
                if self.kind == "noise"
                else self.value
            )
            part[:] = np.clip(np.rint(part + more), 0, COUNTS_MAX)
        return replace(reading, electrodes=counts, validity=validity)


class FaultPlan:
    """All faults of one run, in the order in which they act on a frame; frames come in order."""

    def __init__(self, faults: Sequence[VirtualFault], rate_hz: float, seed: int) -> None:
        acting = [_ActiveFault(fault, rate_hz, [seed, 4, k]) for k, fault in enumerate(faults)]
        self._restarts = [one for one in acting if one.kind == "restart"]
        self._silences = [one for one in acting if one.kind == "silence"]
        self._others = [one for one in acting if one.kind not in ("restart", "silence")]
        self.counters = {f"fault_{fault.kind}_frames": 0 for fault in faults}
        """Frames that each kind of fault has changed; a restart counts once."""
        if any(one.kind == "invalid" for one in acting):
            self.counters["parity_errors"] = 0

    def clear_counters(self) -> None:
        """Set all counters to 0, as at a new opening of a device."""
        self.counters = dict.fromkeys(self.counters, 0)

    def restart(self, tick: int) -> int | None:
        """Frames for which the device is away if it restarts at this frame; else None."""
        for one in self._restarts:
            if tick >= one.first:
                self._restarts.remove(one)
                self.counters["fault_restart_frames"] += 1
                return one.away
        return None

    def silent(self, tick: int) -> bool:
        """Whether nothing comes at this frame."""
        if any(one.on(tick) for one in self._silences):
            self.counters["fault_silence_frames"] += 1
            return True
        return False

    def apply(self, tick: int, group: tuple[Reading, ...]) -> tuple[Reading, ...]:
        """The readings of one instant with their faults, without lost electrode frames."""
        now = [one for one in self._others if one.on(tick)]
        if not now:
            return group
        out: list[Reading] = []
        for reading in group:
            changed = (
                self._changed(reading, now) if isinstance(reading, ElectrodeReading) else reading
            )
            if changed is not None:
                out.append(changed)
        return tuple(out)

    def _changed(
        self, reading: ElectrodeReading, active: list[_ActiveFault]
    ) -> ElectrodeReading | None:
        lost = False
        # All faults act, also on a lost frame: otherwise their random numbers would depend on the
        # losses, and the counts after them would differ from those of a run without losses.
        for one in active:
            if one.kind == "lost":
                hit = one.random.random() < one.value
                lost |= hit
                self.counters["fault_lost_frames"] += hit
                continue
            before = reading.validity
            reading = one.change(reading)
            self.counters[f"fault_{one.kind}_frames"] += 1
            if one.kind == "invalid":
                self.counters["parity_errors"] += (before & ~reading.validity).bit_count()
        return None if lost else reading
