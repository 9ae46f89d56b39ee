"""Wettels 2008 (BioRob): a strip of skin over a fluid channel, whose cross-section it narrows.

Plane stress: one element wide, with a free side. The paper compares two channels and says how they
narrow, without numbers; a strip clamped at the channel's walls has a closed form (Timoshenko).
"""

from __future__ import annotations

import numpy as np
import pytest
from tests.crosscheck import ours
from tests.crosscheck.hexes import block
from tests.crosscheck.problem import Floats, Problem

SKIN_M, SIDE_M = 1.5e-3, 0.2e-3
FLUID_M = 1.0e-3  # depth of the channel
SHEAR_PA, BULK_PA = 0.2e6, 2e9
PRESSURE_PA = 10.0  # small, so that the strip is linear
WIDE_M, NARROW_M = 12e-3, 6e-3
THROUGH = 8


def strip(width_m: float) -> Problem:
    """A strip over a channel, pressed evenly from above and clamped at the channel's walls."""
    along = round(width_m / SKIN_M * THROUGH)
    nodes, hexes = block(
        np.linspace(0.0, width_m, along + 1),
        [0.0, SIDE_M],
        np.linspace(0.0, SKIN_M, THROUGH + 1),
    )
    held = np.zeros(nodes.shape, bool)
    held[nodes[:, 1] == 0.0, 1] = True  # half of a strip
    ends = (nodes[:, 0] == 0.0) | (nodes[:, 0] == width_m)
    held[ends, 0] = held[ends, 2] = True
    weight = np.where(ends, 0.5, 1.0) * (nodes[:, 2] == SKIN_M)
    force = np.zeros(nodes.shape)
    force[:, 2] = -PRESSURE_PA * width_m * SIDE_M * weight / weight.sum()
    return Problem(
        f"strip {width_m}", nodes, hexes, SHEAR_PA, BULK_PA, held, np.zeros(nodes.shape), force
    )


def gap(width_m: float) -> tuple[Floats, Floats]:
    """Place along the channel's width [m] and what the strip takes of its depth there [m]."""
    problem = strip(width_m)
    moved = ours.deform(problem).displacement
    below = np.flatnonzero((problem.nodes[:, 2] == 0.0) & (problem.nodes[:, 1] == 0.0))
    below = below[np.argsort(problem.nodes[below, 0])]
    return problem.nodes[below, 0], -moved[below, 2]


def narrowed_m2(width_m: float) -> float:
    """What the cross-section loses by Timoshenko's beam, clamped at both ends [m^2]."""
    young = 3.0 * SHEAR_PA
    bending = PRESSURE_PA * width_m**5 / (720.0 * young * SKIN_M**3 / 12.0)
    shear = PRESSURE_PA * width_m**3 / (12.0 * 5.0 / 6.0 * SHEAR_PA * SKIN_M)
    return bending + shear


@pytest.mark.parametrize(("width_m", "short_of_beam"), [(WIDE_M, 0.05), (NARROW_M, 0.1)])
def test_the_cross_section_narrows_as_a_beam_says(width_m: float, short_of_beam: float) -> None:
    """A short strip with clamped end faces is stiffer than a beam."""
    place, taken = gap(width_m)
    assert (taken >= -1e-12).all()
    assert np.argmax(taken) == len(place) // 2
    share = np.trapezoid(taken, place) / narrowed_m2(width_m)
    assert 1.0 - short_of_beam < share < 1.0


def test_the_wide_channel_s_resistance_rises_more() -> None:
    """Per unit of length a channel conducts as its cross-section: what an electrode senses."""
    share = []
    for width_m in (WIDE_M, NARROW_M):
        place, taken = gap(width_m)
        share.append(np.trapezoid(taken, place) / (FLUID_M * width_m))
    wide, narrow = share
    assert 0.0 < narrow < wide < 0.05
    # Between the fourth power of the width, in bending, and the second, in shear.
    assert 2.0**2 < wide / narrow < 2.0**4
