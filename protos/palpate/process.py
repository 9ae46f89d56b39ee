"""What every process of palpate needs: how things are closed, optional packages, no pauses."""

from __future__ import annotations

import gc
import importlib
import shlex
import sys
from abc import ABC, abstractmethod
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Self

from palpate.errors import MissingExtraError


class Closing(ABC):
    """Closed at the end of its ``with`` block, on every path."""

    @abstractmethod
    def close(self) -> None:
        """Let go of what it holds."""

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


def typed_command() -> str:
    """The command line as typed, without the folder of the program."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


_YOUNG_OBJECTS = 50_000
"""Collect after so many new container objects; frames and estimates hold no cycles."""

_SWITCH_S = 0.0005
"""How long a busy thread may keep another from the interpreter [s]; Python's default is 5 ms."""


def avoid_pauses() -> None:
    """Call once, when everything is imported and loaded and the first frame may come.

    A full garbage collection looks at every object of every imported module, which takes 10 ms and
    more: a frame's whole period. Those objects live as long as the process, so they are taken out
    of its sight.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(_YOUNG_OBJECTS, 20, 50)
    sys.setswitchinterval(_SWITCH_S)
