"""Geometry of a faceted surface of triangles or quads: areas, normals, volume, edges."""

from __future__ import annotations

import numpy as np

from palpate_fem.arrays import Floats, Ints


def face_vectors(points: Floats, faces: Ints) -> Floats:
    """Normal of each face times its area.

    Args:
        points: Positions [m], shape (V, 3).
        faces: Node ids, counter-clockwise seen from the front, shape (F, 3) or (F, 4).

    Returns:
        Area vectors [m^2], shape (F, 3). Of a warped quad the vector of its boundary, which does
        not depend on how the quad is filled.
    """
    corner = points[faces]
    if faces.shape[1] == 3:
        return np.asarray(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2)
    return np.asarray(np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1]) / 2)


def enclosed_volume(points: Floats, faces: Ints) -> float:
    """Volume inside a closed surface [m^3]; bilinear quads are integrated exactly."""
    corner = points[faces]
    if faces.shape[1] == 3:
        vectors = np.cross(corner[:, 1], corner[:, 2])
        return float(np.einsum("fi,fi->", corner[:, 0], vectors) / 6)
    # Exact for x = bilinear(corners): mean of the two ways to split a quad into triangles.
    total = 0.0
    for split in ((0, 1, 2), (0, 2, 3), (0, 1, 3), (1, 2, 3)):
        a, b, c = (corner[:, i] for i in split)
        total += float(np.einsum("fi,fi->", a, np.cross(b, c)))
    return total / 12


def node_normals(points: Floats, faces: Ints) -> Floats:
    """Unit normals at the nodes: mean of the adjacent faces weighted with their angle there.

    The angle as weight makes the normal independent of how a flat region is cut into faces, and
    gives the right sign of the distance at a node (Baerentzen, Aanaes 2005).

    Returns:
        Normals, shape (V, 3); zero for a node without a face.
    """
    size = faces.shape[1]
    total = np.zeros_like(points)
    for i in range(size):
        here = points[faces[:, i]]
        ahead = points[faces[:, (i + 1) % size]] - here
        behind = points[faces[:, (i - 1) % size]] - here
        normal = np.cross(ahead, behind)
        length = np.linalg.norm(normal, axis=1)
        angle = np.arctan2(length, np.einsum("fi,fi->f", ahead, behind))
        safe = np.where(length > 0, length, 1.0)
        np.add.at(total, faces[:, i], normal * (angle / safe)[:, None])
    length = np.linalg.norm(total, axis=1)
    return np.asarray(total / np.where(length > 0, length, 1.0)[:, None])


def edges(faces: Ints) -> tuple[Ints, Ints]:
    """Directed edges of all faces and the face of each, shapes (N F, 2) and (N F,)."""
    size = faces.shape[1]
    pairs = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    owner = np.repeat(np.arange(len(faces), dtype=np.int32), size)
    return pairs.astype(np.int32), owner


def open_edges(faces: Ints) -> Ints:
    """Edges that are not shared by exactly two faces of opposite direction, shape (N, 2)."""
    pairs, _ = edges(faces)
    if len(pairs) == 0:
        return pairs
    count = int(pairs.max()) + 1
    key = pairs[:, 0].astype(np.int64) * count + pairs[:, 1]
    back = pairs[:, 1].astype(np.int64) * count + pairs[:, 0]
    unique, times = np.unique(key, return_counts=True)
    at = np.searchsorted(unique, back).clip(0, len(unique) - 1)
    matched = (unique[at] == back) & (times[at] == 1)
    once = times[np.searchsorted(unique, key)] == 1
    return np.asarray(pairs[~(matched & once)], np.int32)


def components(faces: Ints, nodes: int) -> Ints:
    """Connected part that each face belongs to, shape (F,)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs, _ = edges(faces)
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(nodes, nodes))
    _, label = connected_components(graph, directed=False)
    return np.asarray(label[faces[:, 0]], np.int32)
