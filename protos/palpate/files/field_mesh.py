"""The mesh of a field: what a bundle has to say of the nodes that its displacements belong to."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.errors import BundleError
from palpate.messages import FloatArray

IndexArray = npt.NDArray[np.int32]

_REMEDY = "export the bundle again with the mesh that its fields were computed on"


@dataclass(frozen=True, slots=True)
class FieldMesh:
    """Nodes and surfaces of a skin; enough to draw a field, not to solve for one.

    Attributes:
        nodes: Positions in the pressurised, untouched state [m], sensor frame, float32, shape
            ``(V, 3)``.
        outer_faces: Triangles of the skin's outside, node ids, int32, shape ``(F, 3)``.
        inner_faces: Triangles of its inside, int32, shape ``(G, 3)``.
        sha256: Content hash of the mesh that the fields were computed on, 32 bytes. It covers more
            than stands here (elements, fixed nodes), so it names the mesh and cannot be recomputed.
    """

    nodes: FloatArray
    outer_faces: IndexArray
    inner_faces: IndexArray
    sha256: bytes


def check_mesh(mesh: FieldMesh, where: str) -> None:
    """Check shapes, types and ranges of a mesh.

    Args:
        mesh: What to check.
        where: Where it stands, for the error.

    Raises:
        BundleError: Names ``where``, the array and what is wrong.
    """
    nodes = mesh.nodes
    if nodes.dtype != np.float32 or nodes.ndim != 2 or nodes.shape[1] != 3 or not len(nodes):
        raise BundleError(
            f"{where}: nodes are {nodes.dtype}{list(nodes.shape)}, not float32[V, 3]",
            remedy=_REMEDY,
        )
    if not np.isfinite(nodes).all():
        raise BundleError(f"{where}: nodes hold NaN or infinity", remedy=_REMEDY)
    for name, faces in (("outer_faces", mesh.outer_faces), ("inner_faces", mesh.inner_faces)):
        if faces.dtype != np.int32 or faces.ndim != 2 or faces.shape[1] != 3:
            raise BundleError(
                f"{where}: {name} are {faces.dtype}{list(faces.shape)}, not int32[F, 3]",
                remedy=_REMEDY,
            )
        if faces.size and not 0 <= int(faces.min()) <= int(faces.max()) < len(nodes):
            raise BundleError(
                f"{where}: {name} name nodes {faces.min()}..{faces.max()}, there are 0.."
                f"{len(nodes) - 1}",
                remedy=_REMEDY,
            )
    if len(mesh.sha256) != 32:
        raise BundleError(
            f"{where}: sha256 has {len(mesh.sha256)} bytes, a SHA-256 has 32", remedy=_REMEDY
        )


def mesh_to_bytes(mesh: FieldMesh) -> bytes:
    """The file ``mesh.npz``."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        nodes=mesh.nodes,
        outer_faces=mesh.outer_faces,
        inner_faces=mesh.inner_faces,
        sha256=np.frombuffer(mesh.sha256, np.uint8),
    )
    return buffer.getvalue()


def mesh_from_bytes(data: bytes, where: str) -> FieldMesh:
    """Read and check ``mesh.npz``.

    Args:
        data: Its bytes.
        where: Where it stands, for the error.

    Raises:
        BundleError: It is no NumPy archive, lacks an array, or an array is not what it must be.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            mesh = FieldMesh(
                archive["nodes"],
                archive["outer_faces"],
                archive["inner_faces"],
                archive["sha256"].astype(np.uint8).tobytes(),
            )
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise BundleError(f"{where} is not a mesh: {error}", remedy=_REMEDY) from error
    check_mesh(mesh, where)
    return mesh
