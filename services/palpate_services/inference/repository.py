"""Where bundles are: packaged with palpate, or in a folder of the user; and the meshes in them."""

from __future__ import annotations

import logging
import os
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from palpate.config import check_name, looking_at
from palpate.errors import BundleError, ConfigError
from palpate.files.atomic import sync_folder, write_synced
from palpate.files.bundle import (
    GOLDEN,
    MANIFEST,
    MESH,
    MODEL,
    RANGE,
    SIGNATURE,
    Bundle,
    FieldMesh,
    read_bundle,
    read_file,
    read_manifest,
    read_mesh,
)
from palpate.files.signature import TrustedKeys
from palpate.process import data_folder
from palpate_services.config import ModelsConfig

_log = logging.getLogger(__name__)

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}")
_VERSION = re.compile(r"[1-9][0-9]{0,8}")

PACKAGED = Path(__file__).parent.parent / "models"
"""Bundles that ship with palpate: ``<name>/<version>/{model.onnx,manifest.json,golden.npz}``."""


def ships(folder: Path) -> bool:
    """Whether a bundle belongs to palpate's installation, which is trusted like its code."""
    return folder.resolve().is_relative_to(PACKAGED.resolve())


def available(models: Path = PACKAGED) -> list[str]:
    """Bundles of a repository's folder as ``name:version``, oldest version first."""
    return Repository(None, packaged=models).available()


def resolve(bundle: str, models: Path = PACKAGED) -> Path:
    """Find a packaged bundle, or one by its path, as ``Repository.resolve`` does.

    Raises:
        ConfigError: There is no such bundle; the error lists what exists.
    """
    return Repository(None, packaged=models).resolve(bundle)


class Repository:
    """Bundles by name and version: those that ship with palpate, and those in a user's folder.

    Both have the layout ``<name>/<version>/``. A version never changes and is never in both.

    Args:
        folder: The user's; None = only those that ship.
        packaged: Those that ship.
        trusted: Keys of which one must have signed each bundle that does not ship; None = none.
    """

    def __init__(
        self,
        folder: Path | None,
        *,
        packaged: Path = PACKAGED,
        trusted: TrustedKeys | None = None,
    ) -> None:
        self.folder = folder
        self._folders = [packaged] if folder is None else [packaged, folder]
        self._trusted = trusted or TrustedKeys()

    @classmethod
    def of_config(cls, models: ModelsConfig) -> Repository:
        """The repository of a station.

        Raises:
            ConfigError: A trusted key cannot be read.
        """
        return cls(models.repository_folder, trusted=TrustedKeys(models.trusted_keys))

    def read(self, folder: Path) -> Bundle:
        """Read a bundle and check its digests and, where keys are trusted, its signature.

        Raises:
            BundleError: It is damaged, its signature is missing or wrong, or it lies in this
                repository under a name or version that is not its own.
        """
        bundle = read_bundle(folder)
        self._check_place(bundle)
        if not ships(folder):
            self._trusted.check(bundle)
        return bundle

    def _check_place(self, bundle: Bundle) -> None:
        """Refuse one that ``resolve`` finds by another name than it publishes with estimates."""
        folder, manifest = bundle.folder, bundle.manifest
        if folder.parent.parent.resolve() not in [one.resolve() for one in self._folders]:
            return
        place = (folder.parent.name, folder.name)
        if _is_place(*place) and place != (manifest.name, str(manifest.version)):
            raise BundleError(
                f"{folder} holds {manifest.name}:{manifest.version}, so it lies in the wrong place",
                remedy="move the folder elsewhere and take it from there: palpate model import",
            )

    @classmethod
    def of_user(cls) -> Repository:
        """The packaged bundles, and those in the folder that a profile has by default."""
        return cls(data_folder() / "models")

    def available(self, task: str | None = None) -> list[str]:
        """Bundles (of a task) as ``name:version``, oldest version first."""
        return [
            f"{name}:{version}"
            for (name, version), folder in sorted(self._found().items())
            if task is None or _task_of(folder) == task
        ]

    def resolve(self, bundle: str) -> Path:
        """Find a bundle's folder by ``name`` (newest version), ``name:version``, or its own path.

        Raises:
            ConfigError: There is no such bundle, where the error lists what exists; or its folder
                is closed.
        """
        # Only a slash or a leading dot makes it a path: a folder in the working directory must not
        # replace a packaged bundle of the same name without notice.
        if "/" in bundle or bundle.startswith("."):
            folder = Path(bundle).expanduser()
            with looking_at(folder):
                if (folder / MANIFEST).is_file():
                    return folder
            raise ConfigError(
                f"bundle {bundle!r}: no {MANIFEST} in {folder.absolute()}",
                remedy="give the folder that holds model.onnx, manifest.json and golden.npz",
            )
        found = self._found()
        name, _, version = bundle.partition(":")
        versions = [number for known, number in found if known == name]
        if versions and not version:
            return found[name, max(versions)]
        if version.isascii() and version.isdigit() and int(version) in versions:
            return found[name, int(version)]
        raise ConfigError(
            f"bundle {bundle!r} is not in the repository {', '.join(map(str, self._folders))}",
            remedy=f"available: {', '.join(self.available())}"
            if found
            else "make one with: make bundle",
        )

    def add(self, source: Path, check: Callable[[Path], Bundle]) -> tuple[str, Path]:
        """Copy a bundle into the user's folder; it appears there complete and checked, or not.

        ``check`` reads the copy and raises what is wrong with it. Returns ``name:version`` and the
        folder; a bundle that is there already, the same by its digest, stays.

        Raises:
            BundleError: ``check`` found something, or another bundle has its name and version.
            ConfigError: There is no user's folder, or it cannot be written.
        """
        if self.folder is None:
            raise ConfigError(
                "there is no folder for imported bundles", remedy="set [models] folder"
            )
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=".import.", dir=self.folder) as temporary:
                copy = _copied(source, Path(temporary) / "bundle")
                try:
                    return self._move_in(copy, check)
                except BundleError as error:  # it names the copy, which is gone when it is read
                    problem = error.problem.replace(str(copy), str(source))
                    raise BundleError(problem, remedy=error.remedy) from error
        except OSError as error:
            raise ConfigError(
                f"{source} cannot be copied into {self.folder}: {error.strerror or error}",
                remedy="check the rights and the free space of that folder: [models] folder",
            ) from error

    def _move_in(self, copy: Path, check: Callable[[Path], Bundle]) -> tuple[str, Path]:
        bundle = check(copy)
        manifest = bundle.manifest
        label = f"{manifest.name}:{manifest.version}"
        assert self.folder is not None
        target = self.folder / check_name(manifest.name) / str(manifest.version)
        there = self._found().get((manifest.name, manifest.version))
        if there is not None:
            if read_bundle(there).sha256 == bundle.sha256:
                if (copy / SIGNATURE).exists() and there == target:  # signed since then
                    os.replace(copy / SIGNATURE, there / SIGNATURE)
                return label, there
            raise BundleError(
                f"another bundle {label} is in {there}, and bundles never change",
                remedy="export it again as the next version",
            )
        target.parent.mkdir(exist_ok=True)
        copy.chmod(0o755)
        os.rename(copy, target)
        return label, target

    def _found(self) -> dict[tuple[str, int], Path]:
        """Folders by name and version; what does not look like a bundle's folder is no bundle."""
        found: dict[tuple[str, int], Path] = {}
        for models in self._folders:
            for folder in models.glob("*/*"):
                name, version = folder.parent.name, folder.name
                if _is_place(name, version) and _has_manifest(folder):
                    found.setdefault((name, int(version)), folder)
        return found


def _is_place(name: str, version: str) -> bool:
    """Whether a repository has bundles in ``name/version``."""
    return bool(_VERSION.fullmatch(version) and _NAME.fullmatch(name))


def _has_manifest(folder: Path) -> bool:
    try:
        return (folder / MANIFEST).is_file()
    except PermissionError:
        return True  # another user's: whoever reads it is told


def _task_of(folder: Path) -> str | None:
    """Task that a bundle's manifest names; None for a broken one."""
    try:
        return read_manifest(folder).task
    except BundleError:
        return None


def _copied(source: Path, target: Path) -> Path:
    """Copy the files of a bundle, and nothing else that lies there."""
    target.mkdir()
    for name in (MODEL, MANIFEST, GOLDEN, MESH, RANGE, SIGNATURE):
        if name in (MESH, RANGE, SIGNATURE) and not (source / name).exists():
            continue
        write_synced(target / name, read_file(source, name))
    sync_folder(target)
    return target


class MeshLibrary:
    """The meshes of fields, by content hash: of a repository, and of more by name or folder.

    ``repository`` None is that of the user.

    Raises:
        ConfigError: One of ``bundles`` does not exist.
    """

    def __init__(self, bundles: Sequence[str] = (), repository: Repository | None = None) -> None:
        self._repository = repository or Repository.of_user()
        self._folders = [self._repository.resolve(bundle) for bundle in bundles]
        self._known: dict[bytes, FieldMesh] | None = None

    def find(self, sha256: bytes) -> FieldMesh | None:
        """The mesh of this content hash; None if no bundle holds it."""
        if self._known is None:
            self._known = {mesh.sha256: mesh for mesh in self._read()}
        return self._known.get(sha256)

    def _read(self) -> Iterator[FieldMesh]:
        known = (self._repository.resolve(name) for name in self._repository.available())
        for folder in (*known, *self._folders):
            try:
                mesh = read_mesh(folder)
            except BundleError as error:  # another bundle may hold the mesh that is needed
                _log.warning("no mesh from this bundle: %s", error)
                continue
            if mesh is not None:
                yield mesh
