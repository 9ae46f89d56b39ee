"""Volume of a solid and area at its nodes, for tests of meshes."""

from __future__ import annotations

import numpy as np

from palpate_fem.arrays import Floats, Ints
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.mesh.surface import enclosed_volume, face_vectors


def solid_volume(mesh: SolidMesh) -> float:
    """Volume of the solid [m^3], exact for bilinear faces, from its boundary."""
    volume = enclosed_volume(mesh.nodes, mesh.outer_faces)
    if len(mesh.inner_faces):
        volume -= enclosed_volume(mesh.nodes, mesh.inner_faces)
    return volume


def node_areas(points: Floats, faces: Ints) -> Floats:
    """Share of the surface that belongs to each node [m^2], shape (V,)."""
    area = np.linalg.norm(face_vectors(points, faces), axis=1)
    share = np.zeros(len(points))
    for column in faces.T:
        np.add.at(share, column, area / faces.shape[1])
    return share
