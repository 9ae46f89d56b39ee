"""Indenters as unions of rounded primitives."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from palpate_fem.arrays import Floats


class PrimitiveKind(IntEnum):
    """Kinds of primitives; the kernels use the numbers."""

    BOX = 0  # |x - c| <= (a, b, c) per axis
    REVOLVED = 1  # a <= distance from the axis <= b, c <= along the axis <= d


@dataclass(frozen=True, slots=True)
class Primitive:
    """A box or a solid of revolution, grown by a rounding radius.

    A sphere is REVOLVED with all sizes 0 and rounding R; a rounded cylinder has a = 0; a ring
    a > 0, and a rounding below a.

    Attributes:
        kind: Box or solid of revolution.
        centre: Centre, or a point on the axis that is the zero of c and d [m], indenter frame.
        axis: Axis of revolution, 0..2 for x, y, z; ignored for a box.
        sizes: BOX half lengths (hx, hy, hz, 0); REVOLVED (radius from, to, along from, to) [m].
        rounding: Distance by which it is grown; its edges get this radius [m].
    """

    kind: PrimitiveKind
    centre: tuple[float, float, float]
    sizes: tuple[float, float, float, float]
    rounding: float
    axis: int = 2


@dataclass(frozen=True, slots=True)
class Indenter:
    """A named indenter.

    Its frame: tip at the origin, the body towards -z, so it presses along +z. With the identity
    orientation in the sensor frame it presses the ventral pad straight towards the nail, and x runs
    along the finger.

    Attributes:
        name: Name of the catalogue.
        primitives: Its parts, at least one.
        fillet_m: Radius of the concave creases between parts [m]; 0 leaves them sharp. A sharp
            crease has two normals, between which contact need not come to rest.
    """

    name: str
    primitives: tuple[Primitive, ...]
    fillet_m: float = 0.0

    def packed(self) -> Floats:
        """Rows for the kernels, (P, 11): kind, axis, centre (3), sizes (4), rounding, fillet."""
        return np.array(
            [
                [float(p.kind), float(p.axis), *p.centre, *p.sizes, p.rounding, self.fillet_m]
                for p in self.primitives
            ],
            np.float64,
        ).reshape(-1, 11)
