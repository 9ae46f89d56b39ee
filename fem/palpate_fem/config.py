"""Parameters of the fingertip and of its solution, with units and limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

from palpate.errors import ConfigError

EDGE_M = 0.47e-3
"""Edge of the parametric mesh's elements on the pad, by default [m]: 31,581 unknowns."""

# Range of each parameter for which the model is made; the paper's optimisation bounds (Table
# "Optimization parameters") lie inside. Outside, meshes fold or the unit of measure is wrong.
LIMITS = {
    "skin_thickness_m": (0.5e-3, 3.0e-3),
    "shear_modulus_pa": (1e4, 1e7),
    "friction_coefficient": (0.0, 2.0),
    "total_thickness_m": (13.7e-3, 16.0e-3),
    "fluid_volume_m3": (0.0, 2.0e-6),
    "bulk_ratio": (1e1, 1e7),
    "strain_stiffening": (1e-6, 0.1),
}

OPTIONAL = ("fluid_volume_m3", "strain_stiffening")
"""Parameters that may be None."""


@dataclass(frozen=True, slots=True)
class FingertipParameters:
    """Physical parameters of one fingertip; the defaults are the paper's optimum.

    Attributes:
        skin_thickness_m: Thickness t_s of the unpressurised skin [m].
        shear_modulus_pa: Shear modulus mu of the skin [Pa], of small strains if it stiffens.
        friction_coefficient: Coulomb coefficient between indenter and skin.
        total_thickness_m: Dorso-ventral extent of the pressurised skin [m]; the fluid is filled in
            until it is reached (paper, "Finite element model configuration").
        fluid_volume_m3: Fluid between skin and core [m^3]; None = what total_thickness_m needs.
        bulk_ratio: Bulk modulus over mu; large enough that its value does not matter.
        strain_stiffening: By how much of mu the skin has become stiffer where m = I1 - 3 is 1; it
            grows with m^2 (Yeoh 1993 with C2 = 0: 3 C3 / C1). None = it does not: neo-Hooke, as the
            paper has it. Soft silicones have 0.004 and more.

    Raises:
        ConfigError: A value is not finite or out of range; names it and its limits.
    """

    skin_thickness_m: float = 1.57e-3
    shear_modulus_pa: float = 2.80e5
    friction_coefficient: float = 0.186
    total_thickness_m: float = 15.1e-3
    fluid_volume_m3: float | None = None
    bulk_ratio: float = 1e4
    strain_stiffening: float | None = None

    def __post_init__(self) -> None:
        for name, (low, high) in LIMITS.items():
            value = getattr(self, name)
            if value is None and name in OPTIONAL:
                continue
            if value is None or not math.isfinite(value) or not low <= value <= high:
                raise ConfigError(
                    f"{name} = {value} is not within [{low:g}, {high:g}]",
                    remedy="stay within these limits; they are in SI units here, in mm, kPa or ml "
                    "as options",
                )
