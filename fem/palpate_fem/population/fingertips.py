"""Fingertips drawn from priors: skins, fills and friction as they differ from sensor to sensor.

Where a specimen's electrodes differ the force of a touch stays the same
(`palpate_fem.population.members`); skin and fill change both, and what an electrode says of a
force.
"""

from __future__ import annotations

import math

import numpy as np

from palpate.errors import ConfigError
from palpate_fem.config import FingertipParameters

# Pairs are the ends of uniform priors.
SKIN_THICKNESS_M = (1.4e-3, 1.8e-3)  # public mesh 1.57 to 1.62 mm; the paper searches 1 to 2 mm
SHEAR_MODULUS_PA = (2.0e5, 4.0e5)  # uniform in its logarithm; the paper's fit 280 kPa
# The unpressurised skin holds 0.40 ml beside the core; the public skin bulges to 15.1 mm by 0.47 ml
# more, ours to 14.8 mm by 0.35 ml more.
FLUID_VOLUME_M3 = (0.50e-6, 0.75e-6)
FRICTION = (0.15, 0.5)  # the paper's fit 0.186; a public model of the same finger 0.78


def draw_fingertips(count: int, seed: int) -> tuple[FingertipParameters, ...]:
    """Draw fingertips.

    The first ones of a larger draw are those of a smaller one.

    Args:
        count: How many.
        seed: The same seed gives the same fingertips.

    Raises:
        ConfigError: Fewer than one.
    """
    if count < 1:
        raise ConfigError(f"{count} fingertips", remedy="draw at least one")
    return tuple(_drawn(seed, number) for number in range(1, count + 1))


def _drawn(seed: int, number: int) -> FingertipParameters:
    # Specimens are drawn with the key [seed, number]: with the same one a fingertip's skin would
    # tell where its specimen's core sits.
    rng = np.random.default_rng([seed, number, 1])
    return FingertipParameters(
        skin_thickness_m=rng.uniform(*SKIN_THICKNESS_M),
        shear_modulus_pa=math.exp(rng.uniform(*np.log(SHEAR_MODULUS_PA))),
        fluid_volume_m3=rng.uniform(*FLUID_VOLUME_M3),
        friction_coefficient=rng.uniform(*FRICTION),
    )
