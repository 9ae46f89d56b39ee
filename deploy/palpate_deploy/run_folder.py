"""Where a run keeps its resolved profile and its logs: one folder a run, in the user's state."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

from palpate.errors import ConfigError
from palpate_deploy.profile import Profile, plain_values
from palpate_deploy.toml_text import toml_text

KEPT_RUNS = 20
"""Older folders are removed; recordings are never kept there."""


def state_folder() -> Path:
    """Folder for what palpate remembers of its runs (XDG base directories)."""
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "palpate"


def new_run_folder(name: str) -> Path:
    """Make an empty folder for a run and forget the oldest runs.

    Raises:
        ConfigError: The folder cannot be made.
    """
    runs = state_folder() / "runs"
    stamp = time.strftime("%Y%m%d-%H%M%S")
    folder = runs / f"{stamp}-{name}-{os.getpid()}"
    try:
        (folder / "logs").mkdir(parents=True, mode=0o700)
    except OSError as error:
        raise ConfigError(
            f"run folder {folder} cannot be made: {error.strerror or error}",
            remedy="set XDG_STATE_HOME to a folder you may write in",
        ) from error
    for old in sorted(path for path in runs.iterdir() if path.is_dir())[:-KEPT_RUNS]:
        if not _in_use(old):
            shutil.rmtree(old, ignore_errors=True)
    return folder


def _in_use(folder: Path) -> bool:
    """Whether the process that the folder is named after still runs."""
    pid = folder.name.rpartition("-")[2]
    if not pid.isdigit():
        return True  # not one of ours
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def write_profile(profile: Profile, folder: Path) -> Path:
    """Write the resolved profile that all processes of a run read."""
    path = folder / "profile.toml"
    path.write_text(toml_text(plain_values(profile)), encoding="utf-8")
    return path
