"""Folders of a user, by the XDG base directory rules: what palpate keeps, and what it remembers."""

from __future__ import annotations

import os
from pathlib import Path


def state_folder() -> Path:
    """What palpate remembers and can lose: logs, profiles of runs, what was served last."""
    return _base("XDG_STATE_HOME", ".local/state") / "palpate"


def data_folder() -> Path:
    """What the user has given to palpate: bundles."""
    return _base("XDG_DATA_HOME", ".local/share") / "palpate"


def _base(variable: str, default: str) -> Path:
    given = os.environ.get(variable)
    return Path(given) if given else Path.home() / default
