"""The virtual finger: a deterministic BioTac with ground truth, for work without hardware.

The same options give the same counts, at any pace. It yields the readings of an experiment:
electrodes, the wrench on the finger, the pose of the indenter and, from a tape, the displacement of
the skin. The first second (at least 50 frames) is untouched, so that a tare succeeds. The readings
come from a model (``virtual.tape``, ``virtual.formula``); this module paces them, ends them, and
applies the faults.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import islice

import numpy as np

from palpate.errors import ConfigError, DeviceLost, DeviceTimeout
from palpate.messages import COUNTS_MAX, Origin, SensorType
from palpate_gateway.device import Device, DeviceIdentity, DeviceInfo
from palpate_gateway.protocols import channels as ch
from palpate_gateway.readings import ElectrodeReading, Reading, RecordedMessage
from palpate_gateway.virtual.faults import FaultPlan
from palpate_gateway.virtual.formula import FormulaModel
from palpate_gateway.virtual.model import FingerModel, Group, VirtualOptions
from palpate_gateway.virtual.tape import TapeModel, find_tape

_RESYNC_S = 1.0
"""A host that lags more has slept; the frames in that time are lost, not late [s]."""

_EVENTS = ("frames", "samples", "missing_frames", "saturated_samples")


def make_model(options: VirtualOptions) -> FingerModel:
    """The model that the options choose.

    Raises:
        ConfigError: There is no such tape, specimen, trajectory or indenter, or options of one
            model come with the other.
        DatasetError: The tape is damaged.
    """
    path = None if options.model == "formula" else find_tape(options.tape)
    if path is not None:
        return TapeModel(options, path)
    if options.model == "tape":
        raise ConfigError("no tape ships with this palpate", remedy="name one with the option tape")
    if options.tape or options.trajectories:
        name = "tape" if options.tape else "trajectories"
        raise ConfigError(
            f"option {name!r} is of the model 'tape', and the virtual finger is the formula",
            remedy=f"leave {name!r} out, or give model = 'tape' and a tape",
        )
    return FormulaModel(options)


class VirtualFinger(Device):
    """A virtual BioTac with ground truth.

    After a fault ``restart`` the next opening continues the model's run, with ticks from 0; any
    other opening starts the run again.
    """

    options_class = VirtualOptions

    def __init__(self, options: VirtualOptions) -> None:
        self._model = make_model(options)
        super().__init__(
            DeviceInfo(
                driver="virtual",
                sensor_type=SensorType.BIOTAC,
                model=self._model.line,
                rate_hz=options.rate_hz,
                live=options.realtime,
                finite=bool(options.episodes or options.frames or options.duration_s),
                origin=Origin.SIMULATED,
            )
        )
        self._options = options
        self._groups: Iterator[Group] = iter(())
        self._group: Group | None = None
        self._faults = FaultPlan((), options.rate_hz, options.seed)
        self._events: dict[str, int] = {}
        self._restarted = False
        self._begun_s = self._back_s = 0.0
        # Three numbers: of the next group in the model's run; of the group at which the device's
        # ticks began; and of frames lost because the host slept (the device's clock went on, the
        # model's run waited).
        self._now = self._origin = self._skipped = 0
        self._last_tick = -1

    @property
    def counters(self) -> Mapping[str, int]:
        """Frames, slots in them, lost frames, saturated samples, and frames with faults."""
        return {**self._events, **self._faults.counters}

    def _open(self) -> DeviceIdentity:
        options = self._options
        if self._restarted and time.monotonic() < self._back_s:
            raise self._lost()
        self._events = dict.fromkeys(_EVENTS, 0)
        if self._restarted:
            self._restarted = False
            self._faults.clear_counters()
        else:
            self._faults = FaultPlan(options.faults, options.rate_hz, options.seed)
            blocks = self._model.run()
            self._groups = islice((group for block in blocks for group in block), self._limit())
            self._group = None
            self._now = 0
        self._origin = self._now
        self._skipped = 0
        self._last_tick = -1
        self._begun_s = time.monotonic()
        return DeviceIdentity(
            serial=options.serial or self._model.serial,
            slot_period_s=1.0 / (options.rate_hz * ch.SLOTS_PER_FRAME),
        )

    def _limit(self) -> int | None:
        """Frames until the source ends; None = endless."""
        options = self._options
        by_time = round(options.duration_s * options.rate_hz) if options.duration_s else None
        given = [limit for limit in (options.frames or None, by_time) if limit is not None]
        return min(given, default=None)

    def _close(self) -> None:
        if not self._restarted:
            self._groups = iter(())
            self._group = None

    def _read(self, timeout_s: float) -> list[Reading]:
        if self._restarted:
            raise self._lost()
        options = self._options
        until_s = time.monotonic() + timeout_s
        quiet = 0
        while True:
            # The next frame is computed before the wait, not when it is due.
            if self._group is None:
                self._group = next(self._groups, None)
            if self._group is None:
                return []
            away = self._faults.restart(self._now)
            if away is not None:
                if options.realtime:
                    self._back_s = time.monotonic() + away / options.rate_hz
                self._pass_over(away)
                self._restarted = True
                raise self._lost()
            if options.realtime:
                self._wait(until_s, timeout_s)
            silent = self._faults.silent(self._now)
            readings = [] if silent else self._readings(self._group)
            self._group = None
            self._now += 1
            if readings:
                return readings
            # Without the host's clock, silent frames are what uses up the timeout.
            quiet += 1
            if not options.realtime and quiet >= timeout_s * options.rate_hz - 1e-6:
                raise self._timeout(timeout_s)

    def _wait(self, until_s: float, timeout_s: float) -> None:
        """Sleep until the next frame is due; due times are absolute, so errors do not add up."""
        rate_hz = self._options.rate_hz
        due_s = self._begun_s + (self._now - self._origin + self._skipped) / rate_hz
        now_s = time.monotonic()
        if due_s > until_s:
            time.sleep(max(until_s - now_s, 0.0))
            raise self._timeout(timeout_s)
        if due_s > now_s:
            time.sleep(due_s - now_s)
        elif now_s - due_s > _RESYNC_S:
            # The gap goes into the ticks, so the next frame reports it as missed frames.
            self._skipped += int((now_s - due_s) * rate_hz)

    def _readings(self, group: Group) -> list[Reading]:
        """Readings of a group with faults and in the device's own ticks."""
        shift = self._skipped - self._origin
        tick = self._now + shift
        time_s = tick / self._options.rate_hz
        out: list[Reading] = []
        for reading in self._faults.apply(self._now, group):
            if isinstance(reading, RecordedMessage):
                continue  # no model makes these
            if isinstance(reading, ElectrodeReading):
                missed = tick - self._last_tick - 1
                self._last_tick = tick
                self._count(reading, missed)
                if missed:
                    reading = replace(reading, missed_before=missed)
            out.append(replace(reading, tick=tick, time_s=time_s) if shift else reading)
        return out

    def _count(self, reading: ElectrodeReading, missed: int) -> None:
        events = self._events
        events["frames"] += 1
        events["samples"] += ch.SLOTS_PER_FRAME
        events["missing_frames"] += missed
        for counts in (reading.electrodes, reading.pac):
            # In 12 bits only 0 and 4095, the ends of the converter's range, are multiples of 4095.
            events["saturated_samples"] += int(np.count_nonzero(counts % COUNTS_MAX == 0))

    def _pass_over(self, groups: int) -> None:
        """Skip the groups of the time in which the device is away."""
        for _ in range(groups):
            self._group = next(self._groups, None)
        self._now += groups

    def _lost(self) -> DeviceLost:
        return DeviceLost("the virtual finger has restarted", remedy="open it again")

    def _timeout(self, timeout_s: float) -> DeviceTimeout:
        return DeviceTimeout(
            f"the virtual finger has no frame within {timeout_s:g} s",
            remedy=f"wait longer than its period of {1.0 / self._options.rate_hz:g} s",
        )
