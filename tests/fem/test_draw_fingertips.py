"""Fingertips drawn from priors: reproducible, within the model's range, each another one."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from palpate.errors import ConfigError
from palpate_fem.config import LIMITS
from palpate_fem.population.fingertips import draw_fingertips
from palpate_fem.population.members import draw_members

DRAWN = ("skin_thickness_m", "shear_modulus_pa", "fluid_volume_m3", "friction_coefficient")


def test_a_smaller_draw_is_the_beginning_of_a_larger_one() -> None:
    assert draw_fingertips(9, 4)[:3] == draw_fingertips(3, 4)
    assert draw_fingertips(3, 5) != draw_fingertips(3, 4)


@pytest.mark.parametrize("name", DRAWN)
def test_values_spread_over_a_range_that_the_model_is_made_for(name: str) -> None:
    values = sorted(getattr(tip, name) for tip in draw_fingertips(200, 0))
    low, high = LIMITS[name]
    assert low < values[0] < 0.85 * values[-1] < 0.85 * high
    assert all(one < other for one, other in pairwise(values))


@pytest.mark.parametrize("name", DRAWN)
def test_specimens_of_the_same_seed_tell_nothing_of_the_fingertips(name: str) -> None:
    """Where each fingertip has one specimen of the same seed, as `data generate` may be told."""
    tips = [getattr(tip, name) for tip in draw_fingertips(200, 5)]
    specimens = [member.specimen for member in draw_members(200, 5)]
    for told in (
        *([one.core_offset_m[axis] for one in specimens] for axis in range(3)),
        [one.sigma_s_m for one in specimens],
        [one.noise_counts for one in specimens],
    ):
        assert abs(np.corrcoef(tips, told)[0, 1]) < 0.25


def test_none_are_refused() -> None:
    with pytest.raises(ConfigError, match="0 fingertips"):
        draw_fingertips(0, 1)
