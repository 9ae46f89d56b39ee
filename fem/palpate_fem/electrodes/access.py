"""How current gets from an electrode into a film that is not thin beside it.

The film's potential lives on the core's surface; what a disc's current meets on its way into the
full height of the film stands in a resistance per area zeta(h) / sigma in front of it. The learning
notes take zeta = h / 2. That is too much for thin films, and it grows without limit, so that *less*
fluid over an electrode would lower its impedance: counts would rise under a fingertip pressed from
2 mm of fluid to 1, which no removal of a conductor can do (Rayleigh's monotonicity), and no real
sensor does. Here zeta is what makes the film's model of one disc (radius a, insulated ground and
roof) give exactly the resistance of the three-dimensional conductor, which was solved by finite
volumes for 0.05 a < h < 3 a; below, the current's edge of a half plane gives (2 ln 2 / pi)^2 h
= 0.195 h. The formula follows those values within 3 % (docs/adr/0016).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SHARE, TURN, EXPONENT = 0.2035, 4.56, 2.113
"""zeta / a = SHARE eta / (1 + (eta / TURN)^EXPONENT), eta = h / a: fitted for 0.05 < eta < 3."""


def access_length(film: Floats, radius_m: float) -> tuple[Floats, Floats]:
    """Access resistance of a disc times conductivity and area, and how it goes with the film.

    Args:
        film: Thickness h over the disc [m], shape (...), positive.
        radius_m: Of the disc [m].

    Returns:
        zeta [m] and d zeta / d h, both of the film's shape.
    """
    eta = film / radius_m
    bend = (eta / TURN) ** EXPONENT
    zeta = SHARE * film / (1 + bend)
    slope = SHARE * (1 + (1 - EXPONENT) * bend) / (1 + bend) ** 2
    return np.asarray(zeta), np.asarray(slope)
