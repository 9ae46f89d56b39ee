"""The formula: a virtual finger that spheres indent, shear and leave at random places.

Its physics is in ``formula_physics``; this module draws the indentations and makes readings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from palpate.errors import ConfigError
from palpate.messages import PAC_SAMPLES
from palpate.rigid import shortest_turn
from palpate_gateway.virtual.formula_physics import (
    INDENTER_RADII_M,
    FormulaContact,
    FormulaSpecimen,
    Touch,
    contact,
    electrode_counts,
    films,
    pause,
    random_touch,
)
from palpate_gateway.virtual.model import (
    BLOCK_FRAMES,
    UNTOUCHED_FRAMES,
    Array,
    Group,
    SampledFrames,
    VirtualOptions,
    groups_of,
)
from palpate_gateway.virtual.sensor import (
    PAC_HIGH_PASS_S,
    PAC_NOISE,
    PAC_PA_PER_COUNT,
    PDC_PA_PER_COUNT,
    SLOW_NOISE,
    converted,
)

_INDENTER = "sphere_14mm"

_ELECTRODE_NOISE = 0.5
"""Settled sensor at 100 Hz: 0.3-0.6 counts, sd (learning reference 4.5)."""

_PAC_REST = 2040.0
_TAC_REST = 2050.0
_TDC_REST = 1900.0
_TDC_WARM_UP = 60.0
_WARM_UP_S = 600.0


class FormulaModel:
    """The finger by closed formulas; see ``FingerModel``.

    Raises:
        ConfigError: The formula has no such specimen or indenter.
    """

    def __init__(self, options: VirtualOptions) -> None:
        self._options = options
        self._indenter = options.indenter or _INDENTER
        if self._indenter not in INDENTER_RADII_M:
            raise ConfigError(
                f"the formula has no indenter {self._indenter!r}",
                remedy=f"choose one of {', '.join(INDENTER_RADII_M)}",
            )
        if isinstance(options.unit, str) or options.unit < 0:
            raise ConfigError(
                f"unit = {options.unit!r} is not a number from 0",
                remedy="the formula's specimens are numbered: give a number",
            )
        self._radius_m = INDENTER_RADII_M[self._indenter]
        self._specimen = FormulaSpecimen.number(options.unit)
        self.line = f"virtual finger, {self._indenter}"
        self.serial = f"VIRTUAL-U{options.unit}-S{options.seed}"

    def run(self) -> Iterator[list[Group]]:
        """See ``FingerModel``."""
        random = np.random.default_rng([self._options.seed, 2])
        first = 0
        for touch in self._touches():
            length = max(1, math.ceil(touch.duration_s * self._options.rate_hz - 1e-9))
            for start in range(0, length, BLOCK_FRAMES):
                count = min(BLOCK_FRAMES, length - start)
                yield self._block(touch, start, first + start, count, random)
            first += length

    def _touches(self) -> Iterator[Touch]:
        options = self._options
        yield pause(max(options.untouched_s, UNTOUCHED_FRAMES / options.rate_hz))
        number = 0
        while not options.episodes or number < options.episodes:
            yield random_touch(options.seed, number)
            number += 1

    def _block(
        self, touch: Touch, start: int, tick: int, count: int, random: np.random.Generator
    ) -> list[Group]:
        """``count`` frames of an indentation from frame ``start`` on, which has tick ``tick``.

        The contact is computed for two more instants, because PAC follows the rate of pressure up
        to the frame after the block.
        """
        rate_hz = self._options.rate_hz
        ahead = contact(touch, np.arange(start, start + count + 2) / rate_hz, self._radius_m)
        state = FormulaContact(*(part[:count] for part in ahead))
        times_s = np.arange(tick, tick + count) / rate_hz
        drift = 1.0 + 0.004 * _warmth(times_s) + 0.001 * np.sin(times_s * (2.0 * math.pi / 180.0))

        clean = electrode_counts(films(touch, state, self._radius_m), self._specimen, drift)
        electrodes = converted(clean + random.normal(0.0, _ELECTRODE_NOISE, clean.shape))
        moving = _pac(ahead.pressure, rate_hz)
        dynamic = converted(moving + random.normal(0.0, PAC_NOISE, moving.shape))
        slow = _slow_channels(state.pressure, self._specimen.pdc_rest, times_s)
        slow_counts = converted(slow + random.normal(0.0, SLOW_NOISE, slow.shape))
        torque = np.cross(state.tip, state.force).astype(np.float32)
        force = state.force.astype(np.float32)
        in_contact = (state.depth > 0.0).tolist()
        orientation = shortest_turn(-touch.place.normal)
        return groups_of(
            tick,
            rate_hz,
            SampledFrames(electrodes, dynamic, slow_counts),
            wrench=(force, torque),
            indenter=self._indenter,
            poses=(state.tip, [orientation] * count),
            in_contact=in_contact,
        )


def _warmth(time_s: Array) -> Array:
    """Share of the warm-up since power-on that is complete, 0 to 1."""
    return 1.0 - np.exp(-time_s / _WARM_UP_S)


def _pac(pressure: Array, rate_hz: float) -> Array:
    """Noise-free PAC [counts], shape ``(N, 22)``, from the pressure at N + 2 frame starts [Pa]."""
    speed = np.diff(pressure) * (rate_hz * PAC_HIGH_PASS_S / PAC_PA_PER_COUNT)
    share = np.arange(PAC_SAMPLES) / PAC_SAMPLES
    return _PAC_REST + speed[:-1, None] * (1.0 - share) + speed[1:, None] * share


def _slow_channels(pressure: Array, pdc_rest: float, time_s: Array) -> Array:
    """Noise-free PDC, TAC, TDC [counts], shape ``(N, 3)``."""
    return np.stack(
        [
            pdc_rest + pressure / PDC_PA_PER_COUNT,
            np.full(len(time_s), _TAC_REST),
            _TDC_REST + _TDC_WARM_UP * _warmth(time_s),
        ],
        axis=1,
    )
