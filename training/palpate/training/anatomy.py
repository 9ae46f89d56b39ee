"""Where the electrodes sit on the BioTac's core: what networks and pictures know of its shape.

Rooms never import one another, so this is training's own copy; a test compares it with the table of
docs/conventions.md.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

_SIDE_MM = [  # E1..E6; E11..E16 are their mirror images
    [0.993, -4.855, -1.116],
    [-2.700, -3.513, -3.670],
    [-6.200, -3.513, -3.670],
    [-8.000, -4.956, -1.116],
    [-10.500, -3.513, -3.670],
    [-13.400, -4.956, -1.116],
]
_TIP_MM = [[4.763, 0, -2.330], [3.031, -1.950, -3.330], [3.031, 1.950, -3.330], [1.299, 0, -4.330]]
_PAD_MM = [[-2.800, 0, -5.080], [-9.800, 0, -5.080], [-13.600, 0, -5.080]]
_X_MM = [[-3.7, -4.956, -1.116], [-15.8, -3.513, -3.670]]
_LOW, _HIGH = [0.0, -0.692, -0.722], [0.0, -0.976, -0.220]  # normals of the two lateral rows


def _mirrored(rows: list[list[float]]) -> list[list[float]]:
    return [[x, -y, z] for x, y, z in rows]


def _unit(rows: list[list[float]]) -> Floats:
    normals = np.array(rows)
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])


_SIDE_NORMALS = [[0.196, -0.956, -0.220], _LOW, _LOW, _HIGH, _LOW, _HIGH]

POSITIONS: Floats = 1e-3 * np.array(_SIDE_MM + _TIP_MM + _mirrored(_SIDE_MM) + _PAD_MM)
"""Centres of E1..E19 [m], shape (19, 3), sensor frame (Lin et al.; docs/conventions.md)."""

NORMALS: Floats = _unit(
    _SIDE_NORMALS + [[0.5, 0.0, -0.866]] * 4 + _mirrored(_SIDE_NORMALS) + [[0.0, 0.0, -1.0]] * 3
)
"""Outward unit normals of E1..E19, shape (19, 3), sensor frame (the same table)."""

X_POSITIONS: Floats = 1e-3 * np.array(_X_MM + _mirrored(_X_MM))
"""Centres of the four excitation electrodes, which are tied together [m], shape (4, 3), sensor
frame; read off the published map to 0.1 mm."""

MIRROR: npt.NDArray[np.int32] = (
    np.array([11, 12, 13, 14, 15, 16, 7, 9, 8, 10, 1, 2, 3, 4, 5, 6, 17, 18, 19], np.int32) - 1
)
"""Index of the electrode at the mirror image (y -> -y) of each of E1..E19, shape (19,)."""
