"""Taring: averaging untouched frames to a baseline, and keeping every baseline of a run."""

from __future__ import annotations

import hashlib
import threading
from collections import deque

import numpy as np

from palpate.errors import DeviceError, ErrorCode, RemoteError
from palpate.messages import NO_TARE, ElectrodeFrame, Tare
from palpate_gateway.condition.stillness import MAX_SD_COUNTS, StillLimits, evidence_of

__all__ = ["MAX_SD_COUNTS", "TARE_FRAMES", "TareCollector", "TareLedger"]

TARE_FRAMES = 50
"""Frames averaged by default: half a second at 100 Hz."""

_KEPT = 1024
_STILL = StillLimits()


class TareCollector:
    """Averages consecutive good frames: those with every channel, and PAC as far as it is sampled.

    Args:
        frames: How many.
        limits: What a sensor that nothing touches does not exceed.
    """

    def __init__(self, frames: int, limits: StillLimits = _STILL) -> None:
        self._wanted = frames
        self._limits = limits
        self._window: deque[ElectrodeFrame] = deque(maxlen=frames)
        self._refused = 0

    def add(self, frame: ElectrodeFrame) -> Tare | None:
        """Take one frame; return the tare when there are enough.

        Raises:
            DeviceError: A channel stays invalid, or something moves; names it. The next frame
                begins anew.
        """
        if _missing(frame):
            self._refused += 1
            if self._refused >= self._wanted:
                raise self._invalid(frame)
            return None
        if self._window and self._window[-1].sensor_type is not frame.sensor_type:
            self._window.clear()  # the finger was exchanged
        self._window.append(frame)
        if len(self._window) < self._wanted:
            return None
        window = list(self._window)
        self._window.clear()
        self._refused = 0
        return self._average(window)

    def _average(self, window: list[ElectrodeFrame]) -> Tare:
        electrodes = np.array([frame.electrodes for frame in window], np.float64)
        pdc = np.array([frame.pdc for frame in window], np.float64)
        pac = np.concatenate([_valid_pac(frame) for frame in window]).astype(np.float64)
        last = window[-1]
        motion = evidence_of(electrodes, pac, pdc).motion(self._limits)
        if motion:
            raise DeviceError(
                f"cannot tare {last.sensor_serial}: {motion}",
                remedy="take everything off the finger and tare again",
            )
        baseline = electrodes.mean(axis=0).astype(np.float32)
        return Tare(
            tare_id=_tare_id(last, baseline.tobytes()),
            stamp=last.stamp,
            sensor_serial=last.sensor_serial,
            electrodes=baseline,
            electrodes_sd=electrodes.std(axis=0).astype(np.float32),
            pdc=float(pdc.mean()),
            pac=float(pac.mean()),
            tac=float(np.mean([frame.tac for frame in window])),
            tdc=float(np.mean([frame.tdc for frame in window])),
            frames_averaged=len(window),
        )

    def _invalid(self, frame: ElectrodeFrame) -> DeviceError:
        bad = _missing(frame)
        refused, self._refused = self._refused, 0
        self._window.clear()
        return DeviceError(
            f"cannot tare {frame.sensor_serial}: {', '.join(bad[:4])} invalid "
            f"({refused} frames refused)",
            remedy="check the cable and connector of this finger; see the parity_errors counters",
        )


def _missing(frame: ElectrodeFrame) -> list[str]:
    """Channels that a tare needs and that this frame does not have."""
    layout = frame.sensor_type.layout
    slow = (1 << layout.first_pac_bit) - 1
    bad = ~frame.validity & slow
    if not bad:
        return [] if frame.validity >> layout.first_pac_bit else ["PAC"]
    return [layout.bit_name(bit) for bit in range(layout.first_pac_bit) if bad >> bit & 1]


def _valid_pac(frame: ElectrodeFrame) -> np.ndarray:
    """Samples of PAC that are good."""
    layout = frame.sensor_type.layout
    if frame.validity == layout.all_valid:
        return frame.pac
    return frame.pac[
        [bool(frame.validity >> layout.first_pac_bit + k & 1) for k in range(len(frame.pac))]
    ]


def _tare_id(last: ElectrodeFrame, baseline: bytes) -> int:
    """An id that is the same for the same replay and another one for every live tare."""
    stamp = last.stamp
    facts = f"{last.sensor_serial}/{stamp.sequence}/{stamp.monotonic_ns}/{stamp.wall_ns}/"
    digest = hashlib.blake2b(facts.encode() + baseline, digest_size=8).digest()
    return int.from_bytes(digest, "little") or 1


class TareLedger:
    """Every tare of one sensor in this run, by id. Safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._tares: dict[int, Tare] = {}
        self._current_id = NO_TARE

    @property
    def current_id(self) -> int:
        """Id of the tare in force; ``NO_TARE`` before the first."""
        return self._current_id

    def enter(self, tare: Tare) -> None:
        """Keep a tare and put it in force."""
        with self._lock:
            self._tares[tare.tare_id] = tare
            self._current_id = tare.tare_id
            while len(self._tares) > _KEPT:
                del self._tares[next(iter(self._tares))]

    def leave(self) -> None:
        """No tare is in force any more; those that were can still be found."""
        with self._lock:
            self._current_id = NO_TARE

    def find(self, tare_id: int) -> Tare:
        """The tare of this id.

        Raises:
            RemoteError: There is none, with code NOT_FOUND.
        """
        with self._lock:
            tare = self._tares.get(tare_id)
        if tare is None:
            raise RemoteError(
                f"tare {tare_id} is not known to this gateway",
                remedy="tare again: ids are kept for one run of the gateway",
                code=ErrorCode.NOT_FOUND,
            )
        return tare
