"""A solid mesh grown from a surface: columns of elements between an inner and an outer surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_fem.mesh.solid import SolidMesh

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
NONE = np.empty(0, np.int32)


def extrude(
    inner: Floats,
    outer: Floats,
    faces: Ints,
    *,
    layers: int,
    fixed_columns: Ints = NONE,
    mirror_columns: Ints = NONE,
    name: str = "",
) -> SolidMesh:
    """Fill the space between two surfaces of the same topology with layers of elements.

    The nodes of a column (one inner node, its outer partner and those between) are consecutive and
    evenly spaced: node = column * (layers + 1) + layer. Neither topology nor numbering depends on
    the thickness, and positions depend on it linearly.

    Args:
        inner: Inner surface [m], shape (C, 3), one row per column.
        outer: Outer partners [m], shape (C, 3).
        faces: Columns of each face, counter-clockwise seen from outside, shape (F, 3) -> wedges or
            (F, 4) -> hexahedra.
        layers: Elements through the thickness, at least 1.
        fixed_columns: Columns whose *outer* node is held by nail or clamp.
        mirror_columns: Column at the mirror image y -> -y of each column, or empty.
        name: For people.

    Returns:
        The solid; `check_mesh` says whether it is a good one.
    """
    if layers < 1:
        raise ValueError(f"layers = {layers}: at least one is needed")
    if inner.shape != outer.shape or faces.shape[1] not in (3, 4):
        raise ValueError("inner and outer need one row per column, faces 3 or 4 columns")
    stride = layers + 1
    share = np.linspace(0.0, 1.0, stride)[None, :, None]
    nodes = (inner[:, None] * (1 - share) + outer[:, None] * share).reshape(-1, 3)
    base = faces.astype(np.int32) * np.int32(stride)
    elements = np.stack(
        [np.concatenate([base + k, base + k + 1], axis=1) for k in range(layers)], axis=1
    ).reshape(-1, 2 * faces.shape[1])
    first = np.arange(len(faces), dtype=np.int32) * np.int32(layers)
    mirror = NONE
    if len(mirror_columns):
        mirror = mirror_columns.astype(np.int32)[:, None] * stride + np.arange(stride)
    return SolidMesh(
        nodes=np.ascontiguousarray(nodes),
        elements=np.ascontiguousarray(elements, np.int32),
        outer_faces=(base + layers).astype(np.int32),
        outer_elements=first + np.int32(layers - 1),
        inner_faces=base.astype(np.int32),
        inner_elements=first,
        fixed=np.sort(fixed_columns.astype(np.int32) * stride + layers).astype(np.int32),
        mirror=mirror.reshape(-1).astype(np.int32),
        name=name,
    )
