"""Slots to frames: decode by channel id, tolerate loss, count everything."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from palpate.gateway.biotac.slots import SlotBlock, slot_block
from palpate.gateway.protocols import channels as ch
from palpate.gateway.readings import ElectrodeReading
from palpate.protos.messages import COUNTS_MAX, PAC_SAMPLES

TIME_JUMP_S = 1e-3
"""A slot later than its place on the slot grid by more than this is a time jump [s]."""

_BELIEVABLE_LOSS = 1_000_000
"""A frame counter that leaps further than this has restarted or is damaged [frames]."""

# Column of each channel id among electrodes 0..18, PDC, TAC, TDC; -1 = another kind.
_COLUMN = np.full(256, -1, np.int64)
_COLUMN[ch.FIRST_ELECTRODE : ch.FIRST_ELECTRODE + ch.ELECTRODES] = np.arange(ch.ELECTRODES)
_COLUMN[[ch.PDC, ch.TAC, ch.TDC]] = (ch.PDC_BIT, ch.TAC_BIT, ch.TDC_BIT)
_KNOWN = np.zeros(256, np.bool_)
_KNOWN[list(ch.CHANNEL_NAMES)] = True
_BITS = np.uint64(1) << np.arange(ch.FIRST_PAC_BIT + PAC_SAMPLES, dtype=np.uint64)


class FrameAssembler:
    """Groups slots of equal (batch, frame) into readings.

    A frame is delivered when the next one begins, or at once when it is whole. Channels that are
    absent or of bad parity keep their validity bit clear; an absent one holds 0.

    Args:
        slot_period_s: Time between two slots [s].
    """

    def __init__(self, slot_period_s: float) -> None:
        self._slot_period_s = slot_period_s
        self._pending = slot_block([])
        self._last_time_s: float | None = None
        self._last_key: tuple[int, int] | None = None
        self._last_ending: tuple[int, ...] | None = None
        self._tick = 0
        self.counters: dict[str, int] = dict.fromkeys(
            (
                "samples",
                "frames",
                "incomplete_frames",
                "missing_frames",
                "counter_restarts",
                "time_jumps",
                "parity_errors",
                "unknown_channels",
                "ignored_slots",
                "duplicate_slots",
                "saturated_samples",
            ),
            0,
        )
        self.parity_errors_by_channel: dict[str, int] = {}

    @property
    def pending_slots(self) -> int:
        """Slots of the frame that has begun and is not yet delivered."""
        return len(self._pending)

    @property
    def ends_inside_frame(self) -> bool:
        """Whether the frame that has begun is cut: it does not end as the one before did.

        A frame that lost a slot on the way still ends as the others do.
        """
        if not len(self._pending) or _is_whole(self._pending):
            return False
        return self._last_ending is None or self._last_ending != _ending(self._pending)

    def push(self, block: SlotBlock) -> list[ElectrodeReading]:
        """Take slots in order of time; return the frames that are now whole or over."""
        if not len(block):
            return []
        self._count(block)
        slots = self._without_late(self._pending.followed_by(block))
        if not len(slots):
            self._pending = slots
            return []
        starts = _frame_starts(slots)
        tail = int(starts[-1])
        if _is_whole(slots.part(tail, len(slots))):
            tail = len(slots)
        else:
            starts = starts[:-1]
        self._pending = slots.part(tail, len(slots))
        return self._assemble(slots.part(0, tail), starts)

    def finish(self) -> list[ElectrodeReading]:
        """Deliver the frame that has begun, whole or not."""
        slots, self._pending = self._pending, slot_block([])
        return self._assemble(slots, _frame_starts(slots)) if len(slots) else []

    def discard_pending(self) -> int:
        """Drop the frame that has begun; return how many slots it had."""
        dropped = len(self._pending)
        self._pending = slot_block([])
        return dropped

    def _count(self, block: SlotBlock) -> None:
        counters = self.counters
        counters["samples"] += len(block)
        times = block.time_s
        if self._last_time_s is not None:
            times = np.concatenate([[self._last_time_s], times])
        self._last_time_s = float(times[-1])
        step = np.diff(times)
        late = (step > self._slot_period_s + TIME_JUMP_S) | (step < -TIME_JUMP_S)
        counters["time_jumps"] += int(np.count_nonzero(late))
        bad = block.channel[~block.good]
        counters["parity_errors"] += len(bad)
        for channel, times_bad in zip(*np.unique(bad, return_counts=True), strict=True):
            name = ch.channel_name(int(channel))
            already = self.parity_errors_by_channel.get(name, 0)
            self.parity_errors_by_channel[name] = already + int(times_bad)
        ends = block.good & ((block.value == 0) | (block.value == COUNTS_MAX))
        counters["saturated_samples"] += int(np.count_nonzero(ends))

    def _without_late(self, slots: SlotBlock) -> SlotBlock:
        """Drop slots of the frame that was delivered because it was whole already."""
        if self._last_key is None:
            return slots
        batch, frame = self._last_key
        late = (slots.batch == batch) & (slots.frame == frame)
        first = len(slots) if late.all() else int(np.argmin(late))
        self.counters["duplicate_slots"] += first
        return slots.part(first, len(slots))

    def _assemble(self, slots: SlotBlock, starts: npt.NDArray[np.int64]) -> list[ElectrodeReading]:
        frames = len(starts)
        if not frames:
            return []
        self._last_ending = _ending(slots)
        # Row of the frame that each slot belongs to.
        row = np.zeros(len(slots), np.int64)
        row[starts[1:]] = 1
        row = np.cumsum(row)

        known = (slots.channel >= 0) & (slots.channel < len(_KNOWN))
        known[known] = _KNOWN[slots.channel[known]]
        self.counters["unknown_channels"] += int(np.count_nonzero(~known))

        column = np.where(known, _COLUMN[np.where(known, slots.channel, 255)], -1)
        is_pac = known & (slots.channel == ch.PAC)
        self.counters["ignored_slots"] += int(np.count_nonzero(known & (column < 0) & ~is_pac))

        # PAC in order of sampling: its running number inside the frame.
        running = np.cumsum(is_pac)
        before = running[starts] - is_pac[starts]
        column = np.where(is_pac, ch.FIRST_PAC_BIT + running - before[row] - 1, column)
        usable = (column >= 0) & (column < ch.FIRST_PAC_BIT + PAC_SAMPLES)
        extra_pac = int(np.count_nonzero(is_pac & ~usable))

        # np.unique gives the first slot of each channel in each frame: repetitions lose.
        cell, first = np.unique(row[usable] * 64 + column[usable], return_index=True)
        at = cell // 64, cell % 64
        counts = np.zeros((frames, ch.FIRST_PAC_BIT + PAC_SAMPLES), np.uint16)
        valid = np.zeros(counts.shape, np.bool_)
        seen = np.zeros(counts.shape, np.bool_)
        counts[at] = slots.value[usable][first]
        valid[at] = slots.good[usable][first]
        seen[at] = True
        present = np.count_nonzero(seen, axis=1)
        self.counters["duplicate_slots"] += extra_pac + int(usable.sum()) - len(cell)
        self.counters["incomplete_frames"] += int(np.count_nonzero(present < counts.shape[1]))
        self.counters["frames"] += frames

        validity = np.where(valid, _BITS, np.uint64(0)).sum(axis=1, dtype=np.uint64)
        readings = []
        for k in range(frames):
            start = int(starts[k])
            missed = self._advance(int(slots.batch[start]), int(slots.frame[start]))
            values = counts[k]
            readings.append(
                ElectrodeReading(
                    tick=self._tick,
                    time_s=float(slots.time_s[start]),
                    missed_before=missed,
                    electrodes=values[: ch.ELECTRODES],
                    pdc=int(values[ch.PDC_BIT]),
                    pac=values[ch.FIRST_PAC_BIT :],
                    tac=int(values[ch.TAC_BIT]),
                    tdc=int(values[ch.TDC_BIT]),
                    validity=int(validity[k]),
                )
            )
        return readings

    def _advance(self, batch: int, frame: int) -> int:
        """Move the unwrapped tick to this frame; return how many frames were lost before it."""
        if self._last_key is None:
            self._last_key = (batch, frame)
            self._tick = max(frame, 0)
            return 0
        missed = frame - self._last_key[1] - 1
        if not 0 <= missed <= _BELIEVABLE_LOSS:
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
    """Channel ids of the last two slots: one alone is often PAC, which is every other slot."""
    return tuple(slots.channel[-2:].tolist())


def _is_whole(slots: SlotBlock) -> bool:
    """Whether one frame's slots hold every channel and 22 PAC samples."""
    if len(slots) < ch.SLOTS_PER_FRAME:
        return False
    channels = slots.channel.tolist()
    wanted = {ch.PDC, ch.TAC, ch.TDC, *range(ch.FIRST_ELECTRODE, ch.FIRST_ELECTRODE + 19)}
    return wanted <= set(channels) and channels.count(ch.PAC) >= PAC_SAMPLES
