"""What several house tests look at."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def _files_of_the_project() -> list[Path]:
    """Files git tracks or would track; without git, everything outside hidden and built folders."""
    try:
        listing = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT,
            capture_output=True,
            check=True,
        ).stdout.decode()
        files = [ROOT / name for name in listing.split("\0") if name]
    except (OSError, subprocess.CalledProcessError):
        skipped = ("build", "dist", "runs", "__pycache__")
        files = [
            path
            for path in ROOT.rglob("*")
            if not any(
                part in skipped or (part.startswith(".") and part != ".ci")
                for part in path.relative_to(ROOT).parts[:-1]
            )
        ]
    return sorted(path for path in files if path.is_file())


@pytest.fixture(scope="session")
def project_files() -> list[Path]:
    """Every file of the project that is, or would be, committed."""
    return _files_of_the_project()


@pytest.fixture(scope="session")
def relative() -> Callable[[Path], str]:
    """A path as people name it: from the top of the project."""
    return lambda path: path.relative_to(ROOT).as_posix()
