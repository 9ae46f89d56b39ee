"""A desk without a network: what a page installs comes from this checkout and this environment.

The page's own ``python3 -m venv``, ``pip install`` and ``make demo`` run. pip gets palpate from a
wheel of this checkout; everything else stands beside it already, as the packages of the environment
that runs the tests.
"""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from tests.readers.desk import CHECKOUT, Desk
from tests.readers.page import blocks_of
from tests.readers.readers import DATA, ROOT

ROUTER = "127.0.0.1:7447"
"""Where a station listens if its profile says nothing else."""
OWN = ("palpate", "_editable_impl_palpate", "_palpate", "pip", "setuptools", "distutils-precedence")
"""What an environment of a page gets by itself, or not at all."""


def follow(path: Path, folder: Path, port: int) -> list[str]:
    """Do what a page says; which commands were left out, and why.

    Raises:
        Unexpected: Something is not as the page says.
    """
    if any("installs" in block.marks for block in blocks_of(path.read_text(encoding="utf-8"))):
        build_wheel(folder / "dist")
    with offline_desk(folder, port) as desk:
        left_out = desk.follow(path)
        desk.end_page()
    return left_out


@contextmanager
def offline_desk(folder: Path, port: int) -> Iterator[Desk]:
    """A folder like a checkout, and terminals whose commands meet on a router of their own."""
    for part in ("docs", "training"):
        (folder / part).symlink_to(ROOT / part)
    endpoint = f"tcp/127.0.0.1:{port}"
    variables = {
        name: value for name, value in os.environ.items() if not name.startswith("PALPATE_")
    } | {
        "PATH": f"{_commands(folder)}:{os.environ['PATH']}",
        "PALPATE_ROUTER__LISTEN": f'["{endpoint}"]',
        "PALPATE_CONNECT": endpoint,
        "PYTHONPATH": _packages(folder),
        "DATA": str(DATA),
        "PIP_NO_BUILD_ISOLATION": "0",  # pip reads it as the option's value: no isolation
        "PIP_NO_DEPS": "1",
        "PIP_NO_INDEX": "1",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
    }
    for name in ("VIRTUAL_ENV", "MAKEFLAGS", "MFLAGS", "MAKELEVEL"):
        variables.pop(name, None)
    here = {CHECKOUT: str(ROOT), ROUTER: f"127.0.0.1:{port}"}
    with Desk(folder, variables, here=here, data=DATA) as desk:
        yield desk


def _commands(folder: Path) -> Path:
    """A folder with `palpate`, `python` and `pip` of this interpreter, also if not installed."""
    commands = folder / "commands"
    commands.mkdir()
    path = os.pathsep.join([str(folder / "installed"), *filter(None, sys.path)])
    run = f'PYTHONPATH="{path}" exec "{sys.executable}"'
    # A profile that is installed says itself where its router listens.
    installed = '[ "$1" = install ] && unset PALPATE_ROUTER__LISTEN\n'
    texts = {
        "palpate": f'{installed}{run} -m palpate_deploy "$@"',
        "python": f'{run} "$@"',
        "python3": f'exec "{sys.executable}" "$@"',  # to make environments with
        "pip": f'PIP_TARGET="{folder / "installed"}" {run} -m pip "$@"',
    }
    for name, text in texts.items():
        (commands / name).write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
        (commands / name).chmod(0o755)
    return commands


def _packages(folder: Path) -> str:
    """Search path with every installed package but palpate, so that pip finds that one missing."""
    packages = folder / "packages"
    packages.mkdir()
    sites = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    for site in sites:
        for entry in Path(site).iterdir():
            if not entry.name.startswith(OWN):
                (packages / entry.name).symlink_to(entry)
    below = [path for path in sys.path if any(path.startswith(f"{site}/") for site in sites)]
    return os.pathsep.join([str(packages), *below])


def build_wheel(dist: Path) -> None:
    """What `make build` writes there."""
    name, content = _wheel()
    dist.mkdir(parents=True, exist_ok=True)
    (dist / name).write_bytes(content)


@cache
def _wheel() -> tuple[str, bytes]:
    """Name and content of the wheel of this checkout: built once, it is the same for every page."""
    with tempfile.TemporaryDirectory() as dist:
        program = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", dist]
        done = subprocess.run(
            program, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False
        )
        assert done.returncode == 0, done.stderr
        (wheel,) = Path(dist).glob("*.whl")
        return wheel.name, wheel.read_bytes()
