"""The virtual finger by closed formulas: spheres that press, shear and let go anywhere."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from palpate.errors import ConfigError
from palpate.rigid import shortest_turn
from palpate_gateway.protocols import channels as ch
from palpate_gateway.readings import ElectrodeReading, PoseReading, WrenchReading
from palpate_gateway.virtual.options import BLOCK_FRAMES, UNTOUCHED_FRAMES, Group, VirtualOptions
from palpate_gateway.virtual.physics import (
    INDENTER_RADII_M,
    Contact,
    Unit,
    contact,
    electrode_counts,
    films,
)
from palpate_gateway.virtual.signals import (
    ELECTRODE_NOISE,
    PAC_NOISE,
    SLOW_NOISE,
    WRENCH_SERIAL,
    converted,
    pac,
    slow_channels,
    warmth,
)
from palpate_gateway.virtual.trajectory import Episode, pause, touch

_INDENTER = "sphere_14mm"


class Formula:
    """The closed-formula finger; see ``Model``.

    Args:
        options: The driver's.

    Raises:
        ConfigError: Unit or indenter are none of this model's.
    """

    def __init__(self, options: VirtualOptions) -> None:
        self._options = options
        self._indenter = options.indenter or _INDENTER
        if self._indenter not in INDENTER_RADII_M:
            raise ConfigError(
                f"the formula has no indenter {self._indenter!r}",
                remedy=f"take one of {', '.join(INDENTER_RADII_M)}",
            )
        if isinstance(options.unit, str) or options.unit < 0:
            raise ConfigError(
                f"unit = {options.unit!r} is no number from 0", remedy="number the formula's units"
            )
        self._radius_m = INDENTER_RADII_M[self._indenter]
        self._unit = Unit.number(options.unit)

    @property
    def line(self) -> str:
        """See ``Model``."""
        return f"virtual finger, {self._indenter}"

    @property
    def serial(self) -> str:
        """See ``Model``."""
        return f"VIRTUAL-U{self._options.unit}-S{self._options.seed}"

    def run(self) -> Iterator[list[Group]]:
        """See ``Model``."""
        random = np.random.default_rng([self._options.seed, 2])
        first = 0
        for episode in self._episodes():
            length = max(1, math.ceil(episode.duration_s * self._options.rate_hz - 1e-9))
            for start in range(0, length, BLOCK_FRAMES):
                count = min(BLOCK_FRAMES, length - start)
                yield self._block(episode, start, first + start, count, random)
            first += length

    def _episodes(self) -> Iterator[Episode]:
        options = self._options
        yield pause(max(options.untouched_s, UNTOUCHED_FRAMES / options.rate_hz))
        number = 0
        while not options.episodes or number < options.episodes:
            yield touch(options.seed, number)
            number += 1

    def _block(
        self, episode: Episode, start: int, tick: int, count: int, random: np.random.Generator
    ) -> list[Group]:
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
        pdc, tac, tdc = converted(slow + random.normal(0.0, SLOW_NOISE, slow.shape)).T.tolist()
        torque = np.cross(state.tip, state.force).astype(np.float32)
        force = state.force.astype(np.float32)
        in_contact = (state.depth > 0.0).tolist()
        orientation = shortest_turn(-episode.place.normal)
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
                WrenchReading(ticks[k], times[k], force[k], torque[k], WRENCH_SERIAL),
                PoseReading(
                    ticks[k],
                    times[k],
                    self._indenter,
                    state.tip[k],
                    orientation,
                    in_contact[k],
                ),
            )
            for k in range(count)
        ]
