"""The bundle: a model as it is shipped, served and checked (docs/adr/0008-bundle.md).

A folder of three files. ``manifest.json`` says what the model is and holds the digests of
``model.onnx`` and ``golden.npz`` (inputs and the outputs they must give); a model of fields has a
fourth, ``mesh.npz``. The bundle's own digest is the SHA-256 of the manifest's bytes and travels
with each estimate.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.errors import BundleError
from palpate.files.field_mesh import FieldMesh, check_mesh, mesh_from_bytes, mesh_to_bytes
from palpate.files.manifest import (
    BUNDLE_CONTRACT_VERSION,
    Manifest,
    check_task,
    parse_manifest,
)
from palpate.files.tasks import TASKS, check_tensors

__all__ = [
    "BUNDLE_CONTRACT_VERSION",
    "TASKS",
    "Bundle",
    "Manifest",
    "check_bundle_mesh",
    "check_task",
    "read_bundle",
    "read_mesh",
    "sha256_hex",
    "write_bundle",
]

MODEL, MANIFEST, GOLDEN, MESH = "model.onnx", "manifest.json", "golden.npz", "mesh.npz"
_FILE_BYTES_MAX = 256 << 20


@dataclass(frozen=True, slots=True)
class Bundle:
    """A bundle in memory, its digests checked.

    Attributes:
        manifest: What it says of itself.
        model: ONNX bytes.
        golden: Inputs and expected outputs by name, batch first.
        sha256: Digest of the manifest, 32 bytes.
        folder: Where it came from.
        mesh: Mesh of its fields; None for a task without.
    """

    manifest: Manifest
    model: bytes
    golden: Mapping[str, npt.NDArray[np.float32]]
    sha256: bytes
    folder: Path
    mesh: FieldMesh | None = None


def sha256_hex(data: bytes) -> str:
    """SHA-256 as hex."""
    return hashlib.sha256(data).hexdigest()


def check_bundle_mesh(mesh: FieldMesh | None, manifest: Manifest, where: str) -> None:
    """Check that a task of fields has its mesh, and that others have none.

    Args:
        mesh: What the bundle holds.
        manifest: What it says of itself.
        where: Names it, for the error.

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
    if len(mesh.nodes) != nodes:
        raise BundleError(
            f"{where}: the mesh has {len(mesh.nodes)} nodes, the tensors are for {nodes}",
            remedy="export the model again with the mesh it was trained on",
        )
    if manifest.mesh_sha256 != mesh.sha256.hex():
        raise BundleError(
            f"{where}: the manifest is for mesh {manifest.mesh_sha256[:12]!r}, {MESH} holds "
            f"{mesh.sha256.hex()[:12]!r}",
            remedy="export the model again with the mesh it was trained on",
        )


def write_bundle(
    folder: Path,
    *,
    model: bytes,
    golden: Mapping[str, npt.NDArray[np.float32]],
    manifest: Manifest,
    mesh: FieldMesh | None = None,
) -> bytes:
    """Write a bundle as a whole or not at all.

    Args:
        folder: Created; a bundle already there is refused, bundles are immutable.
        model: ONNX bytes.
        golden: Inputs and outputs by name.
        manifest: Its digests are filled in here.
        mesh: Mesh of its fields, for a task that has some.

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
    values = asdict(manifest) | {
        "model_sha256": sha256_hex(model),
        "golden_sha256": sha256_hex(golden_bytes),
    }
    if mesh is None:
        # Manifests were written before there were meshes; theirs must keep their bytes.
        del values["mesh_sha256"], values["mesh_file_sha256"]
    else:
        files[MESH] = mesh_to_bytes(mesh)
        values["mesh_file_sha256"] = sha256_hex(files[MESH])
    text = (json.dumps(values, indent=2, sort_keys=True) + "\n").encode()
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        for name, data in (*files.items(), (MANIFEST, text)):
            (temporary / name).write_bytes(data)
        temporary.chmod(0o755)
        os.rename(temporary, folder)
    except OSError as error:
        raise BundleError(f"cannot write {folder}: {error}", remedy="check the disk") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return hashlib.sha256(text).digest()


def read_bundle(folder: Path) -> Bundle:
    """Read a bundle and check its digests, its contract version and its task.

    Raises:
        BundleError: Names the folder and what is wrong.
    """
    text = _read(folder, MANIFEST)
    manifest = parse_manifest(text, folder / MANIFEST)
    check_task(manifest, str(folder))
    model = _read_checked(folder, MODEL, manifest.model_sha256)
    golden = _read_golden(_read_checked(folder, GOLDEN, manifest.golden_sha256), folder)
    mesh = _read_mesh(folder, manifest)
    return Bundle(manifest, model, golden, hashlib.sha256(text).digest(), folder, mesh)


def read_mesh(folder: Path) -> FieldMesh | None:
    """Read the mesh of a bundle and nothing else; None for a bundle without.

    Raises:
        BundleError: Names the folder and what is wrong.
    """
    return _read_mesh(folder, parse_manifest(_read(folder, MANIFEST), folder / MANIFEST))


def _read_mesh(folder: Path, manifest: Manifest) -> FieldMesh | None:
    mesh = None
    if manifest.mesh_file_sha256:
        data = _read_checked(folder, MESH, manifest.mesh_file_sha256)
        mesh = mesh_from_bytes(data, str(folder / MESH))
    check_bundle_mesh(mesh, manifest, str(folder))
    return mesh


def _read_checked(folder: Path, name: str, sha256: str) -> bytes:
    data = _read(folder, name)
    if sha256_hex(data) != sha256:
        raise BundleError(
            f"{folder / name} is not the file its manifest was written for (digest differs)",
            remedy="restore the bundle from where it was made; do not edit bundles",
        )
    return data


def _read(folder: Path, name: str) -> bytes:
    path = folder / name
    try:
        if path.stat().st_size > _FILE_BYTES_MAX:
            raise BundleError(
                f"{path} exceeds {_FILE_BYTES_MAX >> 20} MiB", remedy="ship a smaller model"
            )
        return path.read_bytes()
    except OSError as error:
        raise BundleError(
            f"{path} cannot be read: {error.strerror or error}",
            remedy="a bundle is a folder with model.onnx, manifest.json, golden.npz and, of "
            "fields, mesh.npz",
        ) from error


def _read_golden(data: bytes, folder: Path) -> dict[str, npt.NDArray[np.float32]]:
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            return {name: np.asarray(archive[name], np.float32) for name in archive.files}
    except (ValueError, OSError, KeyError, zipfile.BadZipFile) as error:
        raise BundleError(
            f"{folder / GOLDEN} is not a NumPy archive: {error}", remedy="export the bundle again"
        ) from error
