"""Optional dependencies: a missing one is reported with its install line."""

from __future__ import annotations

import importlib
from types import ModuleType

from palpate.errors import MissingExtraError


def require(module: str, *, extra: str) -> ModuleType:
    """Import an optional dependency.

    Args:
        module: Name to import, e.g. ``"onnxruntime"``.
        extra: The extra of the palpate distribution that installs it.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        # A broken dependency inside an installed package must keep its own message.
        if error.name is not None and not module.startswith(error.name):
            raise
        raise MissingExtraError(module, extra=extra) from error
