"""Readers for the two text formats of the public BioTac meshes: ``.tet`` and ``.obj``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigError

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

REMEDY = "fetch the file anew from the NVlabs/biotac_sim repository, folder assets"


def read_tet(path: Path) -> tuple[Floats, Ints]:
    """Vertices ("v x y z w") and tetrahedra ("t a b c d", from 0) of a .tet file.

    Returns:
        Vertices [m], shape (V, 3), and node ids, shape (E, 4), both as in the file.

    Raises:
        ConfigError: The file cannot be read, holds no tetrahedron, or names an unknown vertex.
    """
    return _read(path, element="t", nodes=4, first=0)


def read_obj(path: Path) -> tuple[Floats, Ints]:
    """Vertices and triangles ("f a//n b//n c//n", from 1) of an .obj file; ids from 0.

    Raises:
        ConfigError: The file cannot be read, holds no triangle, or names an unknown vertex.
    """
    return _read(path, element="f", nodes=3, first=1)


def _read(path: Path, *, element: str, nodes: int, first: int) -> tuple[Floats, Ints]:
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except FileNotFoundError as error:
        raise ConfigError(f"there is no file {path}", remedy=REMEDY) from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read as text: {error}", remedy=REMEDY) from error
    vertices: list[list[float]] = []
    elements: list[list[int]] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        try:
            if words[:1] == ["v"]:
                vertices.append([float(word) for word in words[1:4]])
            elif words[:1] == [element]:
                if len(words) != nodes + 1:
                    raise ValueError(f"{len(words) - 1} nodes where {nodes} are due")
                elements.append([int(word.partition("/")[0]) - first for word in words[1:]])
        except ValueError as error:
            raise ConfigError(f"{path}, line {number}: {error}", remedy=REMEDY) from error
    try:
        points, ids = np.array(vertices, np.float64), np.array(elements, np.int32)
    except (ValueError, OverflowError) as error:
        raise ConfigError(f"{path} has rows of different lengths", remedy=REMEDY) from error
    if points.ndim != 2 or points.shape[1] != 3 or not ids.size:
        raise ConfigError(f"{path} holds no mesh: no complete 'v' or '{element}'", remedy=REMEDY)
    if ids.min() < 0 or ids.max() >= len(points):
        raise ConfigError(
            f"{path} names vertex {int(ids.max()) + first} of {len(points)}", remedy=REMEDY
        )
    if not np.isfinite(points).all():
        raise ConfigError(f"{path} holds a vertex that is not finite", remedy=REMEDY)
    return points, ids


def boundary(tets: Ints, points: Floats) -> Ints:
    """Faces that belong to one tetrahedron only, normals away from the solid, shape (F, 3)."""
    corner = points[tets]
    volume = np.einsum(
        "ei,ei->e",
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]),
        corner[:, 3] - corner[:, 0],
    )
    tets = np.where((volume < 0)[:, None], tets[:, [0, 2, 1, 3]], tets)
    faces = np.concatenate(
        [tets[:, [1, 2, 3]], tets[:, [0, 3, 2]], tets[:, [0, 1, 3]], tets[:, [0, 2, 1]]]
    )
    key = np.sort(faces, axis=1).astype(np.int64) @ np.array([len(points) ** 2, len(points), 1])
    _, index, times = np.unique(key, return_index=True, return_counts=True)
    return np.ascontiguousarray(faces[np.sort(index[times == 1])], np.int32)
