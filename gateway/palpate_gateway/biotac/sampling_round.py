"""The order in which a frame's channels are sampled, and the number of each PAC sample in it.

PAC samples look alike, so their number follows from the place of the slot: from its position if the
source sends it, or else from the channels beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from palpate.messages import FrameLayout
from palpate_gateway.biotac.slots import SlotBlock
from palpate_gateway.protocols import channels as ch

NOT_PAC = -1
SURPLUS = -2
"""Number of a PAC sample that came twice: its neighbours leave no room for it."""
UNPLACED = -3
"""Number of a PAC sample that may be one of several."""

_FAR = 1e6
"""More slots than any frame has."""

Ints = npt.NDArray[np.int64]


class SamplingRound:
    """One order of sampling.

    Args:
        layout: What a frame holds.
        channels: Channel ids in order of sampling, for which ``is_whole`` holds.
    """

    def __init__(self, layout: FrameLayout, channels: Sequence[int]) -> None:
        self.channels: Ints = np.array(channels, np.int64)
        self.channel_bytes = self.channels.tobytes()
        self.ending = tuple(channels[-2:])
        is_pac = self.channels == ch.PAC
        self.pac_numbers: Ints = np.where(is_pac, np.cumsum(is_pac) - 1, NOT_PAC)
        """Number of the PAC sample of each place."""
        self._places = {c: p for p, c in enumerate(channels) if c != ch.PAC}
        own = [self._places[channel] for channel in ch.channels_of(layout)]
        self.places: Ints = np.array([*own, *np.flatnonzero(is_pac)], np.int64)
        """Place of the slot that belongs to each validity bit."""
        # Number of PAC samples before each place, and in all.
        self._before = [0, *np.cumsum(is_pac).tolist()]

    def agrees(self, channels: Ints, positions: Ints) -> bool:
        """Whether slots at these positions are in their places."""
        if positions.max() >= len(self.channels):
            return False
        return bool((self.channels[positions] == channels).all())

    def numbers(
        self, channels: Sequence[int], times_s: Sequence[float] | None, slot_period_s: float
    ) -> list[int]:
        """Number of the PAC sample in each slot of a frame whose positions are not known.

        Between two other channels there are so many PAC slots. If fewer samples came, their times
        show which, provided that the times of the other channels are on the grid of slots.

        Args:
            channels: Channel ids in order of time; slots may be lost or have come twice.
            times_s: Their times [s]; None = unknown.
            slot_period_s: Time between two slots [s].
        """
        anchors = [(-1, -1)]  # slot and place
        for slot, channel in enumerate(channels):
            place = self._places.get(channel, -1)
            if place > anchors[-1][1]:
                anchors.append((slot, place))
        by_time = _places_by_time(anchors[1:], times_s, slot_period_s)
        anchors.append((len(channels), len(self.channels)))
        numbers = [NOT_PAC] * len(channels)
        for (slot, place), (next_slot, next_place) in pairwise(anchors):
            pac = [k for k in range(slot + 1, next_slot) if channels[k] == ch.PAC]
            room = range(self._before[place + 1], self._before[next_place])
            for at, k in enumerate(pac):
                if len(pac) >= len(room):
                    numbers[k] = room[at] if at < len(room) else SURPLUS
                    continue
                found = by_time[k] if by_time else -1
                is_there = place < found < next_place and self.channels[found] == ch.PAC
                numbers[k] = int(self.pac_numbers[found]) if is_there else UNPLACED
        return numbers


def _places_by_time(
    anchors: Sequence[tuple[int, int]], times_s: Sequence[float] | None, slot_period_s: float
) -> list[int]:
    """Place of each slot by its time, on the grid of the anchors; empty if they form no grid.

    Anchors are slots with a known place, and their places; the times are those of all slots.
    """
    if times_s is None or not anchors:
        return []
    origins_s = [times_s[slot] - place * slot_period_s for slot, place in anchors]
    if max(origins_s) - min(origins_s) > slot_period_s / 2:
        return []
    steps = [(time_s - origins_s[0]) / slot_period_s for time_s in times_s]
    return [round(step) if abs(step) < _FAR else -1 for step in steps]


class PacNumbers:
    """Numbers PAC samples by the order of sampling, which it learns from whole frames.

    With ``timed`` the slots have times of the device's clock.
    """

    def __init__(self, layout: FrameLayout, slot_period_s: float, *, timed: bool) -> None:
        self._layout, self._slot_period_s, self._timed = layout, slot_period_s, timed
        self._usual = {
            # Keys: whether a frame begins, and whether it ends with PAC.
            (first, not first): SamplingRound(layout, ch.interleaved(layout, pac_first=first))
            for first in (False, True)
        }
        self.round: SamplingRound | None = None
        """The order of the last whole frame; None before the first."""

    def of(self, slots: SlotBlock, starts: Ints) -> Ints:
        """Number of the PAC sample in each slot of the frames that start at ``starts``.

        Of other slots ``NOT_PAC``.
        """
        ends = [*starts[1:].tolist(), len(slots)]
        frames = [slots.part(start, stop) for start, stop in zip(starts, ends, strict=True)]
        if self.round is None:
            # Frames that lost slots may come before the first whole one.
            for frame in frames:
                if self._of_whole(frame) is not None:
                    break
        return np.concatenate([self._of_frame(frame) for frame in frames])

    def _of_frame(self, frame: SlotBlock) -> Ints:
        numbers = self._of_whole(frame)
        if numbers is not None:
            return numbers
        channels = frame.channel.tolist()
        if (frame.position < 0).any():
            if channels.count(ch.PAC) == self._layout.pac_samples:
                is_pac = frame.channel == ch.PAC
                return np.where(is_pac, np.cumsum(is_pac) - 1, NOT_PAC)
            ends = channels[0] == ch.PAC, channels[-1] == ch.PAC
            usual = self.round or self._usual.get(ends)
            if usual is None:
                return np.where(frame.channel == ch.PAC, UNPLACED, NOT_PAC)
            times_s = frame.time_s.tolist() if self._timed else None
            return np.array(usual.numbers(channels, times_s, self._slot_period_s), np.int64)
        if self.round is not None and self.round.agrees(frame.channel, frame.position):
            return self.round.pac_numbers[frame.position]
        # In both usual orders each second slot is PAC.
        half = frame.position // 2
        numbers = np.where(half < self._layout.pac_samples, half, UNPLACED)
        return np.where(frame.channel == ch.PAC, numbers, NOT_PAC)

    def _of_whole(self, frame: SlotBlock) -> Ints | None:
        """Learn the order from a whole frame; None of another."""
        if len(frame) < self._layout.slots:
            return None
        known = bool((frame.position >= 0).all())
        in_order = np.argsort(frame.position, kind="stable") if known else np.arange(len(frame))
        if known and not np.diff(frame.position[in_order]).all():
            return None  # a position came twice, so another may be missing
        channels = frame.channel[in_order]
        if self.round is None or channels.tobytes() != self.round.channel_bytes:
            if not is_whole(channels.tolist(), self._layout):
                return None
            self.round = SamplingRound(self._layout, channels.tolist())
        numbers = np.empty(len(frame), np.int64)
        numbers[in_order] = self.round.pac_numbers
        return numbers


def is_whole(channels: Sequence[int], layout: FrameLayout) -> bool:
    """Whether these slots hold each channel of a frame once, and perhaps unused channels."""
    return channels.count(ch.PAC) == layout.pac_samples and all(
        channels.count(channel) == 1 for channel in ch.channels_of(layout)
    )


def holds_frame(channels: Sequence[int], layout: FrameLayout) -> bool:
    """Whether these slots hold each channel of a frame; some may have come twice."""
    wanted = {*ch.channels_of(layout)}
    return channels.count(ch.PAC) >= layout.pac_samples and wanted <= {*channels}
