"""The bundle: a model as it is shipped, served and checked (docs/adr/0008-bundle.md).

A folder of three files. ``manifest.json`` says what the model is and holds the digests of
``model.onnx`` and ``golden.npz`` (inputs and the outputs they must give). A model of fields also
has ``mesh.npz``, and one that knows its training inputs ``range.npz``. The bundle's own digest is
the SHA-256 of the manifest's bytes and travels with each estimate.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.errors import BundleError, printable
from palpate.files.atomic import sync_folder, write_synced
from palpate.files.bounded import arrays_of_npz, read_regular
from palpate.files.manifest import Manifest, check_task, manifest_to_bytes, parse_manifest
from palpate.files.tasks import check_tensors
from palpate.files.training_range import (
    RANGE_BYTES_MAX,
    KnownInputs,
    known_inputs_from_bytes,
    known_inputs_to_bytes,
)
from palpate.messages import FloatArray

IndexArray = npt.NDArray[np.int32]

_MESH_REMEDY = "export the bundle again with the mesh that its fields were computed on"


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

    Raises:
        BundleError: Names ``where``, the array and what is wrong.
    """
    if problem := _mesh_problem(mesh):
        raise BundleError(f"{where}: {problem}", remedy=_MESH_REMEDY)


def _mesh_problem(mesh: FieldMesh) -> str:
    nodes = mesh.nodes
    if nodes.dtype != np.float32 or nodes.ndim != 2 or nodes.shape[1] != 3 or not len(nodes):
        return f"nodes are {nodes.dtype}{list(nodes.shape)}, not float32[V, 3]"
    if not np.isfinite(nodes).all():
        return "nodes hold NaN or infinity"
    for name, faces in (("outer_faces", mesh.outer_faces), ("inner_faces", mesh.inner_faces)):
        if faces.dtype != np.int32 or faces.ndim != 2 or faces.shape[1] != 3:
            return f"{name} are {faces.dtype}{list(faces.shape)}, not int32[F, 3]"
        if faces.size and not 0 <= int(faces.min()) <= int(faces.max()) < len(nodes):
            return f"{name} name nodes {faces.min()}..{faces.max()}, there are 0..{len(nodes) - 1}"
    if len(mesh.sha256) != 32:
        return f"sha256 has {len(mesh.sha256)} bytes, a SHA-256 has 32"
    return ""


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

    Raises:
        BundleError: It is no NumPy archive, lacks an array, or an array is not what it must be.
    """
    try:
        arrays = arrays_of_npz(data, _MESH_BYTES_MAX)
        mesh = FieldMesh(
            arrays["nodes"],
            arrays["outer_faces"],
            arrays["inner_faces"],
            arrays["sha256"].astype(np.uint8).tobytes(),
        )
    except (ValueError, KeyError) as error:
        raise BundleError(
            f"{where} is not a mesh: {printable(str(error))}", remedy=_MESH_REMEDY
        ) from error
    check_mesh(mesh, where)
    return mesh


MODEL, MANIFEST, GOLDEN, MESH = "model.onnx", "manifest.json", "golden.npz", "mesh.npz"
RANGE = "range.npz"
SIGNATURE = "signature.txt"
_MODEL_BYTES_MAX = 256 << 20
_MANIFEST_BYTES_MAX = 1 << 20
_GOLDEN_BYTES_MAX = 64 << 20
_MESH_BYTES_MAX = 64 << 20
_BYTES_MAX = {
    MODEL: _MODEL_BYTES_MAX,
    MANIFEST: _MANIFEST_BYTES_MAX,
    GOLDEN: _GOLDEN_BYTES_MAX,
    MESH: _MESH_BYTES_MAX,
    RANGE: RANGE_BYTES_MAX,
    SIGNATURE: 1024,
}
"""Size of each file, and of what its arrays expand to; those that ship have 1 % of it [bytes]."""


@dataclass(frozen=True, slots=True)
class Bundle:
    """A bundle in memory, its digests checked.

    Attributes:
        model: ONNX bytes.
        golden: Inputs and expected outputs by name, batch first.
        sha256: Digest of the manifest, 32 bytes.
        folder: Where it came from.
        mesh: Mesh of its fields; None for a task without.
        known_inputs: Representatives of its training inputs; None = not known.
    """

    manifest: Manifest
    model: bytes
    golden: Mapping[str, npt.NDArray[np.float32]]
    sha256: bytes
    folder: Path
    mesh: FieldMesh | None = None
    known_inputs: KnownInputs | None = None


def sha256_hex(data: bytes) -> str:
    """SHA-256 as hex."""
    return hashlib.sha256(data).hexdigest()


def check_bundle_mesh(mesh: FieldMesh | None, manifest: Manifest, where: str) -> None:
    """Check that a task of fields has its mesh, and that others have none.

    Raises:
        BundleError: No mesh, one too many, or not the one that manifest and tensors mean.
    """
    _, nodes = check_tensors(manifest.task, manifest.inputs, manifest.outputs, where)
    if (mesh is None) != (nodes is None):
        what = "needs a mesh" if mesh is None else "has no mesh"
        raise BundleError(
            f"{where}: a bundle of task {manifest.task!r} {what}",
            remedy=f"{MESH} belongs to bundles of fields, and to no others",
        )
    if mesh is None:
        return
    problem = ""
    if len(mesh.nodes) != nodes:
        problem = f"the mesh has {len(mesh.nodes)} nodes, the tensors are for {nodes}"
    elif manifest.mesh_sha256 != mesh.sha256.hex():
        problem = (
            f"the manifest is for mesh {manifest.mesh_sha256[:12]!r}, {MESH} holds "
            f"{mesh.sha256.hex()[:12]!r}"
        )
    if problem:
        raise BundleError(
            f"{where}: {problem}",
            remedy="export the model again with the mesh it was trained on",
        )


def write_bundle(
    folder: Path,
    *,
    model: bytes,
    golden: Mapping[str, npt.NDArray[np.float32]],
    manifest: Manifest,
    mesh: FieldMesh | None = None,
    known_inputs: KnownInputs | None = None,
) -> bytes:
    """Write a bundle; the folder appears complete or not at all, and is never overwritten.

    ``golden`` holds an array for each input and output; digests of the manifest are filled in here.
    ``known_inputs`` belong to a manifest with a training range.

    Returns:
        The bundle's digest, 32 bytes.

    Raises:
        BundleError: It breaks the contract, or the folder exists.
    """
    if mesh is not None:
        check_mesh(mesh, f"{folder}: mesh")
        manifest = replace(manifest, mesh_sha256=mesh.sha256.hex())
    check_bundle_mesh(mesh, manifest, str(folder))
    missing = {t.name for t in manifest.inputs + manifest.outputs} - set(golden)
    if missing:
        raise BundleError(
            f"{folder}: golden vectors lack {', '.join(sorted(missing))}",
            remedy="give one golden array for each input and output",
        )
    if folder.exists():
        raise BundleError(
            f"{folder} exists and bundles are immutable", remedy="write the next version"
        )
    buffer = io.BytesIO()
    np.savez(buffer, **{name: np.asarray(value, np.float32) for name, value in golden.items()})  # type: ignore[arg-type]
    golden_bytes = buffer.getvalue()
    files = {MODEL: model, GOLDEN: golden_bytes}
    manifest = replace(
        manifest, model_sha256=sha256_hex(model), golden_sha256=sha256_hex(golden_bytes)
    )
    if mesh is not None:
        files[MESH] = mesh_to_bytes(mesh)
        manifest = replace(manifest, mesh_file_sha256=sha256_hex(files[MESH]))
    if known_inputs is not None:
        files[RANGE] = known_inputs_to_bytes(known_inputs)
        manifest = replace(manifest, range_file_sha256=sha256_hex(files[RANGE]))
    text = manifest_to_bytes(manifest, folder / MANIFEST)
    had_parent = folder.parent.exists()
    temporary: Path | None = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        for name, data in (*files.items(), (MANIFEST, text)):
            write_synced(temporary / name, data)
        temporary.chmod(0o755)
        sync_folder(temporary)
        os.rename(temporary, folder)
    except OSError as error:
        raise BundleError(f"cannot write {folder}: {error}", remedy="check the disk") from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
        if not had_parent:
            with contextlib.suppress(OSError):  # of a bundle that is complete it is not empty
                folder.parent.rmdir()
    return hashlib.sha256(text).digest()


def read_bundle(folder: Path) -> Bundle:
    """Read a bundle and check its digests, its contract version and its task.

    Raises:
        BundleError: Names the folder and what is wrong.
    """
    text = read_file(folder, MANIFEST)
    manifest = parse_manifest(text, folder / MANIFEST)
    check_task(manifest, str(folder))
    model = _read_checked(folder, MODEL, manifest.model_sha256)
    golden = _read_golden(_read_checked(folder, GOLDEN, manifest.golden_sha256), folder)
    mesh = _read_mesh(folder, manifest)
    known = _read_known_inputs(folder, manifest)
    return Bundle(manifest, model, golden, hashlib.sha256(text).digest(), folder, mesh, known)


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a bundle and nothing else.

    Raises:
        BundleError: Names the file and what is wrong.
    """
    return parse_manifest(read_file(folder, MANIFEST), folder / MANIFEST)


def read_mesh(folder: Path) -> FieldMesh | None:
    """Read the mesh of a bundle and nothing else; None for a bundle without.

    Raises:
        BundleError: Names the folder and what is wrong.
    """
    return _read_mesh(folder, read_manifest(folder))


def _read_mesh(folder: Path, manifest: Manifest) -> FieldMesh | None:
    mesh = None
    if manifest.mesh_file_sha256:
        data = _read_checked(folder, MESH, manifest.mesh_file_sha256)
        mesh = mesh_from_bytes(data, str(folder / MESH))
    check_bundle_mesh(mesh, manifest, str(folder))
    return mesh


def _read_known_inputs(folder: Path, manifest: Manifest) -> KnownInputs | None:
    if not manifest.range_file_sha256:
        return None
    data = _read_checked(folder, RANGE, manifest.range_file_sha256)
    return known_inputs_from_bytes(data, manifest.inputs[0].shape[1], str(folder / RANGE))


def _read_checked(folder: Path, name: str, sha256: str) -> bytes:
    data = read_file(folder, name)
    if sha256_hex(data) != sha256:
        raise BundleError(
            f"{folder / name} is not the file its manifest was written for (digest differs)",
            remedy="restore the bundle from where it was made; do not edit bundles",
        )
    return data


def read_file(folder: Path, name: str) -> bytes:
    """Read one file of a bundle, by its name.

    Raises:
        BundleError: It is no regular file, is larger than it may be, or cannot be read.
    """
    path = folder / name
    try:
        return read_regular(path, _BYTES_MAX[name])
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or error
        raise BundleError(
            f"{path} cannot be read: {why}",
            remedy="a bundle is a folder with the regular files model.onnx, manifest.json, "
            "golden.npz and, of fields, mesh.npz",
        ) from error


def _read_golden(data: bytes, folder: Path) -> dict[str, npt.NDArray[np.float32]]:
    try:
        arrays = arrays_of_npz(data, _GOLDEN_BYTES_MAX)
        return {name: np.asarray(array, np.float32) for name, array in arrays.items()}
    except ValueError as error:
        raise BundleError(
            f"{folder / GOLDEN} is not a NumPy archive: {printable(str(error))}",
            remedy="export the bundle again",
        ) from error
