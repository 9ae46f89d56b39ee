"""Slots to readings: decoded by channel id, with every loss counted."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from palpate.messages import BIOTAC_LAYOUT, COUNTS_MAX, CountArray, FrameLayout
from palpate_gateway.biotac.sampling_round import SURPLUS, UNPLACED, PacNumbers, holds_frame
from palpate_gateway.biotac.slots import NO_SLOTS, UNKNOWN, SlotBlock
from palpate_gateway.protocols import channels as ch
from palpate_gateway.readings import ElectrodeReading

TIME_JUMP_S = 1e-3
"""A slot that is later than its place on the slot grid by more is a time jump [s]."""

BELIEVABLE_LOSS = 1_000_000
"""A frame counter that jumps by more has restarted or is damaged [frames]."""

_KNOWN = np.zeros(256, np.bool_)
_KNOWN[list(ch.CHANNEL_NAMES)] = True
_COUNTERS = (
    "samples",
    "frames",
    "incomplete_frames",
    "missing_frames",
    "counter_restarts",
    "time_jumps",
    "parity_errors",
    "unknown_channels",
    "ignored_slots",
    "other_electrodes",
    "duplicate_slots",
    "unplaced_slots",
    "saturated_samples",
)


class FrameAssembler:
    """Groups slots of equal (batch, frame) into readings.

    A frame is delivered when the next one begins, or at once when it is whole. The validity bit of
    a channel that is absent or has bad parity stays clear; an absent one holds 0. A PAC sample is
    placed by its position, or else by the channels beside it, in the order of sampling of the last
    whole frame; a sample whose place is uncertain is dropped and counted.

    ``counters["other_electrodes"]`` counts answers of electrodes that the layout does not have.

    Args:
        slot_period_s: Time between two slots [s].
        layout: What a frame holds.
        timed: The slots have times of the device's clock, which show where a slot is lost; False =
            their times were made by counting.
    """

    def __init__(
        self, slot_period_s: float, layout: FrameLayout = BIOTAC_LAYOUT, *, timed: bool = True
    ) -> None:
        self._slot_period_s = slot_period_s
        self.layout = layout
        # Validity bit of each channel id; -1 = it has none.
        self._column = np.full(256, -1, np.int64)
        self._column[[*ch.channels_of(layout)]] = np.arange(layout.first_pac_bit)
        self._bits = np.uint64(1) << np.arange(layout.slots, dtype=np.uint64)
        self._positions = np.arange(layout.slots).tobytes()
        self._unknown = np.full(layout.slots, UNKNOWN).tobytes()
        self._pac_numbers = PacNumbers(layout, slot_period_s, timed=timed)
        self._pending = NO_SLOTS
        self._last_time_s: float | None = None
        self._last_key: tuple[int, int] | None = None
        self._last_ending: tuple[int, ...] | None = None
        self._tick = 0
        self.counters: dict[str, int] = dict.fromkeys(_COUNTERS, 0)
        self.parity_errors_by_channel: dict[str, int] = {}

    @property
    def pending_slots(self) -> int:
        """Slots of the frame that has begun and is not yet delivered."""
        return len(self._pending)

    @property
    def ends_inside_frame(self) -> bool:
        """Whether the frame that has begun is cut off: it does not end as the one before did.

        A frame that lost a slot inside still ends as the others do.
        """
        if not len(self._pending) or self._holds_frame(self._pending):
            return False
        return self._last_ending is None or self._last_ending != _ending(self._pending)

    def push(self, block: SlotBlock) -> list[ElectrodeReading]:
        """Take slots in order of time; return the frames that are now whole or have ended."""
        if not len(block):
            return []
        self._count(block)
        slots = SlotBlock.joined([self._pending, block]) if len(self._pending) else block
        readings: list[ElectrodeReading] = []
        at = self._take_usual(slots, readings)
        slots = self._without_late(slots.part(at, len(slots)) if at else slots)
        if not len(slots):
            self._pending = NO_SLOTS
            return readings
        starts = _frame_starts(slots)
        tail = int(starts[-1])
        if self._holds_frame(slots.part(tail, len(slots))):
            tail = len(slots)
        else:
            starts = starts[:-1]
        self._pending = slots.part(tail, len(slots))
        return readings + self._assemble(slots.part(0, tail), starts)

    def finish(self) -> list[ElectrodeReading]:
        """Deliver the frame that has begun, whole or not."""
        slots, self._pending = self._pending, NO_SLOTS
        return self._assemble(slots, _frame_starts(slots)) if len(slots) else []

    def discard_pending(self) -> int:
        """Drop the frame that has begun; return how many slots it had."""
        dropped = len(self._pending)
        self._pending = NO_SLOTS
        return dropped

    def _count(self, block: SlotBlock) -> None:
        counters = self.counters
        counters["samples"] += len(block)
        times_s = block.time_s
        most_s = self._slot_period_s + TIME_JUMP_S
        if self._last_time_s is not None:
            first_s = float(times_s[0]) - self._last_time_s
            counters["time_jumps"] += not -TIME_JUMP_S <= first_s <= most_s
        self._last_time_s = float(times_s[-1])
        steps = times_s[1:] - times_s[:-1]
        # For most blocks the extremes are enough; this runs for every block.
        if len(steps) and (steps.max() > most_s or steps.min() < -TIME_JUMP_S):
            jumps = (steps > most_s) | (steps < -TIME_JUMP_S)
            counters["time_jumps"] += int(np.count_nonzero(jumps))
        good = block.good
        if not good.all():
            bad = block.channel[~good]
            counters["parity_errors"] += len(bad)
            for channel, times_bad in zip(*np.unique(bad, return_counts=True), strict=True):
                name = ch.channel_name(int(channel))
                already = self.parity_errors_by_channel.get(name, 0)
                self.parity_errors_by_channel[name] = already + int(times_bad)
        value = block.value
        if value.min() == 0 or value.max() >= COUNTS_MAX:
            ends = good & ((value == 0) | (value == COUNTS_MAX))
            counters["saturated_samples"] += int(np.count_nonzero(ends))

    def _take_usual(self, slots: SlotBlock, readings: list[ElectrodeReading]) -> int:
        """Deliver whole frames at the start, in the order of the last one; return their slots.

        Nearly all frames of a live sensor are like that; ``_assemble`` would take far longer.
        """
        usual, size = self._pac_numbers.round, self.layout.slots
        if usual is None or len(slots) < size or len(usual.channels) != size:
            return 0
        channel, position = slots.channel.tobytes(), slots.position.tobytes()
        batches, frames = slots.batch.tobytes(), slots.frame.tobytes()
        at = 0
        for stop in range(size, len(slots) + 1, size):
            cut = slice(8 * at, 8 * stop)
            key = int(slots.batch[at]), int(slots.frame[at])
            if (
                key == self._last_key
                or channel[cut] != usual.channel_bytes
                or batches[cut] != batches[8 * at : 8 * at + 8] * size
                or frames[cut] != frames[8 * at : 8 * at + 8] * size
                or position[cut] not in (self._positions, self._unknown)
            ):
                break
            good = slots.good[at:stop]
            validity = self.layout.all_valid
            if not good.all():
                validity = int(self._bits[good[usual.places]].sum())
            missed = self._advance(*key)
            counts = slots.value[at:stop][usual.places]
            time_s = float(slots.time_s[at])
            readings.append(self._reading(counts, validity, time_s, missed))
            self._last_ending = usual.ending
            at = stop
        self.counters["frames"] += len(readings)
        return at

    def _without_late(self, slots: SlotBlock) -> SlotBlock:
        """Drop slots of a frame that has been delivered already, because it was whole."""
        if self._last_key is None or not len(slots):
            return slots
        batch, frame = self._last_key
        late = (slots.batch == batch) & (slots.frame == frame)
        first = len(slots) if late.all() else int(np.argmin(late))
        self.counters["duplicate_slots"] += first
        return slots.part(first, len(slots))

    def _assemble(self, slots: SlotBlock, starts: npt.NDArray[np.int64]) -> list[ElectrodeReading]:
        frames, layout, counters = len(starts), self.layout, self.counters
        if not frames:
            return []
        self._last_ending = _ending(slots)
        # Row of the frame that each slot belongs to.
        row = np.zeros(len(slots), np.int64)
        row[starts[1:]] = 1
        row = np.cumsum(row)

        known = (slots.channel >= 0) & (slots.channel < len(_KNOWN))
        known[known] = _KNOWN[slots.channel[known]]
        counters["unknown_channels"] += int(np.count_nonzero(~known))
        column = np.where(known, self._column[np.where(known, slots.channel, 255)], -1)
        is_pac = known & (slots.channel == ch.PAC)
        unused = known & (column < 0) & ~is_pac
        others = int(np.count_nonzero(unused & slots.good & (slots.channel >= ch.FIRST_ELECTRODE)))
        counters["other_electrodes"] += others
        counters["ignored_slots"] += int(np.count_nonzero(unused)) - others

        number = self._pac_numbers.of(slots, starts)
        column = np.where(number >= 0, layout.first_pac_bit + number, column)
        usable = column >= 0
        counters["unplaced_slots"] += int(np.count_nonzero(number == UNPLACED))
        surplus = int(np.count_nonzero(number == SURPLUS))

        # np.unique finds the first slot of each channel in each frame; repetitions are dropped.
        cell, first = np.unique(row[usable] * 64 + column[usable], return_index=True)
        at = cell // 64, cell % 64
        counts = np.zeros((frames, layout.slots), np.uint16)
        valid = np.zeros(counts.shape, np.bool_)
        seen = np.zeros(counts.shape, np.bool_)
        counts[at] = slots.value[usable][first]
        valid[at] = slots.good[usable][first]
        seen[at] = True
        present = np.count_nonzero(seen, axis=1)
        counters["duplicate_slots"] += surplus + int(usable.sum()) - len(cell)
        counters["incomplete_frames"] += int(np.count_nonzero(present < layout.slots))
        counters["frames"] += frames

        # 64 bits: a frame of a BioTac SP has 54 slots.
        validity = np.where(valid, self._bits, np.uint64(0)).sum(axis=1, dtype=np.uint64)
        readings = []
        for k, start in enumerate(starts.tolist()):
            missed = self._advance(int(slots.batch[start]), int(slots.frame[start]))
            # Time of the first slot of the round, even if that slot was lost.
            before = max(int(slots.position[start]), 0)
            time_s = float(slots.time_s[start]) - before * self._slot_period_s
            readings.append(self._reading(counts[k], int(validity[k]), time_s, missed))
        return readings

    def _reading(
        self, counts: CountArray, validity: int, time_s: float, missed: int
    ) -> ElectrodeReading:
        """A reading from counts in order of their validity bits."""
        layout = self.layout
        pdc, tac, tdc = counts[layout.pdc_bit : layout.first_pac_bit].tolist()
        return ElectrodeReading(
            tick=self._tick,
            time_s=time_s,
            missed_before=missed,
            electrodes=counts[: layout.electrodes],
            pdc=pdc,
            pac=counts[layout.first_pac_bit :],
            tac=tac,
            tdc=tdc,
            validity=validity,
        )

    def _holds_frame(self, slots: SlotBlock) -> bool:
        """Whether these slots of one frame hold all of its channels."""
        enough = len(slots) >= self.layout.slots
        return enough and holds_frame(slots.channel.tolist(), self.layout)

    def _advance(self, batch: int, frame: int) -> int:
        """Advance the unwrapped tick to this frame; return how many frames were lost before it."""
        if self._last_key is None:
            self._last_key = (batch, frame)
            self._tick = max(frame, 0)
            return 0
        missed = frame - self._last_key[1] - 1
        if not 0 <= missed <= BELIEVABLE_LOSS:
            self.counters["counter_restarts"] += 1
            missed = 0
        self._last_key = (batch, frame)
        self._tick += 1 + missed
        self.counters["missing_frames"] += missed
        return missed


def _frame_starts(slots: SlotBlock) -> npt.NDArray[np.int64]:
    """Index of the first slot of each run of equal (batch, frame)."""
    changed = (np.diff(slots.batch) != 0) | (np.diff(slots.frame) != 0)
    return np.concatenate([[0], np.flatnonzero(changed) + 1])


def _ending(slots: SlotBlock) -> tuple[int, ...]:
    """Channel ids of the last two slots: a single one is often PAC, which is every other slot."""
    return tuple(slots.channel[-2:].tolist())
