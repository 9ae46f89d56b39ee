"""What a cross-check problem is: a solid of hexahedra, its supports and loads, and its solution.

Everything a code needs is in the arrays, so that two codes solve the same discrete problem and not
only the same continuous one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Bools = NDArray[np.bool_]


def no_faces() -> Ints:
    return np.zeros((0, 4), np.int32)


@dataclass(frozen=True)
class Problem:
    """A quasi-static problem of a nearly incompressible neo-Hookean solid.

    Energy per reference volume: W = mu/2 (J^(-2/3) I1 - 3) + kappa/2 (Jm - 1)^2, where J and I1 are
    taken at the 2x2x2 Gauss points and Jm is the element's mean dilatation, its volume over its
    reference volume (Q1P0). All loads grow together from zero to the values below; the problems are
    elastic, so that the steps do not matter.

    Attributes:
        name: For people and for the file of reference figures.
        nodes: Reference positions, shape (V, 3).
        hexes: Node ids, shape (E, 8): a face counter-clockwise seen from the opposite face's far
            side (0-3), then the opposite face in the same order (4-7); positive volume.
        shear_modulus_pa: mu.
        bulk_modulus_pa: kappa.
        held: Displacement components that are prescribed, shape (V, 3).
        displacement: Their final values, shape (V, 3); zero elsewhere.
        pressure_faces: Faces under follower pressure, shape (F, 4), normals *into the solid*
            (bilinear faces, 2x2 Gauss points, current area and normal).
        pressure_pa: Its final value; positive pushes into the solid.
        nodal_force: Final dead loads, shape (V, 3).
        steps: Number of equal steps of the load with which the other code converged.
        grids: The hexahedra are these grids one after the other, first count fastest; with even
            counts, 2x2x2 of them can be read as one quadratic element.
    """

    name: str
    nodes: Floats
    hexes: Ints
    shear_modulus_pa: float
    bulk_modulus_pa: float
    held: Bools
    displacement: Floats
    nodal_force: Floats
    pressure_faces: Ints = field(default_factory=no_faces)
    pressure_pa: float = 0.0
    steps: int = 1
    grids: tuple[tuple[int, int, int], ...] = ()


@dataclass(frozen=True)
class Solution:
    """State at full load.

    Attributes:
        displacement: Of every node, shape (V, 3).
        reaction: Force of the supports on the solid at held components, zero elsewhere, (V, 3).
    """

    displacement: Floats
    reaction: Floats


def enclosed_volume(positions: Floats, faces: Ints) -> float:
    """Volume under bilinear faces: a third of the flux of x through them, exact by 2x2 points.

    The flux of x through a bilinear face is a polynomial of degree 2 in each parameter. For an
    octant the three planes of symmetry pass through the origin and add nothing.
    """
    if not len(faces):
        return 0.0
    corner = positions[faces]
    total = 0.0
    for r in (-(3**-0.5), 3**-0.5):
        for s in (-(3**-0.5), 3**-0.5):
            shape = np.array(
                [(1 - r) * (1 - s), (1 + r) * (1 - s), (1 + r) * (1 + s), (1 - r) * (1 + s)]
            )
            by_r = np.array([-(1 - s), 1 - s, 1 + s, -(1 + s)])
            by_s = np.array([-(1 - r), -(1 + r), 1 + r, 1 - r])
            point, along_r, along_s = (
                np.einsum("a,fai->fi", weight / 4, corner) for weight in (shape, by_r, by_s)
            )
            total += float(np.einsum("fi,fi->", point, np.cross(along_r, along_s))) / 3
    return total
