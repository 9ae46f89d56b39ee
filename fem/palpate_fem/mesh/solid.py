"""A solid mesh with named surfaces: what the solver needs to know of geometry."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


@dataclass(frozen=True)
class SolidMesh:
    """Hexahedra or wedges between an outer and an inner surface.

    Node order of an element: the face nearer to the cavity first, counter-clockwise seen from the
    outside of the skin, then the same nodes one layer further out, so that its volume is positive
    (hexahedron 0-3 and 4-7, wedge 0-2 and 3-5).

    Attributes:
        nodes: Positions [m], shape (V, 3), sensor frame, unpressurised.
        elements: Node ids, shape (E, 8) hexahedra or (E, 6) wedges.
        outer_faces: Faces of the outer surface, (F, 4) or (F, 3), normals away from the solid.
        outer_elements: Element that owns each outer face, shape (F,).
        inner_faces: Faces of the inner surface, normals out of the cavity *into* the solid, so that
            the volume they enclose is positive; empty for a solid without a cavity.
        inner_elements: Element that owns each inner face.
        fixed: Ids of the nodes held by nail and clamp.
        mirror: mirror[i] is the node at the mirror image (y -> -y) of node i; empty if the mesh is
            not mirror-symmetric.
        name: For people.
    """

    nodes: Floats
    elements: Ints
    outer_faces: Ints
    outer_elements: Ints
    inner_faces: Ints
    inner_elements: Ints
    fixed: Ints
    mirror: Ints
    name: str = ""

    @cached_property
    def sha256(self) -> bytes:
        """Digest of everything that a solution depends on, 32 bytes."""
        digest = hashlib.sha256()
        for array in (self.nodes, self.elements, self.outer_faces, self.inner_faces, self.fixed):
            digest.update(str((array.dtype.str, array.shape)).encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.digest()

    @cached_property
    def outer_nodes(self) -> Ints:
        """Ids of the nodes on the outer surface, ascending."""
        return np.unique(self.outer_faces).astype(np.int32)

    @cached_property
    def inner_nodes(self) -> Ints:
        """Ids of the nodes on the inner surface, ascending."""
        return np.unique(self.inner_faces).astype(np.int32)
