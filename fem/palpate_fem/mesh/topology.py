"""Quads of a closed bag: a tube of rings with a rectangular patch at either end.

A ring has 2 (a + b) nodes; a and b are the quads along the sides of the patches: a ventrally and
dorsally, b on either flank. So all nodes have four quads, but the eight corners of the patches
three. Everything is symmetric to the plane of the midline.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int32]


@dataclass(frozen=True)
class Bag:
    """Nodes and quads of the bag.

    Around a ring, node k = 0 is on the ventral midline and k = half on the dorsal one, k ascending
    towards +y first. On a patch, (i, j) counts from its right ventral corner (-y) towards +y
    and dorsally, and its rim is the ring that it closes.

    Attributes:
        rings: Node ids, shape (rings, around); ring 0 is the rim of the proximal patch, the last
            that of the patch at the tip.
        proximal: Node ids of the proximal patch, rim included, shape (a + 1, b + 1).
        tip: Same of the patch at the tip.
        faces: Quads, counter-clockwise seen from outside, shape (F, 4).
        mirror: Node at the mirror image of each node, shape (V,).
    """

    rings: Ints
    proximal: Ints
    tip: Ints
    faces: Ints
    mirror: Ints

    @property
    def left(self) -> Ints:
        """Nodes at y < 0: each is the mirror image of one on the right."""
        half = self.rings.shape[1] // 2
        middle = self.tip.shape[0] // 2
        sides = [self.rings[:, half + 1 :], self.tip[:middle], self.proximal[:middle]]
        return np.unique(np.concatenate([side.ravel() for side in sides]))


def rim(a: int, b: int) -> tuple[Ints, Ints]:
    """Patch position (i, j) of each ring node k, two arrays of shape (2 (a + b),); a is even."""
    half = a // 2
    first = [(i, 0) for i in range(half, a)]  # ventral, from the midline to +y
    up = [(a, j) for j in range(b)]
    over = [(i, b) for i in range(a, 0, -1)]
    down = [(0, j) for j in range(b, 0, -1)]
    last = [(i, 0) for i in range(half)]
    pairs = np.array(first + up + over + down + last, np.int32)
    return pairs[:, 0], pairs[:, 1]


def bag(rings: int, a: int, b: int) -> Bag:
    """Number the nodes of a bag from the proximal patch to the tip.

    Args:
        rings: Rings, the rims of both patches among them, at least 2.
        a: Quads across the ventral side of a patch, even.
        b: Quads along each of its flanks.
    """
    around = 2 * (a + b)
    on_i, on_j = rim(a, b)
    interior = (a - 1) * (b - 1)
    first = interior  # id of ring 0
    ring = first + np.arange(rings * around, dtype=np.int32).reshape(rings, around)
    proximal, tip = (np.empty((a + 1, b + 1), np.int32) for _ in range(2))
    for patch, start, edge in (
        (proximal, 0, ring[0]),
        (tip, first + rings * around, ring[-1]),
    ):
        patch[1:-1, 1:-1] = start + np.arange(interior, dtype=np.int32).reshape(a - 1, b - 1)
        patch[on_i, on_j] = edge
    mirror = np.empty(2 * interior + rings * around, np.int32)
    mirror[ring] = ring[:, -np.arange(around) % around]
    for patch in (proximal, tip):
        mirror[patch] = patch[::-1]
    ahead = np.roll(ring, -1, axis=1)
    tube = np.stack([ring[:-1], ahead[:-1], ahead[1:], ring[1:]], axis=-1).reshape(-1, 4)
    cap = np.stack([tip[:-1, :-1], tip[1:, :-1], tip[1:, 1:], tip[:-1, 1:]], -1).reshape(-1, 4)
    back = np.stack(
        [proximal[:-1, :-1], proximal[:-1, 1:], proximal[1:, 1:], proximal[1:, :-1]], -1
    ).reshape(-1, 4)
    faces = np.ascontiguousarray(np.concatenate([back, tube, cap]), np.int32)
    return Bag(ring, proximal, tip, faces, mirror)
