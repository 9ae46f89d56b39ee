"""Files that a command is asked to write, checked before it computes."""

from __future__ import annotations

import os
from pathlib import Path

from palpate.config import looking_at
from palpate.errors import ConfigError


def check_output(path: Path | None, option: str, ending: str, *inputs: Path | None) -> None:
    """Before a computation: whether its result can be written to a file, if one is named.

    Args:
        path: The file; one that is there is replaced, if it has the ending.
        option: What names it, for the error.
        ending: Of its name: a file of another kind was named by mistake.
        inputs: What the command reads.

    Raises:
        ConfigError: It has another ending, is an input or a folder, or its folder takes no file.
    """
    if path is None:
        return
    if path.suffix != ending:
        raise ConfigError(
            f"{option} {path} does not end in {ending}", remedy=f"name a file NAME{ending}"
        )
    with looking_at(path):
        is_folder = path.is_dir()
    if is_folder:
        raise ConfigError(f"{option} {path} is a folder", remedy=f"name a file NAME{ending}")
    if any(one is not None and one.resolve() == path.resolve() for one in inputs):
        raise ConfigError(f"{option} {path} is what the command reads", remedy="name another file")
    check_folder(path.absolute().parent, option)


def check_folder(path: Path, option: str) -> None:
    """Before a computation: whether files can be written into a folder, which may not exist yet.

    Raises:
        ConfigError: It is a file, or may not be made or written.
    """
    with looking_at(path):
        there = next(one for one in (path, *path.absolute().parents) if one.exists())
    if not there.is_dir():
        raise ConfigError(f"{option}: {there} is no folder", remedy="name another one")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"{option}: {there} may not be written", remedy="name another folder")
