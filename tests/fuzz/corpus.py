"""The corpus of each decoder: one archive, written the same from the same inputs."""

from __future__ import annotations

import hashlib
import importlib
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).parent / "corpus"

LIMIT_BYTES = 200_000
"""Largest archive of a decoder."""

TARGETS = tuple(sorted(path.stem for path in (Path(__file__).parent / "targets").glob("*.py")))
"""Names of the decoders; each has a module of that name."""


@dataclass(frozen=True, slots=True)
class Target:
    """One decoder under attack.

    Attributes:
        check: Takes any bytes, and raises if the decoder breaks a promise.
        seeds: Inputs to begin with.
    """

    check: Callable[[bytes], None]
    seeds: Callable[[], list[bytes]]


def load_target(name: str) -> Target:
    """The decoder's module, imported only now: the caller may instrument the import."""
    module = importlib.import_module(f"tests.fuzz.targets.{name}")
    return Target(module.check, module.seeds)


def archive(name: str) -> Path:
    """Where a decoder's corpus is kept."""
    return FOLDER / f"{name}.zip"


def read_corpus(name: str) -> dict[str, bytes]:
    """Inputs by name; none where nothing was kept yet."""
    if not archive(name).exists():
        return {}
    with zipfile.ZipFile(archive(name)) as file:
        return {info.filename: file.read(info) for info in file.infolist()}


def write_corpus(name: str, inputs: Iterable[bytes]) -> int:
    """Keep the inputs, the shortest first until the archive is full; return how many.

    Names, order and times depend on the inputs alone.
    """
    FOLDER.mkdir(exist_ok=True)
    ordered = sorted(set(inputs), key=lambda data: (len(data), data))
    while True:
        with zipfile.ZipFile(archive(name), "w", zipfile.ZIP_DEFLATED, compresslevel=9) as file:
            for data in ordered:
                digest = hashlib.sha256(data).hexdigest()[:16]
                info = zipfile.ZipInfo(digest, (1980, 1, 1, 0, 0, 0))
                info.compress_type = zipfile.ZIP_DEFLATED
                file.writestr(info, data)
        size = archive(name).stat().st_size
        if size <= LIMIT_BYTES:
            return len(ordered)
        ordered = ordered[: len(ordered) * LIMIT_BYTES // size]
