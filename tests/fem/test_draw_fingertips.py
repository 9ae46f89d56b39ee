"""Fingertips drawn from priors: reproducible, within the model's range, each another one."""

from __future__ import annotations

from itertools import pairwise

import pytest

from palpate.errors import ConfigError
from palpate_fem.config import LIMITS
from palpate_fem.population.fingertips import draw_fingertips

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


def test_none_are_refused() -> None:
    with pytest.raises(ConfigError, match="0 fingertips"):
        draw_fingertips(0, 1)
