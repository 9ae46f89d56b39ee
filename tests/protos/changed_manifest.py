"""A bundle's manifest with one value changed, as a stranger may have done it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from palpate.files.bundle import MANIFEST


def change(folder: Path, where: Sequence[Any], value: object) -> None:
    """Put a value at keys and places, one inside the other, of the manifest of a bundle."""
    values: Any = json.loads((folder / MANIFEST).read_text())
    inside = values
    for key in where[:-1]:
        inside = inside[key]
    inside[where[-1]] = value
    (folder / MANIFEST).write_text(json.dumps(values))
