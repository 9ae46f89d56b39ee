"""Where the electrodes sit on the core of a BioTac; the one copy of the table in the code.

The 19 sensing electrodes are the table of Lin et al. (docs/conventions.md, which a test compares);
the four excitation electrodes, tied together, were read off the published map to 0.1 mm. Sensor
frame: +x to the fingertip, +y lateral, -z to the pad.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def _unit(rows: list[list[float]]) -> Floats:
    normals = np.array(rows)
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])


def _mirrored(rows: list[list[float]]) -> list[list[float]]:
    return [[x, -y, z] for x, y, z in rows]


_SIDE = [  # E1..E6; E11..E16 are their mirror images
    [0.993, -4.855, -1.116],
    [-2.700, -3.513, -3.670],
    [-6.200, -3.513, -3.670],
    [-8.000, -4.956, -1.116],
    [-10.500, -3.513, -3.670],
    [-13.400, -4.956, -1.116],
]
_TIP = [[4.763, 0.0, -2.330], [3.031, -1.950, -3.330], [3.031, 1.950, -3.330], [1.299, 0, -4.330]]
_PAD = [[-2.800, 0.0, -5.080], [-9.800, 0.0, -5.080], [-13.600, 0.0, -5.080]]
_X = [[-3.7, -4.956, -1.116], [-15.8, -3.513, -3.670]]

_LOW, _HIGH = [0.0, -0.692, -0.722], [0.0, -0.976, -0.220]  # normals of the two lateral rows
_SIDE_NORMAL = [[0.196, -0.956, -0.220], _LOW, _LOW, _HIGH, _LOW, _HIGH]
_TIP_NORMAL, _PAD_NORMAL = [0.5, 0.0, -0.866], [0.0, 0.0, -1.0]

ELECTRODE_POSITIONS: Floats = 1e-3 * np.array(_SIDE + _TIP + _mirrored(_SIDE) + _PAD)
"""Centres of E1..E19 [m], shape (19, 3), sensor frame."""

ELECTRODE_NORMALS: Floats = _unit(
    _SIDE_NORMAL + [_TIP_NORMAL] * 4 + _mirrored(_SIDE_NORMAL) + [_PAD_NORMAL] * 3
)
"""Outward unit normals of E1..E19, shape (19, 3), sensor frame."""

EXCITATION_POSITIONS: Floats = 1e-3 * np.array(_X + _mirrored(_X))
"""Centres of the excitation electrodes X1 X2 X3 X4 [m], shape (4, 3), sensor frame."""

EXCITATION_NORMALS: Floats = _unit([_HIGH, _LOW, *_mirrored([_HIGH, _LOW])])
"""Their outward unit normals, shape (4, 3), sensor frame."""

ELECTRODE_MIRROR: NDArray[np.int32] = (
    np.array([11, 12, 13, 14, 15, 16, 7, 9, 8, 10, 1, 2, 3, 4, 5, 6, 17, 18, 19], np.int32) - 1
)
"""Index of the electrode at the mirror image (y -> -y) of each of E1..E19, shape (19,)."""
