"""Where the electrodes sit on the core of a BioTac; the one copy of the tables in the code.

The 19 sensing electrodes are the table of Lin et al. (docs/conventions.md, which a test compares);
the four excitation electrodes, tied together, were read off the published map to 0.1 mm. Sensor
frame: +x to the fingertip, +y lateral, -z to the pad.

Those of the BioTac SP have one source, a simulation model of it and no table of its maker's, and a
frame of their own: the core frame of that model's CAD, with x along the finger, y lateral, -z to
the pad. Its origin is not that of the sensor frame, and which end of x is the fingertip is not said
there. Nothing that takes 19 electrodes takes these.
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

_SP_SIDE = [  # E1..E10; E11..E20 are their mirror images
    [9.815, -3.985, -2.768],
    [8.101, -3.066, -5.208],
    [2.219, -7.162, -3.265],
    [2.131, -5.120, -5.992],
    [-0.473, -2.411, -7.623],
    [-2.334, -7.238, -3.059],
    [-3.471, -4.753, -6.034],
    [-5.676, -1.817, -6.875],
    [-8.147, -3.245, -5.067],
    [-10.082, -3.850, -2.541],
]
_SP_PAD = [[6.572, 0.0, -6.409], [4.322, -1.852, -6.970], [4.322, 1.852, -6.970]]
_SP_PAD += [[1.913, 0.0, -7.571]]
_SP_X = [[6.103, -5.493, -4.277], [-6.185, -5.774, -3.833]]

SP_ELECTRODE_POSITIONS: Floats = 1e-3 * np.array(_SP_SIDE + _mirrored(_SP_SIDE) + _SP_PAD)
"""Centres of E1..E24 of a BioTac SP [m], shape (24, 3), core frame of its model."""

SP_EXCITATION_POSITIONS: Floats = 1e-3 * np.array(_SP_X + _mirrored(_SP_X))
"""Centres of its X1 X2 X3 X4 [m], shape (4, 3), core frame; numbered by the manual's map."""

SP_ELECTRODE_MIRROR: NDArray[np.int32] = (
    np.array([*range(11, 21), *range(1, 11), 21, 23, 22, 24], np.int32) - 1
)
"""Index of the electrode at the mirror image (y -> -y) of each of E1..E24, shape (24,)."""

CORE_RADIUS_M = 5.08e-3
"""Radius of the core's half-cylinder about the x axis and of its spherical tip about the origin
[m]. The flat tip with E7..E10 lies up to 0.56 mm deeper."""


def core_normal(points: NDArray[np.floating]) -> Floats:
    """Outward unit normal of the core below points [m], shape (N, 3); zero on its axis."""
    radial = np.array(points, np.float64)
    radial[:, 0] = np.maximum(radial[:, 0], 0.0)
    length = np.linalg.norm(radial, axis=1, keepdims=True)
    return np.asarray(radial / np.where(length > 0, length, 1.0))


def spatial_modes() -> Floats:
    """Two smooth modes over E1..E19, shape (2, 19): along the finger, and to the sides.

    Both have zero mean and unit mean square, so a mode's factor is the deviation of an electrode.
    """
    raw = np.stack([ELECTRODE_POSITIONS[:, 0], np.abs(ELECTRODE_POSITIONS[:, 1])])
    raw = raw - raw.mean(axis=1, keepdims=True)
    return np.asarray(raw / raw.std(axis=1, keepdims=True))
