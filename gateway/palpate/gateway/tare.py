"""Taring: averaging untouched frames to a baseline, and keeping every baseline of a run."""

from __future__ import annotations

import hashlib
import threading
from collections import deque

import numpy as np

from palpate.gateway.protocols.channels import ALL_VALID, bit_name
from palpate.protos.errors import DeviceError, ErrorCode, RemoteError
from palpate.protos.messages import NO_TARE, ElectrodeFrame, Tare

TARE_FRAMES = 50
"""Frames averaged by default: half a second at 100 Hz."""

MAX_SD_COUNTS = 25.0
"""An electrode that varies more than this is being touched [counts]. A settled sensor has 0.5; the
public capture, with its pauses of a quarter second, has up to 13."""

_KEPT = 1024


class TareCollector:
    """Averages consecutive good frames.

    Args:
        frames: How many.
        max_sd_counts: Largest standard deviation of an untouched electrode [counts].
    """

    def __init__(self, frames: int, max_sd_counts: float = MAX_SD_COUNTS) -> None:
        self._wanted = frames
        self._max_sd_counts = max_sd_counts
        self._window: deque[ElectrodeFrame] = deque(maxlen=frames)
        self._refused = 0

    def add(self, frame: ElectrodeFrame) -> Tare | None:
        """Take one frame; return the tare when there are enough.

        Raises:
            DeviceError: A channel stays invalid, or an electrode varies too much to be untouched;
                names it. The next frame begins anew.
        """
        if frame.validity != ALL_VALID:
            self._refused += 1
            if self._refused >= self._wanted:
                raise self._invalid(frame)
            return None
        self._window.append(frame)
        if len(self._window) < self._wanted:
            return None
        window = list(self._window)
        self._window.clear()
        self._refused = 0
        return self._average(window)

    def _average(self, window: list[ElectrodeFrame]) -> Tare:
        electrodes = np.array([frame.electrodes for frame in window], np.float64)
        deviation = electrodes.std(axis=0)
        worst = int(np.argmax(deviation))
        if deviation[worst] > self._max_sd_counts:
            raise DeviceError(
                f"cannot tare {window[-1].sensor_serial}: E{worst + 1} varies by "
                f"{deviation[worst]:.0f} counts (sd) over {len(window)} frames, at most "
                f"{self._max_sd_counts:g} are allowed",
                remedy="take everything off the finger and tare again",
            )
        baseline = electrodes.mean(axis=0).astype(np.float32)
        last = window[-1]
        return Tare(
            tare_id=_tare_id(last, baseline.tobytes()),
            stamp=last.stamp,
            sensor_serial=last.sensor_serial,
            electrodes=baseline,
            electrodes_sd=deviation.astype(np.float32),
            pdc=float(np.mean([frame.pdc for frame in window])),
            pac=float(np.mean([frame.pac for frame in window])),
            tac=float(np.mean([frame.tac for frame in window])),
            tdc=float(np.mean([frame.tdc for frame in window])),
            frames_averaged=len(window),
        )

    def _invalid(self, frame: ElectrodeFrame) -> DeviceError:
        bad = [bit_name(b) for b in range(ALL_VALID.bit_length()) if not frame.validity >> b & 1]
        refused, self._refused = self._refused, 0
        self._window.clear()
        return DeviceError(
            f"cannot tare {frame.sensor_serial}: {', '.join(bad[:4])} invalid "
            f"({refused} frames refused)",
            remedy="check the cable and connector of this finger; see the parity_errors counters",
        )


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
