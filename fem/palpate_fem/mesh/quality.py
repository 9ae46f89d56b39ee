"""How good the elements of a solid mesh are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.mesh.surface import enclosed_volume

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

# The three neighbours of each corner, in the order that makes their triple product positive.
HEXAHEDRON_CORNERS = (
    (1, 3, 4), (2, 0, 5), (3, 1, 6), (0, 2, 7), (7, 5, 0), (4, 6, 1), (5, 7, 2), (6, 4, 3)
)  # fmt: skip
WEDGE_CORNERS = ((1, 2, 3), (2, 0, 4), (0, 1, 5), (5, 4, 0), (3, 5, 1), (4, 3, 2))
# A wedge with a regular base has triple product sin 60 deg at its corners: scaled to 1.
WEDGE_SCALE = 2.0 / np.sqrt(3.0)


def scaled_jacobians(nodes: Floats, elements: Ints) -> Floats:
    """Quality of each element: least triple product of unit edges over its corners, shape (E,).

    1 for a box or a wedge with a regular base; 0 or less if a corner is flat or inverted; -1 if an
    edge has no length.
    """
    corners = HEXAHEDRON_CORNERS if elements.shape[1] == 8 else WEDGE_CORNERS
    scale = 1.0 if elements.shape[1] == 8 else WEDGE_SCALE
    worst = np.full(len(elements), np.inf)
    for i, neighbours in enumerate(corners):
        here = nodes[elements[:, i]]
        a, b, c = (nodes[elements[:, j]] - here for j in neighbours)
        length = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1) * np.linalg.norm(c, axis=1)
        triple = np.einsum("ei,ei->e", np.cross(a, b), c)
        with np.errstate(divide="ignore", invalid="ignore"):
            here_scaled = np.where(length > 0, scale * triple / length, -1.0)
        worst = np.minimum(worst, here_scaled)
    return worst


def solid_volume(mesh: SolidMesh) -> float:
    """Volume of the solid [m^3], exact for bilinear faces, from its boundary."""
    volume = enclosed_volume(mesh.nodes, mesh.outer_faces)
    if len(mesh.inner_faces):
        volume -= enclosed_volume(mesh.nodes, mesh.inner_faces)
    return volume
