"""Where bundles are found: packaged with palpate, or a folder of one's own."""

from __future__ import annotations

from pathlib import Path

from palpate.errors import ConfigError

MANIFEST = "manifest.json"

PACKAGED = Path(__file__).parent / "models"
"""Bundles that come with palpate: ``<name>/<version>/{model.onnx,manifest.json,golden.npz}``."""


def available(models: Path = PACKAGED) -> list[str]:
    """Bundles of a repository as ``name:version``, oldest version first.

    Args:
        models: Folder of the repository.
    """
    found = [
        (folder.parent.name, int(folder.name))
        for folder in models.glob("*/*")
        if folder.name.isdigit() and (folder / MANIFEST).is_file()
    ]
    return [f"{name}:{version}" for name, version in sorted(found)]


def resolve(bundle: str, models: Path = PACKAGED) -> Path:
    """Find the folder of a bundle.

    Args:
        bundle: ``name`` (newest version), ``name:version``, or the path of a bundle's folder.
        models: Folder of the repository.

    Raises:
        ConfigError: There is no such bundle; the error lists what exists.
    """
    # Only a separator or a dot makes it a path: a folder of the same name in the working directory
    # must not silently take the place of a packaged bundle.
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
