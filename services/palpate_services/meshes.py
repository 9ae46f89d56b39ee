"""Meshes of fields by content hash: whatever bundle holds one can lend it to a picture."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

from palpate.errors import BundleError
from palpate.files.bundle import read_mesh
from palpate.files.field_mesh import FieldMesh
from palpate_services.repository import PACKAGED, available, resolve

log = logging.getLogger(__name__)


class MeshLibrary:
    """Knows the meshes of the packaged bundles and of some more.

    Args:
        bundles: More bundles, by name or folder.
        models: Folder of the packaged ones.

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
            except BundleError as error:  # a picture needs no bundle but the one with its mesh
                log.warning("no mesh from this bundle: %s", error)
                continue
            if mesh is not None:
                yield mesh
