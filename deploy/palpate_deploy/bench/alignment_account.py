"""From frames that all show one known signal to how far off their stamps are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.alignment import Clock, electrode_instants, linear, times_of
from palpate.messages import ElectrodeFrame, IndenterPoseFrame, WrenchFrame
from palpate.sampling import sample_offsets
from palpate_deploy.bench.lateness import OnTime
from palpate_deploy.bench.ramp import time_of

Floats = npt.NDArray[np.float64]

LOW_COUNTS, SPAN_COUNTS = 300, 3500
"""Counts of an electrode that is not pressed, and how many more when it is."""
LOW_N, SPAN_N = 1.0, 20.0
"""Force likewise [N]."""
SPAN_M = 0.02
"""Travel of the indenter [m]."""

Wrenches = dict[str, list[WrenchFrame]]


@dataclass(frozen=True, slots=True)
class Spread:
    """Of many errors [s]: their median, and of their sizes 95 and 99 % and the largest.

    Attributes:
        count: How many readings.
        median_s: Signed: late is positive.
        p95_s: Of the sizes.
        p99_s: Of the sizes.
        max_s: Of the sizes.
    """

    count: int
    median_s: float
    p95_s: float
    p99_s: float
    max_s: float


def spread(errors_s: Floats) -> Spread:
    """Numbers of errors [s]; NaN is left out."""
    kept = errors_s[np.isfinite(errors_s)]
    if not len(kept):
        return Spread(0, np.nan, np.nan, np.nan, np.nan)
    sizes = np.abs(kept)
    p95, p99 = np.percentile(sizes, (95, 99))
    return Spread(len(kept), float(np.median(kept)), float(p95), float(p99), float(sizes.max()))


def _off(share: Floats, stamp_ns: npt.NDArray[np.int64], counts: OnTime) -> Floats:
    """Stamp less the time at which the value was there [s]; NaN at times that do not count."""
    stamp_s = _seconds(stamp_ns)
    return np.where(counts(stamp_s), stamp_s - time_of(share, stamp_s), np.nan)


def _seconds(time_ns: npt.NDArray[np.int64]) -> Floats:
    return np.asarray(1e-9 * time_ns.astype(np.float64))


def _shares(frames: Sequence[ElectrodeFrame], *, pac: bool) -> Floats:
    """What the electrodes, or the PAC samples, of frames show; NaN where a sample is invalid."""
    layout = frames[0].sensor_type.layout
    first, number = (layout.first_pac_bit, layout.pac_samples) if pac else (0, layout.electrodes)
    counts = np.array([frame.pac if pac else frame.electrodes for frame in frames], np.float64)
    bits = np.array([frame.validity for frame in frames], np.uint64)[:, None]
    good = bits >> np.arange(first, first + number, dtype=np.uint64) & np.uint64(1)
    return np.where(good == 1, (counts - LOW_COUNTS) / SPAN_COUNTS, np.nan)


def _forces(frames: Sequence[WrenchFrame]) -> Floats:
    return np.array([[frame.force[2]] for frame in frames], np.float64)


def _travels(frames: Sequence[IndenterPoseFrame]) -> Floats:
    return np.array([[frame.position[0]] for frame in frames], np.float64)


def stamp_errors(
    frames: Sequence[ElectrodeFrame],
    wrenches: Wrenches,
    poses: Sequence[IndenterPoseFrame],
    counts: OnTime,
) -> dict[str, Spread]:
    """How far each stream's stamps are from when their values were there."""
    at_ns = electrode_instants(frames, Clock.MONOTONIC)
    shares = _shares(frames, pac=False)
    stamps_ns = times_of(frames, Clock.MONOTONIC)
    pac_ns = stamps_ns[:, None] + np.array([sample_offsets(frame).pac for frame in frames])
    pac = _shares(frames, pac=True)
    errors = {
        "electrodes": _off(shares, at_ns, counts),
        "PAC": _off(pac, pac_ns, counts),
        "electrodes, all at the stamp": _off(shares, at_ns, counts)
        - _seconds(at_ns - stamps_ns[:, None]),
    }
    for name, stream in wrenches.items():
        share = (_forces(stream)[:, 0] - LOW_N) / SPAN_N
        errors[name] = _off(share, times_of(stream, Clock.MONOTONIC), counts)
    shares = _travels(poses)[:, 0] / SPAN_M
    errors["pose"] = _off(shares, times_of(poses, Clock.MONOTONIC), counts)
    return {name: spread(found) for name, found in errors.items()}


def apart(
    frames: Sequence[ElectrodeFrame],
    wrenches: Wrenches,
    poses: Sequence[IndenterPoseFrame],
    counts: OnTime,
) -> dict[str, Spread]:
    """How far apart in time electrodes and other streams are that were aligned by their stamps.

    Every stream is brought to the instant of each electrode of each frame; what it shows there was
    there sooner or later than what the electrode shows.
    """
    at_ns = electrode_instants(frames, Clock.MONOTONIC)
    about_s = _seconds(at_ns)
    shares = _shares(frames, pac=False)
    electrodes_s = np.where(counts(about_s), time_of(shares, about_s), np.nan)
    out = {}
    for name, stream in wrenches.items():
        force, _ = linear(at_ns, times_of(stream, Clock.MONOTONIC), _forces(stream))
        share = (force[..., 0] - LOW_N) / SPAN_N
        out[name] = spread(electrodes_s - time_of(share, about_s))
    travel, _ = linear(at_ns, times_of(poses, Clock.MONOTONIC), _travels(poses))
    out["pose"] = spread(electrodes_s - time_of(travel[..., 0] / SPAN_M, about_s))
    return out
