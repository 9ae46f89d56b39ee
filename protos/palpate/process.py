"""For every process of palpate: ``with`` blocks, optional packages, provenance, no pauses."""

from __future__ import annotations

import gc
import importlib
import importlib.util
import shlex
import sys
from abc import ABC, abstractmethod
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Self

from palpate.errors import MissingExtraError


class Closing(ABC):
    """Base of what has to be closed: a ``with`` block closes it on every path."""

    @abstractmethod
    def close(self) -> None:
        """Release threads, files and sessions."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def require(module: str, *, extra: str) -> ModuleType:
    """Import an optional dependency, e.g. ``"onnxruntime"``.

    Raises:
        MissingExtraError: It is not installed; ``extra`` of palpate installs it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        # A broken dependency inside an installed package must keep its own message.
        if error.name is not None and not module.startswith(error.name):
            raise
        raise MissingExtraError(module, extra=extra) from error


def check_installed(module: str, *, extra: str) -> None:
    """Check that an optional dependency is there, without importing it.

    Raises:
        MissingExtraError: It is not installed; ``extra`` of palpate installs it.
    """
    try:
        found = importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # the package around it is missing
        found = False
    if not found:
        raise MissingExtraError(module, extra=extra)


def typed_command() -> str:
    """The command line as typed, without the folder of the program, for provenance."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


_YOUNG_OBJECTS = 50_000
"""New container objects between two collections; frames and estimates hold no cycles."""

_SWITCH_S = 0.0005
"""How long a busy thread may hold the interpreter lock [s]; Python's default is 5 ms."""


def avoid_pauses() -> None:
    """Prevent long pauses of Python. Call once, after everything is loaded, before serving.

    A full garbage collection visits every object of every imported module, which takes 10 ms or
    more: the whole period of a frame. These objects live as long as the process, so the collector
    is told to ignore them (``gc.freeze``).
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(_YOUNG_OBJECTS, 20, 50)
    sys.setswitchinterval(_SWITCH_S)
