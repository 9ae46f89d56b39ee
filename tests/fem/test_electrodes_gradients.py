"""Gradients of counts by positions, gaps, pressures and forces, in all regimes of the film."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate_fem.electrodes.gap import Gap
from palpate_fem.electrodes.model import ElectrodeModel
from palpate_fem.electrodes.specimen import SENSING, SpecimenParameters
from palpate_fem.mesh.parametric import biotac

Floats = NDArray[np.float64]

E18 = 17
WITHIN = 1e-5
"""Relative; the differences below are good to 1e-6 where no normal changes its triangle."""

OPEN_M, TOUCHING_M, PRESSED_M = 0.9e-3, 1.355e-3, 1.8e-3
"""Depths of a dent under E18, where the film is 1.35 mm thick."""


@pytest.fixture(scope="module")
def sensor() -> ElectrodeModel:
    return ElectrodeModel(biotac(edge_m=0.6e-3, layers=1))


def fourth_order(function: Callable[[float], float], step: float) -> float:
    near, far = (function(k * step) - function(-k * step) for k in (1, 2))
    return (8 * near - far) / (12 * step)


def state(sensor: ElectrodeModel, depth_m: float, peak_pa: float) -> tuple[Floats, Floats]:
    """A dented skin in a general position, and forces of the core on it, not quite normal."""
    rng = np.random.default_rng(2)
    nodes = sensor.geometry.mesh.nodes
    away = np.linalg.norm(nodes - [ELECTRODE_POSITIONS[E18, 0], 0.3e-3, -6.7e-3], axis=1)
    push = depth_m * np.exp(-((away / 3e-3) ** 2))
    position = nodes + push[:, None] * np.array([0.0, 0.0, 1.0])
    inner = np.zeros(len(nodes), bool)
    inner[sensor.finder.faces.ravel()] = True
    # The core stops the skin; its facets then cut into the core by up to 10 um.
    low = np.flatnonzero(inner & (away < 4e-3))
    for _ in range(4):
        distance, outwards, _ = sensor.geometry.core.grid.evaluate(position[low])
        position[low] -= np.minimum(distance, 0.0)[:, None] * outwards
    position = position + 1e-6 * rng.normal(size=position.shape)
    touched = np.flatnonzero(inner & (away < 2.2e-3))
    force = np.zeros_like(nodes)
    force[touched, 2] = -peak_pa * 0.3e-6 * (1 - (away[touched] / 2.2e-3) ** 2)
    force[touched] += 0.2 * force[touched, 2:] * rng.normal(size=(len(touched), 3))
    return position, force


REGIMES: dict[str, tuple[float, float, dict[str, Any]]] = {
    "open": (OPEN_M, 0.0, {}),
    "touching": (TOUCHING_M, 3e3, {}),
    "squeezed": (PRESSED_M, 3e4, {}),
    "squeezed with another exponent": (PRESSED_M, 3e5, {"squeeze_exponent": 0.6}),
    "on the floor": (PRESSED_M, 3e7, {}),
    "almost no floor": (PRESSED_M, 1e6, {"floor_m": 0.5e-6, "asperity_m": 40e-6}),
}


@pytest.mark.parametrize("regime", REGIMES)
def test_gradients_by_positions_and_forces(sensor: ElectrodeModel, regime: str) -> None:
    depth, peak, changes = REGIMES[regime]
    sensor = sensor.with_specimen(replace(SpecimenParameters(), **changes))
    position, force = state(sensor, depth, peak)
    count = len(position)
    weight = np.random.default_rng(3).normal(size=SENSING)
    motion = np.sin(300 * position[:, [1, 2, 0]])
    change = np.where(force == 0, 0.0, force * np.cos(500 * position[:, [2, 0, 1]]))

    def value(moved: float, pressed: float) -> float:
        response = sensor.respond(position + moved * motion, force + pressed * change)
        return float(weight @ response.counts)

    response = sensor.respond(position, force)
    by_position = (response.to_skin(weight, count) * motion).sum()
    assert by_position == pytest.approx(fourth_order(lambda s: value(s, 0.0), 4e-9), rel=WITHIN)
    by_force = (response.to_core_force(weight, count) * change).sum()
    if peak:
        assert by_force == pytest.approx(fourth_order(lambda s: value(0.0, s), 1e-3), rel=WITHIN)
        # Both at once, as the mechanics change them.
        both = fourth_order(lambda s: value(s, s * 1e5), 4e-9)
        assert by_position + 1e5 * by_force == pytest.approx(both, rel=WITHIN)
    else:
        assert by_force == 0


@pytest.mark.parametrize("regime", REGIMES)
def test_gradients_by_gaps_and_pressures(sensor: ElectrodeModel, regime: str) -> None:
    depth, peak, changes = REGIMES[regime]
    sensor = sensor.with_specimen(replace(SpecimenParameters(), **changes))
    gap = sensor.finder.measure(*state(sensor, depth, peak))
    response = sensor.of_gap(gap)
    weight = np.random.default_rng(3).normal(size=SENSING)
    wave = np.sin(1e3 * sensor.film.nodes[:, 0])

    def value(changed: Gap) -> float:
        return float(weight @ sensor.of_gap(changed).counts)

    by_gap = weight @ response.gradient_gap() @ wave
    differences = fourth_order(lambda s: value(replace(gap, gap=gap.gap + s * wave)), 1e-8)
    assert by_gap == pytest.approx(differences, rel=WITHIN)
    way = gap.pressure * wave
    by_pressure = weight @ response.gradient_pressure() @ way
    # On the floor counts change so little that smaller steps drown in rounding on some processors.
    differences = fourth_order(lambda s: value(replace(gap, pressure=gap.pressure + s * way)), 1e-2)
    assert by_pressure == pytest.approx(differences, rel=WITHIN)


def test_the_pressure_is_a_part_of_the_gradient_by_positions(sensor: ElectrodeModel) -> None:
    """The same forces act on an area that moves; where the gap is closed, that is most of it."""
    position, force = state(sensor, PRESSED_M, 3e4)
    response = sensor.respond(position, force)
    weight = np.zeros(SENSING)
    weight[E18] = 1.0
    whole = response.to_skin(weight, len(position))
    held = response.gap.to_skin(response.gradient_gap()[E18], len(position))
    contact = response.gap.contact
    assert contact is not None
    pressed = contact.pressure > 0.7 * contact.pressure.max()
    part, all_of_it = (np.linalg.norm(g, axis=1)[pressed] for g in (held, whole))
    assert (part < 0.1 * all_of_it).sum() >= 3
    without = sensor.respond(position)
    np.testing.assert_array_equal(without.to_core_force(weight, len(position)), 0.0)


def test_pressure_balances_the_force(sensor: ElectrodeModel) -> None:
    """The pressure over the surface is the core's whole force along the normals of the nodes."""
    position, force = state(sensor, PRESSED_M, 3e4)
    force[:, :2] = 0.0
    contact = sensor.respond(position, force).gap.contact
    assert contact is not None
    total = (contact.pressure[:, None] * contact.area).sum(axis=0)
    assert total[2] == pytest.approx(force[:, 2].sum(), rel=0.05)
