"""The skin as a solid mesh with named surfaces, its extrusion, and the geometry of a fingertip."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from palpate.errors import ConfigError
from palpate_fem.arrays import Floats, Ints
from palpate_fem.mesh.core import RigidCore


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
        name: Shown to users.
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
        """Digest of all that a solution depends on, 32 bytes."""
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
        name: Shown to users.

    Returns:
        The solid; `check_mesh` says whether it can be simulated.
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


def thickness_direction(mesh: SolidMesh) -> Floats:
    """Derivative of the nodes of an extruded mesh by its thickness, (V, 3).

    The inner surface stays; the nodes of a column move along it, in proportion to their layer.

    Raises:
        ConfigError: The mesh was not made by `extrude`.
    """
    layers = len(mesh.elements) // max(len(mesh.outer_faces), 1)
    stride = layers + 1
    fits = mesh.outer_faces.shape == mesh.inner_faces.shape and len(mesh.nodes) % stride == 0
    if not (
        fits
        and layers > 0
        and np.array_equal(mesh.outer_faces, mesh.inner_faces + np.int32(layers))
        and not np.any(mesh.inner_faces % stride)
    ):
        raise ConfigError(
            f"the mesh {mesh.name!r} has no columns between two surfaces, so no thickness",
            remedy="use a mesh made by `biotac`, `read_nvlabs` or `extrude`",
        )
    columns = mesh.nodes.reshape(-1, stride, 3)
    way = columns[:, -1] - columns[:, 0]
    unit = way / np.linalg.norm(way, axis=1)[:, None]
    share = np.linspace(0.0, 1.0, stride)[None, :, None]
    return np.asarray((share * unit[:, None]).reshape(-1, 3))


# Arguments that the mesh builders accept. Thinner skins are not realistic, thicker ones fold at the
# proximal edge; finer meshes are too large for a direct solver, coarser ones miss the shape.
BUILDER_LIMITS = {"thickness_m": (0.5e-3, 3.0e-3), "edge_m": (0.25e-3, 1.5e-3), "layers": (1, 6)}


@dataclass(frozen=True)
class FingertipGeometry:
    """Skin and core, both in the sensor frame [m], unpressurised and not in contact."""

    mesh: SolidMesh
    core: RigidCore


def check_limits(**arguments: float) -> None:
    """Refuse arguments of a builder that are outside `BUILDER_LIMITS`, and edges in parts of um.

    Raises:
        ConfigError: Names the argument, and its limits or the nearest edge.
    """
    for name, value in arguments.items():
        low, high = BUILDER_LIMITS[name]
        if not low <= value <= high:
            raise ConfigError(
                f"{name} = {value} is not within [{low:g}, {high:g}]",
                remedy="stay within these limits; lengths are in metres here, in mm as options",
            )
        # The mesh's name holds its edge in whole um: from it a store's mesh is built again.
        nearest_m = round(value * 1e6) / 1e6
        if name == "edge_m" and abs(value - nearest_m) > 1e-12:
            raise ConfigError(
                f"edge_m = {value:g} is not in whole micrometres",
                remedy=f"give {nearest_m:g}, or as an option {nearest_m * 1e3:g} mm",
            )
