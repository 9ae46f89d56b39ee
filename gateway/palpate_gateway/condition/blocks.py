"""Frames in blocks of a fifth of a second, so that watching them costs little.

A frame is copied into a row; everything else is computed once a block. Invalid samples are left
out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.messages import CountArray, ElectrodeFrame, FrameLayout

BLOCK_S = 0.2
"""Duration of a block [s], but never fewer frames than ``FRAMES_MIN``."""

FRAMES_MIN = 10

Floats = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]
_NONE = np.uint16(0xFFFF)
_Valid = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Block:
    """Statistics of consecutive frames; of E electrodes, arrays have shape ``(E,)``.

    Attributes:
        time_s: Time of the last frame [s], by the frames' monotonic clock.
        frames: How many.
        seen: Valid samples of each electrode; 0 = its other numbers say nothing.
        mean: Mean [counts].
        variance: Variance [counts^2].
        low: Least, uint16 [counts].
        high: Greatest, uint16 [counts].
        pac_seen: Valid samples of PAC.
        pac_mean: Mean [counts].
        pac_variance: Variance [counts^2].
        pac_low: Least [counts].
        pac_high: Greatest [counts].
        slow_seen: Valid samples of PDC, TAC and TDC.
        pdc_mean: Mean [counts].
        pdc_variance: Variance [counts^2].
        tdc_mean: Mean [counts].
    """

    time_s: float
    frames: int
    seen: Counts
    mean: Floats
    variance: Floats
    low: CountArray
    high: CountArray
    pac_seen: int
    pac_mean: float
    pac_variance: float
    pac_low: int
    pac_high: int
    slow_seen: tuple[int, ...]
    pdc_mean: float
    pdc_variance: float
    tdc_mean: float


class Blocks:
    """Collects frames of one sensor.

    Args:
        layout: Of its frames.
        rate_hz: Frames per second [Hz].
    """

    def __init__(self, layout: FrameLayout, rate_hz: float) -> None:
        self._layout = layout
        self._frames = frames = max(FRAMES_MIN, round(BLOCK_S * rate_hz))
        # One row a frame: electrodes, PDC, TAC, TDC, PAC; the columns are the validity bits.
        self._rows = np.zeros((frames, layout.slots), np.uint16)
        self._validity = [0] * frames
        self._count = 0
        self._whole = np.full(layout.slots, frames, np.int64)
        self._bits = np.arange(layout.slots, dtype=np.uint64)

    def begin(self) -> None:
        """Forget the block that has begun."""
        self._count = 0

    def add(self, frame: ElectrodeFrame) -> Block | None:
        """Take a frame; the block when it is full."""
        layout, at = self._layout, self._count
        row = self._rows[at]
        row[: layout.electrodes] = frame.electrodes
        row[layout.electrodes : layout.first_pac_bit] = (frame.pdc, frame.tac, frame.tdc)
        row[layout.first_pac_bit :] = frame.pac
        self._validity[at] = frame.validity
        self._count = at + 1
        if self._count < self._frames:
            return None
        self._count = 0
        return self._block(frame.stamp.monotonic_ns * 1e-9)

    def _block(self, time_s: float) -> Block:
        layout, frames = self._layout, self._frames
        if all(one == layout.all_valid for one in self._validity):
            seen = self._whole
            rows = self._rows.astype(np.float64)
            mean = np.add.reduce(rows, axis=0) / frames
            rows -= mean
            rows *= rows
            variance = np.add.reduce(rows, axis=0) / frames
            low, high = np.minimum.reduce(self._rows), np.maximum.reduce(self._rows)
        else:
            valid = self._valid()
            seen = np.count_nonzero(valid, axis=0)
            some = np.maximum(seen, 1)
            mean = np.where(valid, self._rows, 0.0).sum(axis=0) / some
            variance = np.where(valid, np.square(self._rows - mean), 0.0).sum(axis=0) / some
            low = np.where(valid, self._rows, _NONE).min(axis=0)
            high = np.where(valid, self._rows, 0).max(axis=0)
        e, p = layout.electrodes, layout.first_pac_bit
        parts = (part[p:].tolist() for part in (seen, mean, variance))
        pac = [(n, m, v) for n, m, v in zip(*parts, strict=True) if n]
        pac_seen = sum(n for n, _, _ in pac)
        pac_mean = sum(n * m for n, m, _ in pac) / max(pac_seen, 1)
        pac_square = sum(n * (v + (m - pac_mean) ** 2) for n, m, v in pac)
        return Block(
            time_s=time_s,
            frames=frames,
            seen=seen[:e],
            mean=mean[:e],
            variance=variance[:e],
            low=low[:e],
            high=high[:e],
            pac_seen=pac_seen,
            pac_mean=pac_mean,
            pac_variance=pac_square / max(pac_seen, 1),
            pac_low=min(low[p:].tolist()),
            pac_high=max(high[p:].tolist()),
            slow_seen=tuple(seen[e:p].tolist()),
            pdc_mean=float(mean[e]),
            pdc_variance=float(variance[e]),
            tdc_mean=float(mean[p - 1]),
        )

    def _valid(self) -> _Valid:
        words = np.array(self._validity, np.uint64)
        valid: _Valid = (words[:, None] >> self._bits & np.uint64(1)).astype(np.bool_)
        return valid
