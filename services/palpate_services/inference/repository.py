"""Where bundles are: packaged with palpate, or in a folder of the user; and the meshes in them."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

from palpate.errors import BundleError, ConfigError
from palpate.files.bundle import FieldMesh, read_mesh

_log = logging.getLogger(__name__)

MANIFEST = "manifest.json"

PACKAGED = Path(__file__).parent.parent / "models"
"""Bundles that ship with palpate: ``<name>/<version>/{model.onnx,manifest.json,golden.npz}``."""


def available(models: Path = PACKAGED) -> list[str]:
    """Bundles of a repository's folder as ``name:version``, oldest version first."""
    found = [
        (folder.parent.name, int(folder.name))
        for folder in models.glob("*/*")
        if folder.name.isdigit() and (folder / MANIFEST).is_file()
    ]
    return [f"{name}:{version}" for name, version in sorted(found)]


def resolve(bundle: str, models: Path = PACKAGED) -> Path:
    """Find a bundle's folder by ``name`` (newest version), ``name:version``, or its own path.

    Raises:
        ConfigError: There is no such bundle; the error lists what exists.
    """
    # Only a slash or a leading dot makes it a path: a folder in the working directory must not
    # replace a packaged bundle of the same name without notice.
    if "/" in bundle or bundle.startswith("."):
        folder = Path(bundle).expanduser()
        if (folder / MANIFEST).is_file():
            return folder
        raise ConfigError(
            f"bundle {bundle!r}: no {MANIFEST} in {folder.absolute()}",
            remedy="give the folder that holds model.onnx, manifest.json and golden.npz",
        )
    known = available(models)
    name, _, version = bundle.partition(":")
    versions = [int(entry.partition(":")[2]) for entry in known if entry.startswith(f"{name}:")]
    if versions and not version:
        return models / name / str(max(versions))
    if version.isdigit() and int(version) in versions:
        return models / name / str(int(version))
    raise ConfigError(
        f"bundle {bundle!r} is not in the repository {models}",
        remedy=f"available: {', '.join(known)}" if known else "make one with: make bundle",
    )


class MeshLibrary:
    """The meshes of fields, by content hash: of packaged bundles, and of more by name or folder.

    Raises:
        ConfigError: One of ``bundles`` does not exist.
    """

    def __init__(self, bundles: Sequence[str] = (), models: Path = PACKAGED) -> None:
        self._folders = [resolve(bundle, models) for bundle in bundles]
        self._models = models
        self._known: dict[bytes, FieldMesh] | None = None

    def find(self, sha256: bytes) -> FieldMesh | None:
        """The mesh of this content hash; None if no bundle holds it."""
        if self._known is None:
            self._known = {mesh.sha256: mesh for mesh in self._read()}
        return self._known.get(sha256)

    def _read(self) -> Iterator[FieldMesh]:
        packaged = (resolve(name, self._models) for name in available(self._models))
        for folder in (*packaged, *self._folders):
            try:
                mesh = read_mesh(folder)
            except BundleError as error:  # another bundle may hold the mesh that is needed
                _log.warning("no mesh from this bundle: %s", error)
                continue
            if mesh is not None:
                yield mesh
