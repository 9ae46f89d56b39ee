"""Faulty channels: saturated, dead, stuck, odd.

* saturated: every sample of 0.2 s at an end of the converter's range. Strong presses do that.
* dead: no valid word in most frames of a second; or at an end of the range for a second while the
  other channels show that nothing touches the sensor.
* stuck: an electrode without any change for three seconds while the others vary; PAC without any
  change for a second (it always has noise); or every channel at once: then the line repeats old
  words. An electrode stays stuck until it changes.
* odd: at rest, levels that an intact sensor does not have (hardware reference 1.9): one or two
  electrodes far below the others mean an air bubble, all of them low a thin layer of fluid.

None of the real recordings raises a false alarm: docs/tare-and-health.md.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Iterable, Sequence

import numpy as np
import numpy.typing as npt

from palpate.messages import COUNTS_MAX, ChannelFault, FaultKind
from palpate_gateway.condition.stillness import FrameBlock

SATURATED_BLOCKS = 1
WINDOW_BLOCKS = 5
"""A second."""

STUCK_BLOCKS = 15
"""Three seconds. In a minute and a half of real recordings, electrodes of a quiet sensor keep their
value for up to 0.6 s; durations longer by 0.07 s are e times as rare."""

INVALID_SHARE = 0.5
OTHERS_VARY_COUNTS = 6
"""The others vary if half of them change by this much within a block [counts]: a noisy sensor does
so at rest, a quiet one when it is touched."""

FAR_COUNTS = 1500.0
"""Intact electrodes are up to 930 counts below the median of all at rest (E11 of one sensor)."""

THIN_COUNTS = 1800.0
"""A median below this is above 12.7 kOhm; intact sensors have 2 to 4 kOhm."""

REMEDIES = {
    FaultKind.SATURATED: "press less hard; if nothing touches the sensor, check the electrode",
    FaultKind.DEAD: "check plug and cable of this finger; see its parity_errors counters",
    FaultKind.STUCK: "power the sensor off and on; if it stays, its converter or its line repeats",
    FaultKind.ODD: "far below the others: an air bubble, all low: too little fluid; refill the "
    "finger and tare again",
}
"""Remedy for each kind of fault."""

_SLOW = ("PDC", "TAC", "TDC")
_GAUGES = {kind: f"{kind.name.lower()}_channels" for kind in REMEDIES}
_Flags = npt.NDArray[np.bool_]


class ChannelHealth:
    """Finds the faulty channels of one sensor.

    Args:
        electrodes: Their number.
        unfilled: Channels other than electrodes that are never valid, which is no fault.
    """

    def __init__(self, electrodes: int, unfilled: Collection[str] = ()) -> None:
        self._electrodes, self._unfilled = electrodes, frozenset(unfilled)
        self._stuck: dict[int, int] = {}  # electrode, from 0, to the value that it keeps
        self._names: dict[FaultKind, tuple[str, ...]] = {}
        self.usable: _Flags = np.ones(electrodes, np.bool_)
        """Electrodes without a fault, bool, shape ``(E,)``."""
        self.counters: Counter[str] = Counter({_counter(kind): 0 for kind in REMEDIES})
        """How often channels became saturated, dead, stuck or odd."""
        self.begin()

    @property
    def faults(self) -> tuple[ChannelFault, ...]:
        """Present faults."""
        return tuple(ChannelFault(kind, names) for kind, names in self._names.items())

    def gauges(self) -> dict[str, float]:
        """Number of channels that have each fault at present."""
        return {name: float(len(self._names.get(kind, ()))) for kind, name in _GAUGES.items()}

    def begin(self) -> None:
        """The device was opened again: judge by the frames from now on."""
        # Numbers of blocks in a row: at an end of the range; without any change; the same for PAC.
        self._at_rail = np.zeros(self._electrodes, np.int64)
        self._standing = np.zeros(self._electrodes, np.int64)
        self._pac_standing = 0
        self._last: FrameBlock | None = None
        self._recent: deque[FrameBlock] = deque(maxlen=WINDOW_BLOCKS)
        self._varied: deque[bool] = deque(maxlen=STUCK_BLOCKS)

    def add(self, block: FrameBlock, *, untouched: bool) -> None:
        """Take a block.

        Args:
            block: The newest.
            untouched: The levels of usable electrodes and PDC show that nothing touches the sensor.
        """
        self._follow(block)
        names: dict[FaultKind, list[str]] = {}
        saturated = self._at_rail >= SATURATED_BLOCKS
        dead = self._dead(names, untouched=untouched)
        stuck = self._find_stuck(block) & ~dead
        saturated &= ~dead
        self.usable = ~(saturated | dead | stuck)
        for kind, flags in (
            (FaultKind.SATURATED, saturated),
            (FaultKind.DEAD, dead),
            (FaultKind.STUCK, stuck),
        ):
            if flags.any():
                names[kind] = _electrode_names(flags) + names.get(kind, [])
        self._judge_pac(block, names)
        if untouched and self.usable.any():
            odd = _odd(block, self.usable)
            if odd:
                names[FaultKind.ODD] = odd
        self._note({kind: tuple(found) for kind, found in names.items()})

    def _follow(self, block: FrameBlock) -> None:
        last, self._last = self._last, block
        self._recent.append(block)
        at_end = ((block.high == 0) | (block.low == COUNTS_MAX)) & (block.seen > 0)
        self._at_rail = (self._at_rail + 1) * at_end
        stands = block.low == block.high
        pac_stands = block.pac_low == block.pac_high
        if last is not None:
            stands &= block.low == last.low
            pac_stands &= block.pac_low == last.pac_low
        self._standing = (self._standing + 1) * stands
        self._pac_standing = (self._pac_standing + 1) * pac_stands
        spread = sorted((block.high - block.low).tolist())
        self._varied.append(spread[len(spread) // 2] >= OTHERS_VARY_COUNTS)

    def _dead(self, names: dict[FaultKind, list[str]], *, untouched: bool) -> _Flags:
        dead: _Flags = np.zeros(self._electrodes, np.bool_)
        if untouched:
            dead = self._at_rail >= WINDOW_BLOCKS
        if len(self._recent) < WINDOW_BLOCKS:
            return dead
        few = INVALID_SHARE * self._recent[-1].frames * WINDOW_BLOCKS
        # In most blocks every word is valid, which the minimum shows at once.
        if min(int(block.seen.min()) for block in self._recent) < self._recent[-1].frames:
            dead = dead | (np.add.reduce([block.seen for block in self._recent]) < few)
        slow = [sum(seen) for seen in zip(*(b.slow_seen for b in self._recent), strict=True)]
        silent = [name for name, seen in zip(_SLOW, slow, strict=True) if seen < few]
        silent = [name for name in silent if name not in self._unfilled]
        if silent:
            names[FaultKind.DEAD] = silent
        return dead

    def _find_stuck(self, block: FrameBlock) -> _Flags:
        stuck: _Flags = np.zeros(self._electrodes, np.bool_)
        if self._stuck:
            same = block.low == block.high
            self._stuck = {
                at: v for at, v in self._stuck.items() if same[at] and block.low[at] == v
            }
        found = self._standing >= STUCK_BLOCKS
        if found.any() and any(self._varied):
            at_end = (block.low == 0) | (block.low == COUNTS_MAX)
            found &= ~at_end & (block.seen > 0)
        else:
            repeats = min(int(self._standing.min()), self._pac_standing) >= WINDOW_BLOCKS
            found = np.full(self._electrodes, repeats)
        if found.any():
            self._stuck |= {int(at): int(block.low[at]) for at in np.flatnonzero(found)}
        stuck[list(self._stuck)] = True
        return stuck

    def _judge_pac(self, block: FrameBlock, names: dict[FaultKind, list[str]]) -> None:
        kind = None
        if block.pac_seen and block.pac_low == block.pac_high and block.pac_low in (0, COUNTS_MAX):
            kind = FaultKind.SATURATED
        elif len(self._recent) == WINDOW_BLOCKS:
            if not any(one.pac_seen for one in self._recent):
                kind = None if "PAC" in self._unfilled else FaultKind.DEAD
            elif self._pac_standing >= WINDOW_BLOCKS and all(b.pac_seen for b in self._recent):
                kind = FaultKind.STUCK
        if kind is not None:
            names.setdefault(kind, []).append("PAC")

    def _note(self, found: dict[FaultKind, tuple[str, ...]]) -> None:
        for kind, channels in found.items():
            new = len(set(channels) - set(self._names.get(kind, ())))
            self.counters[_counter(kind)] += new
        self._names = found


def describe(faults: Iterable[ChannelFault]) -> str:
    """Faults in words, e.g. ``E7 stuck; E3, E9 saturated``; a long list is cut."""
    return "; ".join(f"{_listed(fault.channels)} {fault.kind.name.lower()}" for fault in faults)


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - 4} more" if len(names) > 4 else ""
    return ", ".join(names[:4]) + more


def _counter(kind: FaultKind) -> str:
    return f"channels_{kind.name.lower()}"


def _electrode_names(flags: _Flags) -> list[str]:
    return [f"E{at + 1}" for at in np.flatnonzero(flags)]


def _odd(block: FrameBlock, usable: _Flags) -> list[str]:
    levels = sorted(block.mean[usable].tolist())
    median = levels[len(levels) // 2]
    if median < THIN_COUNTS:
        return _electrode_names(usable)
    if max(median - levels[0], levels[-1] - median) <= FAR_COUNTS:
        return []
    return _electrode_names(usable & (np.abs(block.mean - median) > FAR_COUNTS))
