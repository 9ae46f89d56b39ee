"""Frame, position and time of slots that carry no number.

They follow from the order of the channels and from the stamps: each channel but PAC occurs once in
a frame, and a PAC sample is identified by its neighbours. A frame ends where the cycle of channels
begins again (hardware reference 2.1).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate_gateway.protocols import channels as ch
from palpate_gateway.protocols.silences import Floats, Silences

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class SlotPlace:
    """Place of one slot in its stream.

    Attributes:
        run: Number of the connection, or of the change of the sequence, from 0.
        frame: Frame number from 0, lost frames counted.
        position: Place in the sequence.
        time_s: When it was sampled [s], by the clock of the stamps: on the grid of slots, which
            starts again where frames were lost; the stamp itself if stamps are exact.
    """

    run: int
    frame: int
    position: int
    time_s: float


@dataclass(frozen=True, slots=True)
class SlotPlaces:
    """Places of many slots; see ``SlotPlace``.

    Attributes:
        kept: Which of the slots have a place, int64, shape ``(N,)``.
        run: int64, shape ``(N,)``, as are frame and position.
        frame: Frame numbers.
        position: Places in the sequence.
        time_s: When they were sampled [s], float64, shape ``(N,)``.
    """

    kept: Ints
    run: Ints
    frame: Ints
    position: Ints
    time_s: Floats

    def __len__(self) -> int:
        return len(self.kept)


LEARNT_FROM = 128
"""Slots in a row that must repeat before their order is accepted: two cycles of up to 64."""

_SCATTER_S = 2e-3
"""No stamp is too early by more than this [s]."""


class SlotOrder:
    """A cycle of channels, and the number of steps from slot to slot in it.

    Args:
        channels: Channel indices in order of sampling; at least one occurs exactly once.
    """

    def __init__(self, channels: Sequence[int]) -> None:
        self.channels = tuple(channels)
        self.size = size = len(self.channels)
        """Slots of a cycle."""
        self.anchors = {c: p for p, c in enumerate(channels) if self.channels.count(c) == 1}
        """Position of each channel that occurs once, so that it identifies its position."""
        if not self.anchors:
            raise ValueError("no channel of the sequence occurs exactly once")
        self.cycle = np.array(self.channels, np.int64)
        """The channels as an array."""
        self.is_anchor = np.array([c in self.anchors for c in self.channels])
        """Whether the channel of each position identifies it, bool."""
        # From the last position back, so that the nearest place of a channel stays.
        self._steps = [
            {self.channels[(p + steps) % size]: steps for steps in range(size, 0, -1)}
            for p in range(size)
        ]

    def steps(self, position: int, channel: int) -> int:
        """Slots from a position forward to the next one of a channel of the sequence."""
        return self._steps[position][channel]

    def steps_near(self, position: int, channel: int, expected: float) -> int:
        """Slots forward to a channel of the sequence, as near as possible to an expected number."""
        least, size = self.steps(position, channel), self.size
        if abs(least - expected) < 1:
            return least
        places = [p for p, one in enumerate(self.channels) if one == channel]
        least_of = [(place - position - 1) % size + 1 for place in places]
        steps = [one + size * max(round((expected - one) / size), 0) for one in least_of]
        return min(steps, key=lambda one: abs(one - expected))


def learn_order(seen: Sequence[int]) -> SlotOrder | None:
    """The shortest cycle that these channels repeat, started at E1; None if they repeat none.

    Args:
        seen: Channel indices of consecutive slots; cycles up to half as long are found.
    """
    for size in range(1, len(seen) // 2 + 1):
        if all(a == b for a, b in zip(seen, seen[size:], strict=False)):
            cycle = tuple(seen[:size])
            once = [c for c in cycle if cycle.count(c) == 1]
            if not once:
                return None
            start = cycle.index(min(once, key=lambda c: (c < ch.FIRST_ELECTRODE, c == ch.PAC, c)))
            return SlotOrder(cycle[start:] + cycle[:start])
    return None


class SlotClock:
    """Gives slots without numbers their frame, position and time.

    The position follows from the order of the channels; PAC is taken for the next PAC slot until a
    channel that occurs once corrects that. How many whole frames were lost follows from the stamps,
    see ``Silences``; that can take four frames to decide, whose times are then too early.

    Slots before the first whole frame, and before the sequence is known, get no place.
    ``counters["lost_frames"]`` counts whole cycles, ``counters["lost_slots"]`` single slots.

    Args:
        slot_rate_hz: Slots per second of the sender's clock; if it is wrong by many percent, a
            silence is misjudged.
        sequence: Channels of a frame in order; None learns them from the stream, E1 first.
        exact: The stamps are the sender's own times of sampling, so that each loss shows at once.
    """

    def __init__(
        self,
        *,
        slot_rate_hz: float = ch.SLOT_RATE_HZ,
        sequence: Sequence[int] | None = None,
        exact: bool = False,
    ) -> None:
        if not (math.isfinite(slot_rate_hz) and slot_rate_hz > 0):
            raise ValueError(f"slot rate {slot_rate_hz} Hz is not positive")
        self._period_s = 1.0 / slot_rate_hz
        self._exact = exact
        self._learns = sequence is None
        self._order = None if sequence is None else SlotOrder(sequence)
        self._seen: deque[int] = deque(maxlen=LEARNT_FROM)
        self._doubt = self._learns
        self._run = -1
        self._base = 0  # number of the first frame of this run
        self._resume_s: float | None = None  # end of the last frame of the previous run
        self._silences: Silences | None = None  # None between two runs
        self._origin_s = 0.0  # time of index 0, the first slot of the first frame
        self._index = 0  # of the last slot, lost slots counted
        self._last_s = 0.0
        self._sure = (0, 0.0)  # index and stamp of the last slot whose channel occurs once
        self._since = 0  # slots after it
        self._frame = 0  # of the last slot that was placed, in this run
        self.counters: dict[str, int] = dict.fromkeys(
            ("placed", "unplaced", "foreign", "late", "lost_slots", "lost_frames"), 0
        )

    @property
    def sequence(self) -> tuple[int, ...]:
        """Channels of a frame in order; empty while they are being learnt."""
        return () if self._order is None else self._order.channels

    def place(self, channel: int, stamp_s: float) -> SlotPlace | None:
        """Place the next slot; None if it gets no place.

        Args:
            channel: Its channel index.
            stamp_s: When it came [s], by a clock without steps.
        """
        self._learn(channel)
        order = self._order
        if order is None:
            self.counters["unplaced"] += 1
            return None
        if channel not in order.channels:
            self.counters["foreign"] += 1
            self._begin_doubt()
            return None
        if self._silences is None:
            if channel in order.anchors:
                self._begin(order, order.anchors[channel], stamp_s)
        elif not self._advance(order, self._silences, channel, stamp_s):
            self.counters["late"] += 1
            return None
        if self._silences is None or self._index < 0:
            self.counters["unplaced"] += 1
            return None
        frame, position = divmod(self._index, order.size)
        if frame < self._frame:  # PAC had run ahead into the next frame
            self.counters["late"] += 1
            return None
        self._frame = frame
        self.counters["placed"] += 1
        time_s = stamp_s if self._exact else self._time_s(self._index)
        return SlotPlace(self._run, self._base + frame, position, time_s)

    def place_all(self, channels: Ints, stamps_s: Floats) -> SlotPlaces:
        """Place many slots, without those that get no place; the same result as ``place``, faster.

        Both arrays have shape ``(N,)``.
        """
        if len(channels) and (steady := self._steady(channels, stamps_s)) is not None:
            return steady
        stamped = zip(channels.tolist(), stamps_s.tolist(), strict=True)
        places = [self.place(*slot) for slot in stamped]
        kept = [number for number, place in enumerate(places) if place is not None]
        placed = [(p.run, p.frame, p.position) for p in places if p is not None]
        run, frame, position = np.array(placed, np.int64).reshape(-1, 3).T
        times = np.array([p.time_s for p in places if p is not None], np.float64)
        return SlotPlaces(np.array(kept, np.int64), run, frame, position, times)

    def _steady(self, channels: Ints, stamps_s: Floats) -> SlotPlaces | None:
        """Places of slots that are just the next ones, in order and in time; None if they are not.

        One by one a slot costs 10 us; a hand brings 8800 a second.
        """
        order, silences = self._order, self._silences
        if order is None or silences is None or self._doubt or self._index < 0:
            return None
        if self._index != self._sure[0] + self._since:  # PAC has run ahead
            return None
        size, number = order.size, len(channels)
        if (self._index + 1) // size < self._frame:  # and had run ahead over the edge
            return None
        index = np.arange(self._index + 1, self._index + 1 + number)
        position = index % size
        if not np.array_equal(channels, order.cycle[position]):
            return None
        times_s: Floats
        if self._exact:
            expected_s = self._last_s + (index - self._index) * self._period_s
            if np.abs(stamps_s - expected_s).max() > 0.25 * self._period_s:
                return None
            times_s = stamps_s
        else:
            times_s = self._origin_s + index.astype(np.float64) * self._period_s
            if not silences.pass_over(stamps_s, stamps_s - times_s):
                return None
        if self._learns:
            self._seen.extend(channels.tolist())
        self._index = int(index[-1])
        self._last_s = float(stamps_s[-1])
        sure = np.flatnonzero(order.is_anchor[position])
        if len(sure):
            last = int(sure[-1])
            self._sure = (int(index[last]), float(stamps_s[last]))
            self._since = number - 1 - last
        else:
            self._since += number
        frame = index // size
        self._frame = int(frame[-1])
        self.counters["placed"] += number
        run = np.full(number, self._run)
        return SlotPlaces(np.arange(number), run, self._base + frame, position, times_s)

    def _time_s(self, index: int) -> float:
        return self._origin_s + index * self._period_s

    def _learn(self, channel: int) -> None:
        self._seen.append(channel)
        if not self._doubt or len(self._seen) < LEARNT_FROM:
            return
        order = learn_order(tuple(self._seen))
        if order is None:
            # Comparing again at each further slot would cost too much time.
            for _ in range(LEARNT_FROM // 2):
                self._seen.popleft()
            return
        self._doubt = False
        if self._order is None or order.channels != self._order.channels:
            self._end_run()
            self._order = order

    def _begin_doubt(self) -> None:
        """The order may have changed: the next 128 slots decide."""
        if self._learns and not self._doubt:
            self._doubt = True
            self._seen.clear()

    def _begin(self, order: SlotOrder, position: int, stamp_s: float) -> None:
        frame_s = order.size * self._period_s
        # The rest of the frame that has begun lies before index 0 and gets no place.
        self._index = position - order.size if position else 0
        self._origin_s = stamp_s - self._index * self._period_s
        self._sure = (self._index, stamp_s)
        self._last_s = stamp_s
        self._since = 0
        self._frame = 0
        self._silences = Silences(frame_s, stamp_s)
        self._run += 1
        if self._resume_s is not None:
            missed = math.floor((self._origin_s - self._resume_s) / frame_s + 0.5)
            self.counters["lost_frames"] += max(missed, 0)
            self._base += max(missed, 0)

    def _end_run(self) -> None:
        if self._order is not None and self._silences is not None and self._index >= 0:
            # PAC may have run ahead into the next frame, whose slots are placed then.
            frames = max(self._index // self._order.size, self._frame) + 1
            self._base += frames
            rest = frames * self._order.size - self._index
            begun_s = self._last_s if self._exact else self._time_s(self._index)
            self._resume_s = begun_s + rest * self._period_s
        self._silences = None

    def _advance(self, order: SlotOrder, silences: Silences, channel: int, stamp_s: float) -> bool:
        """Advance to the next slot; False if it belongs to the past."""
        anchored = channel in order.anchors
        target = self._target(order, channel, stamp_s)
        if not self._exact and self._is_early(order, silences, target, stamp_s):
            return False
        missing = 0
        if anchored:
            # Only here is the position certain: slots counted since the last anchor are those that
            # came, so the rest of the way between both anchors was lost.
            missing = max(target - self._sure[0] - 1 - self._since, 0)
            self._sure = (target, stamp_s)
            self._since = 0
        else:
            self._since += 1
        before, self._index, self._last_s = self._index, target, stamp_s
        # Exact stamps show whole lost frames too. The order of channels shows only what is lost
        # besides whole cycles; those are found by ``Silences``.
        frames, slots = divmod(missing, order.size) if self._exact else (0, missing)
        if not self._exact:
            certain = target == self._sure[0] + self._since
            frames, shift_s = silences.judge(
                stamp_s,
                stamp_s - self._time_s(target),
                broken=slots > 0,
                edge=certain and target // order.size > before // order.size,
            )
            self._origin_s += shift_s
            self._index += frames * order.size
            self._sure = (self._sure[0] + frames * order.size, self._sure[1])
        self.counters["lost_frames"] += frames
        self.counters["lost_slots"] += slots
        if slots > 0:
            self._begin_doubt()
        return True

    def _target(self, order: SlotOrder, channel: int, stamp_s: float) -> int:
        """Index that the slot seems to have."""
        size = order.size
        anchored = channel in order.anchors
        index, last_s = self._sure if anchored else (self._index, self._last_s)
        if self._exact:
            expected = (stamp_s - last_s) / self._period_s
            return index + order.steps_near(index % size, channel, expected)
        # Without exact stamps the shortest way is taken; whole cycles are found by ``Silences``.
        target = index + order.steps(index % size, channel)
        ahead = self._index - target
        # PAC may have run ahead, by a repetition or else by more than half a frame.
        return target + (ahead + size // 2) // size * size if ahead >= 0 else target

    def _is_early(self, order: SlotOrder, silences: Silences, target: int, stamp_s: float) -> bool:
        """Whether a slot comes too early for a place far ahead, so that it belongs to the past."""
        if 2 * (target - self._index) <= max(order.size, 2):
            return False
        leeway_s = max(order.size * self._period_s / 2, _SCATTER_S)
        return stamp_s - self._time_s(target) < silences.usual_s - leeway_s
