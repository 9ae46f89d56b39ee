"""The virtual finger: a deterministic BioTac with ground truth, for work without hardware.

Same options, same counts, on any host and at any pace. It yields what an experiment yields:
electrodes, the wrench on the finger, and the pose of the indenter. The first second (at least 50
frames) is untouched, so that a tare succeeds.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np
from pydantic import Field

from palpate.gateway import channels as ch
from palpate.gateway.device import Device, DeviceIdentity, DeviceInfo
from palpate.gateway.readings import ElectrodeReading, PoseReading, Reading, WrenchReading
from palpate.gateway.virtual_geometry import pressing
from palpate.gateway.virtual_physics import (
    INDENTER_RADII_M,
    Contact,
    Unit,
    contact,
    electrode_counts,
    films,
)
from palpate.gateway.virtual_signals import (
    ELECTRODE_NOISE,
    PAC_NOISE,
    converted,
    pac,
    slow_channels,
    warmth,
)
from palpate.gateway.virtual_trajectory import Episode, pause, touch
from palpate.protos.config import StrictConfig
from palpate.protos.errors import DeviceTimeout
from palpate.protos.messages import Origin, SensorType

_UNTOUCHED_FRAMES = 50
_BLOCK_FRAMES = 16
"""Frames computed at once: NumPy's cost per call is shared, yet no read stalls for long."""

_RESYNC_S = 1.0
"""A host that lags more than this has slept: the frames meanwhile are lost, not late [s]."""


class VirtualOptions(StrictConfig):
    """Options of the ``virtual`` driver.

    Attributes:
        seed: Of trajectories and noise.
        unit: Number of the finger; fixes its electrics.
        serial: Serial number; empty = made from unit and seed.
        indenter: Sphere that presses.
        rate_hz: Frames per second [Hz].
        realtime: Paced by the host's clock, as hardware is; False = as fast as it is read.
        untouched_s: Time before the first touch [s]; at least 50 frames.
        episodes: Touches, then the source ends; 0 = endless.
        frames: Frames, then the source ends; 0 = endless.
        duration_s: Device time, then the source ends [s]; 0 = endless.
    """

    seed: int = Field(default=0, ge=0)
    unit: int = Field(default=1, ge=0)
    serial: str = ""
    indenter: Literal["sphere_3-5mm", "sphere_7mm", "sphere_14mm"] = "sphere_14mm"
    rate_hz: float = Field(default=100.0, ge=1.0, le=2000.0)
    realtime: bool = True
    untouched_s: float = Field(default=1.0, ge=0.0)
    episodes: int = Field(default=0, ge=0)
    frames: int = Field(default=0, ge=0)
    duration_s: float = Field(default=0.0, ge=0.0)


class Virtual(Device):
    """A virtual BioTac with ground truth."""

    options_class = VirtualOptions

    def __init__(self, options: VirtualOptions) -> None:
        super().__init__(
            DeviceInfo(
                driver="virtual",
                sensor_type=SensorType.BIOTAC,
                model=f"virtual finger, {options.indenter}",
                rate_hz=options.rate_hz,
                live=options.realtime,
                finite=bool(options.episodes or options.frames or options.duration_s),
                origin=Origin.SIMULATED,
            )
        )
        self._options = options
        self._radius_m = INDENTER_RADII_M[options.indenter]
        self._unit = Unit.number(options.unit)
        self._counters = {"frames": 0, "samples": 0, "missing_frames": 0}
        self._ready: deque[tuple[Reading, ...]] = deque()
        self._blocks: Iterator[list[tuple[Reading, ...]]] = iter(())
        self._begun_s = 0.0
        self._delivered = 0
        self._skipped = 0
        self._missed = 0

    @property
    def counters(self) -> Mapping[str, int]:
        """Frames, slots in them, and frames lost because the host slept."""
        return dict(self._counters)

    def _open(self) -> DeviceIdentity:
        options = self._options
        self._counters = dict.fromkeys(self._counters, 0)
        self._ready.clear()
        self._blocks = self._make_blocks()
        self._delivered = self._skipped = self._missed = 0
        self._begun_s = time.monotonic()
        return DeviceIdentity(
            serial=options.serial or f"VIRTUAL-U{options.unit}-S{options.seed}",
            slot_period_s=1.0 / (options.rate_hz * ch.SLOTS_PER_FRAME),
        )

    def _close(self) -> None:
        self._ready.clear()
        self._blocks = iter(())

    def _read(self, timeout_s: float) -> list[Reading]:
        # The next block is computed while there is time to wait, not when its frame is due.
        if not self._ready:
            self._ready.extend(next(self._blocks, ()))
        if not self._ready:
            return []
        if not self._options.realtime:
            readings = [reading for group in self._ready for reading in group]
            self._count(len(self._ready))
            self._ready.clear()
            return readings
        self._wait(timeout_s)
        group = self._ready.popleft()
        self._count(1)
        return [self._shifted(reading) for reading in group] if self._skipped else list(group)

    def _wait(self, timeout_s: float) -> None:
        """Sleep until the next frame is due; deadlines are absolute, so errors do not add up."""
        due_s = self._begun_s + (self._delivered + self._skipped) / self._options.rate_hz
        wait_s = due_s - time.monotonic()
        self._missed = 0
        if wait_s > timeout_s:
            time.sleep(max(timeout_s, 0.0))
            raise DeviceTimeout(
                f"the virtual finger has no frame within {timeout_s:g} s",
                remedy=f"wait longer than its period of {1.0 / self._options.rate_hz:g} s",
            )
        if wait_s > 0.0:
            time.sleep(wait_s)
        elif wait_s < -_RESYNC_S:
            self._missed = int(-wait_s * self._options.rate_hz)
            self._skipped += self._missed
            self._counters["missing_frames"] += self._missed

    def _count(self, frames: int) -> None:
        self._delivered += frames
        self._counters["frames"] += frames
        self._counters["samples"] += frames * ch.SLOTS_PER_FRAME

    def _shifted(self, reading: Reading) -> Reading:
        """The reading as a device gives it that went on while the host slept."""
        tick = self._delivered - 1 + self._skipped
        time_s = tick / self._options.rate_hz
        if isinstance(reading, ElectrodeReading):
            return ElectrodeReading(
                tick,
                time_s,
                self._missed,
                reading.electrodes,
                reading.pdc,
                reading.pac,
                reading.tac,
                reading.tdc,
                reading.validity,
            )
        if isinstance(reading, WrenchReading):
            return WrenchReading(tick, time_s, reading.force, reading.torque, reading.serial)
        if isinstance(reading, PoseReading):
            return PoseReading(
                tick,
                time_s,
                reading.indenter,
                reading.position,
                reading.orientation,
                reading.in_contact,
            )
        return reading

    def _episodes(self) -> Iterator[Episode]:
        options = self._options
        yield pause(max(options.untouched_s, _UNTOUCHED_FRAMES / options.rate_hz))
        number = 0
        while not options.episodes or number < options.episodes:
            yield touch(options.seed, number)
            number += 1

    def _frame_limit(self) -> float:
        options = self._options
        by_time = round(options.duration_s * options.rate_hz) if options.duration_s else math.inf
        return min(options.frames or math.inf, by_time)

    def _make_blocks(self) -> Iterator[list[tuple[Reading, ...]]]:
        random = np.random.default_rng([self._options.seed, 2])
        limit = self._frame_limit()
        first = 0
        for episode in self._episodes():
            length = max(1, math.ceil(episode.duration_s * self._options.rate_hz - 1e-9))
            for start in range(0, length, _BLOCK_FRAMES):
                count = min(_BLOCK_FRAMES, length - start)
                block = self._block(episode, start, first + start, count, random)
                if first + start + count >= limit:
                    yield block[: int(limit) - first - start]
                    return
                yield block
            first += length

    def _block(
        self, episode: Episode, start: int, tick: int, count: int, random: np.random.Generator
    ) -> list[tuple[Reading, ...]]:
        """Frames ``start`` to ``start + count - 1`` of an episode, the first of which is ``tick``.

        One more instant than frames, because PAC follows the pressure until the next frame.
        """
        rate_hz = self._options.rate_hz
        ahead = contact(episode, np.arange(start, start + count + 2) / rate_hz, self._radius_m)
        state = Contact(
            ahead.depth[:count],
            ahead.tip[:count],
            ahead.normal_force[:count],
            ahead.traction[:count],
            ahead.force[:count],
            ahead.pressure[:count],
        )
        times_s = np.arange(tick, tick + count) / rate_hz
        drift = 1.0 + 0.004 * warmth(times_s) + 0.001 * np.sin(times_s * (2.0 * math.pi / 180.0))

        clean = electrode_counts(films(episode, state, self._radius_m), self._unit, drift)
        electrodes = converted(clean + random.normal(0.0, ELECTRODE_NOISE, clean.shape))
        moving = pac(ahead.pressure, rate_hz)
        dynamic = converted(moving + random.normal(0.0, PAC_NOISE, moving.shape))
        slow = slow_channels(state.pressure, self._unit.pdc_rest, times_s)
        pdc, tac, tdc = converted(slow + random.normal(0.0, 0.5, slow.shape)).T.tolist()
        torque = np.cross(state.tip, state.force).astype(np.float32)
        force = state.force.astype(np.float32)
        in_contact = (state.depth > 0.0).tolist()
        orientation = pressing(episode.place.normal)
        ticks, times = range(tick, tick + count), times_s.tolist()
        return [
            (
                ElectrodeReading(
                    ticks[k],
                    times[k],
                    0,
                    electrodes[k],
                    pdc[k],
                    dynamic[k],
                    tac[k],
                    tdc[k],
                    ch.ALL_VALID,
                ),
                WrenchReading(ticks[k], times[k], force[k], torque[k], "VIRTUAL-FT"),
                PoseReading(
                    ticks[k],
                    times[k],
                    self._options.indenter,
                    state.tip[k],
                    orientation,
                    in_contact[k],
                ),
            )
            for k in range(count)
        ]
