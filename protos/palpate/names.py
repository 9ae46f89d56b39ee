"""Names that may stand in a key: stations, sensors, services, instances."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator

from palpate.errors import ConfigError

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}")


def check_name(name: str, what: str = "name") -> str:
    """Return ``name`` if it may stand in a key.

    Args:
        name: The name.
        what: What it names, for the error.

    Raises:
        ConfigError: It may not; the error names it and the rule.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{what} {name!r} cannot stand in a Zenoh key",
            remedy="use 1-63 of a-z, 0-9, '-', '_', starting with a letter or digit",
        )
    return name


Name = Annotated[str, AfterValidator(check_name)]
"""A configuration value that is checked by :func:`check_name`."""
