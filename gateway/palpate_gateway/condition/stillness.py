"""Whether a sensor is still: a sensor that moves is touched, or was touched just before.

PAC is the dynamic part of the fluid's pressure: any touch of the skin disturbs it, even a hand that
holds the finger. PDC changes slowly while skin and fluid relax. Electrodes vary and shift. A still
sensor may be touched all the same: a stand can press with a constant force (see ``condition``).

Frames are collected in blocks of a fifth of a second, so that this costs little: a frame is copied
into a row, everything else is computed once a block. Limits come from the real captures in
docs/tare-and-health.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.messages import CountArray, ElectrodeFrame, FrameLayout

BLOCK_S = 0.2
"""Duration of a block [s]; a block has at least ``FRAMES_MIN`` frames."""

FRAMES_MIN = 10

Floats = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]
_NONE = np.uint16(0xFFFF)


@dataclass(frozen=True, slots=True)
class FrameBlock:
    """Statistics of consecutive frames without invalid samples; arrays have shape ``(E,)``.

    Attributes:
        time_s: Time of the last frame [s], by the frames' monotonic clock.
        frames: Number of frames.
        seen: Valid samples of each electrode; 0 = its other numbers mean nothing.
        mean: Mean [counts].
        variance: Variance [counts^2].
        low: Minimum, uint16 [counts].
        high: Maximum, uint16 [counts].
        pac_seen: Valid samples of PAC.
        pac_mean: Mean [counts].
        pac_variance: Variance [counts^2].
        pac_low: Minimum [counts].
        pac_high: Maximum [counts].
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


class FrameBlocks:
    """Collects frames of one sensor, which come at ``rate_hz``."""

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
        """Drop the block that has begun."""
        self._count = 0

    def add(self, frame: ElectrodeFrame) -> FrameBlock | None:
        """Take a frame; returns the block when it is full."""
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

    def _block(self, time_s: float) -> FrameBlock:
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
            words = np.array(self._validity, np.uint64)
            valid = (words[:, None] >> self._bits & np.uint64(1)).astype(np.bool_)
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
        return FrameBlock(
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


MAX_SD_COUNTS = 25.0
"""An electrode that varies more than this is being touched [counts]. A settled sensor has 0.5; the
public capture, with its pauses of a quarter second, has up to 13."""

MAX_PAC_SD_COUNTS = 9.0
"""PAC that varies more is being touched [counts]: the real capture has 4 at rest, and 19 at the
quietest while a hand holds the finger."""

MAX_PDC_SD_COUNTS = 1.5
"""PDC that varies more is creeping or touched [counts]: real sensors have 0.6 at rest and 1.6 at
the quietest while they are held."""

_SHIFT_COUNTS = 2.0
_SHIFT_NOISE = 2.0
"""Electrodes that shift by more than this much, and their noise this many times, are moving."""

WINDOW_BLOCKS = 3
"""Number of blocks in a window: 0.6 s."""


@dataclass(frozen=True, slots=True)
class StillLimits:
    """Noise up to which a sensor counts as still.

    Attributes:
        electrode_sd: Standard deviation of any electrode [counts].
        pac_sd: Standard deviation of PAC [counts]; infinity = PAC is ignored.
        pdc_sd: Standard deviation of PDC [counts]; infinity = PDC is ignored.
    """

    electrode_sd: float = MAX_SD_COUNTS
    pac_sd: float = MAX_PAC_SD_COUNTS
    pdc_sd: float = MAX_PDC_SD_COUNTS


@dataclass(frozen=True, slots=True)
class MotionEvidence:
    """Signs of a touch in a window of frames.

    Attributes:
        frames: Frames in the window.
        electrode: The electrode that varies most, from 0.
        electrode_sd: Its standard deviation [counts].
        shift: Difference between the means of the second and the first half of the window, root
            mean square over the electrodes [counts].
        noise: Shift that noise alone causes [counts].
        pac_sd: Standard deviation of PAC [counts].
        pdc_sd: Standard deviation of PDC [counts].
    """

    frames: int
    electrode: int
    electrode_sd: float
    shift: float
    noise: float
    pac_sd: float
    pdc_sd: float

    def motion(self, limits: StillLimits) -> str:
        """A sentence about what moves; empty = the sensor is still."""
        over = f"over {self.frames} frames, at most"
        if self.electrode_sd > limits.electrode_sd:
            return (
                f"E{self.electrode + 1} varies by {self.electrode_sd:.0f} counts (sd) {over} "
                f"{limits.electrode_sd:g} are allowed"
            )
        if self.pac_sd > limits.pac_sd:
            return (
                f"PAC varies by {self.pac_sd:.0f} counts (sd) {over} {limits.pac_sd:g} are allowed"
            )
        if self.pdc_sd > limits.pdc_sd:
            return (
                f"PDC varies by {self.pdc_sd:.1f} counts (sd) {over} {limits.pdc_sd:g} are allowed"
            )
        most = _SHIFT_COUNTS + _SHIFT_NOISE * self.noise
        # With PDC ignored only the variation of electrodes counts, and a shift is accepted.
        if math.isfinite(limits.pdc_sd) and self.shift > most:
            return (
                f"electrodes shift by {self.shift:.1f} counts (rms) {over} {most:.1f} are allowed"
            )
        return ""


def evidence_of(electrodes: Floats, pac: Floats, pdc: Floats) -> MotionEvidence:
    """Evidence of whole frames.

    Args:
        electrodes: Raw counts, shape ``(N, E)``; at least two frames.
        pac: Valid samples of PAC, any shape; may be none.
        pdc: Raw counts, shape ``(N,)``.
    """
    frames, half = len(electrodes), len(electrodes) // 2
    step = electrodes[frames - half :].mean(axis=0) - electrodes[:half].mean(axis=0)
    pac_sd = float(pac.std()) if pac.size else 0.0
    return _evidence(frames, half, electrodes.var(axis=0), step, pac_sd, float(pdc.std()))


def evidence_of_blocks(
    blocks: Sequence[FrameBlock], usable: npt.NDArray[np.bool_]
) -> MotionEvidence:
    """Evidence of consecutive blocks.

    Args:
        blocks: At least two.
        usable: Electrodes to be used, bool, shape ``(E,)``; at least one.
    """
    count, half, frames = len(blocks), len(blocks) // 2, blocks[0].frames
    means = np.array([block.mean for block in blocks])
    inside = np.array([block.variance for block in blocks])
    mean = np.add.reduce(means) / count
    variance = np.add.reduce(inside + np.square(means - mean)) / count * usable
    step = (np.add.reduce(means[-half:]) - np.add.reduce(means[:half])) / half * usable
    pac = [(block.pac_mean, block.pac_variance) for block in blocks if block.pac_seen]
    pdc = [(block.pdc_mean, block.pdc_variance) for block in blocks if block.slow_seen[0]]
    return _evidence(
        count * frames, half * frames, variance, step, _pooled_sd(pac), _pooled_sd(pdc)
    )


def _evidence(
    frames: int, half: int, variance: Floats, step: Floats, pac_sd: float, pdc_sd: float
) -> MotionEvidence:
    worst = int(variance.argmax())
    # Noise of the difference of two means over ``half`` frames each. Electrodes that are left out
    # have variance and step 0: they lower noise and shift alike.
    noise = math.sqrt(2.0 * float(np.add.reduce(variance)) / len(variance) / half)
    shift = math.sqrt(float(step @ step) / len(step))
    return MotionEvidence(
        frames, worst, math.sqrt(float(variance[worst])), shift, noise, pac_sd, pdc_sd
    )


def _pooled_sd(parts: Sequence[tuple[float, float]]) -> float:
    """Standard deviation of parts of equal size, from mean and variance of each."""
    if not parts:
        return 0.0
    mean = sum(one for one, _ in parts) / len(parts)
    return math.sqrt(sum(inside + (one - mean) ** 2 for one, inside in parts) / len(parts))
