"""Systems in folders, to install into."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.install.cases import PROFILES, VIRTUAL

from palpate_deploy.install import service
from palpate_deploy.install.plan import InstallOrder

PROGRAM = "/opt/palpate/bin/palpate"

Install = Callable[..., None]


@pytest.fixture(autouse=True)
def plain_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """No setting of the user in a test."""
    for name in [name for name in os.environ if name.upper().startswith("PALPATE_")]:
        monkeypatch.delenv(name)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """The root of a system: as bare as Debian's smallest, with a file of somebody else."""
    root = tmp_path / "root"
    for folder in ("etc/systemd/system/multi-user.target.wants", "usr/lib", "var/lib", "var/cache"):
        (root / folder).mkdir(parents=True)
    (root / "etc/systemd/system/other.service").write_text("[Service]\n")
    return root


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    """A profile of the virtual finger."""
    path = tmp_path / "lab.toml"
    path.write_text(VIRTUAL, encoding="utf-8")
    return path


@pytest.fixture(params=sorted(PROFILES))
def case(request: pytest.FixtureRequest) -> str:
    """Each profile of ``PROFILES``, by name."""
    return str(request.param)


@pytest.fixture
def install(root: Path, profile: Path) -> Install:
    """Install the profile, or another one, into the system."""

    def run(
        source: Path | str = profile, *, name: str = "", program: str = PROGRAM, **more: object
    ) -> None:
        service.install(InstallOrder(str(source), name, root, program, **more))  # type: ignore[arg-type]

    return run


@pytest.fixture
def this_host(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Let the system in the folder be this host, run by systemd; the file with what it was told.

    A file of that name with ``.fail`` makes the commands that it names fail; empty = all.
    """
    told = tmp_path / "systemctl.log"
    told.touch()
    programs = tmp_path / "programs"
    programs.mkdir()
    for name in ("systemctl", "udevadm"):
        script = programs / name
        fails = f'[ -e {told}.fail ] && {{ [ ! -s {told}.fail ] || grep -qx "$1" {told}.fail; }}'
        script.write_text(f'#!/bin/sh\necho {name} "$@" >> {told}\n! {{ {fails}; }}\n')
        script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    monkeypatch.setattr("palpate_deploy.install.ledger.Host.is_this_host", True)
    monkeypatch.setattr("palpate_deploy.install.ledger.Host.is_running", True)
    return told
