"""Tares: averaging untouched frames to a baseline, and keeping every baseline of a run."""

from __future__ import annotations

import hashlib
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Literal

import numpy as np

from palpate.errors import DeviceError, ErrorCode, RemoteError
from palpate.messages import NO_TARE, CountArray, ElectrodeFrame, Tare
from palpate_gateway.condition.stillness import StillLimits, evidence_of

TareMode = Literal["still", "first", "query"]
"""When a sensor is tared first: when it is still, when its electrodes are, or only on request."""

TARE_FRAMES = 50
"""Frames averaged by default: half a second at 100 Hz."""

TARE_LEAST = 2
"""Frames averaged at least: whether something moves shows between two halves."""

_KEPT = 1024
_STILL = StillLimits()


class TareCollector:
    """Averages consecutive good frames: all electrodes and PDC are valid.

    PAC, TAC and TDC are averaged over their valid samples; 0 = there was none.
    """

    def __init__(self, frames: int, limits: StillLimits = _STILL) -> None:
        self._wanted = frames
        self._limits = limits
        self._window: deque[ElectrodeFrame] = deque(maxlen=frames)
        self._refused = 0

    def add(self, frame: ElectrodeFrame) -> Tare | None:
        """Take one frame; return the tare when there are enough.

        Raises:
            DeviceError: An electrode or PDC stays invalid, or something moves; names it. The next
                frame starts a new average.
        """
        if not _is_valid(frame, frame.sensor_type.layout.pdc_bit) or not frame.electrodes_valid:
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
        last, layout = window[-1], window[-1].sensor_type.layout
        # Judged as one window, not frame by frame: a slow shift shows only between its halves.
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
            pac=float(pac.mean()) if pac.size else 0.0,
            tac=_mean([one.tac for one in window if _is_valid(one, layout.tac_bit)]),
            tdc=_mean([one.tdc for one in window if _is_valid(one, layout.tdc_bit)]),
            frames_averaged=len(window),
        )

    def _invalid(self, frame: ElectrodeFrame) -> DeviceError:
        layout = frame.sensor_type.layout
        needed = range(layout.pdc_bit + 1)
        channels = [layout.bit_name(bit) for bit in needed if not _is_valid(frame, bit)]
        refused, self._refused = self._refused, 0
        self._window.clear()
        return DeviceError(
            f"cannot tare {frame.sensor_serial}: {', '.join(channels[:4])} invalid "
            f"({refused} frames refused)",
            remedy="check the cable and connector of this finger; see the parity_errors counters",
        )


def _is_valid(frame: ElectrodeFrame, bit: int) -> bool:
    return bool(frame.validity >> bit & 1)


def _mean(counts: list[int]) -> float:
    return sum(counts) / max(len(counts), 1)


def _valid_pac(frame: ElectrodeFrame) -> CountArray:
    """Valid samples of PAC."""
    layout = frame.sensor_type.layout
    if frame.validity == layout.all_valid:
        return frame.pac
    return frame.pac[
        [bool(frame.validity >> layout.first_pac_bit + k & 1) for k in range(len(frame.pac))]
    ]


def _tare_id(last: ElectrodeFrame, baseline: bytes) -> int:
    """An id that every replay of a recording repeats, and no live tare shares with another."""
    stamp = last.stamp
    facts = f"{last.sensor_serial}/{stamp.sequence}/{stamp.monotonic_ns}/{stamp.wall_ns}/"
    digest = hashlib.blake2b(facts.encode() + baseline, digest_size=8).digest()
    return int.from_bytes(digest, "little") or 1


class TareLedger:
    """Every tare of one sensor in this run, by id. May be used from several threads."""

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


@dataclass(frozen=True, slots=True, eq=False)
class _AskedTare:
    collector: TareCollector
    future: Future[Tare]
    anyway: bool


class TareAttempts:
    """The attempts to tare one sensor: the gateway's own, and those that were requested.

    ``offer`` and ``finish`` belong to one thread; the rest may be called from any.

    Args:
        frames: Frames in a tare, unless a request says otherwise.
        limits: Noise up to which a sensor counts as still.
        at_start: Whether to tare without a request, as soon as the sensor is still.
        distance: A few words on how far a tare is from the untouched sensor, by more than drift;
            empty = it is not.
    """

    def __init__(
        self,
        frames: int,
        limits: StillLimits,
        *,
        at_start: bool,
        distance: Callable[[Tare], str] = lambda _: "",
    ) -> None:
        self.ledger = TareLedger()
        self.counters: dict[str, int] = {"tares": 0, "tares_refused": 0}
        self.error: DeviceError | None = None
        """Why the sensor is not tared, or not again without a request; None after a success."""
        self.frames = frames
        self._limits = limits
        self._distance = distance
        self._own = TareCollector(frames, limits) if at_start else None
        self._lock = threading.Lock()
        self._requested: list[_AskedTare] = []
        self._over = ""

    @property
    def attempting(self) -> bool:
        """Whether an attempt without a request is under way."""
        return self._own is not None

    def attempt(self) -> None:
        """Tare as soon as the sensor is still; does nothing if such an attempt is under way."""
        if self._own is None:
            self._own = TareCollector(self.frames, self._limits)

    def touched(self) -> None:
        """The sensor is not untouched: it is not tared again without a request.

        The next attempt waits until the sensor has been untouched for long enough. One without any
        tare in force goes on: it has no level to be compared with.
        """
        if self._own is not None and self.ledger.current_id != NO_TARE:
            self._own = self.error = None

    def ask(
        self, frames: int, *, anyway: bool = False, sensor: str, never: str = ""
    ) -> Future[Tare]:
        """Tare with the next frames (0 = the usual number).

        Args:
            frames: How many.
            anyway: Also where the sensor rests farther from its untouched level than it drifts.
            sensor: Its name, for errors.
            never: Why it can never be tared; empty = it can.

        Raises:
            DeviceError: No further frames will come to be averaged.
        """
        future: Future[Tare] = Future()
        collector = TareCollector(frames or self.frames, self._limits)
        with self._lock:
            if self._over or never:
                raise DeviceError(
                    f"{sensor} cannot be tared: {self._over or never}",
                    remedy="tare a live tactile sensor, or ask for a known tare by its id",
                )
            self._requested.append(_AskedTare(collector, future, anyway))
        return future

    def offer(self, frame: ElectrodeFrame) -> list[Tare]:
        """Take a frame; the tares that it has completed, which are in force now."""
        if self._own is None and not self._requested:
            return []
        tares = []
        if self._own is not None:
            tare = self._try(self._own, frame)
            if isinstance(tare, Tare):
                tares.append(tare)
        with self._lock:
            # A tare that nobody waits for any more must not come into force.
            requested = [one for one in self._requested if not one.future.cancelled()]
            self._requested = list(requested)
        for request in requested:
            result = self._try(request.collector, frame, anyway=request.anyway)
            if result is None:
                continue
            if isinstance(result, Tare):
                tares.append(result)
            with self._lock:
                self._requested = [one for one in self._requested if one is not request]
            _answer(request.future, result)
        return tares

    def finish(self) -> None:
        """The recording has ended: no further frame will come."""
        with self._lock:
            self._over = why = "the recording has ended"
            requested, self._requested = self._requested, []
        error = DeviceError(f"not tared: {why}", remedy="tare while the sensor delivers")
        for request in requested:
            _answer(request.future, error)

    def give_up(self, why: str) -> None:
        """The sensor is away: requests fail, and no tare averages frames of before and after."""
        self.touched()  # for all that is known
        with self._lock:
            requested, self._requested = self._requested, []
        if self._own is not None:
            self._own = TareCollector(self.frames, self._limits)
        error = DeviceError(f"not tared: {why}", remedy="tare when the sensor delivers again")
        for request in requested:
            _answer(request.future, error)

    def resume(self, tare: Tare) -> None:
        """A tare of the run before is in force again; none is attempted without a request."""
        self._own = None
        self.ledger.enter(tare)

    def recorded(self, tare: Tare) -> None:
        """A tare of a record is put in force."""
        self.ledger.enter(tare)
        self.counters["tares"] += 1

    def _try(
        self, collector: TareCollector, frame: ElectrodeFrame, *, anyway: bool = False
    ) -> Tare | DeviceError | None:
        try:
            tare = collector.add(frame)
            if tare is not None and not anyway:
                self._check_distance(tare)
        except DeviceError as error:
            # Who asked is told, and the tare in force goes on.
            if collector is self._own or self.ledger.current_id == NO_TARE:
                self.error = error
            self.counters["tares_refused"] += 1
            return error
        if tare is not None:
            self._own = None
            self.error = None
            self.recorded(tare)
        return tare

    def _check_distance(self, tare: Tare) -> None:
        distance = self._distance(tare)
        if distance:
            raise DeviceError(
                f"cannot tare {tare.sensor_serial}: still, but {distance}",
                remedy="take everything off the finger and tare again; if nothing touches it, it "
                "has drifted that far: palpate tare NAME --anyway",
            )


def _answer(future: Future[Tare], result: Tare | DeviceError) -> None:
    if not future.set_running_or_notify_cancel():
        return  # the request timed out and was cancelled
    if isinstance(result, Tare):
        future.set_result(result)
    else:
        future.set_exception(result)
