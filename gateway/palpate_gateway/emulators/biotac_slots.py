"""Sampling commands of a BioTac's host, and the BioTac's answers (hardware reference 1.3 to 1.7).

Written from the tables of the page: 80 is PAC, 83 PDC, 85 TAC, 86 TDC, A2 to C7 are E1 to E19, C8
to D0 are E20 to E24 of the BioTac SP. A word is data[11:5] and parity, data[4:0], two zeros and
parity; every byte has an odd number of ones.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence

import numpy as np
import numpy.typing as npt

from palpate_gateway.emulators.emulator import HostTimed, slow_press

ELECTRODE_COMMANDS = bytes.fromhex("A2A4A7A8ABADAEB0B3B5B6B9BABCBFC1C2C4C7 C8CBCDCED0")
"""Sampling commands of E1..E24."""

SLOW_COMMANDS = bytes.fromhex("838586")
"""Sampling commands of PDC, TAC, TDC, in the order of a round."""

PAC_COMMAND = 0x80

ELECTRODES = 19
ELECTRODES_SP = 24
"""Electrodes of the BioTac SP, whose rounds have 54 slots."""

CHANNELS = ELECTRODES + 4
"""Number of counts of a source: E1..E19, PDC, TAC, TDC, PAC."""

WORD_FAULTS = ("parity", "absent", "error_word", "saturated", "stuck")
"""Faults of the words of fingers: see ``SlotBlocks.with_faults``."""

CountSource = Callable[[float, int], Sequence[int]]
"""Gives E1..E19, PDC, TAC, TDC and PAC (23 counts) at a time [s] of a finger (from 0)."""

Times = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Counts = npt.NDArray[np.int64]

_SP_REPEATS = (16, 6, 7, 8, 9)
_SP_MORE = 40
_PRESSED = (-300, -500, -700)


class CountTrack(HostTimed, ABC):
    """A source that gives the counts of many slots at once; it is a ``CountSource``, too."""

    def __call__(self, t: float, finger: int) -> Sequence[int]:
        """All 23 counts at a time."""
        every = np.arange(CHANNELS)
        counts: list[int] = self.slots(np.full(CHANNELS, t), every, finger).tolist()
        return counts

    @abstractmethod
    def slots(self, times_s: Times, places: Indices, finger: int) -> Counts:
        """The count of one channel at each time; ``places`` are indices into the 23 counts."""


def idle_counts(t: float, finger: int) -> Sequence[int]:
    """An untouched finger: a different count for each channel, and a PAC that changes."""
    pac = 2040 + round(t * 4400.0) % 5
    return [*(2000 + 50 * k + finger for k in range(19)), 2600 + finger, 2045, 1914, pac]


def press_counts(t: float, finger: int) -> Sequence[int]:
    """The idle finger under the load of ``slow_press``: electrodes fall, PDC rises."""
    share = slow_press(t)[2] / 4.0
    counts = list(idle_counts(t, finger))
    for k in range(ELECTRODES):
        counts[k] += round(_PRESSED[k % 3] * share)
    counts[ELECTRODES] += round(900 * share)
    return counts


def round_of(electrodes: int = ELECTRODES, *, pac_first: bool = False) -> list[tuple[int, int]]:
    """Command and place (index of the count) of each slot of a round.

    E20..E24 of a BioTac SP, which sources do not give, have the places from ``CHANNELS`` on.
    """
    if electrodes not in (ELECTRODES, ELECTRODES_SP):
        raise ValueError(f"electrodes {electrodes} is neither {ELECTRODES} nor {ELECTRODES_SP}")
    more = range(CHANNELS, CHANNELS + electrodes - ELECTRODES)
    slow = range(ELECTRODES, ELECTRODES + len(SLOW_COMMANDS))
    commands = ELECTRODE_COMMANDS[:electrodes] + SLOW_COMMANDS
    order = []
    for command, place in zip(commands, [*range(ELECTRODES), *more, *slow], strict=True):
        pair = [(command, place), (PAC_COMMAND, CHANNELS - 1)]
        order += pair[::-1] if pac_first else pair
    return order


def count_at(counts: Sequence[int], place: int) -> int:
    """The count of a place; E20..E24 are those of the nearby E17, E7..E10 plus 40 counts."""
    if place < CHANNELS:
        return counts[place]
    return min(counts[_SP_REPEATS[place - CHANNELS]] + _SP_MORE, 4095)


def counts_at(source: CountSource, times_s: Times, places: Indices, finger: int) -> Counts:
    """The count of one place at each time [s], shapes (N,); E20..E24 have their places, too."""
    if not isinstance(source, CountTrack):
        slots = zip(times_s.tolist(), places.tolist(), strict=True)
        return np.array([count_at(source(t, finger), place) for t, place in slots], np.int64)
    # E20..E24 of a BioTac SP are made of nearby electrodes, as in ``count_at``.
    known = places < CHANNELS
    repeated = np.array(_SP_REPEATS)[np.where(known, 0, places - CHANNELS)]
    counts = source.slots(times_s, np.where(known, places, repeated), finger)
    return np.minimum(counts + np.where(known, 0, _SP_MORE), 4095)


def word(value: int) -> bytes:
    """The two bytes of a count."""
    return bytes([_odd((value >> 5) << 1), _odd((value & 0x1F) << 3)])


def _odd(upper: int) -> int:
    """A byte with an odd number of ones; the lowest bit is the parity."""
    return upper | (upper.bit_count() + 1) % 2


_WORDS = np.array([list(word(value)) for value in range(4096)], np.uint8)


class SlotBlocks:
    """Payloads of many slots at once: at 4400 slots per second there is little time for each.

    Args:
        source: Counts of the fingers.
        fingers: Words of each slot.
        order: Command and place of each slot of a round.
    """

    def __init__(self, source: CountSource, fingers: int, order: Sequence[tuple[int, int]]) -> None:
        self._source, self._fingers, self._length = source, fingers, len(order)
        self._commands = np.array([command for command, _ in order], np.uint8)
        self._places = np.array([place for _, place in order], np.int64)
        self._order = list(order)
        self._stuck_s: float | None = None

    def block(self, slot: int, count: int, time_s: float, step_s: float) -> list[bytes]:
        """Payloads (command and words) of slots, the first at ``time_s``, ``step_s`` apart."""
        where = np.arange(slot, slot + count) % self._length
        times_s: Times = time_s + step_s * np.arange(count, dtype=np.float64)
        places = self._places[where]
        width = 1 + 2 * self._fingers
        out = np.empty((count, width), np.uint8)
        out[:, 0] = self._commands[where]
        for finger in range(self._fingers):
            counts = counts_at(self._source, times_s, places, finger)
            out[:, 1 + 2 * finger : 3 + 2 * finger] = _WORDS[counts]
        data = out.tobytes()
        return [data[at : at + width] for at in range(0, len(data), width)]

    def with_faults(self, slot: int, time_s: float, faults: Collection[str]) -> bytes:
        """Payload of one slot with some of ``WORD_FAULTS``.

        ``stuck``: all fingers repeat the counts from its begin; ``saturated``: all answer 4095;
        ``parity``: one bit of the first finger's word is wrong; ``error_word``: the first finger
        reports too little sampling delay; ``absent``: the last finger does not answer.
        """
        if "stuck" not in faults:
            self._stuck_s = None
        elif self._stuck_s is None:
            self._stuck_s = time_s
        at_s = time_s if self._stuck_s is None else self._stuck_s
        command, place = self._order[slot % self._length]
        out = bytearray([command])
        for finger in range(self._fingers):
            value = 4095 if "saturated" in faults else count_at(self._source(at_s, finger), place)
            first, second = word(value)
            if finger == 0 and "parity" in faults:
                first ^= 0x10
            if finger == 0 and "error_word" in faults:
                first, second = 0xA5, 0x2D
            if finger == self._fingers - 1 and "absent" in faults:
                first = second = 0
            out += bytes([first, second])
        return bytes(out)
